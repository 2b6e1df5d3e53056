//! A cell of an edge and three vehicles that loses its leaders, one after the other, and gets them back.
//!
//! `cargo run --example mixed_aggregation`
//!
//! All nodes run in this process, each on a runtime of its own and with its own broker and sockets on loopback. Shutting a
//! runtime down ends a node as SIGKILL ends a process: its connections break, and nobody is told. The vehicles have no
//! cameras; what they would see is published through their gateways ten times a second. Figures are from the maps that
//! the nodes accepted, as their map logs tell; the program fails if the cell does.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use ecod::epoch::Epoch;
use ecod::landmark::LandmarkConfig;
use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{ObjectReport, PerceivedObject, ReportKind, Role, SCHEMA_VERSION};
use ecod_actors::clock;
use ecod_actors::config::NodeConfig;
use ecod_actors::follower::ReceivedMap;
use ecod_actors::gateway::GatewayMessage;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::seat::Seat;
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};

/// The places of the cell, 3 m apart; nobody is at the last.
const PLACES: [&str; 3] = ["slot-0", "slot-1", "slot-2"];

/// What each vehicle reads at which places; all see that the last is empty, and noether misreads the first.
const SEEN: [(&str, &[(u8, &str)]); 3] = [
    ("euclid", &[(0, "ABC123"), (1, "XYZ789")]),
    ("gauss", &[(0, "ABC123"), (1, "XYZ789")]),
    ("noether", &[(0, "ABC128"), (1, "XYZ789")]),
];

const REPORT_PERIOD: Duration = Duration::from_millis(100);

/// What is done to the cell.
enum Step {
    /// The edge starts; it is to lead in the end.
    StartEdge,
    /// All vehicles start that are not there.
    StartVehicles,
    /// Whoever leads is killed; another is to lead in the end.
    KillLeader,
}

const SCRIPT: [Step; 7] = [
    Step::StartVehicles,
    Step::StartEdge,
    Step::KillLeader,
    Step::KillLeader,
    Step::StartEdge,
    Step::StartVehicles,
    Step::KillLeader,
];

/// Time in which a cell must be served by one leader again.
const PATIENCE: Duration = Duration::from_secs(20);

/// Time between recovery and the next step: all have links to the leader and the standby that it named.
const CALM: Duration = Duration::from_secs(2);

fn main() -> anyhow::Result<()> {
    let runtime = Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    runtime.block_on(async {
        let mut cell = Cell::new()?;
        let outcome = play(&mut cell).await;
        let total = cell.record(Timestamp(0))?;
        cell.stop().await;
        println!("\nlongest gap {} ms, {} rounds missed, {} stale accepted", total.gap_ms, total.missed, total.stale);
        outcome?;
        ensure!(total.stale == 0, "superseded maps were accepted");
        Ok(())
    })
}

async fn play(cell: &mut Cell) -> anyhow::Result<()> {
    println!("{:>7}  {:<27}{:<15}{:>8}  map; votes of {}", "time", "event", "leader@term", "gap", PLACES.join(", "));
    for step in SCRIPT {
        let from = clock::now();
        let event = cell.carry_out(step).await?;
        println!("{:>5.1} s  {event}", cell.age());
        let epoch = cell.recovered().await?;
        let age = cell.age();
        tokio::time::sleep(CALM).await;
        let Record { gap_ms, .. } = cell.record(from)?;
        println!("{age:>5.1} s  {:<27}{epoch:<15}{gap_ms:>5} ms  {}", format!("{} leads", epoch.leader), cell.agreed());
    }
    Ok(())
}

/// The nodes that live, and the map logs of all that ever did.
struct Cell {
    directory: TempDir,
    started: Instant,
    runs: usize,
    nodes: BTreeMap<&'static str, (NodeHandle, Runtime)>,
}

/// What the nodes missed, or should have.
#[derive(Default)]
struct Record {
    /// Longest time between two maps.
    gap_ms: u128,
    /// Rounds that a node did not get between two that it got.
    missed: u64,
    /// Maps that are no later than the one before.
    stale: usize,
}

impl Cell {
    fn new() -> anyhow::Result<Self> {
        Ok(Self { directory: tempfile::tempdir()?, started: Instant::now(), runs: 0, nodes: BTreeMap::new() })
    }

    fn age(&self) -> f64 {
        self.started.elapsed().as_secs_f64()
    }

    /// Does what the script says, and says it.
    async fn carry_out(&mut self, step: Step) -> anyhow::Result<String> {
        let leader = self.epoch().map(|epoch| epoch.leader);
        Ok(match step {
            Step::StartEdge => {
                self.start("edge", Role::Edge).await?;
                "edge starts".into()
            }
            Step::StartVehicles => {
                let missing = SEEN.map(|(name, _)| name).into_iter().filter(|name| !self.nodes.contains_key(name));
                let missing: Vec<_> = missing.collect();
                for name in &missing {
                    self.start(name, Role::Auto).await?;
                }
                format!("{} start", missing.join(", "))
            }
            Step::KillLeader => {
                let leader = leader.context("nobody leads")?;
                let (node, runtime) = self.nodes.remove(leader.as_str()).context("the leader is not there")?;
                runtime.shutdown_background();
                drop(node);
                format!("{leader} is killed")
            }
        })
    }

    /// Starts a node that finds the others by their addresses; a vehicle begins to report.
    async fn start(&mut self, name: &'static str, role: Role) -> anyhow::Result<()> {
        self.runs += 1;
        let mut config = NodeConfig {
            name: Some(NodeName::new(name)?),
            role,
            listen: Some(([127, 0, 0, 1], 0).into()),
            state_dir: Some(self.directory.path().join("state")),
            map_log: Some(self.directory.path().join(format!("{name}.{}.maps", self.runs))),
            landmarks: PLACES.iter().zip(0..).map(|(id, n)| LandmarkConfig::at(*id, spot(n), 0.0)).collect(),
            ..NodeConfig::default()
        };
        config.membership.bind = Some(([127, 0, 0, 1], 0).into());
        config.membership.multicast.enabled = false;
        let addresses = self.nodes.values().filter_map(|(node, _)| node.gossip_address());
        config.membership.seeds = addresses.map(|address| address.to_string()).collect();
        config.validate()?;
        let runtime = Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let node = runtime.spawn(node::start(config)).await??;
        if let Some((_, seen)) = SEEN.iter().find(|(vehicle, _)| *vehicle == name) {
            runtime.spawn(report(NodeName::new(name)?, seen, node.seats().gateway.clone()));
        }
        self.nodes.insert(name, (node, runtime));
        Ok(())
    }

    /// Waits until all nodes take the maps of one that is there, which is the edge if that is there.
    async fn recovered(&self) -> anyhow::Result<Epoch> {
        let recovered = async {
            loop {
                if let Some(epoch) = self.epoch()
                    && self.nodes.contains_key(epoch.leader.as_str())
                    && (epoch.leader.as_str() == "edge" || !self.nodes.contains_key("edge"))
                {
                    return epoch;
                }
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        tokio::time::timeout(PATIENCE, recovered).await.with_context(|| format!("no recovery within {PATIENCE:?}"))
    }

    /// The leadership that all nodes follow and have maps of, if there is one.
    fn epoch(&self) -> Option<Epoch> {
        let epoch = |(node, _): &(NodeHandle, Runtime)| {
            let followed = node.leadership().borrow().epoch.clone()?;
            let newest = node.newest_map().borrow().clone()?.map;
            (Epoch::new(newest.epoch, newest.aggregator.clone()) == followed).then_some(followed)
        };
        let mut epochs = self.nodes.values().map(epoch);
        let first = epochs.next()??;
        epochs.all(|epoch| epoch.as_ref() == Some(&first)).then_some(first)
    }

    /// What the map says of each place, and what the votes.
    fn agreed(&self) -> String {
        let Some((node, _)) = self.nodes.values().next() else { return String::new() };
        let map = node.newest_map().borrow().as_ref().map(|newest| Arc::clone(&newest.map));
        let verdicts = node.newest_verdicts().borrow().as_ref().map(|newest| Arc::clone(&newest.message));
        let map = map.iter().flat_map(|map| &map.landmarks).map(|place| match &place.label {
            Some(label) => label.to_string(),
            None if place.observers.is_empty() => "?".into(),
            None => "-".into(),
        });
        let votes = verdicts.iter().flat_map(|verdicts| &verdicts.verdicts);
        let votes = votes.map(|verdict| verdict.label.as_ref().map_or("?".into(), ToString::to_string));
        format!("{}; {}", map.collect::<Vec<_>>().join(" "), votes.collect::<Vec<_>>().join(" "))
    }

    /// What all nodes took from then on, by their map logs.
    fn record(&self, from: Timestamp) -> anyhow::Result<Record> {
        let mut record = Record::default();
        for entry in std::fs::read_dir(self.directory.path())? {
            let path = entry?.path();
            if path.extension().is_none_or(|extension| extension != "maps") {
                continue;
            }
            // The last line of a killed node may be cut short.
            let text = std::fs::read_to_string(&path)?;
            let maps: Vec<ReceivedMap> = text.lines().map_while(|line| serde_json::from_str(line).ok()).collect();
            let place = |m: &ReceivedMap| (Epoch::new(m.map.epoch, m.map.aggregator.clone()), m.map.round);
            for [before, after] in maps.array_windows().filter(|[_, after]| after.received_at >= from) {
                record.gap_ms = record.gap_ms.max(after.received_at.since(before.received_at).as_millis());
                record.missed += after.map.round.saturating_sub(before.map.round + 1);
                record.stale += usize::from(place(after) <= place(before));
            }
        }
        Ok(record)
    }

    async fn stop(self) {
        for (node, runtime) in self.nodes.into_values() {
            if runtime.spawn(node.stop()).await.is_err() {
                eprintln!("a node did not end well");
            }
            runtime.shutdown_background();
        }
    }
}

/// Where a place is, in metres east.
fn spot(place: u8) -> f64 {
    3.0 * f64::from(place)
}

/// Publishes for ever what a vehicle sees: for the map, with all places in view, and as votes.
async fn report(node: NodeName, seen: &[(u8, &str)], gateway: Seat<GatewayMessage>) {
    let mut ticks = tokio::time::interval(REPORT_PERIOD);
    for seq in 0.. {
        ticks.tick().await;
        let object = |(place, label): &(u8, &str)| PerceivedObject {
            label: (*label).into(),
            confidence: 0.9,
            x_m: spot(*place),
            y_m: 0.0,
            covariance_m2: None,
            landmark: Some(PLACES[usize::from(*place)].into()),
        };
        let report = Arc::new(ObjectReport {
            schema: SCHEMA_VERSION,
            node: node.clone(),
            seq,
            captured_at_us: clock::now(),
            pose: None,
            objects: seen.iter().map(object).collect(),
            seen: Some(PLACES.iter().map(|place| (*place).into()).collect()),
        });
        for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
            gateway.send(GatewayMessage::PublishReport { kind, report: Arc::clone(&report) });
        }
    }
}
