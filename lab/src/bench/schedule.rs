//! When reports are due.

use std::thread;
use std::time::{Duration, Instant};

use ecod::model::time::Timestamp;
use ecod_actors::platform::clock;

/// Ticks of equal length, fixed before the first one, independent of the load.
#[derive(Debug, Clone, Copy)]
pub(super) struct Schedule {
    start: Instant,
    start_at: Timestamp,
    period: Duration,
}

impl Schedule {
    /// The first tick is `wait` from now.
    pub(super) fn starting_in(wait: Duration, period: Duration) -> Self {
        Self {
            start: Instant::now() + wait,
            start_at: clock::now() + wait,
            period,
        }
    }

    pub(super) fn period(&self) -> Duration {
        self.period
    }

    /// When a tick begins.
    pub(super) fn begin(&self, tick: u32) -> Instant {
        self.start + self.period * tick
    }

    /// The capture time of a tick's reports.
    pub(super) fn captured_at(&self, tick: u32) -> Timestamp {
        self.start_at + self.period * tick
    }

    /// The tick whose reports were captured at that time, within the error of an estimated clock;
    /// `None` before the first.
    pub(super) fn tick_captured_at(&self, captured: Timestamp) -> Option<u32> {
        let half = self.period / 2;
        let since = (captured + half).micros_from(self.start_at);
        let tick = u128::try_from(since).ok()? / self.period.as_micros();
        u32::try_from(tick).ok()
    }
}

/// Blocks this thread until then.
pub(super) fn wait_until(due: Instant) {
    thread::sleep(due.saturating_duration_since(Instant::now()));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capture_time_gives_tick() {
        let schedule = Schedule::starting_in(Duration::ZERO, Duration::from_millis(100));
        assert_eq!(
            schedule.begin(3) - schedule.begin(0),
            Duration::from_millis(300)
        );
        for tick in [0, 1, 77] {
            let captured = schedule.captured_at(tick);
            assert_eq!(schedule.tick_captured_at(captured), Some(tick));
            assert_eq!(
                schedule.tick_captured_at(captured.shifted(-20_000)),
                Some(tick),
                "a clock that is a little off"
            );
        }
        assert_eq!(
            schedule.tick_captured_at(schedule.captured_at(0) - Duration::from_secs(1)),
            None
        );
    }
}
