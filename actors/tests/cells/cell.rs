//! A cell of nodes in one process: reports become maps on every vehicle, whatever part of a node ends.

use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::Position;
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{GlobalMap, ObjectReport, PerceivedObject, ReportKind, Role, Trouble};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::observe::recorder::RecordConfig;
use ecod_actors::platform::clock;
use ecod_testkit::node_config;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(20);

fn config(name: &str, role: Role) -> NodeConfig {
    let slot = |n: i32| LandmarkConfig::at(format!("slot-{n}"), f64::from(n) * 3.0, 0.0);
    NodeConfig {
        landmarks: (0..3).map(slot).collect(),
        ..node_config(name, "lot-1", role)
    }
}

async fn edge() -> NodeHandle {
    node::start(config("edge", Role::Edge)).await.unwrap()
}

async fn cav(name: &str, edge: &NodeHandle) -> NodeHandle {
    let mut config = config(name, Role::Cav);
    config.mqtt.broker = edge.broker_address().map(Into::into);
    config.mqtt.retry_max_ms = 100;
    config.validate().unwrap();
    node::start(config).await.unwrap()
}

fn report(node: &str, label: &str, slot: i32) -> Arc<ObjectReport> {
    Arc::new(ObjectReport {
        objects: vec![PerceivedObject::new(
            label,
            0.9,
            f64::from(slot) * 3.0 + 0.1,
            0.0,
        )],
        ..ObjectReport::new(NodeName::new(node).unwrap(), 1, clock::now())
    })
}

fn label(map: &GlobalMap, slot: usize) -> Option<&str> {
    map.landmarks[slot].label.as_deref()
}

/// Makes the reporter publish its detections until the receiver's newest map meets the condition.
async fn reported(
    reporter: &NodeHandle,
    receiver: &NodeHandle,
    make: impl Fn() -> Arc<ObjectReport>,
    wanted: impl Fn(&GlobalMap) -> bool,
) -> Arc<GlobalMap> {
    let newest = receiver.newest_map();
    let settled = async {
        loop {
            let message = GatewayMessage::PublishReport {
                kind: ReportKind::Detections,
                report: make(),
            };
            reporter.slots().gateway.send(message);
            tokio::time::sleep(Duration::from_millis(50)).await;
            if let Some(received) = newest
                .borrow()
                .as_ref()
                .filter(|received| wanted(&received.map))
            {
                return Arc::clone(&received.map);
            }
        }
    };
    timeout(PATIENCE, settled)
        .await
        .expect("the map does not have the expected content")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn vehicle_receives_objects_of_another() {
    let edge = edge().await;
    let euclid = cav("euclid", &edge).await;
    let galileo = cav("galileo", &edge).await;
    let sees = || report("euclid", "ABC123", 1);
    let map = reported(&euclid, &galileo, sees, |map| {
        label(map, 1) == Some("ABC123")
    })
    .await;
    assert_eq!(map.aggregator.as_str(), "edge");
    assert_eq!(
        map.landmarks[1].contributors,
        [NodeName::from_static("euclid")]
    );
    assert_eq!(label(&map, 0), None);
    for node in [euclid, galileo, edge] {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rounds_keep_order() {
    let edge = edge().await;
    let euclid = cav("euclid", &edge).await;
    let mut newest = euclid.newest_map();
    let mut last = (0, 0);
    for _ in 0..10 {
        timeout(PATIENCE, newest.changed()).await.unwrap().unwrap();
        let map = newest.borrow_and_update().clone().unwrap().map;
        assert!(
            (map.epoch, map.round) > last,
            "{:?} after {last:?}",
            (map.epoch, map.round)
        );
        last = (map.epoch, map.round);
    }
    euclid.stop().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn cell_survives_any_part_loss() {
    let log = tempfile::tempdir().unwrap();
    let record = Some(RecordConfig {
        min_free_mb: 0,
        ..RecordConfig::new(log.path())
    });
    let edge = node::start(NodeConfig {
        record,
        ..config("edge", Role::Edge)
    })
    .await
    .unwrap();
    let gossip = edge.gossip_address();
    let euclid = cav("euclid", &edge).await;
    let sees = |name: &'static str| move || report("euclid", name, 2);
    reported(&euclid, &euclid, sees("before"), |map| {
        label(map, 2) == Some("before")
    })
    .await;

    let kills: [(&str, &dyn Fn()); 9] = [
        ("election", &|| edge.slots().election.get().unwrap().kill()),
        ("membership", &|| {
            edge.slots().membership.get().unwrap().kill();
        }),
        ("recorder", &|| edge.slots().recorder.get().unwrap().kill()),
        ("fuser", &|| edge.slots().fuser.get().unwrap().kill()),
        ("edge-gateway", &|| {
            edge.slots().gateway.get().unwrap().kill();
        }),
        ("edge-follower", &|| {
            edge.slots().follower.get().unwrap().kill();
        }),
        ("broker", &|| edge.slots().broker.get().unwrap().kill()),
        ("gateway", &|| euclid.slots().gateway.get().unwrap().kill()),
        ("follower", &|| {
            euclid.slots().follower.get().unwrap().kill();
        }),
    ];
    for (part, kill) in kills {
        let term = edge.leadership().borrow().epoch.clone().unwrap().term;
        kill();
        eprintln!("killed {part}");
        // A new election has no state directory, so it does not have the used term.
        let is_fresh = |map: &GlobalMap| part != "election" || map.epoch > term;
        reported(&euclid, &euclid, sees(part), |map| {
            label(map, 2) == Some(part) && is_fresh(map)
        })
        .await;
    }
    assert_eq!(
        edge.gossip_address(),
        gossip,
        "others find the membership where it was"
    );
    euclid.stop().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_supervisor_hands_over() {
    let edge = edge().await;
    let seeds = vec![edge.gossip_address().unwrap().to_string()];
    let mut others = Vec::new();
    for (name, role) in [("gauss", Role::Auto), ("euclid", Role::Cav)] {
        let mut config = config(name, role);
        config.membership.seeds = seeds.clone();
        others.push(node::start(config).await.unwrap());
    }
    let [gauss, euclid] = &others[..] else {
        panic!("two were started")
    };
    let led_by = |name: &'static str| {
        move |map: &GlobalMap| map.aggregator.as_str() == name && label(map, 0) == Some("x")
    };
    reported(euclid, euclid, || report("euclid", "x", 0), led_by("edge")).await;
    let standby = async {
        let mut leadership = gauss.leadership();
        leadership
            .wait_for(|leadership| leadership.position == Position::StandingBy)
            .await
            .map(drop)
    };
    timeout(PATIENCE, standby)
        .await
        .expect("gauss stands by")
        .unwrap();
    edge.slots()
        .fuser
        .get()
        .unwrap()
        .try_get_supervisor()
        .unwrap()
        .kill();
    reported(euclid, euclid, || report("euclid", "x", 0), led_by("gauss")).await;
    for node in others {
        node.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn repeatedly_ending_part_stops_node() {
    let mut edge = edge().await;
    for _ in 0..=node::MAX_RESTARTS {
        let fuser = edge.slots().fuser.get().unwrap();
        fuser.kill();
        let slots = edge.slots().clone();
        let replaced = async {
            while slots.fuser.get().unwrap().get_id() == fuser.get_id() {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        if timeout(Duration::from_secs(2), replaced).await.is_err() {
            break;
        }
    }
    let error = timeout(PATIENCE, edge.failed()).await.unwrap().unwrap_err();
    assert!(error.to_string().contains("fuser: "), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_supervisor_stops_node() {
    let mut edge = edge().await;
    let address = edge.broker_address().unwrap();
    let supervisor = edge
        .slots()
        .fuser
        .get()
        .unwrap()
        .try_get_supervisor()
        .unwrap();
    supervisor.kill();
    let error = timeout(Duration::from_secs(5), edge.failed())
        .await
        .expect("within bounds")
        .unwrap_err();
    assert!(error.to_string().contains("supervisor"), "{error}");
    let closed = async {
        while tokio::net::TcpStream::connect(address).await.is_ok() {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(PATIENCE, closed)
        .await
        .expect("the broker ends with its supervisor");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn second_namesake_is_refused() {
    let edge = edge().await;
    let near = |name: &str, role| {
        let mut config = config(name, role);
        config.membership.seeds = vec![edge.gossip_address().unwrap().to_string()];
        config
    };
    let euclid = node::start(near("euclid", Role::Auto)).await.unwrap();
    let of_edge = |node: &NodeHandle| {
        node.leadership()
            .borrow()
            .epoch
            .as_ref()
            .is_some_and(|epoch| (epoch.term, epoch.leader.as_str()) == (1, "edge"))
    };
    timeout(
        PATIENCE,
        euclid
            .leadership()
            .wait_for(|now| now.position == Position::StandingBy),
    )
    .await
    .unwrap()
    .unwrap();
    let mut second = node::start(near("euclid", Role::Cav)).await.unwrap();
    let error = timeout(PATIENCE, second.failed())
        .await
        .expect("it gives up")
        .unwrap_err();
    assert!(
        error
            .to_string()
            .contains("another running node of the cell lot-1 is called euclid"),
        "{error}"
    );
    let twin = |trouble: &Trouble| {
        trouble.kind == "name_taken" && trouble.about.as_deref() == Some("euclid")
    };
    let own = second.counters().troubles().present();
    assert!(own.iter().any(twin), "{own:?}");
    let seen = edge.counters().troubles().present();
    assert!(
        seen.iter()
            .any(|trouble| twin(trouble) && trouble.cause.contains("at 127.0.0.1:")),
        "{seen:?}"
    );
    second.stop().await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    assert!(of_edge(&edge) && of_edge(&euclid) && edge.members().borrow().len() == 1);
    euclid.stop().await;
    edge.stop().await;
}

/// A terminal that is closed ends `top` as `q` does: it leaves the cell, and does not spin on the terminal that is gone.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn top_leaves_when_terminal_closes() {
    let edge = edge().await;
    let (terminal, side) = pty_process::blocking::open().unwrap();
    terminal.resize(pty_process::Size::new(40, 120)).unwrap();
    let seed = edge.gossip_address().unwrap().to_string();
    let top = pty_process::blocking::Command::new(env!("CARGO_BIN_EXE_ecod-node"))
        .args(["top", "--cell", "lot-1", "--seed", &seed])
        .env("ECOD_MEMBERSHIP__MULTICAST__ENABLED", "false")
        .env("ECOD_MEMBERSHIP__BIND", "127.0.0.1:0");
    let mut top = top.spawn(side).unwrap();
    let members = edge.members();
    timeout(
        PATIENCE,
        members.clone().wait_for(|members| members.len() == 1),
    )
    .await
    .expect("it joins")
    .unwrap();
    drop(terminal);
    let ended = async {
        loop {
            if let Some(status) = top.try_wait().unwrap() {
                break status;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let ended = timeout(PATIENCE, ended).await;
    top.kill().ok();
    let ended = ended.expect("it ends");
    assert!(ended.success(), "{ended}");
    assert!(members.borrow().is_empty(), "the member is gone");
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn busy_port_is_named() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let config = NodeConfig {
        listen: Some(address),
        ..config("edge", Role::Edge)
    };
    let error = node::start(config).await.err().expect("the port is busy");
    assert!(error.to_string().contains(&address.to_string()), "{error}");
}
