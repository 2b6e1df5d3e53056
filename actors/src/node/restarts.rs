//! Limit on restarts of a node's parts.

use std::collections::VecDeque;
use std::time::Duration;

use ecod::model::time::Timestamp;

/// Most restarts within [`RESTART_SPAN`].
pub const MAX_RESTARTS: usize = 10;

/// The span in which restarts are counted.
pub const RESTART_SPAN: Duration = Duration::from_secs(60);

/// The restarts of the last span.
#[derive(Debug, Default)]
pub(super) struct Restarts {
    times: VecDeque<Timestamp>,
}

impl Restarts {
    /// True if one more restart is allowed; counts it if so.
    pub(super) fn allow(&mut self, now: Timestamp) -> bool {
        self.times.retain(|time| now.since(*time) < RESTART_SPAN);
        let allowed = self.times.len() < MAX_RESTARTS;
        if allowed {
            self.times.push_back(now);
        }
        allowed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_burst_exceeds_limit() {
        let mut burst = Restarts::default();
        assert_eq!(
            (0..20)
                .filter(|s| burst.allow(Timestamp(s * 1_000_000)))
                .count(),
            MAX_RESTARTS
        );
        let mut trickle = Restarts::default();
        assert!((0..100).all(|s| trickle.allow(Timestamp(s * 7_000_000))));
    }
}
