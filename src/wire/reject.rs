//! Reasons for which a payload is not used.

use std::fmt;

/// Why a payload was not used; nothing was changed by it. The name is the reason's label in counters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RejectReason {
    /// More bytes than [`Limits`](super::Limits) allow.
    TooLarge,
    /// Neither JSON nor CBOR, truncated, not UTF-8, or without a required field.
    Malformed,
    /// A `schema` other than [`SCHEMA_VERSION`](super::SCHEMA_VERSION).
    UnknownSchema,
    /// The payload's node is not the topic's.
    NodeMismatch,
    /// More objects or seen landmarks than [`Limits::objects`](super::Limits::objects).
    TooManyObjects,
    /// A number is NaN, infinite or out of the world's bounds, or a covariance is not one.
    NotFinite,
    /// An epoch, round, count or time beyond [`MAX_INTEGER`](super::MAX_INTEGER), or a score out of its bounds.
    OutOfRange,
    /// A confidence outside 0 to 1.
    ConfidenceOutOfRange,
    /// An empty or overlong label or landmark id.
    InvalidLabel,
    /// Captured or fused further in the future than clocks may differ.
    FromTheFuture,
    /// Captured too long ago, or a round that was under way for too long.
    Stale,
    /// Not newer than a report already taken from this node.
    OutOfOrder,
    /// A vehicle beyond the most that an aggregator keeps.
    TooManyVehicles,
    /// A topic that is none of this cell's.
    UnknownTopic,
    /// From an aggregator or epoch that has been superseded.
    Superseded,
    /// From an aggregator that the election does not name.
    NotElected,
    /// A report for an algorithm that the cell does not run.
    NotFused,
    /// A payload without a signature of the cell, where every payload must have one.
    BadSignature,
    /// Evidence of a node that is not known to be one that may lead.
    NotCandidate,
    /// Evidence of a term that the election does not know yet.
    UnknownTerm,
}

impl RejectReason {
    /// All reasons, for counters.
    pub const ALL: [Self; 20] = [
        Self::TooLarge,
        Self::Malformed,
        Self::UnknownSchema,
        Self::NodeMismatch,
        Self::TooManyObjects,
        Self::NotFinite,
        Self::OutOfRange,
        Self::ConfidenceOutOfRange,
        Self::InvalidLabel,
        Self::FromTheFuture,
        Self::Stale,
        Self::OutOfOrder,
        Self::TooManyVehicles,
        Self::UnknownTopic,
        Self::Superseded,
        Self::NotElected,
        Self::NotFused,
        Self::BadSignature,
        Self::NotCandidate,
        Self::UnknownTerm,
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
            Self::OutOfRange => "out_of_range",
            Self::ConfidenceOutOfRange => "confidence_out_of_range",
            Self::InvalidLabel => "invalid_label",
            Self::FromTheFuture => "from_the_future",
            Self::Stale => "stale",
            Self::OutOfOrder => "out_of_order",
            Self::TooManyVehicles => "too_many_vehicles",
            Self::UnknownTopic => "unknown_topic",
            Self::Superseded => "superseded",
            Self::NotElected => "not_elected",
            Self::NotFused => "not_fused",
            Self::BadSignature => "bad_signature",
            Self::NotCandidate => "not_candidate",
            Self::UnknownTerm => "unknown_term",
        }
    }
}

impl fmt::Display for RejectReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::error::Error for RejectReason {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_can_be_indexed_by_reason() {
        for (index, reason) in RejectReason::ALL.into_iter().enumerate() {
            assert_eq!(reason as usize, index);
        }
    }
}
