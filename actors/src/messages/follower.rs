//! Messages to the follower.

use std::sync::Arc;

use ecod::wire::{GlobalMap, Reputations, Verdicts};

use crate::transport::mqtt::Delivery;

/// A message from the cell's leader; the follower accepts or refuses it.
#[derive(Debug)]
pub enum FollowerMessage {
    /// A map.
    TakeMap {
        /// The map and when it came.
        delivery: Delivery<Arc<GlobalMap>>,
    },
    /// Verdicts.
    TakeVerdicts {
        /// The verdicts and when they came.
        delivery: Delivery<Arc<Verdicts>>,
    },
    /// Reputations.
    TakeReputations {
        /// The reputations and when they came.
        delivery: Delivery<Arc<Reputations>>,
    },
}
