//! Whether a broker that takes what is sent passes it on.
//!
//! A broker that hangs, or whose answers do not arrive, keeps its connections: for seconds nothing but the missing echo
//! of this node's own messages tells. Messages are counted beside the time, so that a node that was stopped itself, and
//! sent nothing meanwhile, does not blame its broker.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use ecod::time::Timestamp;

/// What a link's task hears, for the gateway to see.
#[derive(Debug, Default)]
pub(crate) struct Hearing {
    packets: AtomicU64,
    is_missed: AtomicBool,
}

impl Hearing {
    /// Notes that something came in; true when the broker was taken for stalled.
    pub(crate) fn note(&self) -> bool {
        self.packets.fetch_add(1, Ordering::AcqRel);
        self.is_missed.load(Ordering::Acquire) && self.is_missed.swap(false, Ordering::AcqRel)
    }

    /// Asks to be told when something comes in.
    pub(crate) fn miss(&self) {
        self.is_missed.store(true, Ordering::Release);
    }

    pub(crate) fn packets(&self) -> u64 {
        self.packets.load(Ordering::Acquire)
    }
}

/// What was sent since anything came in.
#[derive(Debug, Default)]
pub(crate) struct Silence {
    packets: u64,
    since: Timestamp,
    unanswered: u32,
}

/// A broker is taken for stalled after so many messages that should have come back, and so long. Six busy loops on two
/// processors hold up a broker's thread by some tens of milliseconds.
const LEAST_UNANSWERED: u32 = 6;
const PATIENCE: Duration = Duration::from_millis(800);

impl Silence {
    /// Notes a message that should come back, where so many packets have come in; true when the broker seems stalled.
    pub(crate) fn note_sent(&mut self, packets: u64, now: Timestamp) -> bool {
        if self.unanswered == 0 || packets != self.packets {
            *self = Self { packets, since: now, unanswered: 0 };
        }
        self.unanswered += 1;
        self.unanswered >= LEAST_UNANSWERED && now.since(self.since) >= PATIENCE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// When the broker seems stalled, of messages sent at these milliseconds without an answer.
    fn stalled_at(sent_ms: impl IntoIterator<Item = u64>) -> Option<u64> {
        let mut silence = Silence::default();
        sent_ms.into_iter().find(|ms| silence.note_sent(7, Timestamp(ms * 1000)))
    }

    #[test]
    fn many_messages_over_some_time_without_an_answer_are_a_stall() {
        assert_eq!(stalled_at((0..).step_by(100)), Some(800));
        assert_eq!(stalled_at((0..700).step_by(1)), None, "many at once are no time");
        assert_eq!(stalled_at((0..2500).step_by(500)), None, "few say nothing");
        assert_eq!(stalled_at([0, 60_000, 60_001, 60_100]), None, "nor does the time that this node was stopped");
    }

    #[test]
    fn whatever_comes_in_begins_the_count_anew() {
        let mut silence = Silence::default();
        assert!((0..100).all(|n| !silence.note_sent(n / 5, Timestamp(n * 150_000))));
    }

    #[test]
    fn the_end_of_a_stall_is_told_once() {
        let hearing = Hearing::default();
        assert!(!hearing.note());
        hearing.miss();
        assert!(hearing.note() && !hearing.note());
        assert_eq!(hearing.packets(), 3);
    }
}
