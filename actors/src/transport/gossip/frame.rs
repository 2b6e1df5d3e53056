//! Frames: the format of the membership's datagrams.
//!
//! ```text
//!  0      2        3     4       8                24         32
//! | ec 0d | version | kind | cell | sender's session | counter | sealed body ... | seal (16) |
//! ```
//!
//! All integers are big-endian. The seal is ChaCha20-Poly1305 with the head as associated data, the
//! counter as nonce, and a key of its own for every pair of sessions and direction.

use std::net::SocketAddr;

use ecod::model::names::NodeName;
use serde::{Deserialize, Serialize};

use super::MAX_PAYLOAD_BYTES;
use super::counters::FrameEvent;
use super::key::{Cookie, FrameCipher, SessionId};
use super::node_id::NodeId;

/// Bytes before the sealed body.
pub(crate) const HEADER_BYTES: usize = 32;

/// Longest frame in bytes.
pub(crate) const MAX_FRAME_BYTES: usize = HEADER_BYTES + MAX_PAYLOAD_BYTES + SEAL_BYTES;

const SEAL_BYTES: usize = 16;
const MAGIC: [u8; 2] = [0xec, 0x0d];

/// Version of a frame. A cell has one: nodes with certificates and nodes without do not admit each
/// other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Version {
    /// Sessions prove the cell's key.
    Key = 1,
    /// Sessions prove the certificates of their nodes, too.
    Certificate = 2,
}

/// Content of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FrameKind {
    /// A greeting, sealed for all nodes of the cell.
    Hello = 1,
    /// A step of the handshake that establishes a session.
    Handshake = 2,
    /// A message of the SWIM protocol.
    Gossip = 3,
    /// A datagram of the node's other actors.
    Payload = 4,
    /// A request for a renewed certificate, or its answer.
    Renewal = 5,
}

/// A step of the handshake. In a cell with certificates an
/// [`Attestation`](super::handshake::Attestation) follows each proof and accept. Each side proves
/// that it is reachable now by returning the other's cookie:
///
/// ```text
/// A ── Hello ─────────────────────────────────────▶ all, or a seed
/// A ◀───── Challenge { cookie of B } ────────────── B    remembers nothing
/// A ── Proof { that cookie, cookie of A } ────────▶ B    B knows A
/// A ◀───── Accept { that cookie } ───────────────── B    A knows B
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Handshake {
    /// Requests that the greeting node prove that it is reachable.
    Challenge {
        /// Cookie to be returned.
        cookie: Cookie,
        /// Name of the challenger.
        name: NodeName,
    },
    /// Proves reachability, and requests the same proof from the challenger.
    Proof {
        /// The challenger's cookie.
        echo: Cookie,
        /// Cookie to be returned.
        cookie: Cookie,
        /// Identity of the prover.
        introduction: Introduction,
    },
    /// Proves the challenger's reachability; ends the handshake.
    Accept {
        /// The prover's cookie.
        echo: Cookie,
        /// Identity of the accepter.
        introduction: Introduction,
    },
}

impl Handshake {
    /// The returned cookie and the sender's introduction; `None` for a challenge.
    pub(crate) fn answer(&self) -> Option<(&Cookie, &Introduction)> {
        match self {
            Self::Challenge { .. } => None,
            Self::Proof {
                echo, introduction, ..
            }
            | Self::Accept { echo, introduction } => Some((echo, introduction)),
        }
    }
}

/// Information that two nodes exchange in the handshake.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Introduction {
    /// Identity of the sender.
    pub(crate) id: NodeId,
    /// Address from which the receiver's packets reach the sender.
    pub(crate) seen_at: SocketAddr,
    /// Other claims to the receiver's name that the sender has received.
    pub(crate) claim: NameClaim,
}

/// Other claims to the name of a node that has just proven its reachability.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum NameClaim {
    /// No other claim.
    Free,
    /// A node of that name with this `life` is down. Only a greater `life` is accepted.
    After(u64),
    /// A later started node has the name.
    Taken,
}

/// A greeting. In frames of [`Version::Certificate`] a [`Greeting`] follows it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Hello {
    /// Name of the sender.
    pub(crate) name: NodeName,
}

/// More about a greeting.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Greeting {
    /// True if the sender needs a new session: it lost the previous one, or receives no frames in
    /// it.
    pub(crate) wants_session: bool,
}

/// The part of a frame that is authenticated and not encrypted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FrameHeader {
    pub(crate) version: Version,
    pub(crate) kind: FrameKind,
    pub(crate) sender: SessionId,
    pub(crate) counter: u64,
}

impl FrameHeader {
    /// Reads the head of a frame; the body follows the head.
    pub(crate) fn read(frame: &[u8], cell: [u8; 4]) -> Result<Self, FrameEvent> {
        if frame.len() > MAX_FRAME_BYTES {
            return Err(FrameEvent::Oversized);
        }
        let Some((head, _)) = frame
            .split_first_chunk::<HEADER_BYTES>()
            .filter(|(_, body)| body.len() >= SEAL_BYTES)
        else {
            return Err(FrameEvent::Malformed);
        };
        let [m0, m1, version, kind, c0, c1, c2, c3, rest @ ..] = head;
        let version = match version {
            1 => Version::Key,
            2 => Version::Certificate,
            _ => return Err(FrameEvent::Malformed),
        };
        if [*m0, *m1] != MAGIC {
            return Err(FrameEvent::Malformed);
        }
        let kind = match kind {
            1 => FrameKind::Hello,
            2 => FrameKind::Handshake,
            3 => FrameKind::Gossip,
            4 => FrameKind::Payload,
            5 => FrameKind::Renewal,
            _ => return Err(FrameEvent::Malformed),
        };
        if [*c0, *c1, *c2, *c3] != cell {
            return Err(FrameEvent::WrongCell);
        }
        let (Some(&sender), Some(&counter)) = (rest.first_chunk(), rest.last_chunk()) else {
            return Err(FrameEvent::Malformed);
        };
        Ok(Self {
            version,
            kind,
            sender,
            counter: u64::from_be_bytes(counter),
        })
    }

    /// Writes a whole frame, sealed.
    pub(crate) fn write(&self, cell: [u8; 4], body: &[u8], seal: &FrameCipher) -> Vec<u8> {
        let mut frame = Vec::with_capacity(HEADER_BYTES + body.len() + SEAL_BYTES);
        frame.extend_from_slice(&self.bytes(cell));
        frame.extend_from_slice(body);
        seal.close(self.counter, &mut frame, HEADER_BYTES);
        frame
    }

    /// The head as it is on the wire.
    pub(crate) fn bytes(&self, cell: [u8; 4]) -> [u8; HEADER_BYTES] {
        let start: [&[u8]; 3] = [&MAGIC, &[self.version as u8, self.kind as u8], &cell];
        let all = [
            &start.concat(),
            &self.sender[..],
            &self.counter.to_be_bytes(),
        ]
        .concat();
        all.try_into().unwrap_or([0; HEADER_BYTES])
    }
}
