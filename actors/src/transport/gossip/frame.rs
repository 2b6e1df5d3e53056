//! Frames: what a datagram of the membership looks like.
//!
//! ```text
//!  0      2        3     4       8                24         32
//! | ec 0d | version | kind | cell | sender's session | counter | sealed body ... | seal (16) |
//! ```
//!
//! All integers are big-endian. The seal is ChaCha20-Poly1305 with the head as associated data, the counter as nonce,
//! and a key of its own for every pair of sessions and direction.

use std::net::SocketAddr;

use ecod::names::NodeName;
use serde::{Deserialize, Serialize};

use super::MAX_PAYLOAD_BYTES;
use super::key::{Cookie, FrameCipher, SessionId};
use super::node_id::NodeId;

/// Bytes before the sealed body.
pub(crate) const HEADER_BYTES: usize = 32;

/// Longest frame in bytes.
pub(crate) const MAX_FRAME_BYTES: usize = HEADER_BYTES + MAX_PAYLOAD_BYTES + SEAL_BYTES;

const SEAL_BYTES: usize = 16;
const MAGIC: [u8; 2] = [0xec, 0x0d];
const VERSION: u8 = 1;

/// What a frame holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FrameKind {
    /// A greeting to whom it may concern, sealed for everybody.
    Hello = 1,
    /// A step of the handshake that establishes a session.
    Handshake = 2,
    /// Words of the gossip protocol.
    Gossip = 3,
    /// A datagram of the node's other parts.
    Payload = 4,
}

/// A node greets; another challenges it; each proves that it is there now by returning the other's cookie:
///
/// ```text
/// A ── Hello ─────────────────────────────────────▶ all, or a seed
/// A ◀───── Challenge { cookie of B } ────────────── B    remembers nothing
/// A ── Proof { that cookie, cookie of A } ────────▶ B    B knows A
/// A ◀───── Accept { that cookie } ───────────────── B    A knows B
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum Handshake {
    /// "Show that you are there."
    Challenge {
        /// To be returned.
        cookie: Cookie,
        /// Who asks.
        name: NodeName,
    },
    /// "I am; show that you are."
    Proof {
        /// The challenger's cookie.
        echo: Cookie,
        /// To be returned.
        cookie: Cookie,
        /// Who proves.
        introduction: Introduction,
    },
    /// "I am too."
    Accept {
        /// The prover's cookie.
        echo: Cookie,
        /// Who accepts.
        introduction: Introduction,
    },
}

/// What two nodes tell each other when they meet.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Introduction {
    /// The sender.
    pub(crate) id: NodeId,
    /// Where the sender sees the receiver.
    pub(crate) seen_at: SocketAddr,
    /// What the sender knows of the receiver's name.
    pub(crate) claim: NameClaim,
}

/// What is known of a name besides who just proved to bear it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum NameClaim {
    /// Nothing that is in the way.
    Free,
    /// A later life of that name is over: only one after it will be believed.
    After(u64),
    /// A node that started later bears it.
    Taken,
}

/// A greeting.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Hello {
    /// Who greets.
    pub(crate) name: NodeName,
}

/// The open part of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FrameHeader {
    pub(crate) kind: FrameKind,
    pub(crate) sender: SessionId,
    pub(crate) counter: u64,
}

/// A frame that is no frame of this cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HeadError {
    Oversized,
    Malformed,
    WrongCell,
}

impl FrameHeader {
    /// Reads the head of a frame; its body is what follows [`HEAD_BYTES`].
    pub(crate) fn read(frame: &[u8], cell: [u8; 4]) -> Result<Self, HeadError> {
        if frame.len() > MAX_FRAME_BYTES {
            return Err(HeadError::Oversized);
        }
        let Some((head, _)) = frame.split_first_chunk::<HEADER_BYTES>().filter(|(_, body)| body.len() >= SEAL_BYTES)
        else {
            return Err(HeadError::Malformed);
        };
        let [m0, m1, version, kind, c0, c1, c2, c3, rest @ ..] = head;
        if [*m0, *m1] != MAGIC || *version != VERSION {
            return Err(HeadError::Malformed);
        }
        let kind = match kind {
            1 => FrameKind::Hello,
            2 => FrameKind::Handshake,
            3 => FrameKind::Gossip,
            4 => FrameKind::Payload,
            _ => return Err(HeadError::Malformed),
        };
        if [*c0, *c1, *c2, *c3] != cell {
            return Err(HeadError::WrongCell);
        }
        let (Some(&sender), Some(&counter)) = (rest.first_chunk(), rest.last_chunk()) else {
            return Err(HeadError::Malformed);
        };
        Ok(Self { kind, sender, counter: u64::from_be_bytes(counter) })
    }

    /// Writes a whole frame.
    pub(crate) fn write(&self, cell: [u8; 4], body: &[u8], seal: &FrameCipher) -> Vec<u8> {
        let mut frame = Vec::with_capacity(HEADER_BYTES + body.len() + SEAL_BYTES);
        frame.extend_from_slice(&MAGIC);
        frame.extend_from_slice(&[VERSION, self.kind as u8]);
        frame.extend_from_slice(&cell);
        frame.extend_from_slice(&self.sender);
        frame.extend_from_slice(&self.counter.to_be_bytes());
        frame.extend_from_slice(body);
        seal.close(self.counter, &mut frame, HEADER_BYTES);
        frame
    }
}
