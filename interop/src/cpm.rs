//! Collective perception messages of ETSI TS 103 324 V2.1.1, in UPER.
//!
//! Positions in a message are metres east and north of its reference position, which is on Earth
//! (WGS 84). A cell therefore needs an origin on Earth. Confidences of positions are half widths at
//! a level of 95 %: 1.96 standard deviations.

mod classes;
mod decoding;
mod encoding;
mod frame;
mod identifiers;
mod segments;

use std::collections::BTreeSet;

use ecod::model::names::Label;
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::PerceivedObject;

pub use decoding::decode;
pub use encoding::{encode_map, encode_report};
pub use identifiers::{ObjectIds, RECEIVED_PART, StationIds, is_received};
pub use segments::Segments;

/// Maximum size of a message in bytes: 255 objects with all optional fields need less than half of
/// it.
pub const MAX_BYTES: usize = 64 * 1024;

/// Standard deviations in the half width of an interval of 95 %.
const SIGMAS: f64 = 1.96;

/// Coordinates in centimetres, excluding the codes for values out of range.
const COORDINATES_CM: std::ops::RangeInclusive<i32> = -131_071..=131_070;

/// Code of a coordinate's confidence: the half width is more than 40.94 m.
const WIDE_COORDINATE: u16 = 4095;

/// Code of a coordinate's confidence that is unavailable.
const UNSTATED_COORDINATE: u16 = 4096;

/// Version of the protocol in the header of all messages of release 2.
const PROTOCOL_VERSION: u8 = 2;

/// Kind of message in the header: CPM.
const MESSAGE_ID: u8 = 14;

/// Milliseconds from the Unix epoch to 2004-01-01, minus the five leap seconds since then, which
/// `TimestampIts` counts.
const ITS_EPOCH_MS: u64 = 1_072_915_200_000 - 5_000;

/// The properties of a cell that its messages need.
#[derive(Debug, Clone, PartialEq)]
pub struct CpmCell {
    /// Place of the cell's frame on Earth.
    pub origin: GeographicOrigin,
    /// Labels of vacancy signs, which are not objects.
    pub vacancy_signs: BTreeSet<Label>,
}

/// A message to be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedCpm {
    /// The message in UPER.
    pub bytes: Vec<u8>,
    /// Objects that it has no room for: beyond 255, or more than 1310 m from the reference
    /// position.
    pub left_out: usize,
}

/// A station's objects at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct ReceivedCpm {
    /// Number of the station.
    pub station_id: u32,
    /// Reference time of the message. All objects are moved to it by their velocities.
    pub captured_at: Timestamp,
    /// Number of this segment and of all, if the station's objects are spread over several
    /// messages.
    pub segment: Option<(u8, u8)>,
    /// The objects in the cell's frame.
    pub objects: Vec<PerceivedObject>,
    /// Objects without a usable place: a coordinate out of range, or a measurement more than a
    /// second from the reference time.
    pub left_out: usize,
}

/// A message that cannot be written or used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum CpmError {
    /// The message has more than [`MAX_BYTES`] bytes.
    #[error("too large")]
    TooLarge,
    /// Not UPER of a CPM.
    #[error("not a CPM in UPER")]
    Malformed,
    /// Values that UPER of a CPM has no room for, such as a time after 2143.
    #[error("values for which a CPM has no room")]
    Unencodable,
    /// Another version or kind of message.
    #[error("not a CPM of release 2")]
    OtherMessage,
    /// A reference position that is unavailable, or has an error out of range: the standard calls
    /// it not valid.
    #[error("no reference position")]
    NoPosition,
    /// A reference position more than 100 km from the cell's origin.
    #[error("more than 100 km from the cell's origin")]
    TooFar,
    /// More objects than a report may have: [`Limits::objects`](ecod::wire::Limits::objects).
    #[error("more objects than a report may have")]
    TooManyObjects,
    /// A time before 2004.
    #[error("a time before 2004")]
    NoTime,
}

#[cfg(test)]
mod tests;
