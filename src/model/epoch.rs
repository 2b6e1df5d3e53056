//! Leaderships and their order.
//!
//! On the wire an [`Epoch`] is two fields: `epoch` is [`Epoch::term`] and `aggregator` is
//! [`Epoch::leader`]. Two sides of a split network may use the same term; the name makes their
//! epochs different, and the pair orders them all.

use std::fmt;

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::model::names::NodeName;

/// One leadership: ordered by term, then by the leader's name; no two leaderships share one.
#[derive(
    Debug,
    Clone,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    Encode,
    Decode,
    JsonSchema,
)]
pub struct Epoch {
    /// Counts up with every leadership that a component of the network has seen; the `epoch` of
    /// maps and verdicts.
    #[n(0)]
    pub term: u64,
    /// The leading node; the `aggregator` of maps and verdicts.
    #[n(1)]
    pub leader: NodeName,
}

impl Epoch {
    /// The leadership of `leader` in `term`.
    pub fn new(term: u64, leader: NodeName) -> Self {
        Self { term, leader }
    }
}

impl fmt::Display for Epoch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.leader, self.term)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn epoch(term: u64, leader: &str) -> Epoch {
        Epoch::new(term, NodeName::new(leader).unwrap())
    }

    #[test]
    fn epochs_order_by_term_first() {
        assert!(epoch(2, "a") > epoch(1, "z"));
        assert!(epoch(2, "b") > epoch(2, "a"));
    }
}
