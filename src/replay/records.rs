//! Lines of a replay's input and output.

use serde::{Deserialize, Serialize};

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{GlobalMap, Limits, ObjectReport, RejectReason, ReportKind, Verdicts, decode};

/// One line of a replay's output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected a global map or verdicts")]
pub enum FusedLine {
    /// A round of PACE.
    Map(GlobalMap),
    /// A round of VOTE.
    Verdicts(Verdicts),
}

/// A report of a recording, with its kind and the virtual time of its line.
#[derive(Debug, Clone)]
pub(super) struct RecordedReport {
    pub(super) kind: ReportKind,
    pub(super) at: Timestamp,
    pub(super) report: ObjectReport,
}

/// The optional fields of a line beside its report.
#[derive(Debug, Deserialize)]
struct Envelope {
    #[serde(default)]
    topic: Option<String>,
    #[serde(default)]
    received_at_us: Option<Timestamp>,
}

impl RecordedReport {
    pub(super) fn read(text: &[u8], limits: &Limits) -> Result<Self, RejectReason> {
        let text = text.trim_ascii();
        if text.len() > limits.payload_bytes {
            return Err(RejectReason::TooLarge);
        }
        if text.first() != Some(&b'{') {
            return Err(RejectReason::Malformed);
        }
        let report: ObjectReport = decode(text, limits)?;
        let Envelope { topic, received_at_us } = serde_json::from_slice(text).map_err(|_| RejectReason::Malformed)?;
        let kind = topic.map_or(Ok(ReportKind::default()), |topic| kind(&topic, &report.node))?;
        Ok(Self { kind, at: received_at_us.unwrap_or(report.captured_at_us), report })
    }
}

/// The kind of a `topic` field: `detections` or `vote_detections`, or a whole MQTT topic that ends with it and the node's
/// name.
fn kind(topic: &str, node: &NodeName) -> Result<ReportKind, RejectReason> {
    let mut levels = topic.rsplit('/');
    let last = levels.next().unwrap_or_default();
    let (level, named) = levels.next().map_or((last, None), |level| (level, Some(last)));
    let kind = match level {
        "detections" => ReportKind::Detections,
        "vote_detections" => ReportKind::VoteDetections,
        _ => return Err(RejectReason::UnknownTopic),
    };
    if named.is_none_or(|named| named == node.as_str()) { Ok(kind) } else { Err(RejectReason::NodeMismatch) }
}
