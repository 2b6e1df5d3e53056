//! Requests to the actor `Membership`, from the election and from the membership itself.

use std::net::SocketAddr;

use bytes::Bytes;
use ecod::model::names::NodeName;
use ractor::RpcReplyPort;

/// Requests to the membership.
#[derive(Debug)]
pub enum MembershipMessage {
    /// Send a datagram to a node, once and without waiting; it may be lost.
    Send {
        /// The addressee.
        to: NodeName,
        /// At most [`crate::transport::gossip::MAX_PAYLOAD_BYTES`].
        payload: Bytes,
    },
    /// Query the bound address, which may be unspecified.
    Address {
        /// Gets the answer.
        reply: RpcReplyPort<SocketAddr>,
    },
    /// Greet these addresses; sent by the membership to itself.
    SetSeeds {
        /// The seeds, resolved.
        addresses: Vec<SocketAddr>,
    },
    /// Read changed certificates, and end sessions with an expired or revoked certificate; sent by
    /// the membership to itself.
    CheckCertificates,
    /// Process waiting datagrams and due timers; sent by the membership to itself.
    Wake,
}
