//! Proof that a round was published by the aggregator named in it.

use crate::model::names::NodeName;

/// Proof of a round's aggregator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Origin {
    /// It arrived over the aggregator's own broker, has its signature, or is the node's own.
    Proven,
    /// Only claimed in the message itself: in a cell without certificates, or over another node's
    /// broker.
    Claimed,
}

/// State of the signature under a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SignatureState {
    /// The aggregator signed this round.
    Valid,
    /// There is no signature, a wrong signature, or a signature of a node whose certificate is not
    /// available.
    Invalid,
    /// This node cannot verify signatures: it has no certificates, or no membership.
    Unverifiable,
}

impl Origin {
    /// Origin of a round that arrived over a broker; `None` if the round is refused.
    ///
    /// `broker` is the node whose certificate the broker has proven, if any. An aggregator's own
    /// broker lets only the aggregator publish rounds. Another node's broker may let other clients
    /// publish them, so only rounds signed by the aggregator are accepted from it. `signature` is
    /// only called when it is needed.
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
    fn foreign_broker_round_needs_signature() {
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
