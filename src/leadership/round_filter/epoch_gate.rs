//! The order of rounds: neither epochs nor the rounds of one epoch go back.

use crate::model::epoch::Epoch;
use crate::wire::RejectReason;

/// Admits the rounds of one topic so that neither epoch nor, within an epoch, round ever goes back.
///
/// The gate moves with what it admits, never with what the election knows: the last round of an old leader is still
/// taken while the new one, already elected, has published nothing. That makes a handover free of gaps.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct EpochGate {
    floor: u64,
    latest: Option<(Epoch, u64)>,
}

impl EpochGate {
    /// A gate that has admitted nothing and refuses terms below `floor`.
    pub fn new(floor: u64) -> Self {
        Self {
            floor,
            latest: None,
        }
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

    /// The epoch and round admitted last.
    pub fn latest(&self) -> Option<(&Epoch, u64)> {
        self.latest.as_ref().map(|(epoch, round)| (epoch, *round))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::names::NodeName;

    fn epoch(term: u64, leader: &str) -> Epoch {
        Epoch::new(term, NodeName::new(leader).unwrap())
    }

    #[test]
    fn the_gate_refuses_old_epochs_and_repeated_rounds() {
        let mut gate = EpochGate::default();
        assert_eq!(gate.admit(&epoch(3, "edge"), 88), Ok(()));
        assert_eq!(
            gate.admit(&epoch(3, "edge"), 88),
            Err(RejectReason::Superseded)
        );
        assert_eq!(gate.admit(&epoch(3, "edge"), 89), Ok(()));
        assert_eq!(gate.admit(&epoch(4, "euclid"), 90), Ok(()));
        assert_eq!(
            gate.admit(&epoch(3, "edge"), 91),
            Err(RejectReason::Superseded)
        );
        assert_eq!(
            gate.admit(&epoch(4, "edge"), 91),
            Err(RejectReason::Superseded)
        );
        assert_eq!(gate.latest(), Some((&epoch(4, "euclid"), 90)));
    }

    #[test]
    fn a_restarted_node_refuses_terms_below_the_persisted_one() {
        let mut gate = EpochGate::new(7);
        assert_eq!(
            gate.admit(&epoch(6, "edge"), 500),
            Err(RejectReason::Superseded)
        );
        assert_eq!(gate.admit(&epoch(7, "edge"), 1), Ok(()));
    }
}
