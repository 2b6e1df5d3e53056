//! Counters of the gossip socket.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

use strum::{IntoStaticStr, VariantArray};

/// An event of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case")]
pub enum FrameEvent {
    /// Accepted by the socket for sending.
    Sent,
    /// Not sent: the socket or the network refused it.
    SendFailed,
    /// Not sent: there is no session with the addressee, or not yet.
    NoSession,
    /// Received from any address.
    Received,
    /// Longer than any frame.
    Oversized,
    /// Not a frame, or a body that cannot be decoded.
    Malformed,
    /// Received from a node of another cell.
    WrongCell,
    /// Not sealed with the cell's key for this node.
    BadSeal,
    /// Of a node without certificate in a cell that has them, or the reverse.
    Uncertified,
    /// The proof of a certificate that is of another cell, invalid, revoked, of another name or not
    /// signed by its owner.
    Untrusted,
    /// A session ended: its certificate was revoked or has expired.
    Expelled,
    /// Received before, too late, or an answer without a recent request.
    Replayed,
    /// Its counter is too far ahead of the last one, because a sender stops long before so many
    /// unanswered frames: starts a handshake.
    CounterJump,
    /// Authentic, from a session that is not established: starts a handshake.
    Unestablished,
    /// From a node whose name a later started node has.
    Superseded,
    /// Gossip in the name of another node than its sender.
    NameMismatch,
    /// Beyond the rate of answers, or beyond the frames that a session may send.
    Throttled,
    /// From a node beyond `membership.max_peers`.
    TooManyPeers,
    /// A request for a renewed certificate that this node refused, as for a revoked one.
    RenewalRefused,
}

impl FrameEvent {
    /// All events in order of declaration.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// The label of the event's counter.
    pub fn as_str(self) -> &'static str {
        self.into()
    }
}

/// The counters of one gossip socket.
#[derive(Debug, Default)]
pub struct FrameCounters([AtomicU64; FrameEvent::ALL.len()]);

impl FrameCounters {
    /// Counts one frame with this event.
    #[expect(clippy::indexing_slicing, reason = "there is a place for every event")]
    pub fn count(&self, event: FrameEvent) {
        self.0[event as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Occurrences of an event.
    #[expect(clippy::indexing_slicing, reason = "there is a place for every event")]
    pub fn get(&self, event: FrameEvent) -> u64 {
        self.0[event as usize].load(Ordering::Relaxed)
    }

    /// All counts by label, zeros included.
    pub fn snapshot(&self) -> BTreeMap<&'static str, u64> {
        FrameEvent::ALL
            .iter()
            .map(|event| (event.as_str(), self.get(*event)))
            .collect()
    }
}
