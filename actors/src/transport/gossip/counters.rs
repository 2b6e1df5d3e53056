//! What came and went on the gossip socket, counted.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};

/// Something that happened to a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FrameEvent {
    /// Sent.
    Sent,
    /// Not sent: the socket or the network refused it.
    SendFailed,
    /// Not sent: the addressee is not known, or not yet.
    NoSession,
    /// Came in, from whomever.
    Received,
    /// Longer than any frame.
    Oversized,
    /// Not a frame, or a body that says nothing.
    Malformed,
    /// Of another cell.
    WrongCell,
    /// Not sealed with the cell's key for this node.
    BadSeal,
    /// Taken before, or too late, or the answer to nothing asked lately.
    Replayed,
    /// Sealed well, from a session that is not established: a handshake is begun.
    Unestablished,
    /// From a node whose name belongs to one that started later.
    Superseded,
    /// Speaks for another node than the one that sealed it.
    NameMismatch,
    /// Would have been answered, but too many were lately.
    Throttled,
    /// From a node beyond the most that are known at a time.
    TooManyPeers,
}

impl FrameEvent {
    /// All of them, for snapshots.
    pub const ALL: [Self; 14] = [
        Self::Sent,
        Self::SendFailed,
        Self::NoSession,
        Self::Received,
        Self::Oversized,
        Self::Malformed,
        Self::WrongCell,
        Self::BadSeal,
        Self::Replayed,
        Self::Unestablished,
        Self::Superseded,
        Self::NameMismatch,
        Self::Throttled,
        Self::TooManyPeers,
    ];

    /// The label of its counter.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sent => "sent",
            Self::SendFailed => "send_failed",
            Self::NoSession => "no_session",
            Self::Received => "received",
            Self::Oversized => "oversized",
            Self::Malformed => "malformed",
            Self::WrongCell => "wrong_cell",
            Self::BadSeal => "bad_seal",
            Self::Replayed => "replayed",
            Self::Unestablished => "unestablished",
            Self::Superseded => "superseded",
            Self::NameMismatch => "name_mismatch",
            Self::Throttled => "throttled",
            Self::TooManyPeers => "too_many_peers",
        }
    }
}

/// The counters of one gossip socket.
#[derive(Debug, Default)]
pub struct FrameCounters([AtomicU64; FrameEvent::ALL.len()]);

impl FrameCounters {
    /// Counts one.
    #[expect(clippy::indexing_slicing, reason = "there is a place for every event")]
    pub fn count(&self, event: FrameEvent) {
        self.0[event as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// How often it happened.
    #[expect(clippy::indexing_slicing, reason = "there is a place for every event")]
    pub fn get(&self, event: FrameEvent) -> u64 {
        self.0[event as usize].load(Ordering::Relaxed)
    }

    /// All counts by label, zeros too.
    pub fn snapshot(&self) -> BTreeMap<&'static str, u64> {
        FrameEvent::ALL.map(|event| (event.as_str(), self.get(event))).into()
    }
}
