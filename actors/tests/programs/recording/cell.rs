//! Nodes in this process that record, drive, and can be killed.

use std::collections::BTreeMap;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::replay::FusedLine;
use ecod::wire::{ObjectReport, PerceivedObject, ReportKind, Role, WirePose};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::observe::recorder::{
    LogEvent, LogIdentity, LogMessage, LogReader, RecordConfig, SchemaName, files,
};
use ecod_actors::platform::clock;
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};
use tracing_subscriber::EnvFilter;

const PATIENCE: Duration = Duration::from_secs(30);

pub(crate) fn name(text: &str) -> NodeName {
    NodeName::new(text).unwrap()
}

/// An address at which nobody gossips now.
pub(crate) fn free_address() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
}

/// A node that records below `directory`: loopback only, found by a seed.
pub(crate) fn config(
    node: &str,
    role: Role,
    bind: Option<SocketAddr>,
    seed: SocketAddr,
    directory: &Path,
) -> NodeConfig {
    let mut config = NodeConfig {
        name: Some(name(node)),
        role,
        listen: Some(SocketAddr::from(([127, 0, 0, 1], 0))),
        state_dir: Some(directory.into()),
        landmarks: vec![
            LandmarkConfig::at("slot-0", 2.0, 1.0),
            LandmarkConfig::at("slot-1", 4.0, 1.0),
        ],
        record: Some(RecordConfig {
            min_free_mb: 0,
            ..RecordConfig::new(directory.join(node))
        }),
        ..NodeConfig::default()
    };
    config.membership.bind = Some(bind.unwrap_or(SocketAddr::from(([127, 0, 0, 1], 0))));
    config.membership.seeds = vec![seed.to_string()];
    config.membership.multicast.enabled = false;
    config.dashboard.enabled = false;
    config.election.stable_ms = 500;
    config.reputations.publish_period_s = 0.2;
    config.fusion.vote.weighted.freshness_s = 0.3;
    config.validate().unwrap();
    config
}

/// Some nodes of one cell.
pub(crate) struct Cell {
    directory: TempDir,
    seed: SocketAddr,
    nodes: BTreeMap<String, (NodeHandle, Runtime)>,
    seq: u64,
}

impl Default for Cell {
    fn default() -> Self {
        // With RUST_LOG=info a failing test tells what the nodes did.
        tracing_subscriber::fmt()
            .with_env_filter(EnvFilter::from_default_env())
            .try_init()
            .ok();
        Self {
            directory: tempfile::tempdir().unwrap(),
            seed: free_address(),
            nodes: BTreeMap::new(),
            seq: 0,
        }
    }
}

impl Cell {
    pub(crate) fn directory(&self) -> &Path {
        self.directory.path()
    }

    pub(crate) fn config(&self, node: &str, role: Role) -> NodeConfig {
        config(
            node,
            role,
            self.nodes.is_empty().then_some(self.seed),
            self.seed,
            self.directory.path(),
        )
    }

    /// Starts a node on a runtime of its own; the first is the seed of the others.
    pub(crate) async fn start(&mut self, node: &str, role: Role) {
        self.start_with(self.config(node, role)).await;
    }

    /// The same with another configuration.
    pub(crate) async fn start_with(&mut self, config: NodeConfig) {
        let node = config.name.as_ref().unwrap().to_string();
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let handle = runtime.spawn(node::start(config)).await.unwrap().unwrap();
        self.nodes.insert(node, (handle, runtime));
    }

    /// Ends all tasks of a node where they are.
    pub(crate) fn kill(&mut self, node: &str) {
        let (handle, runtime) = self.nodes.remove(node).unwrap();
        self.seed = self
            .nodes
            .values()
            .next()
            .unwrap()
            .0
            .gossip_address()
            .unwrap();
        runtime.shutdown_background();
        drop(handle);
    }

    /// Stops all nodes; their logs are in the directory.
    pub(crate) async fn stop(mut self) -> TempDir {
        while let Some((_, (node, runtime))) = self.nodes.pop_first() {
            runtime.spawn(node.stop()).await.unwrap();
            runtime.shutdown_background();
        }
        self.directory
    }

    pub(crate) fn node(&self, node: &str) -> &NodeHandle {
        &self.nodes[node].0
    }

    /// Lets every vehicle that runs report, for both algorithms, with noise and now and then a wrong label.
    pub(crate) async fn drive(&mut self, time: Duration) {
        let end = tokio::time::Instant::now() + time;
        while tokio::time::Instant::now() < end {
            self.seq += 1;
            for (number, (node, (handle, _))) in self
                .nodes
                .iter()
                .enumerate()
                .filter(|(_, (node, _))| *node != "edge")
            {
                let report = Arc::new(report(node, self.seq, number));
                for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
                    let message = GatewayMessage::PublishReport {
                        kind,
                        report: Arc::clone(&report),
                    };
                    handle.slots().gateway.send(message);
                }
            }
            tokio::time::sleep(Duration::from_millis(30)).await;
        }
    }

    /// Waits until every node takes maps of this node and follows it.
    pub(crate) async fn served_by(&self, leader: &str) {
        self.until(&format!("{leader} serves all"), |cell| {
            cell.sources()
                .iter()
                .all(|source| source.as_deref() == Some(leader))
                .then_some(())
        })
        .await;
    }

    /// Waits until every node takes maps of one node that is another than this, and says which.
    pub(crate) async fn served_by_another_than(&self, old: &str) -> String {
        self.until(&format!("another than {old} serves all"), |cell| {
            let sources = cell.sources();
            let first = sources.first()?.clone()?;
            (first != old && sources.iter().all(|source| *source == Some(first.clone())))
                .then_some(first)
        })
        .await
    }

    fn sources(&self) -> Vec<Option<String>> {
        let source = |(node, _): &(NodeHandle, Runtime)| {
            let leader = node.leadership().borrow().leader()?.clone();
            let source = node.newest_map().borrow().as_ref()?.map.aggregator.clone();
            (leader == source).then(|| source.to_string())
        };
        self.nodes.values().map(source).collect()
    }

    pub(crate) async fn until<T>(
        &self,
        what: &str,
        mut holds: impl FnMut(&Self) -> Option<T>,
    ) -> T {
        let deadline = tokio::time::Instant::now() + PATIENCE;
        loop {
            if let Some(found) = holds(self) {
                return found;
            }
            assert!(
                tokio::time::Instant::now() < deadline,
                "not within {PATIENCE:?}: {what}"
            );
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

fn report(node: &str, seq: u64, vehicle: usize) -> ObjectReport {
    let off = 0.013 * ((seq * 7 + vehicle as u64 * 3) % 11) as f64;
    let is_wrong = (seq + vehicle as u64).is_multiple_of(9);
    let object = |landmark: &str, x_m: f64| PerceivedObject {
        label: if is_wrong { "truck" } else { "car" }.into(),
        confidence: 0.7 + off,
        x_m: x_m + off,
        y_m: 1.0 - off / 3.0,
        covariance_m2: Some([0.01 + off / 7.0, 0.0, 0.02]),
        landmark: Some(landmark.into()),
        ..PerceivedObject::new("", 0.0, 0.0, 0.0)
    };
    ObjectReport {
        pose: Some(WirePose::new(0.1 * vehicle as f64, off, 0.3)),
        objects: vec![object("slot-0", 2.0), object("slot-1", 4.0)],
        ..ObjectReport::new(name(node), seq, clock::now())
    }
}

/// All files of a log.
pub(crate) struct Log {
    pub(crate) identity: Option<LogIdentity>,
    pub(crate) messages: Vec<LogMessage>,
    pub(crate) problems: Vec<String>,
}

impl Log {
    pub(crate) fn read(directory: &Path) -> Self {
        let mut log = Self {
            identity: None,
            messages: Vec::new(),
            problems: Vec::new(),
        };
        for file in files(directory).unwrap() {
            for event in LogReader::open(&file).unwrap() {
                match event {
                    Ok(LogEvent::Identity(identity)) => log.identity = Some(*identity),
                    Ok(LogEvent::Message(message)) => log.messages.push(message),
                    Err(error) => log.problems.push(error.to_string()),
                }
            }
        }
        log
    }

    pub(crate) fn count(&self, schema: SchemaName) -> usize {
        self.messages
            .iter()
            .filter(|message| message.schema == schema)
            .count()
    }

    /// The maps and verdicts.
    pub(crate) fn fused(&self) -> Vec<FusedLine> {
        let fused = |message: &&LogMessage| {
            matches!(message.schema, SchemaName::GlobalMap | SchemaName::Verdicts)
        };
        self.messages
            .iter()
            .filter(fused)
            .map(|message| serde_json::from_slice(&message.json).unwrap())
            .collect()
    }
}
