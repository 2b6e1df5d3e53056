//! Messages to the actor of this name.

use std::sync::Arc;

use ecod::leadership::node::Input;
use ecod::wire::NodeStatus;

use crate::transport::gossip::MembershipEvent;
use crate::transport::mqtt::Delivery;

/// What the election is told.
#[derive(Debug)]
pub enum LeaderElectionMessage {
    /// The membership found something out, or brought a message.
    Membership {
        /// What it was.
        event: MembershipEvent,
    },
    /// A broker passed on a status.
    TakeStatus {
        /// Another node's status, or its last will, and its place among what waits.
        delivery: Delivery<Arc<NodeStatus>>,
    },
    /// Something else happened at the node.
    Note {
        /// What it was.
        input: Input,
    },
}
