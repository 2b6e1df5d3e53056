//! Messages to the follower.

use std::sync::Arc;

use ecod::wire::{GlobalMap, Reputations, Verdicts};

use crate::transport::mqtt::Delivery;

/// A message from the cell's leader; the follower accepts or refuses it.
#[derive(Debug)]
pub enum FollowerMessage {
    /// A map.
    TakeMap {
        /// The map and its time of receipt.
        delivery: Delivery<Arc<GlobalMap>>,
    },
    /// Verdicts.
    TakeVerdicts {
        /// The verdicts and their time of receipt.
        delivery: Delivery<Arc<Verdicts>>,
    },
    /// Reputations.
    TakeReputations {
        /// The reputations and their time of receipt.
        delivery: Delivery<Arc<Reputations>>,
    },
}
