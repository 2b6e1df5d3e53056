//! Proof that a round is of the aggregator that it names.

use crate::model::names::NodeName;

/// Proof of a round's aggregator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Origin {
    /// It came over the aggregator's own broker, has its signature, or is the node's own.
    Proven,
    /// Its own word only: in a cell without certificates, or at a broker of others.
    Claimed,
}

/// State of the signature under a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignatureState {
    /// The aggregator signed this round.
    Valid,
    /// None, a wrong one, or one of a node whose certificate is not known.
    Invalid,
    /// This node cannot verify signatures: it has no certificates, or no membership.
    Unverifiable,
}

impl Origin {
    /// Origin of a round that came over a broker; `None` if the round is refused.
    ///
    /// `broker` is the node whose certificate the broker has proven, if any. An aggregator's own broker lets nobody else
    /// publish rounds. The broker of another node may: only what the aggregator signed is taken from it. `signature` is
    /// asked for where it matters.
    pub fn of(
        aggregator: Option<&NodeName>,
        broker: Option<&NodeName>,
        signature: impl FnOnce() -> SignatureState,
    ) -> Option<Self> {
        if broker.is_some() && broker == aggregator {
            return Some(Self::Proven);
        }
        match (signature(), broker) {
            (SignatureState::Valid, _) => Some(Self::Proven),
            (SignatureState::Invalid, Some(_)) => None,
            (SignatureState::Invalid, None) | (SignatureState::Unverifiable, _) => {
                Some(Self::Claimed)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_over_another_nodes_broker_needs_a_signature() {
        use SignatureState::{Invalid, Unverifiable, Valid};

        let [edge, euclid] = ["edge", "euclid"].map(NodeName::from_static);
        let of =
            |broker: Option<&NodeName>, signature| Origin::of(Some(&edge), broker, || signature);
        for (broker, signature, expected) in [
            (Some(&edge), Invalid, Some(Origin::Proven)),
            (Some(&euclid), Valid, Some(Origin::Proven)),
            (Some(&euclid), Invalid, None),
            (Some(&euclid), Unverifiable, Some(Origin::Claimed)),
            (None, Valid, Some(Origin::Proven)),
            (None, Invalid, Some(Origin::Claimed)),
            (None, Unverifiable, Some(Origin::Claimed)),
        ] {
            assert_eq!(of(broker, signature), expected, "{broker:?} {signature:?}");
        }
        assert_eq!(
            Origin::of(None, Some(&edge), || Invalid),
            None,
            "it names no aggregator"
        );
    }
}
