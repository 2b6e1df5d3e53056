//! Datagrams between the nodes of a cell: membership, authentication, and messages of the election.

#![deny(clippy::indexing_slicing)]

pub(crate) mod config;
pub(crate) mod counters;
pub(crate) mod frame;
#[cfg(fuzzing)]
pub mod fuzzing;
pub(crate) mod handshake;
pub(crate) mod key;
pub(crate) mod machine;
pub(crate) mod node_id;
pub(crate) mod notices;
pub(crate) mod replay_window;
pub(crate) mod reply_throttle;
pub(crate) mod seeds;
pub(crate) mod session_keys;
pub(crate) mod sessions;
pub(crate) mod socket;
pub(crate) mod swim;
#[cfg(any(test, fuzzing))]
pub(crate) mod test_authority;
use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use ecod::diagnostics::TroubleKind;
use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;

pub(crate) use config::is_host_and_port;
pub use config::{DEFAULT_PORT, MembershipConfig, MulticastConfig};
pub use counters::{FrameCounters, FrameEvent};
pub(crate) use key::payload_key;
pub use key::{KeyError, check_key};
pub(crate) use seeds::look_up;
pub use socket::BindError;
pub(crate) use socket::is_of_this_machine;

/// Maximum size in bytes of a payload that the membership sends.
pub const MAX_PAYLOAD_BYTES: usize = 1200;

/// A node of the cell.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Member {
    /// Name of the node; in a cell with certificates, the name in its certificate.
    pub name: NodeName,
    /// Time of its start in Unix microseconds, by its own clock.
    pub run: u64,
    /// Address of its gossip socket.
    pub gossip: SocketAddr,
    /// Address of its broker, if it has one.
    pub broker: Option<SocketAddr>,
    /// The role with which the node was started; in a cell with certificates, at most the
    /// certificate's role.
    pub role: Role,
    /// Its proven certificate in DER; `None` in a cell without certificates.
    pub certificate: Option<Arc<[u8]>>,
}

/// An event of the membership.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MembershipEvent {
    /// A node is alive, or a new run of it.
    Alive {
        /// The node with its current addresses.
        member: Member,
    },
    /// A node does not answer. It is declared down unless it answers soon.
    Suspected {
        /// Name of the node.
        name: NodeName,
    },
    /// A node is down.
    Down {
        /// Name of the node.
        name: NodeName,
    },
    /// The certificate of a node was revoked or has expired. An event that the node is down
    /// follows.
    Expelled {
        /// Name of the node.
        name: NodeName,
    },
    /// A living node's addresses changed.
    Changed {
        /// The node as it is now.
        member: Member,
    },
    /// This node's own address changed; connections from the earlier address are dead.
    Moved,
    /// A datagram of another node arrived.
    Received {
        /// Node that sent it, as its session proves.
        from: NodeName,
        /// Its rights by its certificate; all in a cell without certificates.
        rights: Rights,
        /// The payload as its sender passed it.
        payload: Bytes,
        /// Time of arrival by this node's clock.
        received_at: Timestamp,
    },
    /// Another node or host does not fit this cell.
    Troubled {
        /// Name of the node, or address of the host.
        about: String,
        /// Kind of the trouble.
        kind: TroubleKind,
        /// The trouble as text.
        cause: String,
    },
    /// Another node has this node's name, and all other nodes accept that node.
    Excluded,
}

/// Callback for events. It runs on the membership's own task and must not block.
pub type EventSink = Arc<dyn Fn(MembershipEvent) + Send + Sync>;
