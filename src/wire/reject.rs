//! Reasons to reject a payload.

use std::fmt;

/// Defines the reasons together with their names in counters.
macro_rules! reject_reasons {
    ($($(#[$doc:meta])* $reason:ident = $name:literal,)*) => {
        /// The reason why a payload was not used. The state is unchanged in this case.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum RejectReason {
            $($(#[$doc])* $reason,)*
        }

        impl RejectReason {
            /// All reasons, for counters; `reason as usize` is the index.
            pub const ALL: [Self; [$($name),*].len()] = [$(Self::$reason,)*];

            /// The reason as a counter's label.
            pub fn as_str(self) -> &'static str {
                match self {
                    $(Self::$reason => $name,)*
                }
            }
        }
    };
}

reject_reasons! {
    /// More bytes than [`Limits`](super::Limits) allow.
    TooLarge = "too_large",
    /// Not valid JSON or CBOR, truncated, not UTF-8, or without a required field.
    Malformed = "malformed",
    /// A `schema` other than [`SCHEMA_VERSION`](super::SCHEMA_VERSION).
    UnknownSchema = "unknown_schema",
    /// The node in the payload differs from the node in the topic.
    NodeMismatch = "node_mismatch",
    /// More objects or seen landmarks than [`Limits::objects`](super::Limits::objects).
    TooManyObjects = "too_many_objects",
    /// A number is NaN, infinite or out of the world's bounds, or a covariance is invalid.
    NotFinite = "not_finite",
    /// An epoch, round, count or time beyond [`MAX_INTEGER`](super::MAX_INTEGER), or a score out of
    /// its bounds.
    OutOfRange = "out_of_range",
    /// A confidence outside 0 to 1.
    ConfidenceOutOfRange = "confidence_out_of_range",
    /// An empty or overlong label or landmark id.
    InvalidLabel = "invalid_label",
    /// Captured or fused further in the future than clocks may differ.
    FromTheFuture = "from_the_future",
    /// Captured too long ago, or a round that took too long.
    Stale = "stale",
    /// Not newer than an earlier report of this node.
    OutOfOrder = "out_of_order",
    /// A vehicle beyond the maximum number that an aggregator keeps.
    TooManyVehicles = "too_many_vehicles",
    /// A map of a cell beyond the maximum number that a subscriber keeps.
    TooManyCells = "too_many_cells",
    /// A topic outside this cell.
    UnknownTopic = "unknown_topic",
    /// From an aggregator or epoch that has been superseded.
    Superseded = "superseded",
    /// From an aggregator other than the elected one.
    NotElected = "not_elected",
    /// A report for an algorithm that the cell does not run.
    NotFused = "not_fused",
    /// A box of a program that gives no position, such as one above the horizon.
    NotPlaced = "not_placed",
    /// A payload without the cell's signature, or evidence or a round without its aggregator's
    /// signature, where one is required.
    BadSignature = "bad_signature",
    /// Evidence of a node that is not a registered candidate.
    NotCandidate = "not_candidate",
    /// Evidence of a term that the election has not seen yet.
    UnknownTerm = "unknown_term",
    /// Evidence of a leadership that its sender cannot vouch for.
    Unattested = "unattested",
    /// Evidence of more votes than there can have been.
    Implausible = "implausible",
    /// A program's message at its node's broker under a name other than the node's, or on a topic
    /// that is read-only for programs.
    NotPermitted = "not_permitted",
}

impl RejectReason {
    /// The name as text.
    pub fn in_words(self) -> String {
        self.as_str().replace('_', " ")
    }
}

impl fmt::Display for RejectReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl std::error::Error for RejectReason {}
