//! Rate of maps to the region.

use std::time::Duration;

use ecod::model::time::Timestamp;

/// Time after a neighbour's last map for which the neighbour counts as present.
const NEIGHBOUR_TIMEOUT: Duration = Duration::from_secs(5);

/// Factor on the rate while a neighbour is present.
const NEIGHBOUR_FACTOR: f64 = 5.0;

/// Fraction of the interval by which a map may be early, because rounds do not close exactly at due
/// times.
const MAX_EARLY_SHARE: f64 = 0.25;

/// The times at which maps are due. They stay on a fixed grid independent of when maps arrive, so
/// that the mean rate is the configured rate.
#[derive(Debug)]
pub(super) struct MapPace {
    max_hz: f64,
    due: Timestamp,
    max_early: Duration,
    neighbour_at: Option<Timestamp>,
}

impl MapPace {
    /// The first map is due at once.
    pub(super) fn new(max_hz: f64) -> Self {
        Self {
            max_hz,
            due: Timestamp::default(),
            max_early: Duration::ZERO,
            neighbour_at: None,
        }
    }

    /// Records that a neighbour's map was accepted.
    pub(super) fn record_neighbour(&mut self, now: Timestamp) {
        self.neighbour_at = Some(now);
    }

    /// True if a map is due.
    pub(super) fn is_due(&self, now: Timestamp) -> bool {
        now + self.max_early >= self.due
    }

    /// Advances to the next due time.
    pub(super) fn advance(&mut self, now: Timestamp) {
        let has_neighbour = self
            .neighbour_at
            .is_some_and(|at| now.since(at) < NEIGHBOUR_TIMEOUT);
        let factor = if has_neighbour { NEIGHBOUR_FACTOR } else { 1.0 };
        let interval = Duration::from_secs_f64(1.0 / (factor * self.max_hz));
        self.max_early = interval.mul_f64(MAX_EARLY_SHARE);
        self.due = if now.since(self.due) < interval {
            self.due
        } else {
            now
        } + interval;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Number of maps in ten seconds of rounds about every 100 ms, up to 10 ms early or late, from
    /// this time on.
    fn count(pace: &mut MapPace, from_ms: u64) -> usize {
        let rounds = (0..100).map(|round| from_ms + 100 * round + 7 * round % 20 - 10);
        let due = rounds.filter(|ms| {
            let now = Timestamp(ms * 1000);
            let is_due = pace.is_due(now);
            if is_due {
                pace.advance(now);
            }
            is_due
        });
        due.count()
    }

    #[test]
    fn neighbour_raises_map_rate_fivefold() {
        let mut pace = MapPace::new(2.0);
        assert_eq!(count(&mut pace, 5_000), 21, "the first at once");
        assert_eq!(count(&mut pace, 15_000), 20);
        pace.record_neighbour(Timestamp(25_000_000));
        let beside = count(&mut pace, 25_000);
        assert!(
            (54..=60).contains(&beside),
            "{beside}: ten per second for five seconds, then two"
        );
        assert!(
            (19..=21).contains(&count(&mut pace, 35_000)),
            "back to two per second after the neighbour's timeout"
        );
        assert_eq!(count(&mut MapPace::new(0.5), 5_000), 6);
    }
}
