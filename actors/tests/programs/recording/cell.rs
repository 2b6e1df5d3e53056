//! Nodes that record and drive.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ecod::perception::landmark::LandmarkConfig;
use ecod::replay::FusedLine;
use ecod::wire::{ObjectReport, PerceivedObject, ReportKind, Role, WirePose};
use ecod_actors::messages::gateway::GatewayMessage;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::recorder::{
    LogEvent, LogIdentity, LogMessage, LogReader, RecordConfig, SchemaName, files,
};
use ecod_actors::platform::clock;
use ecod_testkit::{Cell, name, node_config};
use tokio::time::{Instant, sleep};

/// A node that records below `directory`.
pub(crate) fn config(node: &str, role: Role, directory: &Path) -> NodeConfig {
    let mut config = NodeConfig {
        state_dir: Some(directory.into()),
        landmarks: vec![
            LandmarkConfig::at("slot-0", 2.0, 1.0),
            LandmarkConfig::at("slot-1", 4.0, 1.0),
        ],
        record: Some(RecordConfig {
            min_free_mb: 0,
            ..RecordConfig::new(directory.join(node))
        }),
        ..node_config(node, "cell", role)
    };
    config.election.stable_ms = 500;
    config.reputations.publish_period_s = 0.2;
    config.fusion.vote.weighted.freshness_s = 0.3;
    config.validate().unwrap();
    config
}

/// Lets every vehicle that runs report, for both algorithms, with noise and now and then a wrong label.
pub(crate) async fn drive(cell: &Cell, time: Duration) {
    static SEQ: AtomicU64 = AtomicU64::new(1);
    let end = Instant::now() + time;
    while Instant::now() < end {
        let seq = SEQ.fetch_add(1, Ordering::Relaxed);
        let vehicles = cell.nodes().enumerate();
        for (number, (node, handle)) in vehicles.filter(|(_, (node, _))| *node != "edge") {
            let report = Arc::new(report(node, seq, number));
            for kind in [ReportKind::Detections, ReportKind::VoteDetections] {
                let message = GatewayMessage::PublishReport {
                    kind,
                    report: Arc::clone(&report),
                };
                handle.slots().gateway.send(message);
            }
        }
        sleep(Duration::from_millis(30)).await;
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
