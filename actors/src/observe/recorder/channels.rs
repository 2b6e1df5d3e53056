//! Channels of a log: JSON messages under stable schema names.
//!
//! `ecod.*` are payloads of the cell and facts about the recording node; `foxglove.*` are drawings
//! for viewers. Topics are the cell's topics without its root, such as `detections/euclid`.
//! Messages without a topic in the cell are on `node/…`, `scene/…`, `tf`, `log`, `camera`,
//! `camera_calibration` and `camera_boxes`.

use std::collections::BTreeMap;

use ecod::leadership::{Leadership, Position};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::replay::JournalEntry;
use ecod::wire;
use schemars::{JsonSchema, Schema};
use serde::{Deserialize, Serialize};

use super::foxglove;
use super::viewer_schema::schema_of;

/// Lists every schema once: its name in the code, its message, its name in the log.
macro_rules! schemas {
    ($($(#[$doc:meta])* $schema:ident($message:ty) = $name:literal,)*) => {
        /// A channel's schema; the names in the log are stable.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum SchemaName {
            $($(#[$doc])* $schema,)*
        }

        impl SchemaName {
            /// All schemas in order of declaration.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$schema),*];

            /// The name in the log.
            pub fn as_str(self) -> &'static str {
                match self {
                    $(Self::$schema => $name,)*
                }
            }

            /// The JSON Schema of the messages, in the form that viewers read.
            pub(crate) fn json_schema(self) -> Schema {
                match self {
                    $(Self::$schema => schema_of::<$message>(),)*
                }
            }
        }
    };
}

schemas! {
    /// Report of one vehicle for one algorithm.
    ObjectReport(wire::ObjectReport) = "ecod.ObjectReport",
    /// The map of a round.
    GlobalMap(wire::GlobalMap) = "ecod.GlobalMap",
    /// The verdicts of a round.
    Verdicts(wire::Verdicts) = "ecod.Verdicts",
    /// The reputations of all vehicles.
    Reputations(wire::Reputations) = "ecod.Reputations",
    /// Share of another candidate's evidence.
    LedgerShare(wire::LedgerShare) = "ecod.LedgerShare",
    /// Status that a node has published.
    NodeStatus(wire::NodeStatus) = "ecod.NodeStatus",
    /// A change of the leadership as observed by the recording node.
    Leadership(LeadershipChange) = "ecod.Leadership",
    /// Counters of the recording node.
    Counters(CounterReading) = "ecod.Counters",
    /// An input of the recording node's aggregator.
    JournalEntry(JournalEntry) = "ecod.JournalEntry",
    /// A drawing of map or report.
    SceneUpdate(foxglove::scene::SceneUpdate) = "foxglove.SceneUpdate",
    /// Pose of a vehicle in the map's frame.
    FrameTransform(foxglove::FrameTransform) = "foxglove.FrameTransform",
    /// Line of text for viewers.
    Log(foxglove::Log) = "foxglove.Log",
    /// Compressed image of a camera.
    CompressedImage(foxglove::picture::CompressedImage) = "foxglove.CompressedImage",
    /// The optics of a camera's images.
    CameraCalibration(foxglove::picture::CameraCalibration) = "foxglove.CameraCalibration",
    /// Boxes of the detections in a camera image.
    ImageAnnotations(foxglove::picture::ImageAnnotations) = "foxglove.ImageAnnotations",
}

impl SchemaName {
    /// The schema of that name in the log.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|schema| schema.as_str() == name)
    }
}

/// The leadership from now on, as observed by the recording node.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LeadershipChange {
    /// The recording node.
    pub node: NodeName,
    /// Time of the change by its clock.
    pub at_us: Timestamp,
    /// `seeking`, `following`, `standing_by` or `leading`.
    pub position: String,
    /// The highest leadership that was followed or led so far.
    pub epoch: Option<Epoch>,
    /// The node that leads next.
    pub standby: Option<NodeName>,
}

impl LeadershipChange {
    pub(crate) fn new(node: NodeName, at_us: Timestamp, leadership: &Leadership) -> Self {
        let position = match leadership.position {
            Position::Seeking => "seeking",
            Position::Following => "following",
            Position::StandingBy => "standing_by",
            Position::Leading => "leading",
        };
        let Leadership { epoch, standby, .. } = leadership.clone();
        Self {
            node,
            at_us,
            position: position.into(),
            epoch,
            standby,
        }
    }

    /// The change as text.
    pub(crate) fn in_words(&self) -> String {
        match (self.position.as_str(), &self.epoch) {
            ("leading", Some(epoch)) => format!("leads in term {}", epoch.term),
            ("seeking", _) => "has no leader".into(),
            (_, Some(epoch)) => format!("follows {} in term {}", epoch.leader, epoch.term),
            (position, None) => position.into(),
        }
    }
}

/// Counters of the recording node at one moment; they only grow.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct CounterReading {
    /// The recording node.
    pub node: NodeName,
    /// Time of the reading by its clock.
    pub at_us: Timestamp,
    /// Counted events by name.
    pub events: BTreeMap<String, u64>,
    /// Payloads that were not used, by reason.
    pub rejects: BTreeMap<String, u64>,
    /// Messages discarded under overload, by reason; empty in logs of earlier versions.
    #[serde(default)]
    pub shed: BTreeMap<String, u64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schema_names_round_trip() {
        for schema in SchemaName::ALL {
            assert_eq!(SchemaName::from_name(schema.as_str()), Some(schema));
        }
        assert_eq!(SchemaName::from_name("foxglove.Grid"), None);
    }

    #[test]
    fn viewer_channels_match_published_schemas() {
        for (schema, fields) in [
            (SchemaName::SceneUpdate, &["deletions", "entities"][..]),
            (
                SchemaName::FrameTransform,
                &[
                    "timestamp",
                    "parent_frame_id",
                    "child_frame_id",
                    "translation",
                    "rotation",
                ][..],
            ),
            (
                SchemaName::Log,
                &["timestamp", "level", "message", "name", "file", "line"][..],
            ),
            (
                SchemaName::CompressedImage,
                &["timestamp", "frame_id", "data", "format"][..],
            ),
            (
                SchemaName::CameraCalibration,
                &[
                    "timestamp",
                    "frame_id",
                    "width",
                    "height",
                    "distortion_model",
                    "D",
                    "K",
                    "R",
                    "P",
                ][..],
            ),
            (
                SchemaName::ImageAnnotations,
                &["circles", "points", "texts"][..],
            ),
        ] {
            let json = serde_json::to_value(schema.json_schema()).unwrap();
            let properties = json["properties"].as_object().unwrap();
            assert_eq!(properties.len(), fields.len(), "{schema:?}");
            assert!(
                fields.iter().all(|field| properties.contains_key(*field)),
                "{properties:?}"
            );
        }
    }
}
