//! Programs next to nodes: with any leader, each program participates in the cell at its own node's broker.

mod boxes;
mod cell;
mod certificates;
mod courses;
mod process;
mod readers;
mod websocket;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use ecod::wire::{GlobalMap, Role, Verdicts, decode};
use ecod_actors::node::NodeHandle;
use ecod_actors::telemetry::counters::ShedReason;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};

use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{Packet, SubscribeProperties};
use rumqttc::v5::{AsyncClient, Event, MqttOptions};

use cell::{Cell, PATIENCE, Program, Round};
use process::Node;

fn is_at_east(node: &NodeHandle, x_m: f64, contributor: &str) -> bool {
    node.newest_map()
        .borrow()
        .as_ref()
        .is_some_and(|received| shows(&received.map, x_m, contributor))
}

fn shows(map: &GlobalMap, x_m: f64, contributor: &str) -> bool {
    let east = &map.landmarks[1];
    (east.x_m - x_m).abs() < 1e-3
        && east
            .contributors
            .iter()
            .any(|name| name.as_str() == contributor)
}

/// True if a program got the last of these maps.
fn has_last(program: &Program, accepted: &[(Round, Instant)]) -> bool {
    let (last, _) = accepted.last().unwrap();
    program.rounds().iter().any(|(round, _)| round == last)
}

/// Reports until a node's map shows it.
pub(crate) async fn reported(
    cell: &Cell,
    program: &Program,
    name: &str,
    viewer: &str,
    x_m: f64,
    contributor: &str,
) {
    let shown = async {
        for seq in 0.. {
            program.report("detections", name, seq, x_m).await;
            tokio::time::sleep(Duration::from_millis(50)).await;
            if is_at_east(cell.node(viewer), x_m, contributor) {
                return;
            }
        }
    };
    tokio::time::timeout(PATIENCE, shown)
        .await
        .unwrap_or_else(|_| panic!("{name} at {x_m} never shown"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn maps_survive_leader_kill() {
    let mut cell = Cell::of_four().await;
    let mut programs = Vec::new();
    for name in ["edge", "gauss", "noether", "euclid"] {
        let program = Program::connect("planner", cell.door(name), &["global_detections"]).await;
        programs.push((name, cell.watch(name), program));
    }
    tokio::time::sleep(Duration::from_secs(2)).await;
    let at_edge = programs[0].1.lock().unwrap().clone();
    cell.until("the edge's program has its maps", |_| {
        has_last(&programs[0].2, &at_edge)
    })
    .await;
    cell.kill("edge");
    cell.served_by("gauss").await;
    tokio::time::sleep(Duration::from_secs(2)).await;
    for (name, accepted, program) in &programs {
        let accepted = if *name == "edge" {
            at_edge.clone()
        } else {
            accepted.lock().unwrap().clone()
        };
        cell.until("the program has its node's maps", |_| {
            has_last(program, &accepted)
        })
        .await;
        let got = program.rounds();
        let rounds = |list: &[(Round, Instant)]| {
            list.iter()
                .map(|(round, _)| round.clone())
                .collect::<Vec<_>>()
        };
        let accepted_rounds = rounds(&accepted);
        let got_rounds = rounds(&got);
        assert!(
            got_rounds.windows(2).all(|pair| pair[0] < pair[1]),
            "{name}: in order, none twice: {got_rounds:?}"
        );
        // The watch may skip a map; it may begin later and end earlier than the client.
        let missing: Vec<_> = accepted_rounds
            .iter()
            .filter(|round| !got_rounds.contains(round))
            .collect();
        assert!(missing.is_empty(), "{name}: {missing:?}");
        let leaders: Vec<_> = got_rounds
            .iter()
            .map(|(_, leader, _)| leader.as_str())
            .collect();
        assert!(leaders.contains(&"edge"), "{name}: {leaders:?}");
        assert!(
            *name == "edge" || leaders.last() == Some(&"gauss"),
            "{name}: {leaders:?}"
        );
        let longest =
            |list: &[(Round, Instant)]| list.windows(2).map(|pair| pair[1].1 - pair[0].1).max();
        let mut behind: Vec<_> = got
            .iter()
            .filter_map(|(round, at)| {
                let (_, node_at) = accepted.iter().find(|(accepted, _)| accepted == round)?;
                Some(at.saturating_duration_since(*node_at))
            })
            .collect();
        behind.sort();
        println!(
            "{name}: {} maps; longest gap {:?} at the node, {:?} at the door; behind the node {:?} median, {:?} at most",
            got.len(),
            longest(&accepted),
            longest(&got),
            behind.get(behind.len() / 2),
            behind.last()
        );
    }
    drop(programs);
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn any_broker_port_accepts_detector() {
    let mut cell = Cell::of_four().await;
    let lidar = Program::connect("lidar", cell.door("euclid"), &[]).await;
    let radar = Program::connect("radar", cell.door("noether"), &[]).await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 3.1, "euclid").await;
    reported(&cell, &radar, "noether", "euclid", 2.9, "noether").await;
    cell.kill("edge");
    cell.served_by("gauss").await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 3.2, "euclid").await;
    reported(&cell, &radar, "noether", "euclid", 2.8, "noether").await;
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leader_and_standby_get_report_once() {
    let cell = Cell::of_four().await;
    let lidar = Program::connect("lidar", cell.door("euclid"), &[]).await;
    // Each aggregator counts rejected reports by sender.
    let report = br#"{"schema":1,"node":"euclid--lidar","seq":1,"captured_at_us":1,"objects":[]}"#;
    assert_eq!(
        lidar
            .ask("detections/euclid--lidar", report.to_vec())
            .await
            .0,
        "Success"
    );
    let taken = |name: &str| -> u64 {
        let rejects = cell.node(name).counters().rejects_by_source();
        rejects
            .iter()
            .filter(|count| count.source == "euclid--lidar")
            .map(|count| count.times)
            .sum()
    };
    cell.until("edge and gauss have it", |_| {
        taken("edge") > 0 && taken("gauss") > 0
    })
    .await;
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert_eq!(
        ["edge", "gauss", "noether", "euclid"].map(taken),
        [1, 1, 0, 0]
    );
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn program_receives_all_messages() {
    let cell = Cell::of_four().await;
    let lidar = Program::connect("lidar", cell.door("gauss"), &[]).await;
    let filters = ["nodes/+", "reputations", "detections/+"];
    let mut displays = Vec::new();
    for name in ["euclid", "edge", "noether"] {
        displays.push((
            name,
            Program::connect("display", cell.door(name), &filters).await,
        ));
    }
    // A report reaches a door as soon as its node has subscribed to reports at the leader's broker.
    let heard = |display: &Program, topic: &str| !display.received_on(topic).is_empty();
    let probed = async {
        for seq in 0.. {
            lidar.report("detections", "gauss--probe", seq, 0.0).await;
            tokio::time::sleep(Duration::from_millis(50)).await;
            if displays
                .iter()
                .all(|(_, display)| heard(display, "detections/gauss--probe"))
            {
                return;
            }
        }
    };
    tokio::time::timeout(PATIENCE, probed)
        .await
        .expect("reports reach all doors");
    let reporters = ["gauss--lidar", "gauss"];
    for seq in 0..10 {
        for reporter in reporters {
            lidar.report("detections", reporter, seq, 3.0).await;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let seqs = |display: &Program, reporter: &str| -> Vec<u64> {
        let seq = |payload: &[u8]| {
            decode::<ecod::wire::ObjectReport>(payload, &Default::default())
                .unwrap()
                .seq
        };
        display
            .received_on(&format!("detections/{reporter}"))
            .iter()
            .map(|heard| seq(&heard.payload))
            .collect()
    };
    for (name, display) in &displays {
        for topic in cell
            .names()
            .iter()
            .map(|node| format!("nodes/{node}"))
            .chain(["reputations".into()])
        {
            cell.until(&format!("{name}: {topic}"), |_| heard(display, &topic))
                .await;
        }
        for reporter in reporters {
            cell.until(&format!("{name}: {reporter}'s last report"), |_| {
                seqs(display, reporter).contains(&9)
            })
            .await;
            let reports = seqs(display, reporter);
            assert_eq!(
                reports,
                (0..10).collect::<Vec<_>>(),
                "{name}: each report of {reporter} once"
            );
        }
    }
    drop(displays);
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unread_topic_has_no_success() {
    let node = Node::start();
    let door = node.door().await;
    let program = Program::connect("planner", door, &[]).await;
    for topic in ["detection/edge--lidar", "nonsense", "global_detection"] {
        let (reason, text) = program.ask(topic, b"{}".to_vec()).await;
        assert_eq!(reason, "TopicNameInvalid", "{topic}");
        assert!(text.contains(topic) && text.contains("edge--"), "{text}");
    }
    let _reader = Program::connect("display", door, &["+"]).await;
    let (reason, _) = program.ask("nonsense", b"{}".to_vec()).await;
    assert_eq!(reason, "Success", "a program reads it");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_name_their_subscription() {
    let node = Node::start();
    let door = node.door().await;
    let options = MqttOptions::new("display", door.ip().to_string(), door.port());
    let (client, mut events) = AsyncClient::new(options, 8);
    for (id, filter) in [(7, "ecod/v1/lot/global_detections"), (8, "pictures")] {
        let properties = SubscribeProperties {
            id: Some(id),
            user_properties: Vec::new(),
        };
        client
            .subscribe_with_properties(filter, QoS::AtMostOnce, properties)
            .await
            .unwrap();
    }
    client
        .publish("pictures", QoS::AtMostOnce, false, "x")
        .await
        .unwrap();
    let mut seen = BTreeMap::new();
    let all = async {
        while seen.len() < 2 {
            if let Event::Incoming(Packet::Publish(publish)) = events.poll().await.unwrap() {
                let ids = publish.properties.map(|p| p.subscription_identifiers);
                seen.insert(publish.topic, ids.unwrap_or_default());
            }
        }
    };
    tokio::time::timeout(PATIENCE, all).await.unwrap();
    let ids: Vec<_> = seen.into_values().collect();
    assert_eq!(ids, [vec![7], vec![8]]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn foreign_name_is_refused() {
    let cell = Cell::of_four().await;
    for name in ["euclid", "noether"] {
        let program = Program::connect(
            "mallory",
            cell.door(name),
            &["nodes/+/clients", "global_detections", "nodes/+"],
        )
        .await;
        let own = format!("{name}--lidar");
        let payload = |node: &str| {
            format!(r#"{{"schema":1,"node":"{node}","seq":1,"captured_at_us":1,"objects":[]}}"#)
                .into_bytes()
        };
        assert_eq!(
            program
                .ask(&format!("detections/{own}"), payload(&own))
                .await
                .0,
            "Success"
        );
        for topic in [
            "detections/gauss",
            "vote_detections/edge--lidar",
            "global_detections",
            "nodes/gauss",
            "ledger/gauss",
        ] {
            let (reason, text) = program.ask(topic, payload("gauss")).await;
            assert_eq!(reason, "NotAuthorized", "{topic}");
            assert!(text.contains(name), "{topic}: {text}");
        }
        let (reason, text) = program
            .ask(&format!("detections/{own}"), payload("gauss"))
            .await;
        let is_told = text.contains("node_mismatch (it names gauss)");
        assert!(
            reason == "PayloadFormatInvalid" && is_told,
            "{reason} {text}"
        );
        let without_seq =
            format!(r#"{{"schema":1,"node":"{own}","captured_at_us":1,"objects":[]}}"#)
                .into_bytes();
        for (payload, flaw) in [
            (without_seq, "missing field `seq`"),
            (b"garbage".to_vec(), "expected value, at column 1"),
        ] {
            let (_, text) = program.ask(&format!("detections/{own}"), payload).await;
            assert!(text.contains("malformed") && text.contains(flaw), "{text}");
        }
        let rejects = cell.node(name).counters().rejects_by_source();
        let denied = rejects
            .iter()
            .find(|count| count.source == "mallory" && count.reason.as_str() == "not_permitted");
        assert_eq!(denied.map(|count| count.times), Some(5));
        let statuses = program.received_on(&format!("nodes/{name}/clients"));
        let late = Program::connect("late", cell.door(name), &["nodes/+/clients"]).await;
        let retained = || late.received_on(&format!("nodes/{name}/clients"));
        cell.until("the retained status", |_| !retained().is_empty())
            .await;
        for heard in [statuses.last().expect("a status"), &retained()[0]] {
            let status: serde_json::Value = serde_json::from_slice(&heard.payload).unwrap();
            assert_eq!(
                (&status["node"], &status["refused"][0]["client"]),
                (&name.into(), &"mallory".into()),
                "{status}"
            );
        }
        let forged = program
            .received_on("global_detections")
            .iter()
            .any(|heard| heard.payload == payload("gauss"));
        assert!(
            !forged
                && program
                    .received_on("nodes/gauss")
                    .iter()
                    .all(|heard| heard.payload != payload("gauss"))
        );
    }
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn refused_program_is_logged_once() {
    let node = Node::start();
    let program = Program::connect("mallory", node.door().await, &[]).await;
    for topic in ["global_detections", "global_verdicts", "global_detections"] {
        assert_eq!(program.ask(topic, b"{}".to_vec()).await.0, "NotAuthorized");
    }
    let log = node.log();
    let refusals: Vec<_> = log
        .lines()
        .filter(|line| line.contains("WARN") && line.contains("mallory"))
        .collect();
    assert!(
        matches!(refusals[..], [line] if line.contains("not_permitted")),
        "{log}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn follower_port_accepts_votes() {
    let cell = Cell::of_four().await;
    let lidar = Program::connect("lidar", cell.door("euclid"), &[]).await;
    let display = Program::connect("display", cell.door("noether"), &["global_verdicts"]).await;
    let is_voted = || {
        let verdicts = display.received_on("global_verdicts").into_iter();
        let mut verdicts =
            verdicts.map(|heard| decode::<Verdicts>(&heard.payload, &Default::default()).unwrap());
        verdicts.any(|message| {
            let east = message
                .verdicts
                .iter()
                .find(|verdict| &*verdict.landmark == "east")
                .unwrap();
            east.label.as_deref() == Some("car")
                && east
                    .contributors
                    .iter()
                    .any(|name| name.as_str() == "euclid")
        })
    };
    let voted = async {
        for seq in 0.. {
            lidar.vote("euclid--lidar", seq, "east").await;
            tokio::time::sleep(Duration::from_millis(50)).await;
            if is_voted() {
                return;
            }
        }
    };
    tokio::time::timeout(PATIENCE, voted)
        .await
        .expect("a verdict by the vote");
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn flooding_program_is_harmless() {
    let cell = Cell::of_four().await;
    let flood = Program::connect("flood", cell.door("euclid"), &[]).await;
    let quiet = Program::connect("radar", cell.door("noether"), &[]).await;
    let flooding = async {
        for seq in 0..3000 {
            flood.report("detections", "euclid--flood", seq, 0.0).await;
            if seq % 10 == 0 {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        }
    };
    tokio::join!(
        flooding,
        reported(&cell, &quiet, "noether--radar", "euclid", 3.1, "noether")
    );
    let shed = cell.node("euclid").counters().all_shed();
    let throttled = [ShedReason::ReportThrottled, ShedReason::BrokerThrottled];
    assert!(
        shed.iter()
            .any(|shed| shed.source == "flood" && throttled.contains(&shed.reason)),
        "{shed:?}"
    );
    let elsewhere = cell.node("edge").counters().all_shed();
    assert!(
        elsewhere
            .iter()
            .all(|shed| shed.source.starts_with("euclid")),
        "{elsewhere:?}"
    );
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn external_broker_keeps_broker_port() {
    let mut outside = EmbeddedBroker::new(BrokerConfig::default());
    let broker = outside
        .start(std::net::SocketAddr::from(([127, 0, 0, 1], 0)))
        .unwrap();
    let mut cell = Cell::new();
    for (name, role) in [("gauss", Role::Auto), ("euclid", Role::Cav)] {
        cell.start(name, role, |config| {
            config.mqtt.broker = Some(broker.into());
        })
        .await;
    }
    cell.served_by("gauss").await;
    for name in ["gauss", "euclid"] {
        assert_eq!(
            cell.node(name).broker_address(),
            None,
            "no node receives the address of a door"
        );
        let program = Program::connect("lidar", cell.door(name), &["global_detections"]).await;
        reported(
            &cell,
            &program,
            &format!("{name}--lidar"),
            "euclid",
            3.1,
            name,
        )
        .await;
        cell.until("the program has a round", |_| !program.rounds().is_empty())
            .await;
    }
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn broker_port_can_be_disabled() {
    let cell = Cell::of_four_with(|config| config.broker.door = false).await;
    assert_eq!(cell.node("euclid").listens_at(), None);
    assert!(cell.node("noether").listens_at().is_some(), "for nodes");
    cell.stop().await;
}
