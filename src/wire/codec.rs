//! JSON and CBOR; the first byte tells them apart.

use std::fmt;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{GlobalMap, NodeStatus, ObjectReport, Reputations, SCHEMA_VERSION, Verdicts};
use crate::names::{MAX_NAME_BYTES, NodeName};

/// How a payload is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Encoding {
    /// Text that people and every language can read; the default.
    #[default]
    Json,
    /// RFC 8949 with the same field names.
    Cbor,
}

/// Bounds that a report must keep to be decoded at all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Largest payload in bytes.
    pub payload_bytes: usize,
    /// Most objects, and most seen landmarks, in one report.
    pub objects: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { payload_bytes: 256 * 1024, objects: 1024 }
    }
}

/// Why a payload was not used; nothing was changed by it. The name is the reason's label in counters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RejectReason {
    /// More bytes than [`Limits::payload_bytes`].
    TooLarge,
    /// Neither JSON nor CBOR, truncated, not UTF-8, or without a required field.
    Malformed,
    /// A `schema` other than [`SCHEMA_VERSION`].
    UnknownSchema,
    /// The payload's node is not the topic's.
    NodeMismatch,
    /// More objects or seen landmarks than [`Limits::objects`].
    TooManyObjects,
    /// A number is NaN, infinite or out of the world's bounds, or a covariance is not one.
    NotFinite,
    /// A confidence outside 0 to 1.
    ConfidenceOutOfRange,
    /// An empty or overlong label or landmark id.
    InvalidLabel,
    /// Captured further in the future than clocks may differ.
    FromTheFuture,
    /// Captured too long ago.
    Stale,
    /// Not newer than a report already taken from this node.
    OutOfOrder,
    /// A vehicle beyond the most that an aggregator keeps.
    TooManyVehicles,
    /// A topic that is none of this cell's.
    UnknownTopic,
    /// From an aggregator or epoch that has been superseded.
    Superseded,
}

impl RejectReason {
    /// All reasons, for counters.
    pub const ALL: [Self; 14] = [
        Self::TooLarge,
        Self::Malformed,
        Self::UnknownSchema,
        Self::NodeMismatch,
        Self::TooManyObjects,
        Self::NotFinite,
        Self::ConfidenceOutOfRange,
        Self::InvalidLabel,
        Self::FromTheFuture,
        Self::Stale,
        Self::OutOfOrder,
        Self::TooManyVehicles,
        Self::UnknownTopic,
        Self::Superseded,
    ];

    /// The reason as a counter's label.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::TooLarge => "too_large",
            Self::Malformed => "malformed",
            Self::UnknownSchema => "unknown_schema",
            Self::NodeMismatch => "node_mismatch",
            Self::TooManyObjects => "too_many_objects",
            Self::NotFinite => "not_finite",
            Self::ConfidenceOutOfRange => "confidence_out_of_range",
            Self::InvalidLabel => "invalid_label",
            Self::FromTheFuture => "from_the_future",
            Self::Stale => "stale",
            Self::OutOfOrder => "out_of_order",
            Self::TooManyVehicles => "too_many_vehicles",
            Self::UnknownTopic => "unknown_topic",
            Self::Superseded => "superseded",
        }
    }
}

impl fmt::Display for RejectReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::error::Error for RejectReason {}

/// Largest coordinate in metres that is taken for a position on Earth.
const WORLD_BOUND_M: f64 = 1e8;

/// Writes a payload.
///
/// # Panics
/// Never for the payloads of this crate: they serialise into memory.
pub fn encode<T: Serialize>(payload: &T, encoding: Encoding) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(512);
    match encoding {
        Encoding::Json => serde_json::to_writer(&mut bytes, payload).expect("payloads serialise into memory"),
        Encoding::Cbor => ciborium::into_writer(payload, &mut bytes).expect("payloads serialise into memory"),
    }
    bytes
}

/// What travels on a topic, with the version of its form.
pub trait Payload: Serialize + DeserializeOwned {
    /// Major version that the payload claims to have.
    fn schema(&self) -> u32;
}

macro_rules! payloads {
    ($($payload:ty),+) => {
        $(impl Payload for $payload {
            fn schema(&self) -> u32 {
                self.schema
            }
        })+
    };
}

payloads!(ObjectReport, GlobalMap, Verdicts, Reputations, NodeStatus);

/// Reads any payload whose `schema` is known.
///
/// # Errors
/// [`RejectReason::TooLarge`], [`RejectReason::Malformed`], [`RejectReason::UnknownSchema`], or
/// [`RejectReason::NotFinite`] for JSON numbers beyond 64-bit floats.
pub fn decode<T: Payload>(bytes: &[u8], limits: &Limits) -> Result<T, RejectReason> {
    if bytes.len() > limits.payload_bytes {
        return Err(RejectReason::TooLarge);
    }
    let payload: T = read(bytes).map_err(|reason| match read::<SchemaOnly>(bytes) {
        Ok(SchemaOnly { schema }) if schema != SCHEMA_VERSION => RejectReason::UnknownSchema,
        _ => reason,
    })?;
    if payload.schema() != SCHEMA_VERSION {
        return Err(RejectReason::UnknownSchema);
    }
    Ok(payload)
}

/// Reads a report and checks every value in it; `topic_node` is the node named by its topic.
///
/// # Errors
/// The first reason found; see [`RejectReason`].
pub fn decode_report(bytes: &[u8], topic_node: &NodeName, limits: &Limits) -> Result<ObjectReport, RejectReason> {
    let report: ObjectReport = decode(bytes, limits)?;
    if report.node != *topic_node {
        return Err(RejectReason::NodeMismatch);
    }
    report.validate(limits)?;
    Ok(report)
}

impl ObjectReport {
    /// Checks version, counts, numbers and labels.
    ///
    /// # Errors
    /// The first reason found.
    pub fn validate(&self, limits: &Limits) -> Result<(), RejectReason> {
        if self.schema != SCHEMA_VERSION {
            return Err(RejectReason::UnknownSchema);
        }
        let seen = self.seen.as_deref().unwrap_or_default();
        if self.objects.len() > limits.objects || seen.len() > limits.objects {
            return Err(RejectReason::TooManyObjects);
        }
        if let Some(pose) = self.pose
            && !(in_world(pose.x_m) && in_world(pose.y_m) && pose.heading_rad.is_finite())
        {
            return Err(RejectReason::NotFinite);
        }
        if !seen.iter().all(|id| is_label(id)) {
            return Err(RejectReason::InvalidLabel);
        }
        self.objects.iter().try_for_each(|object| {
            if !(in_world(object.x_m) && in_world(object.y_m))
                || object.covariance().is_some_and(|covariance| !covariance.is_valid())
            {
                return Err(RejectReason::NotFinite);
            }
            if !(0.0..=1.0).contains(&object.confidence) {
                return Err(RejectReason::ConfidenceOutOfRange);
            }
            if !is_label(&object.label) || object.landmark.as_ref().is_some_and(|id| !is_label(id)) {
                return Err(RejectReason::InvalidLabel);
            }
            Ok(())
        })
    }
}

#[derive(Deserialize)]
struct SchemaOnly {
    schema: u32,
}

fn read<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, RejectReason> {
    match bytes.first() {
        Some(b'{' | b' ' | b'\n' | b'\r' | b'\t') => serde_json::from_slice(bytes).map_err(|error| {
            // serde_json has no other way to tell 1e999 from a syntax error.
            let overflow = error.to_string().starts_with("number out of range");
            if overflow { RejectReason::NotFinite } else { RejectReason::Malformed }
        }),
        Some(_) => ciborium::from_reader(bytes).map_err(|_| RejectReason::Malformed),
        None => Err(RejectReason::Malformed),
    }
}

fn in_world(coordinate_m: f64) -> bool {
    coordinate_m.abs() <= WORLD_BOUND_M
}

fn is_label(text: &str) -> bool {
    (1..=MAX_NAME_BYTES).contains(&text.len()) && !text.chars().any(char::is_control)
}
