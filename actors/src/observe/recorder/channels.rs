//! The channels of a log: JSON messages under stable schema names.
//!
//! `ecod.*` are the payloads of the cell and what a node knows about itself, `foxglove.*` what viewers draw. Topics are
//! those of the cell without its root, `detections/euclid`, and `node/…`, `scene/…`, `tf`, `log` and `camera` for what is
//! on no topic.

use std::collections::BTreeMap;

use ecod::epoch::Epoch;
use ecod::leadership::{Leadership, Position};
use ecod::names::NodeName;
use ecod::replay::JournalEntry;
use ecod::time::Timestamp;
use schemars::{JsonSchema, Schema};
use serde::{Deserialize, Serialize};

use super::foxglove;
use super::viewer_schema::schema_of;

/// A channel's schema by its name in the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SchemaName {
    /// A vehicle's report.
    ObjectReport,
    /// The map of a round.
    GlobalMap,
    /// The verdicts of a round.
    Verdicts,
    /// How far vehicles are trusted.
    Reputations,
    /// Another candidate's evidence.
    LedgerShare,
    /// What a node says about itself.
    NodeStatus,
    /// Who leads, as the recording node sees it: [`LeadershipChange`].
    Leadership,
    /// The recording node's counters: [`CounterReading`].
    Counters,
    /// What the recording node's aggregator was told: [`JournalEntry`].
    JournalEntry,
    /// Things in the world to be drawn.
    SceneUpdate,
    /// Where a vehicle stands.
    FrameTransform,
    /// What happened, in words.
    Log,
    /// A picture of the camera.
    CompressedImage,
}

impl SchemaName {
    /// All of them.
    pub const ALL: [Self; 13] = [
        Self::ObjectReport,
        Self::GlobalMap,
        Self::Verdicts,
        Self::Reputations,
        Self::LedgerShare,
        Self::NodeStatus,
        Self::Leadership,
        Self::Counters,
        Self::JournalEntry,
        Self::SceneUpdate,
        Self::FrameTransform,
        Self::Log,
        Self::CompressedImage,
    ];

    /// The name in the log; it stays as it is.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::ObjectReport => "ecod.ObjectReport",
            Self::GlobalMap => "ecod.GlobalMap",
            Self::Verdicts => "ecod.Verdicts",
            Self::Reputations => "ecod.Reputations",
            Self::LedgerShare => "ecod.LedgerShare",
            Self::NodeStatus => "ecod.NodeStatus",
            Self::Leadership => "ecod.Leadership",
            Self::Counters => "ecod.Counters",
            Self::JournalEntry => "ecod.JournalEntry",
            Self::SceneUpdate => "foxglove.SceneUpdate",
            Self::FrameTransform => "foxglove.FrameTransform",
            Self::Log => "foxglove.Log",
            Self::CompressedImage => "foxglove.CompressedImage",
        }
    }

    /// The schema of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|schema| schema.as_str() == name)
    }

    /// The JSON Schema of its messages, as viewers read it.
    pub(crate) fn json_schema(self) -> Schema {
        use ecod::wire;
        match self {
            Self::ObjectReport => schema_of::<wire::ObjectReport>(),
            Self::GlobalMap => schema_of::<wire::GlobalMap>(),
            Self::Verdicts => schema_of::<wire::Verdicts>(),
            Self::Reputations => schema_of::<wire::Reputations>(),
            Self::LedgerShare => schema_of::<wire::LedgerShare>(),
            Self::NodeStatus => schema_of::<wire::NodeStatus>(),
            Self::Leadership => schema_of::<LeadershipChange>(),
            Self::Counters => schema_of::<CounterReading>(),
            Self::JournalEntry => schema_of::<JournalEntry>(),
            Self::SceneUpdate => schema_of::<foxglove::SceneUpdate>(),
            Self::FrameTransform => schema_of::<foxglove::FrameTransform>(),
            Self::Log => schema_of::<foxglove::Log>(),
            Self::CompressedImage => schema_of::<foxglove::CompressedImage>(),
        }
    }
}

/// Who leads, as the recording node sees it from now on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct LeadershipChange {
    /// The recording node.
    pub node: NodeName,
    /// Since when, by its clock.
    pub at_us: Timestamp,
    /// `seeking`, `following`, `standing_by` or `leading`.
    pub position: String,
    /// The highest leadership that was followed or led so far.
    pub epoch: Option<Epoch>,
    /// Who leads next.
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
        Self { node, at_us, position: position.into(), epoch, standby }
    }

    /// The change in words.
    pub(crate) fn in_words(&self) -> String {
        match (self.position.as_str(), &self.epoch) {
            ("leading", Some(epoch)) => format!("leads in term {}", epoch.term),
            ("seeking", _) => "knows of no leader".into(),
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
    /// When, by its clock.
    pub at_us: Timestamp,
    /// What happened, by name.
    pub events: BTreeMap<String, u64>,
    /// Payloads that were not used, by reason.
    pub rejects: BTreeMap<String, u64>,
    /// What was left out under overload, by reason; none in logs of earlier versions.
    #[serde(default)]
    pub shed: BTreeMap<String, u64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_their_own_and_lead_back() {
        for schema in SchemaName::ALL {
            assert_eq!(SchemaName::from_name(schema.as_str()), Some(schema));
        }
        assert_eq!(SchemaName::from_name("foxglove.Grid"), None);
    }

    #[test]
    fn what_viewers_draw_has_the_fields_of_the_published_schemas() {
        for (schema, fields) in [
            (SchemaName::SceneUpdate, &["deletions", "entities"][..]),
            (
                SchemaName::FrameTransform,
                &["timestamp", "parent_frame_id", "child_frame_id", "translation", "rotation"][..],
            ),
            (SchemaName::Log, &["timestamp", "level", "message", "name", "file", "line"][..]),
            (SchemaName::CompressedImage, &["timestamp", "frame_id", "data", "format"][..]),
        ] {
            let json = serde_json::to_value(schema.json_schema()).unwrap();
            let properties = json["properties"].as_object().unwrap();
            assert_eq!(properties.len(), fields.len(), "{schema:?}");
            assert!(fields.iter().all(|field| properties.contains_key(*field)), "{properties:?}");
        }
    }
}
