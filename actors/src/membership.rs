//! The actor that owns the node's gossip socket: who is alive, independent of MQTT, and small datagrams between nodes.
//!
//! ```text
//! LeaderElection ── Send ─────> Membership <──── UDP ────> other nodes
//! Broker ───────── SetBroker ─>     │
//!                                   └──> MembershipEvent, watch of all members
//! ```

mod config;

use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::Role;
use ractor::RpcReplyPort;
use tokio::sync::watch;

pub use config::{DEFAULT_PORT, MembershipConfig, MulticastConfig};

/// What the membership is asked to do.
#[derive(Debug)]
pub enum MembershipMessage {
    /// Send a datagram to a node, once and without waiting; it may be lost.
    Send {
        /// The addressee.
        to: NodeName,
        /// At most [`MAX_PAYLOAD_BYTES`].
        payload: Bytes,
    },
    /// Tell all where this node's broker listens, or that it has none.
    SetBroker {
        /// The address; others put what they see of this node in place of 0.0.0.0.
        address: Option<SocketAddr>,
    },
    /// Say goodbye to all, who then take this node for down at once.
    Leave,
    /// Name all living nodes but this one.
    Members {
        /// Gets the answer.
        reply: RpcReplyPort<Vec<Member>>,
    },
    /// Datagrams wait or a deadline has passed; sent by the membership to itself.
    Wake,
}

/// Largest payload of [`MembershipMessage::Send`] in bytes.
pub const MAX_PAYLOAD_BYTES: usize = 1200;

/// A node of the cell.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Member {
    /// Its name.
    pub name: NodeName,
    /// When it started, in Unix microseconds by its own clock.
    pub run: u64,
    /// Where it gossips.
    pub gossip: SocketAddr,
    /// Where its broker can be reached, if it has one.
    pub broker: Option<SocketAddr>,
    /// The role it was started with.
    pub role: Role,
}

/// What the membership found out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MembershipEvent {
    /// A node is there, or a new run of it.
    Alive {
        /// The node.
        member: Member,
    },
    /// A node does not answer; it is given up unless it does so soon.
    Suspected {
        /// The node.
        name: NodeName,
    },
    /// A node is gone.
    Down {
        /// The node.
        name: NodeName,
    },
    /// A living node's addresses changed.
    Changed {
        /// The node as it is now.
        member: Member,
    },
    /// A datagram came.
    Received {
        /// The authenticated sender.
        from: NodeName,
        /// What it sent.
        payload: Bytes,
        /// When it came, by this node's clock.
        received_at: Timestamp,
    },
    /// Two running nodes use one name, perhaps that of this node; only the later started one is heard.
    NameTaken {
        /// The name.
        name: NodeName,
    },
}

/// Takes events on the membership's own task: it must not wait.
pub type EventSink = Arc<dyn Fn(MembershipEvent) + Send + Sync>;

/// What a membership needs at its start.
pub struct MembershipArguments {
    /// The node's name.
    pub name: NodeName,
    /// The cell; nodes of others are not heard.
    pub cell: NodeName,
    /// When the node started, in Unix microseconds.
    pub run: u64,
    /// The role it was started with.
    pub role: Role,
    /// Where the node's broker listens, if it has one.
    pub broker: Option<SocketAddr>,
    /// Timings, seeds and limits.
    pub config: MembershipConfig,
    /// Gets every event.
    pub events: EventSink,
    /// Holds all living nodes but this one, by name.
    pub members: watch::Sender<Vec<Member>>,
}
