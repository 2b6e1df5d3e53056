//! How many answers strangers get.

use std::collections::HashMap;
use std::time::Duration;

use ecod::time::Timestamp;

use super::key::SessionId;

/// Limits answers to all strangers together and to each session, so that one recorded greeting, sent over and over,
/// does not use up what is meant for others.
#[derive(Debug, Clone)]
pub(super) struct Answers {
    all: Throttle,
    answered: HashMap<SessionId, Timestamp>,
}

impl Answers {
    pub(super) fn new(now: Timestamp) -> Self {
        Self { all: Throttle::new(BURST, STEADY, now), answered: HashMap::new() }
    }

    /// Whether this session may get an answer now.
    pub(super) fn allow(&mut self, session: &SessionId, now: Timestamp) -> bool {
        if self.answered.get(session).is_some_and(|at| now.since(*at) < EACH) {
            return false;
        }
        let allowed = self.all.allow(now);
        if allowed {
            if self.answered.len() >= MAX_ANSWERED {
                self.answered.retain(|_, at| now.since(*at) < EACH);
            }
            self.answered.insert(*session, now);
        }
        allowed
    }
}

/// Most answers to strangers at once, and time until one more: a cell of 64 that starts together meets unhindered.
const BURST: u32 = 256;
const STEADY: Duration = Duration::from_millis(10);

/// Least time between two answers to one session.
const EACH: Duration = Duration::from_millis(50);

/// From so many sessions on, those that may be answered again are forgotten; at most [`BURST`] more are not.
const MAX_ANSWERED: usize = 256;

/// Allows a burst, then a steady rate.
#[derive(Debug, Clone)]
pub(crate) struct Throttle {
    left: u32,
    burst: u32,
    interval: Duration,
    filled: Timestamp,
}

impl Throttle {
    pub(crate) fn new(burst: u32, interval: Duration, now: Timestamp) -> Self {
        Self { left: burst, burst, interval, filled: now }
    }

    /// Whether a whole burst would be allowed now.
    pub(crate) fn is_rested(&self, now: Timestamp) -> bool {
        now.since(self.filled) >= self.interval * self.burst.saturating_sub(self.left)
    }

    /// Whether one more is allowed now.
    pub(crate) fn allow(&mut self, now: Timestamp) -> bool {
        let earned = now.since(self.filled).as_micros() / self.interval.as_micros().max(1);
        let earned = u32::try_from(earned).unwrap_or(u32::MAX);
        self.filled =
            if self.left.saturating_add(earned) >= self.burst { now } else { self.filled + self.interval * earned };
        self.left = self.left.saturating_add(earned).min(self.burst);
        let allowed = self.left > 0;
        self.left = self.left.saturating_sub(1);
        allowed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_is_allowed_then_a_rate() {
        let mut throttle = Throttle::new(3, Duration::from_millis(10), Timestamp(0));
        let mut allowed = |ms: u64| (0..100).filter(|_| throttle.allow(Timestamp(ms * 1000))).count();
        assert_eq!([allowed(0), allowed(5), allowed(10), allowed(35), allowed(10_000)], [3, 0, 1, 2, 3]);
    }
}
