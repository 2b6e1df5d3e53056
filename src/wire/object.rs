//! Objects in reports of vehicles and in maps of the aggregator.

use std::collections::BTreeMap;

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::compact::{CovarianceForm, Form, Half, Millimetres, Single, Text, UuidBytes};
use crate::model::geometry::Covariance;
use crate::model::names::{Label, LandmarkId, NodeName};
use crate::model::time::Timestamp;

/// A detection with its position in the world.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct PerceivedObject {
    /// Class label or decoded text.
    #[cbor(n(0), with = "Text")]
    pub label: Label,
    /// The detector's confidence, 0 to 1.
    #[cbor(n(1), with = "Half")]
    pub confidence: f64,
    /// East in metres.
    #[cbor(n(2), with = "Millimetres")]
    pub x_m: f64,
    /// North in metres.
    #[cbor(n(3), with = "Millimetres")]
    pub y_m: f64,
    /// Position covariance `[xx, xy, yy]` in m².
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(4), with = "CovarianceForm", has_nil)]
    pub covariance_m2: Option<[f64; 3]>,
    /// The landmark to which the node assigns this object; required in VOTE.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(5), with = "Text", has_nil)]
    pub landmark: Option<LandmarkId>,
    /// Velocity over ground `[east, north]` in metres per second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(6), with = "Half", has_nil)]
    pub velocity_mps: Option<[f64; 2]>,
    /// Heading of the object in radians, counter-clockwise from east.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(7), with = "Half", has_nil)]
    pub heading_rad: Option<f64>,
    /// Size `[length, width]` in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(8), with = "Half", has_nil)]
    pub size_m: Option<[f64; 2]>,
    /// The detector's confidence in each class, 0 to 1, if it provides more than the best one.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[cbor(n(9), with = "Half", has_nil)]
    pub scores: BTreeMap<Label, f64>,
}

impl PerceivedObject {
    /// An object with label, confidence and position only.
    pub fn new(label: impl Into<Label>, confidence: f64, x_m: f64, y_m: f64) -> Self {
        Self {
            label: label.into(),
            confidence,
            x_m,
            y_m,
            ..Self::default()
        }
    }

    /// The reported covariance, if any.
    pub fn covariance(&self) -> Option<Covariance> {
        self.covariance_m2.map(Covariance::from)
    }
}

/// The field of view of a camera or scanner, from the pose of its report and centred on its
/// heading.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct FieldOfView {
    /// Range in metres within which objects are usually detected.
    #[cbor(n(0), with = "Half")]
    pub range_m: f64,
    /// Opening angle in radians, both sides together; 2π for all around.
    #[cbor(n(1), with = "Single")]
    pub angle_rad: f64,
}

/// An object that is not at a landmark, at the time of fusion.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct FusedObject {
    /// Stable identity of the object.
    #[cbor(n(0), with = "UuidBytes")]
    pub id: Uuid,
    /// The agreed label.
    #[cbor(n(1), with = "Text")]
    pub label: Label,
    /// Probability, 0 to 1, that the object exists and is within 1.5 m of the position.
    #[cbor(n(2), with = "Half")]
    pub confidence: f64,
    /// East in metres.
    #[cbor(n(3), with = "Millimetres")]
    pub x_m: f64,
    /// North in metres.
    #[cbor(n(4), with = "Millimetres")]
    pub y_m: f64,
    /// Position covariance `[xx, xy, yy]` in m².
    #[cbor(n(5), with = "CovarianceForm")]
    pub covariance_m2: [f64; 3],
    /// The nodes whose detections were used for the entry.
    #[n(6)]
    pub contributors: Vec<NodeName>,
    /// Probability that the object exists and is still there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(7), with = "Half", has_nil)]
    pub existence: Option<f64>,
    /// Probability of each class.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    #[cbor(n(14), with = "Half", has_nil)]
    pub scores: BTreeMap<Label, f64>,
    /// Velocity over ground `[east, north]` in metres per second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(8), with = "Half", has_nil)]
    pub velocity_mps: Option<[f64; 2]>,
    /// Heading of the object in radians, counter-clockwise from east.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(9), with = "Half", has_nil)]
    pub heading_rad: Option<f64>,
    /// Size `[length, width]` in metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(10), with = "Half", has_nil)]
    pub size_m: Option<[f64; 2]>,
    /// Time in seconds since it was last detected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cbor(n(11), with = "Half", has_nil)]
    pub age_s: Option<f64>,
    /// Time of the first detection, in the cell's time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(12)]
    pub first_seen_us: Option<Timestamp>,
    /// The node whose vehicle this object is, by the node's own report.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[n(13)]
    pub vehicle: Option<NodeName>,
}

impl FusedObject {
    /// An object with label, confidence and position only.
    pub fn new(
        id: Uuid,
        label: impl Into<Label>,
        confidence: f64,
        x_m: f64,
        y_m: f64,
        covariance: Covariance,
    ) -> Self {
        Self {
            id,
            label: label.into(),
            confidence,
            x_m,
            y_m,
            covariance_m2: covariance.into(),
            ..Self::default()
        }
    }

    /// Covariance of the position in m², east and north.
    pub fn covariance(&self) -> Covariance {
        self.covariance_m2.into()
    }
}

/// The estimated error of a vehicle's positions, from objects that several vehicles detect.
///
/// A reported position p is corrected to R(`dheading_rad`)·(p − `about_m`) + `about_m` + (`dx_m`,
/// `dy_m`).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct PoseCorrection {
    /// Centre of the rotation `[east, north]` in metres: the reported pose, or the middle of the
    /// vehicle's detections.
    #[cbor(n(0), with = "Millimetres")]
    pub about_m: [f64; 2],
    /// East in metres.
    #[cbor(n(1), with = "Millimetres")]
    pub dx_m: f64,
    /// North in metres.
    #[cbor(n(2), with = "Millimetres")]
    pub dy_m: f64,
    /// Rotation in radians, counter-clockwise.
    #[cbor(n(3), with = "Half")]
    pub dheading_rad: f64,
    /// Number of pairs of detections in the estimate; older ones count less.
    #[cbor(n(4), with = "Half")]
    pub pairs: f64,
}
