//! Messages to the actor of this name.

use std::sync::Arc;

use ecod::leadership::node::Input;
use ecod::wire::NodeStatus;

use crate::transport::gossip::MembershipEvent;
use crate::transport::mqtt::Delivery;

/// Messages to the election.
#[derive(Debug)]
pub enum LeaderElectionMessage {
    /// The membership found something out, or brought a message.
    Membership {
        /// The news.
        event: MembershipEvent,
    },
    /// A broker passed on a status.
    TakeStatus {
        /// Another node's status, or its last will, and its place among what waits.
        delivery: Delivery<Arc<NodeStatus>>,
    },
    /// Something else happened at the node.
    Note {
        /// The news.
        input: Input,
    },
}
