//! Detection of a stalled broker, which accepts messages and does not forward them.
//!
//! A broker that hangs, or whose answers are lost, keeps its connections open. For some seconds the
//! only symptom is that this node's own messages are not echoed. The monitor counts messages in
//! addition to time: a node that was stalled itself sent no messages, so it does not mistake its
//! own stall for a stalled broker.

use crate::leadership::timers::{ECHO_TIMEOUT, MIN_UNANSWERED};
use crate::model::time::Timestamp;

/// Number and age of the messages sent since the last packet arrived on a link.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct EchoMonitor {
    /// Number of packets received when the first of these messages was sent.
    packets: u64,
    since: Timestamp,
    unanswered: u32,
}

impl EchoMonitor {
    /// Records a message that the broker should echo, on a link that has received `packets` packets
    /// so far. Returns true if the broker is stalled.
    pub fn record_sent(&mut self, packets: u64, now: Timestamp) -> bool {
        if self.unanswered == 0 || packets != self.packets {
            *self = Self {
                packets,
                since: now,
                unanswered: 0,
            };
        }
        self.unanswered += 1;
        self.unanswered >= MIN_UNANSWERED && now.since(self.since) >= ECHO_TIMEOUT
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Time in ms at which the broker counts as stalled, if messages are sent at the given times
    /// and not answered.
    fn stalled_at(sent_ms: impl IntoIterator<Item = u64>) -> Option<u64> {
        let mut echo = EchoMonitor::default();
        sent_ms
            .into_iter()
            .find(|ms| echo.record_sent(7, Timestamp(ms * 1000)))
    }

    #[test]
    fn unanswered_messages_are_stall() {
        assert_eq!(stalled_at((0..).step_by(100)), Some(800));
        assert_eq!(
            stalled_at((0..700).step_by(1)),
            None,
            "many at once are no time"
        );
        assert_eq!(
            stalled_at((0..2500).step_by(500)),
            None,
            "few messages are no evidence"
        );
        assert_eq!(
            stalled_at([0, 60_000, 60_001, 60_100]),
            None,
            "nor does the time that this node was stopped"
        );
    }

    #[test]
    fn any_message_resets_count() {
        let mut echo = EchoMonitor::default();
        assert!((0..100).all(|n| !echo.record_sent(n / 5, Timestamp(n * 150_000))));
    }
}
