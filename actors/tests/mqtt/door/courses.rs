//! Exactly the maps that a node accepted, while the lead is handed over and behind an external broker.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use ecod::aggregator::Algorithms;
use ecod::leadership::Position;
use ecod::model::names::NodeName;
use ecod::wire::{NodeState, NodeStatus, Reputation, Reputations, Role, Verdicts};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::LastWill;
use rumqttc::v5::{AsyncClient, MqttOptions};
use tokio::time::{sleep, timeout};

use crate::door::cell::{Cell, PATIENCE, Program};
use crate::door::reported;
use crate::mosquitto::Mosquitto;

const MAPS: &[&str] = &["global_detections"];

pub(crate) async fn planners<'a>(cell: &Cell, nodes: &[&'a str]) -> Vec<(&'a str, Program)> {
    let mut planners = Vec::new();
    for node in nodes {
        planners.push((*node, cell.program("planner", node, MAPS).await));
    }
    planners
}

pub(crate) fn leaders<const N: usize>(names: [&str; N]) -> BTreeSet<String> {
    names.map(str::to_owned).into()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn planned_handover_keeps_maps_complete() {
    let mut cell = Cell::new();
    for (name, role, priority) in [
        ("gauss", Role::Auto, 200),
        ("noether", Role::Auto, 100),
        ("euclid", Role::Cav, 100),
    ] {
        cell.start(name, role, |config| config.election.priority = priority)
            .await;
    }
    cell.served_by("gauss").await;
    cell.stands_by("noether").await;
    let planners = planners(&cell, &["gauss", "noether", "euclid"]).await;
    sleep(Duration::from_millis(500)).await;
    cell.start("edge", Role::Edge, |_| ()).await;
    cell.served_by("edge").await;
    sleep(Duration::from_millis(500)).await;
    for seen in cell.have_exactly(&planners).await {
        assert_eq!(seen, leaders(["gauss", "edge"]));
    }
    drop(planners);
    cell.stop().await;
}

fn messages<T: serde::de::DeserializeOwned>(program: &Program, topic: &str) -> Vec<T> {
    program
        .received_on(topic)
        .iter()
        .map(|heard| serde_json::from_slice(&heard.payload).unwrap())
        .collect()
}

/// The newest reputations that a program got of this leader.
fn reputations_by(program: &Program, leader: &str) -> Option<BTreeMap<NodeName, Reputation>> {
    let all = messages::<Reputations>(program, "reputations").into_iter();
    let of_leader = |message: &Reputations| {
        message
            .aggregator
            .as_ref()
            .is_some_and(|name| name.as_str() == leader)
    };
    all.filter(of_leader)
        .last()
        .map(|message| message.reputations)
}

fn votes_of(program: &Program, leader: &str, voter: &str) -> u64 {
    let reputations = reputations_by(program, leader).unwrap_or_default();
    reputations
        .get(&NodeName::new(voter).unwrap())
        .map_or(0, |reputation| reputation.correct)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn outputs_survive_leader_kill() {
    let mut cell = Cell::of_four_with(|config| {
        config.fusion.vote.weighted.freshness_s = 0.2;
        config.reputations.publish_period_s = 0.1;
    })
    .await;
    let mut voters = Vec::new();
    let mut displays = Vec::new();
    for node in ["gauss", "noether", "euclid"] {
        voters.push((
            format!("{node}--lidar"),
            cell.program("lidar", node, &[]).await,
        ));
        displays.push(
            cell.program(
                "display",
                node,
                &["global_verdicts", "reputations", "nodes/+"],
            )
            .await,
        );
    }
    let votes = async |seqs: std::ops::Range<u64>, holds: &dyn Fn() -> bool| {
        let voting = async {
            for seq in seqs {
                for (name, voter) in &voters {
                    voter.vote(name, seq, "east").await;
                }
                sleep(Duration::from_millis(50)).await;
                if holds() {
                    return;
                }
            }
        };
        timeout(PATIENCE, voting).await.expect("votes count");
    };
    votes(0..10_000, &|| {
        displays
            .iter()
            .all(|display| votes_of(display, "edge", "euclid") > 3)
    })
    .await;
    // The last votes become evidence, which the edge sends to the others.
    sleep(Duration::from_secs(3)).await;
    let before: Vec<_> = displays
        .iter()
        .map(|display| reputations_by(display, "edge").unwrap())
        .collect();
    assert!(
        before.iter().all(|reputations| *reputations == before[0]),
        "{before:?}"
    );

    cell.kill("edge");
    cell.served_by("gauss").await;
    let known = |_: &Cell| {
        displays
            .iter()
            .all(|display| reputations_by(display, "gauss").as_ref() == Some(&before[0]))
    };
    cell.until("the reputations are as before at each door", known)
        .await;
    let counted = votes_of(&displays[0], "gauss", "euclid");
    votes(10_000..20_000, &|| {
        displays
            .iter()
            .all(|display| votes_of(display, "gauss", "euclid") > counted)
    })
    .await;
    for display in &displays {
        let verdicts: Vec<Verdicts> = messages(display, "global_verdicts");
        let rounds: Vec<_> = verdicts
            .iter()
            .map(|message| (message.epoch, message.round))
            .collect();
        assert!(
            rounds.windows(2).all(|pair| pair[0] < pair[1]),
            "in order, none twice: {rounds:?}"
        );
        let by: BTreeSet<_> = verdicts
            .iter()
            .map(|message| message.aggregator.to_string())
            .collect();
        assert_eq!(by, leaders(["edge", "gauss"]));
        let last = |node: &str| messages::<NodeStatus>(display, &format!("nodes/{node}")).pop();
        cell.until("each status states the leader", |_| {
            let is = |node, state| last(node).is_some_and(|status| status.state == state);
            let follows = |node| {
                last(node).is_some_and(|status| {
                    status.aggregator.is_some_and(|by| by.as_str() == "gauss")
                })
            };
            is("edge", NodeState::Offline)
                && is("gauss", NodeState::Aggregating)
                && follows("noether")
                && follows("euclid")
        })
        .await;
    }
    drop((voters, displays));
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nodeless_vehicle_may_precede_leader() {
    let mut cell = Cell::new();
    cell.start("edge", Role::Edge, |config| config.election.join_ms = 3000)
        .await;
    let euclid = cell.program("planner", "edge", &[]).await;
    let empty = br#"{"schema":1,"node":"euclid--yolo","seq":1,"captured_at_us":1,"objects":[]}"#;
    let answer = euclid.ask("detections/euclid--yolo", empty.to_vec()).await;
    let position = cell.node("edge").leadership().borrow().position;
    assert_eq!(
        (answer.0.as_str(), position),
        ("Success", Position::Seeking),
        "{}",
        answer.1
    );
    reported(&cell, &euclid, "euclid--yolo", "edge", 3.1, "euclid").await;
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nodeless_vehicle_leaves_last_will() {
    let mut cell = Cell::new();
    cell.start("edge", Role::Edge, |_| ()).await;
    cell.served_by("edge").await;
    let watcher = cell.program("watcher", "edge", &["nodes/+"]).await;
    let door = cell.door("edge");
    let status = r#"{"schema":1,"node":"euclid","id":"01a1fca2-b074-775a-88b5-e92725a307f1","role":"cav","state":"offline","epoch":0,"version":"9"}"#;
    let login = async |name: &str, topic: &str| {
        let mut options = MqttOptions::new(name, door.ip().to_string(), door.port());
        let topic = format!("ecod/v1/lot/{topic}");
        options.set_last_will(LastWill::new(topic, status, QoS::AtLeastOnce, true, None));
        let (_client, mut events) = AsyncClient::new(options, 4);
        // The connection ends here without a farewell.
        events.poll().await.is_ok()
    };
    assert!(login("euclid", "nodes/euclid").await);
    for topic in ["nodes/edge", "global_detections", "detections/edge"] {
        assert!(!login("gauss", topic).await, "{topic}");
    }
    let published = async {
        while watcher.received_on("nodes/euclid").is_empty() {
            sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, published).await.unwrap();
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn endless_names_leave_status_room() {
    let mut cell = Cell::new();
    cell.start("edge", Role::Edge, |_| ()).await;
    cell.served_by("edge").await;
    let mallory = cell.program("mallory", "edge", &[]).await;
    let status = async |n: usize, text: &str| {
        mallory
            .ask_retained(&format!("nodes/x{n}"), text.as_bytes().to_vec(), true)
            .await
    };
    for n in 0..256 {
        assert_eq!(status(n, "hello").await.0, "Success", "{n}");
    }
    let (reason, text) = status(256, "hello").await;
    assert!(
        reason == "NotAuthorized" && text.contains("256 vehicles without a node"),
        "{reason} {text}"
    );
    let watcher = cell.program("watcher", "edge", &["nodes/+"]).await;
    let door = cell.door("edge");
    for name in ["x999", "x7"] {
        let mut options = MqttOptions::new(name, door.ip().to_string(), door.port());
        let topic = format!("ecod/v1/lot/nodes/{name}");
        let status = format!(
            r#"{{"schema":1,"node":"{name}","id":"01a1fca2-b074-775a-88b5-e92725a307f1","role":"cav","state":"offline","epoch":0,"version":"9"}}"#
        );
        options.set_last_will(LastWill::new(topic, status, QoS::AtLeastOnce, true, None));
        let (_client, mut events) = AsyncClient::new(options, 4);
        assert!(events.poll().await.is_ok(), "{name}");
    }
    let published = async {
        while watcher.received_on("nodes/x7").is_empty() {
            sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, published).await.unwrap();
    assert!(
        watcher.received_on("nodes/x999").is_empty(),
        "a last will beyond the room"
    );
    assert_eq!(status(7, "hello again").await.0, "Success", "its own place");
    assert_eq!(status(8, "").await.0, "Success", "it gives up its place");
    assert_eq!(status(256, "hello").await.0, "Success");
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unusable_messages_are_refused() {
    let mut cell = Cell::new();
    cell.start("edge", Role::Edge, |config| {
        config.fusion.algorithms = Algorithms::Pace;
    })
    .await;
    cell.served_by("edge").await;
    let program = cell.program("planner", "edge", &[]).await;
    let report = |name: &str| {
        format!(r#"{{"schema":1,"node":"{name}","seq":1,"captured_at_us":1,"objects":[]}}"#)
            .into_bytes()
    };
    let (reason, text) = program.ask("vote_detections/edge", report("edge")).await;
    assert!(
        reason == "PayloadFormatInvalid" && text.contains("`fusion.algorithms`"),
        "{reason} {text}"
    );
    for part in 0..16 {
        let name = format!("edge--{part}");
        assert_eq!(
            program
                .ask(&format!("detections/{name}"), report(&name))
                .await
                .0,
            "Success",
            "{name}"
        );
    }
    let (reason, text) = program.ask("detections/edge--16", report("edge--16")).await;
    assert!(
        reason == "PayloadFormatInvalid" && text.contains("has 16 parts that report"),
        "{reason} {text}"
    );
    assert_eq!(
        program.ask("detections/edge--7", report("edge--7")).await.0,
        "Success",
        "it has its place"
    );
    assert_eq!(
        program.ask("detections/edge", report("edge")).await.0,
        "Success",
        "the node is no part"
    );
    cell.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn mosquitto_maps_survive_leader_kill() {
    let mosquitto = Mosquitto::start();
    let mut cell = Cell::new();
    for (name, role, priority) in [
        ("gauss", Role::Auto, 200),
        ("noether", Role::Auto, 100),
        ("euclid", Role::Cav, 100),
    ] {
        cell.start(name, role, |config| {
            config.election.priority = priority;
            config.mqtt.broker = Some(mosquitto.address());
        })
        .await;
    }
    cell.served_by("gauss").await;
    cell.stands_by("noether").await;
    let planners = planners(&cell, &["noether", "euclid"]).await;
    let lidar = cell.program("lidar", "euclid", &[]).await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 3.1, "euclid").await;
    cell.kill("gauss");
    cell.served_by("noether").await;
    reported(&cell, &lidar, "euclid--lidar", "noether", 2.9, "euclid").await;
    for seen in cell.have_exactly(&planners).await {
        assert_eq!(seen, leaders(["gauss", "noether"]));
    }
    drop(planners);
    cell.stop().await;
}
