//! Messages to the follower.

use std::sync::Arc;

use ecod::wire::{GlobalMap, Reputations, Verdicts};

use crate::transport::mqtt::Delivery;

/// A message from the cell's leader; the follower accepts or refuses it.
#[derive(Debug)]
pub enum FollowerMessage {
    /// A map of a closed round.
    HandleMap {
        /// The map and its time of receipt.
        delivery: Delivery<Arc<GlobalMap>>,
    },
    /// Verdicts of a closed round.
    HandleVerdicts {
        /// The verdicts and their time of receipt.
        delivery: Delivery<Arc<Verdicts>>,
    },
    /// Reputations, possibly retained by a broker.
    HandleReputations {
        /// The reputations and their time of receipt.
        delivery: Delivery<Arc<Reputations>>,
    },
}
