//! Detection of a broker that takes what is sent and passes nothing on.
//!
//! A broker that hangs, or whose answers are lost, keeps its connections. For seconds only the missing echo of this
//! node's own messages shows it. Messages are counted beside the time: a node that was stopped itself sent nothing, and
//! does not blame its broker.

use crate::leadership::timers::{ECHO_TIMEOUT, MIN_UNANSWERED};
use crate::model::time::Timestamp;

/// Number and age of the messages sent since anything came in on a link.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct EchoMonitor {
    /// Packets that had come in when the first of them was sent.
    packets: u64,
    since: Timestamp,
    unanswered: u32,
}

impl EchoMonitor {
    /// Notes a message that should come back, on a link where so many packets have come in; true when the broker is
    /// stalled.
    pub fn note_sent(&mut self, packets: u64, now: Timestamp) -> bool {
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

    /// Time in ms at which the broker counts as stalled, for messages sent at these milliseconds without an answer.
    fn stalled_at(sent_ms: impl IntoIterator<Item = u64>) -> Option<u64> {
        let mut echo = EchoMonitor::default();
        sent_ms
            .into_iter()
            .find(|ms| echo.note_sent(7, Timestamp(ms * 1000)))
    }

    #[test]
    fn many_messages_over_some_time_without_an_answer_are_a_stall() {
        assert_eq!(stalled_at((0..).step_by(100)), Some(800));
        assert_eq!(
            stalled_at((0..700).step_by(1)),
            None,
            "many at once are no time"
        );
        assert_eq!(stalled_at((0..2500).step_by(500)), None, "few say nothing");
        assert_eq!(
            stalled_at([0, 60_000, 60_001, 60_100]),
            None,
            "nor does the time that this node was stopped"
        );
    }

    #[test]
    fn whatever_comes_in_begins_the_count_anew() {
        let mut echo = EchoMonitor::default();
        assert!((0..100).all(|n| !echo.note_sent(n / 5, Timestamp(n * 150_000))));
    }
}
