//! Nodes in this process that can be killed like processes, vehicles that report, and the maps that the nodes missed.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{ObjectReport, PerceivedObject, ReportKind, Role};
use ecod_actors::messages::actor_slot::ActorSlot;
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};

use crate::{PLACES, SEEN};

const REPORT_PERIOD: Duration = Duration::from_millis(100);

/// The running nodes, and the map logs of all nodes.
pub(crate) struct Cell {
    directory: TempDir,
    runs: usize,
    pub(crate) nodes: BTreeMap<&'static str, (NodeHandle, Runtime)>,
}

/// Maps that the nodes missed, or should have missed.
#[derive(Default)]
pub(crate) struct Record {
    /// Longest time between two maps.
    pub(crate) gap_ms: u128,
    /// Rounds that a node did not receive between two received rounds.
    pub(crate) missed: u64,
    /// Maps that are not later than the map before.
    pub(crate) stale: usize,
}

impl Cell {
    pub(crate) fn new() -> anyhow::Result<Self> {
        Ok(Self {
            directory: tempfile::tempdir()?,
            runs: 0,
            nodes: BTreeMap::new(),
        })
    }

    /// Starts a node that finds the others by their addresses. A vehicle then starts to report.
    pub(crate) async fn start(&mut self, name: &'static str, role: Role) -> anyhow::Result<()> {
        self.runs += 1;
        let mut config = NodeConfig {
            name: Some(NodeName::new(name)?),
            role,
            listen: Some(([127, 0, 0, 1], 0).into()),
            state_dir: Some(self.directory.path().join("state")),
            map_log: Some(
                self.directory
                    .path()
                    .join(format!("{name}.{}.maps", self.runs)),
            ),
            landmarks: PLACES
                .map(|(id, x_m)| LandmarkConfig::at(id, x_m, 0.0))
                .into(),
            ..NodeConfig::default()
        };
        config.membership.bind = Some(([127, 0, 0, 1], 0).into());
        config.membership.multicast.enabled = false;
        config.dashboard.enabled = false;
        let addresses = self
            .nodes
            .values()
            .filter_map(|(node, _)| node.gossip_address());
        config.membership.seeds = addresses.map(|address| address.to_string()).collect();
        config.validate()?;
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let node = runtime.spawn(node::start(config)).await??;
        if let Some((_, seen)) = SEEN.iter().find(|(vehicle, _)| *vehicle == name) {
            runtime.spawn(report(
                NodeName::new(name)?,
                seen,
                node.slots().gateway.clone(),
            ));
        }
        self.nodes.insert(name, (node, runtime));
        Ok(())
    }

    /// The leadership that all nodes follow and receive maps from, if there is one.
    pub(crate) fn epoch(&self) -> Option<Epoch> {
        let epoch = |(node, _): &(NodeHandle, Runtime)| {
            let followed = node.leadership().borrow().epoch.clone()?;
            let newest = node.newest_map().borrow().clone()?.map;
            (Epoch::new(newest.epoch, newest.aggregator.clone()) == followed).then_some(followed)
        };
        let mut epochs = self.nodes.values().map(epoch);
        let first = epochs.next()??;
        epochs
            .all(|epoch| epoch.as_ref() == Some(&first))
            .then_some(first)
    }

    /// Labels of each landmark by the map, and by the votes.
    pub(crate) fn agreed(&self) -> (String, String) {
        let Some((node, _)) = self.nodes.values().next() else {
            return Default::default();
        };
        let newest = node
            .newest_map()
            .borrow()
            .as_ref()
            .map(|newest| Arc::clone(&newest.map));
        let verdicts = node
            .newest_verdicts()
            .borrow()
            .as_ref()
            .map(|newest| Arc::clone(&newest.message));
        let map = newest
            .iter()
            .flat_map(|map| &map.landmarks)
            .map(|place| match &place.label {
                Some(label) => label.to_string(),
                None if place.observers.is_empty() => "?".into(),
                None => "-".into(),
            });
        let votes = verdicts
            .iter()
            .flat_map(|verdicts| &verdicts.verdicts)
            .map(|verdict| {
                verdict
                    .label
                    .as_ref()
                    .map_or("?".into(), ToString::to_string)
            });
        (
            map.collect::<Vec<_>>().join(" "),
            votes.collect::<Vec<_>>().join(" "),
        )
    }

    /// Maps that all nodes accepted from then on, by their logs.
    pub(crate) fn record(&self, from: Timestamp) -> anyhow::Result<Record> {
        let mut record = Record::default();
        for entry in std::fs::read_dir(self.directory.path())? {
            let path = entry?.path();
            if path.extension().is_none_or(|extension| extension != "maps") {
                continue;
            }
            // The last line of a killed node may be cut short.
            let text = std::fs::read_to_string(&path)?;
            let maps: Vec<ReceivedMap> = text
                .lines()
                .map_while(|line| serde_json::from_str(line).ok())
                .collect();
            let place = |m: &ReceivedMap| {
                (
                    Epoch::new(m.map.epoch, m.map.aggregator.clone()),
                    m.map.round,
                )
            };
            for [before, after] in maps
                .array_windows()
                .filter(|[_, after]| after.received_at >= from)
            {
                record.gap_ms = record
                    .gap_ms
                    .max(after.received_at.since(before.received_at).as_millis());
                record.missed += after.map.round.saturating_sub(before.map.round + 1);
                record.stale += usize::from(place(after) <= place(before));
            }
        }
        Ok(record)
    }

    /// Ends all tasks of a node at once. Its connections break without a farewell.
    pub(crate) fn kill(&mut self, name: &str) -> anyhow::Result<()> {
        let (node, runtime) = self
            .nodes
            .remove(name)
            .with_context(|| format!("{name} is not there"))?;
        runtime.shutdown_background();
        drop(node);
        Ok(())
    }

    pub(crate) async fn stop(self) {
        for (node, runtime) in self.nodes.into_values() {
            if runtime.spawn(node.stop()).await.is_err() {
                eprintln!("a node did not end well");
            }
            runtime.shutdown_background();
        }
    }
}

/// Publishes the detections of a vehicle until it ends: for the map, with all landmarks in view, and as votes.
async fn report(node: NodeName, seen: &[(usize, &str)], gateway: ActorSlot<GatewayMessage>) {
    let mut ticks = tokio::time::interval(REPORT_PERIOD);
    for seq in 0.. {
        ticks.tick().await;
        let object = |(place, label): &(usize, &str)| PerceivedObject {
            landmark: Some(PLACES[*place].0.into()),
            ..PerceivedObject::new(*label, 0.9, PLACES[*place].1, 0.0)
        };
        let report = Arc::new(ObjectReport {
            objects: seen.iter().map(object).collect(),
            seen: Some(PLACES.iter().map(|(id, _)| (*id).into()).collect()),
            ..ObjectReport::new(node.clone(), seq, clock::now())
        });
        for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
            gateway.send(GatewayMessage::PublishReport {
                kind,
                report: Arc::clone(&report),
            });
        }
    }
}
