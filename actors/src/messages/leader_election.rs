//! Requests to the actor `LeaderElection`, from membership, gateway and the node's other parts.

use std::sync::Arc;

use ecod::leadership::node::Input;
use ecod::wire::NodeStatus;

use crate::transport::gossip::MembershipEvent;
use crate::transport::mqtt::Delivery;

/// Messages to the election.
#[derive(Debug)]
pub enum LeaderElectionMessage {
    /// The membership detected a change, or received a message.
    Membership {
        /// The change, or the received message.
        event: MembershipEvent,
    },
    /// A broker forwarded a status.
    HandleStatus {
        /// Another node's status, or its last will, and its place in the queue.
        delivery: Delivery<Arc<NodeStatus>>,
    },
    /// Something else happened at the node.
    Record {
        /// Input of the state machine of the leadership.
        input: Input,
    },
}
