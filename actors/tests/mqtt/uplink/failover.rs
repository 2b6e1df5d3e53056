//! The uplink moves with the lead.

use std::fs::File;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::wire::{CellMap, NodeState, Role};
use ecod_actors::messages::newest::ReceivedMap;
use ecod_testkit::until_async as until;

use crate::uplink::cell::config;
use crate::uplink::region::{Broker, Subscriber, in_order, longest_gap};

/// A node as a process; killed when dropped.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

fn spawn(
    name: &'static str,
    role: Role,
    seed: SocketAddr,
    broker: &Broker,
    directory: &Path,
) -> Process {
    let mut config = config("north", broker.address());
    config.name = Some(NodeName::from_static(name));
    config.role = role;
    config.state_dir = Some(directory.into());
    config.map_log = Some(directory.join(format!("{name}.maps")));
    config.membership.bind = Some(if role == Role::Edge {
        seed
    } else {
        SocketAddr::from(([127, 0, 0, 1], 0))
    });
    config.membership.seeds = vec![seed.to_string()];
    config.election.stable_ms = 1000;
    let file = directory.join(format!("{name}.toml"));
    std::fs::write(&file, toml::to_string(&config).unwrap()).unwrap();
    let log = File::options()
        .create(true)
        .append(true)
        .open(directory.join(format!("{name}.log")))
        .unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
    command
        .arg("--config")
        .arg(file)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log);
    Process(command.spawn().unwrap())
}

/// The longest time between two maps that a vehicle took.
fn longest_gap_in_cell(directory: &Path) -> Duration {
    let text = std::fs::read_to_string(directory.join("gauss.maps")).unwrap();
    // The last line may be cut short.
    let maps: Vec<ReceivedMap> = text
        .lines()
        .filter_map(|line| serde_json::from_str(line).ok())
        .collect();
    maps.windows(2)
        .map(|pair| pair[1].received_at.since(pair[0].received_at))
        .max()
        .unwrap()
}

/// SIGKILL for the leader's process: the region's gap is at most a second longer than the cell's. Epochs and rounds
/// are in order, and the status is the present leader's. When the edge is back, so is the uplink.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn new_leader_continues_uplink() {
    for broker in Broker::both() {
        let subscriber = Subscriber::new(&broker.address());
        let directory = tempfile::tempdir().unwrap();
        let seed = UdpSocket::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        let node = |name, role| spawn(name, role, seed, &broker, directory.path());
        let edge = node("edge", Role::Edge);
        let _vehicles = ["euclid", "gauss"].map(|name| node(name, Role::Auto));
        let maps = || in_order(subscriber.maps("north"));
        let last_of = || {
            maps()
                .last()
                .map(|(message, _)| message.map.aggregator.to_string())
        };
        let leads = |names: &[&str]| last_of().is_some_and(|last| names.contains(&last.as_str()));
        until("the edge's maps in the region", async || leads(&["edge"])).await;
        // Time until the node has the name of the standby and a connection to it.
        tokio::time::sleep(Duration::from_secs(3)).await;
        let at_kill = maps().len() - 1;
        drop(edge);
        until("a vehicle's maps in the region", async || {
            leads(&["euclid", "gauss"])
        })
        .await;
        tokio::time::sleep(Duration::from_secs(2)).await;
        let of_region = longest_gap(&maps()[at_kill..]);
        let of_cell = longest_gap_in_cell(directory.path());
        eprintln!(
            "{}: edge killed, gap in the cell {of_cell:?}, in the region {of_region:?}",
            broker.name()
        );
        assert!(
            of_region <= of_cell + Duration::from_secs(1),
            "{of_region:?}, in the cell {of_cell:?}"
        );
        let has_status = |names: &[&str]| {
            let status = subscriber.status("north").unwrap();
            status.state == NodeState::Aggregating && names.contains(&status.node.as_str())
        };
        until("the new leader's status", async || {
            has_status(&["euclid", "gauss"])
        })
        .await;

        let _edge = node("edge", Role::Edge);
        let before = maps().len();
        until("the edge's maps again", async || leads(&["edge"])).await;
        until("the edge's status", async || has_status(&["edge"])).await;
        // A former leader that continued to publish would repeatedly be among the last four.
        let of_edge = |message: &CellMap| message.map.aggregator.as_str() == "edge";
        let is_alone = || {
            subscriber
                .maps("north")
                .iter()
                .rev()
                .take(4)
                .all(|(message, _)| of_edge(message))
        };
        until("no other leader's maps", async || is_alone()).await;
        let maps = maps();
        let sent = subscriber.maps("north").len();
        eprintln!(
            "{}: {} of {sent} maps are later than all before",
            broker.name(),
            maps.len()
        );
        eprintln!(
            "{}: lead handed back, gap in the region {:?}",
            broker.name(),
            longest_gap(&maps[before..])
        );
        assert!(
            of_edge(&maps[at_kill].0)
                && maps[at_kill..].iter().any(|(message, _)| !of_edge(message))
        );
    }
}
