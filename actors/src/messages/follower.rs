//! Messages to the actor of this name.

use crate::transport::mqtt::Delivery;

/// What the follower is asked to do.
#[derive(Debug)]
pub enum FollowerMessage {
    /// Take a map.
    TakeMap {
        /// The map and when it came.
        delivery: Delivery,
    },
    /// Take verdicts.
    TakeVerdicts {
        /// The verdicts and when they came.
        delivery: Delivery,
    },
    /// Take reputations.
    TakeReputations {
        /// The reputations and when they came.
        delivery: Delivery,
    },
}
