//! Lines of a replay's input and output.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::envelope::Envelope;
use super::flaw;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{
    Encoding, Flaw, GlobalMap, Limits, ObjectReport, RejectReason, ReportKind, Verdicts, decode,
    encode,
};

/// One line of a replay's output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected a global map or verdicts")]
pub enum FusedLine {
    /// A round of PACE.
    Map(GlobalMap),
    /// A round of VOTE.
    Verdicts(Verdicts),
}

impl FusedLine {
    /// The line as JSON, without a line end.
    pub fn to_json(&self) -> Vec<u8> {
        match self {
            Self::Map(map) => encode(map, Encoding::Json),
            Self::Verdicts(verdicts) => encode(verdicts, Encoding::Json),
        }
    }
}

/// A report of a recording, with its kind and the virtual time of its line.
#[derive(Debug, Clone)]
pub(super) struct RecordedReport {
    pub(super) kind: ReportKind,
    pub(super) at: Timestamp,
    /// True if every object has a position.
    pub(super) is_placed: bool,
    pub(super) report: ObjectReport,
}

impl RecordedReport {
    pub(super) fn read(text: &[u8], limits: &Limits) -> Result<Self, Flaw> {
        let text = text.trim_ascii();
        if text.len() > limits.payload_bytes {
            return Err(flaw::too_large(limits));
        }
        if text.first() != Some(&b'{') {
            return Err(Flaw::new(RejectReason::Malformed, "", "is no JSON object"));
        }
        let reason = match decode::<ObjectReport>(text, limits) {
            Ok(report) => return Self::new(text, report, limits),
            Err(reason) => reason,
        };
        let Some(placed) = votes_by_name(text) else {
            return Err(flaw::of_line(text, reason, limits));
        };
        let limits = Limits {
            payload_bytes: usize::MAX,
            ..*limits
        };
        let report =
            decode(&placed, &limits).map_err(|reason| flaw::of_line(&placed, reason, &limits))?;
        Ok(Self {
            is_placed: false,
            ..Self::new(&placed, report, &limits)?
        })
    }

    fn new(text: &[u8], report: ObjectReport, limits: &Limits) -> Result<Self, Flaw> {
        let Envelope {
            topic,
            received_at_us,
        } = serde_json::from_slice(text)
            .map_err(|_| flaw::of_line(text, RejectReason::Malformed, limits))?;
        let kind = topic.map_or(Ok(ReportKind::default()), |topic| {
            kind(&topic, &report.node)
        })?;
        Ok(Self {
            kind,
            at: received_at_us.unwrap_or(report.captured_at_us),
            is_placed: true,
            report,
        })
    }
}

/// A line of votes by name, with zeros for the positions that its objects do not have; `None` for
/// other lines.
fn votes_by_name(text: &[u8]) -> Option<Vec<u8>> {
    let mut line: Value = serde_json::from_slice(text).ok()?;
    if !line
        .get("topic")?
        .as_str()?
        .split('/')
        .any(|level| level == "vote_detections")
    {
        return None;
    }
    let mut is_by_name = false;
    for object in line
        .get_mut("objects")?
        .as_array_mut()?
        .iter_mut()
        .filter_map(Value::as_object_mut)
    {
        let is_absent = |key| object.get(key).is_none_or(Value::is_null);
        if object.get("landmark").is_some_and(Value::is_string)
            && is_absent("x_m")
            && is_absent("y_m")
        {
            object.extend(["x_m", "y_m"].map(|key| (key.to_owned(), 0.into())));
            is_by_name = true;
        }
    }
    is_by_name.then(|| line.to_string().into_bytes())
}

/// The kind of a `topic` field: `detections` or `vote_detections`, or a whole MQTT topic that ends
/// with it and the node's name.
fn kind(topic: &str, node: &NodeName) -> Result<ReportKind, Flaw> {
    let mut levels = topic.rsplit('/');
    let last = levels.next().unwrap_or_default();
    let (level, named) = levels
        .next()
        .map_or((last, None), |level| (level, Some(last)));
    let kind = match level {
        "detections" => ReportKind::Detections,
        "vote_detections" => ReportKind::VoteDetections,
        _ => {
            let fault = "is neither detections nor vote_detections";
            return Err(Flaw::new(RejectReason::UnknownTopic, "topic", fault));
        }
    };
    let is_other = named.is_some_and(|named| named != node.as_str());
    let fault = || format!("names another node than `{node}`");
    if is_other {
        Err(Flaw::new(RejectReason::NodeMismatch, "topic", fault()))
    } else {
        Ok(kind)
    }
}
