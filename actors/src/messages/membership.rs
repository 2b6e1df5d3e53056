//! Requests to the actor `Membership`, from the election and from the membership itself.

use std::net::SocketAddr;

use bytes::Bytes;
use ecod::model::names::NodeName;
use ractor::RpcReplyPort;

/// Result of a renewal step that ran in a separate task.
#[derive(Debug)]
pub enum RenewalOutcome {
    /// This node has decided about another node's request.
    Answered {
        /// Node that sent the request.
        to: NodeName,
        /// Its request, by which a repeated one is recognised.
        request: Vec<u8>,
        /// Its new certificate in DER, or the reason for the refusal.
        answer: Result<Vec<u8>, String>,
    },
    /// This node has replaced its own certificate, or the reason why not.
    Replaced(Result<(), String>),
}

/// Requests to the membership.
#[derive(Debug)]
pub enum MembershipMessage {
    /// Send a datagram to a node, once and without waiting; it may be lost.
    Send {
        /// Node to which the datagram goes.
        to: NodeName,
        /// Payload of at most [`crate::transport::gossip::MAX_PAYLOAD_BYTES`].
        payload: Bytes,
    },
    /// Query the bound address, which may be unspecified.
    Address {
        /// Gets the bound address.
        reply: RpcReplyPort<SocketAddr>,
    },
    /// Greet these addresses; sent by the membership to itself.
    SetSeeds {
        /// Resolved addresses of all seeds.
        addresses: Vec<SocketAddr>,
    },
    /// Read changed certificates, and end sessions with an expired or revoked certificate; sent by
    /// the membership to itself.
    CheckCertificates,
    /// Check whether this machine still has the node's address; sent by the membership to itself.
    CheckAddress,
    /// A renewal of a certificate was decided; sent by the membership to itself.
    Renewal {
        /// Result of the step of the renewal.
        outcome: RenewalOutcome,
    },
    /// Process waiting datagrams and due timers; sent by the membership to itself.
    Wake,
}
