//! Leaderships and their order, and the gate that refuses what a superseded leader still sends.
//!
//! On the wire an [`Epoch`] is two fields: `epoch` is [`Epoch::term`] and `aggregator` is [`Epoch::leader`]. Two sides
//! of a split network may use the same term; the name makes their epochs different, and the pair orders them all.

use std::fmt;

use minicbor::{Decode, Encode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::names::NodeName;
use crate::wire::{GlobalMap, RejectReason};

/// One leadership: ordered by term, then by the leader's name; no two leaderships share one.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, Encode, Decode, JsonSchema)]
pub struct Epoch {
    /// Counts up with every leadership that a component of the network has seen; the `epoch` of maps and verdicts.
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

/// Admits the rounds of one topic so that neither epoch nor, within an epoch, round ever goes back.
///
/// The gate moves with what it admits, never with what the election knows: the last round of an old leader is still
/// taken while the new one, already elected, has published nothing. That is what makes a handover free of gaps.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct EpochGate {
    floor: u64,
    latest: Option<(Epoch, u64)>,
}

impl EpochGate {
    /// A gate that has admitted nothing and refuses terms below `floor`; see [`crate::leadership::election::Election::floor`].
    pub fn new(floor: u64) -> Self {
        Self { floor, latest: None }
    }

    /// Takes round `round` of `epoch`, or refuses it.
    ///
    /// # Errors
    /// [`RejectReason::Superseded`] when a later epoch was admitted, or this or a later round of the same; the gate is
    /// unchanged.
    pub fn admit(&mut self, epoch: &Epoch, round: u64) -> Result<(), RejectReason> {
        let newer = match &self.latest {
            None => epoch.term >= self.floor,
            Some((latest, last_round)) => (epoch, round) > (latest, *last_round),
        };
        if !newer {
            return Err(RejectReason::Superseded);
        }
        self.latest = Some((epoch.clone(), round));
        Ok(())
    }

    /// Takes a map, or refuses it.
    ///
    /// # Errors
    /// As [`Self::admit`].
    pub fn admit_map(&mut self, map: &GlobalMap) -> Result<(), RejectReason> {
        self.admit(&Epoch::new(map.epoch, map.aggregator.clone()), map.round)
    }

    /// The epoch and round admitted last.
    pub fn latest(&self) -> Option<(&Epoch, u64)> {
        self.latest.as_ref().map(|(epoch, round)| (epoch, *round))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn epoch(term: u64, leader: &str) -> Epoch {
        Epoch::new(term, NodeName::new(leader).unwrap())
    }

    #[test]
    fn epochs_order_by_term_then_leader() {
        assert!(epoch(2, "a") > epoch(1, "z"));
        assert!(epoch(2, "b") > epoch(2, "a"));
    }

    #[test]
    fn the_gate_refuses_old_epochs_and_repeated_rounds() {
        let mut gate = EpochGate::default();
        assert_eq!(gate.admit(&epoch(3, "edge"), 88), Ok(()));
        assert_eq!(gate.admit(&epoch(3, "edge"), 88), Err(RejectReason::Superseded));
        assert_eq!(gate.admit(&epoch(3, "edge"), 89), Ok(()));
        assert_eq!(gate.admit(&epoch(4, "euclid"), 90), Ok(()));
        assert_eq!(gate.admit(&epoch(3, "edge"), 91), Err(RejectReason::Superseded));
        assert_eq!(gate.admit(&epoch(4, "edge"), 91), Err(RejectReason::Superseded));
        assert_eq!(gate.latest(), Some((&epoch(4, "euclid"), 90)));
    }

    #[test]
    fn a_restarted_node_refuses_terms_below_the_persisted_one() {
        let mut gate = EpochGate::new(7);
        assert_eq!(gate.admit(&epoch(6, "edge"), 500), Err(RejectReason::Superseded));
        assert_eq!(gate.admit(&epoch(7, "edge"), 1), Ok(()));
    }
}
