//! The order of rounds: epochs, and the rounds within an epoch, only increase.

use crate::model::epoch::Epoch;
use crate::wire::RejectReason;

/// Admits the rounds of one topic so that the epoch, and the round within an epoch, only increase.
///
/// The gate moves with the admitted rounds and is independent of the election: the last round of an
/// old leader is still accepted while its elected successor has not published yet. This makes
/// handovers free of gaps.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct EpochGate {
    floor: u64,
    latest: Option<(Epoch, u64)>,
}

impl EpochGate {
    /// Creates an empty gate that refuses terms below `floor`.
    pub fn new(floor: u64) -> Self {
        Self {
            floor,
            latest: None,
        }
    }

    /// Admits round `round` of `epoch`, or refuses it.
    ///
    /// # Errors
    /// Returns [`RejectReason::Superseded`] if a later epoch was admitted, or this or a later round
    /// of the same epoch. The gate is unchanged in this case.
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
    fn old_or_repeated_rounds_refused() {
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
    fn terms_below_persisted_are_refused() {
        let mut gate = EpochGate::new(7);
        assert_eq!(
            gate.admit(&epoch(6, "edge"), 500),
            Err(RejectReason::Superseded)
        );
        assert_eq!(gate.admit(&epoch(7, "edge"), 1), Ok(()));
    }
}
