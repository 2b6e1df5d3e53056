//! The payloads that nodes exchange, version 1, and their encodings.
//!
//! One round on the wire:
//!
//! ```text
//! CAV         -> detections/<node>        ObjectReport   (PACE)
//! CAV         -> vote_detections/<node>   ObjectReport   whose objects name a landmark (VOTE)
//! program     -> boxes/<node>             BoxReport      to a node's broker, which projects the boxes
//! aggregator  -> global_detections        GlobalMap
//! aggregator  -> global_verdicts          Verdicts
//! aggregator  -> reputations              Reputations    retained
//! candidate   -> cell                     CellDescription  retained: the settings that all nodes share
//! candidate   -> ledger/<node>            LedgerShare    evidence behind the reputations, for the next aggregator
//! every node  -> nodes/<node>             NodeStatus     retained, with last will
//! broker      -> nodes/<node>/clients     ClientRefusals retained, at that node's broker alone
//! ```
//!
//! Beyond a cell, its leader publishes on a broker of the region ([`RegionTopic`]).
//!
//! All times are Unix microseconds, lengths metres, angles radians, positions in the cell's ENU
//! frame.

#![deny(clippy::indexing_slicing)]

mod box_report;
mod cell_map;
mod client_refusals;
pub(crate) mod codec;
mod compact;
mod description;
pub(crate) mod flaw;
mod ledger;
mod numbers;
mod object;
mod region_topic;
mod reject;
mod topic;
mod trouble;
mod validation;

use std::collections::BTreeMap;
use std::fmt;

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

pub use box_report::{BoxCamera, BoxReport, PixelBox, decode_boxes, encode_boxes};
pub use cell_map::{CellMap, NeighbourObject};
pub use client_refusals::{ClientRefusal, ClientRefusals};
pub use codec::{Encoding, decode, decode_entries, decode_report, decode_share, encode};
pub use description::{
    CellDescription, ContentHash, DescriptionStamp, DescriptionStatus, InvalidHash,
};
pub use flaw::Flaw;
pub use ledger::{LedgerEntry, LedgerMark, LedgerShare, LedgerSignature};
pub use numbers::use_integers;
pub use object::{FieldOfView, FusedObject, PerceivedObject, PoseCorrection};
pub use region_topic::{RegionTopic, RegionTopicKind};
pub use reject::RejectReason;
pub use topic::{ReportKind, Topic, Topics};
pub use trouble::{MAX_DISMISSED, MAX_TROUBLE_TEXT, MAX_TROUBLES, Trouble};
pub use validation::{
    InvalidEntry, InvalidValue, Limits, MAX_DESCRIPTION_BYTES, MAX_FUSED_AHEAD_S, MAX_INTEGER,
    MAX_SHARE_ENTRIES, Payload, check_fused_at,
};

use crate::model::epoch::Epoch;
use crate::model::geometry::{Pose, wrap_angle};
use crate::model::names::{Label, LandmarkId, NodeName};
use crate::model::origin::{PoseError, check_azimuth};
use crate::model::time::Timestamp;
use compact::{Form, Half, Millimetres, Single, Text, UuidBytes, skip_empty};

/// Major version of every payload; payloads of other versions are rejected.
pub const SCHEMA_VERSION: u32 = 1;

/// The detections of one vehicle in one frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct ObjectReport {
    /// Major version of the payload, [`SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The reporting node; equals the last level of the topic.
    #[n(1)]
    pub node: NodeName,
    /// Increases by one with every report of a node since it started.
    #[n(2)]
    pub seq: u64,
    /// Capture time of the frame: in the cell's time if `clock_error_us` is present, otherwise by
    /// the sender's own clock.
    #[n(3)]
    pub captured_at_us: Timestamp,
    /// Pose of the camera; absent if it is unavailable.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(5)]
    pub pose: Option<WirePose>,
    /// The detected objects.
    #[n(4)]
    pub objects: Vec<PerceivedObject>,
    /// Landmarks that were in view, near enough and not hidden, with or without a detection.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(6), with = "Text", has_nil)]
    pub seen: Option<Vec<LandmarkId>>,
    /// The field of view from the pose; without it, the aggregator derives from the detections
    /// where a miss counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(7)]
    pub view: Option<FieldOfView>,
    /// Maximum error in microseconds of the sender's estimate of the cell's time; absent without an
    /// estimate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(8)]
    pub clock_error_us: Option<u32>,
    /// Yaw rate in radians per second, counter-clockwise, of a rotating frame of positions, such as
    /// a frame fixed to a vehicle; absent in a frame that does not rotate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(9), with = "Single", has_nil)]
    pub frame_yaw_rate_radps: Option<f64>,
    /// False if the reporter is a fixed camera, which is not an object of the map; absent for a
    /// vehicle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(10)]
    pub moving: Option<bool>,
}

impl ObjectReport {
    /// Creates a report of the current schema version without pose and objects.
    pub fn new(node: NodeName, seq: u64, captured_at: Timestamp) -> Self {
        Self {
            schema: SCHEMA_VERSION,
            node,
            seq,
            captured_at_us: captured_at,
            pose: None,
            objects: Vec::new(),
            seen: None,
            view: None,
            clock_error_us: None,
            frame_yaw_rate_radps: None,
            moving: None,
        }
    }

    /// The report in the form that VOTE needs: only objects at landmarks.
    #[must_use]
    pub fn votes(&self) -> Self {
        let at_landmarks = self
            .objects
            .iter()
            .filter(|object| object.landmark.is_some());
        Self {
            pose: self.pose,
            objects: at_landmarks.cloned().collect(),
            clock_error_us: self.clock_error_us,
            ..Self::new(self.node.clone(), self.seq, self.captured_at_us)
        }
    }
}

/// A camera pose on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct WirePose {
    /// East in metres.
    #[cbor(n(0), with = "Millimetres")]
    pub x_m: f64,
    /// North in metres.
    #[cbor(n(1), with = "Millimetres")]
    pub y_m: f64,
    /// Direction of the camera's axis in radians, counter-clockwise from east.
    #[cbor(n(2), with = "Single")]
    pub heading_rad: f64,
    /// Height of the camera above the ground in metres; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(3), with = "Millimetres", has_nil)]
    pub height_m: Option<f64>,
    /// Angle of the camera's axis below the horizon in radians; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(4), with = "Single", has_nil)]
    pub pitch_rad: Option<f64>,
    /// Angle in radians by which the camera leans to its right; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(5), with = "Single", has_nil)]
    pub roll_rad: Option<f64>,
}

impl WirePose {
    /// A pose in the plane, in metres and radians; all other fields are absent.
    pub fn new(x_m: f64, y_m: f64, heading_rad: f64) -> Self {
        Self {
            x_m,
            y_m,
            heading_rad,
            height_m: None,
            pitch_rad: None,
            roll_rad: None,
        }
    }

    /// A pose with a heading in degrees clockwise from the y axis, the north of a frame that is not
    /// rotated.
    ///
    /// # Errors
    /// Returns [`PoseError::Azimuth`] for an azimuth beyond ±360°.
    pub fn from_compass(x_m: f64, y_m: f64, azimuth_deg: f64) -> Result<Self, PoseError> {
        check_azimuth(azimuth_deg)?;
        let heading_rad = wrap_angle((90.0 - azimuth_deg).to_radians());
        Ok(Self::new(x_m, y_m, heading_rad))
    }
}

impl From<WirePose> for Pose {
    fn from(pose: WirePose) -> Self {
        Self::new(pose.x_m, pose.y_m, pose.heading_rad)
    }
}

impl From<Pose> for WirePose {
    fn from(pose: Pose) -> Self {
        Self::new(pose.position.x, pose.position.y, pose.heading_rad)
    }
}

/// The fused map of one round (PACE).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct GlobalMap {
    /// Major version of the payload, [`SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The node that fused this map.
    #[n(1)]
    pub aggregator: NodeName,
    /// Term of the leadership that fused it.
    #[n(2)]
    pub epoch: u64,
    /// Increases by one with every round of an epoch.
    #[n(3)]
    pub round: u64,
    /// Time when the round closed, in the cell's time.
    #[n(4)]
    pub fused_at_us: Timestamp,
    /// Capture time, in the cell's time, of the oldest report used in the map; absent without
    /// reports.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(5)]
    pub oldest_capture_us: Option<Timestamp>,
    /// One entry per landmark, in configuration order.
    #[n(6)]
    pub landmarks: Vec<LandmarkState>,
    /// Objects that matched no landmark.
    #[n(7)]
    pub objects: Vec<FusedObject>,
    /// Corrections of each vehicle's positions before fusion, by vehicle.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[cbor(n(8), with = "skip_empty", has_nil)]
    pub pose_corrections: BTreeMap<NodeName, PoseCorrection>,
    /// Objects of neighbouring cells near this cell. They are not this cell's own objects.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cbor(n(9), with = "skip_empty", has_nil)]
    pub neighbour_objects: Vec<NeighbourObject>,
}

impl GlobalMap {
    /// An empty map of a round of a leadership that closed at `fused_at`.
    pub fn new(epoch: &Epoch, round: u64, fused_at: Timestamp) -> Self {
        Self {
            schema: SCHEMA_VERSION,
            aggregator: epoch.leader.clone(),
            epoch: epoch.term,
            round,
            fused_at_us: fused_at,
            oldest_capture_us: None,
            landmarks: Vec::new(),
            objects: Vec::new(),
            pose_corrections: BTreeMap::new(),
            neighbour_objects: Vec::new(),
        }
    }
}

/// The agreed state of one landmark.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct LandmarkState {
    /// The location.
    #[cbor(n(0), with = "Text")]
    pub id: LandmarkId,
    /// The agreed label, or null without a detection.
    #[cbor(n(1), with = "Text", has_nil)]
    pub label: Option<Label>,
    /// Confidence in the label, 0 to 1; 0 without a label.
    #[cbor(n(2), with = "Half")]
    pub confidence: f64,
    /// Fused east in metres, or the location's own coordinate.
    #[cbor(n(3), with = "Millimetres")]
    pub x_m: f64,
    /// Fused north in metres, or the location's own coordinate.
    #[cbor(n(4), with = "Millimetres")]
    pub y_m: f64,
    /// The nodes whose detections were used for the entry.
    #[n(5)]
    pub contributors: Vec<NodeName>,
    /// The nodes that had the location in view, with or without a detection. A null label with
    /// observers means that the location is empty; without observers it is unknown.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cbor(n(6), with = "skip_empty", has_nil)]
    pub observers: Vec<NodeName>,
    /// Labels that nodes recently read at the location, with the nodes; also in a cell that votes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cbor(n(7), with = "skip_empty", has_nil)]
    pub readings: Vec<LabelReading>,
}

/// Nodes that read a label at a landmark.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct LabelReading {
    /// The label.
    #[cbor(n(0), with = "Text")]
    pub label: Label,
    /// The nodes.
    #[n(1)]
    pub nodes: Vec<NodeName>,
}

/// The verdicts of one round (VOTE).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct Verdicts {
    /// Major version of the payload, [`SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The node that counted the votes.
    #[n(1)]
    pub aggregator: NodeName,
    /// Term of the leadership that counted them.
    #[n(2)]
    pub epoch: u64,
    /// Increases by one with every round of an epoch.
    #[n(3)]
    pub round: u64,
    /// Time when the round closed, in the cell's time.
    #[n(4)]
    pub fused_at_us: Timestamp,
    /// One entry per landmark.
    #[n(5)]
    pub verdicts: Vec<Verdict>,
}

impl Verdicts {
    /// The verdicts of a round of a leadership that closed at `fused_at`.
    pub fn new(epoch: &Epoch, round: u64, fused_at: Timestamp, verdicts: Vec<Verdict>) -> Self {
        Self {
            schema: SCHEMA_VERSION,
            aggregator: epoch.leader.clone(),
            epoch: epoch.term,
            round,
            fused_at_us: fused_at,
            verdicts,
        }
    }
}

/// The agreed label of one landmark.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct Verdict {
    /// The location.
    #[cbor(n(0), with = "Text")]
    pub landmark: LandmarkId,
    /// The label with the highest score, or null without votes.
    #[cbor(n(1), with = "Text", has_nil)]
    pub label: Option<Label>,
    /// Score of the label; 0 without a label.
    #[cbor(n(2), with = "Half")]
    pub score: f64,
    /// Lead of the label's score over the score of the next best label; 0 while hysteresis keeps a
    /// label that does not lead.
    #[cbor(n(3), with = "Half")]
    pub margin: f64,
    /// Score of every label with votes.
    #[cbor(n(4), with = "Half", has_nil)]
    pub votes: BTreeMap<Label, f64>,
    /// The nodes whose votes were used for the entry.
    #[n(5)]
    pub contributors: Vec<NodeName>,
}

/// The reputation of each vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct Reputations {
    /// Major version of the payload, [`SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The node that publishes them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(1)]
    pub aggregator: Option<NodeName>,
    /// Term of leadership.
    #[n(2)]
    pub epoch: u64,
    /// The last round in the reputations.
    #[n(3)]
    pub round: u64,
    /// One entry per vehicle.
    #[n(4)]
    pub reputations: BTreeMap<NodeName, Reputation>,
}

/// The reputation of one vehicle and its evidence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct Reputation {
    /// Weight of the vehicle's votes, 0.30 to 1.00.
    #[cbor(n(0), with = "Half")]
    pub score: f64,
    /// Number of votes that agreed with the verdict.
    #[n(1)]
    pub correct: u64,
    /// Number of votes that disagreed with the verdict.
    #[n(2)]
    pub incorrect: u64,
}

/// A node's status, published by itself; the broker publishes the last will when the node goes
/// silent.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct NodeStatus {
    /// Major version of the payload, [`SCHEMA_VERSION`].
    #[n(0)]
    pub schema: u32,
    /// The node; equals the last level of the topic.
    #[n(1)]
    pub node: NodeName,
    /// Identity of this run of the node.
    #[cbor(n(2), with = "UuidBytes")]
    pub id: Uuid,
    /// The configured role.
    #[n(3)]
    pub role: Role,
    /// The current state.
    #[n(4)]
    pub state: NodeState,
    /// The epoch it follows or leads.
    #[n(5)]
    pub epoch: u64,
    /// The aggregator it follows, or itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(6)]
    pub aggregator: Option<NodeName>,
    /// True if the node's broker, fuser and gateway work, so that it could lead; absent on a node
    /// that cannot lead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(7)]
    pub fit: Option<bool>,
    /// Version of the software.
    #[n(8)]
    pub version: String,
    /// The node's description of the cell; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(9)]
    pub description: Option<DescriptionStatus>,
    /// Current troubles of the node, and of vehicles as observed by the node.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cbor(n(10), with = "skip_empty", has_nil)]
    pub troubles: Vec<Trouble>,
    /// Address and port at which the node serves its page; absent without one. An unspecified
    /// address represents all of the node's own addresses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(11)]
    pub page: Option<String>,
    /// Nodes that are not missed when they are absent: the node itself after an orderly stop or if
    /// it moves from cell to cell, and nodes that an operator has dismissed at this node.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[cbor(n(12), with = "skip_empty", has_nil)]
    pub dismissed: Vec<NodeName>,
}

impl NodeStatus {
    /// The status of a node that has just started and does not follow an aggregator yet.
    pub fn starting(node: NodeName, id: Uuid, role: Role, version: &str) -> Self {
        Self {
            schema: SCHEMA_VERSION,
            node,
            id,
            role,
            state: NodeState::Following,
            epoch: 0,
            aggregator: None,
            fit: None,
            version: version.to_owned(),
            description: None,
            troubles: Vec::new(),
            page: None,
            dismissed: Vec::new(),
        }
    }
}

/// The configured role of a node.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
#[serde(rename_all = "lowercase")]
#[cbor(index_only)]
pub enum Role {
    /// Aggregates if no better candidate is alive, otherwise follows.
    #[n(0)]
    Auto,
    /// Cannot become aggregator.
    #[n(1)]
    Cav,
    /// Always the preferred aggregator; has no camera.
    #[n(2)]
    Edge,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Auto => "auto",
            Self::Cav => "cav",
            Self::Edge => "edge",
        })
    }
}

/// The current state of a node.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema,
)]
#[serde(rename_all = "lowercase")]
#[cbor(index_only)]
pub enum NodeState {
    /// Receives maps and verdicts from an aggregator.
    #[n(0)]
    Following,
    /// Makes maps and verdicts.
    #[n(1)]
    Aggregating,
    /// Not connected.
    #[n(2)]
    Offline,
}

/// The JSON Schema of every payload, by the payload's name.
pub fn schemas() -> BTreeMap<&'static str, schemars::Schema> {
    [
        ("ObjectReport", schemars::schema_for!(ObjectReport)),
        ("BoxReport", schemars::schema_for!(BoxReport)),
        ("GlobalMap", schemars::schema_for!(GlobalMap)),
        ("CellMap", schemars::schema_for!(CellMap)),
        ("Verdicts", schemars::schema_for!(Verdicts)),
        ("CellDescription", schemars::schema_for!(CellDescription)),
        ("Reputations", schemars::schema_for!(Reputations)),
        ("LedgerShare", schemars::schema_for!(LedgerShare)),
        ("NodeStatus", schemars::schema_for!(NodeStatus)),
        ("ClientRefusals", schemars::schema_for!(ClientRefusals)),
    ]
    .into()
}
