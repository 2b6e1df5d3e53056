//! A clock that stops while its node is stalled.

use std::time::Duration;

use crate::model::time::Timestamp;

/// Clock of the time during which the node was awake, driven by the caller's `now`.
///
/// A node that was not scheduled, was suspended, or whose clock was set could not receive messages
/// in that time. It must not count this time toward a peer's timeout. The clock therefore advances
/// at most to the planned deadline plus a tolerance, and never runs backwards.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct AwakeClock {
    outside: Timestamp,
    inside: Timestamp,
    tolerance: Duration,
}

impl AwakeClock {
    /// Creates a clock that starts at `now`. A delay of up to `tolerance` counts as elapsed time.
    pub fn new(now: Timestamp, tolerance: Duration) -> Self {
        Self {
            outside: now,
            inside: now,
            tolerance,
        }
    }

    /// Advances the clock and returns its time, given the caller's time `now` and the next deadline
    /// `due` on this clock.
    pub fn advance(&mut self, now: Timestamp, due: Timestamp) -> Timestamp {
        let planned = due.since(self.inside) + self.tolerance;
        self.inside = self.inside + now.since(self.outside).min(planned);
        self.outside = now;
        self.inside
    }

    /// The time of this clock.
    pub fn now(&self) -> Timestamp {
        self.inside
    }

    /// The caller's time at which this clock will reach `due`.
    pub fn outside(&self, due: Timestamp) -> Timestamp {
        self.outside + due.since(self.inside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1000;

    #[test]
    fn stalls_and_set_clocks_excluded() {
        let at = |ms: u64| Timestamp(1_000_000 + ms * MS);
        let mut clock = AwakeClock::new(at(0), Duration::from_millis(40));
        assert_eq!(clock.advance(at(30), at(80)), at(30));
        assert_eq!(
            clock.advance(at(90), at(80)),
            at(90),
            "a little late is time"
        );
        assert_eq!(clock.advance(at(5_000), at(100)), at(140), "a stall is not");
        assert_eq!(
            clock.advance(at(10), at(200)),
            at(140),
            "nor is a clock set back"
        );
        assert_eq!(clock.outside(at(200)), at(70));
        assert_eq!(
            clock.advance(at(3_600_000), at(200)),
            at(240),
            "nor one set forward"
        );
    }
}
