//! Detection of a broker thread that hangs.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ecod::model::time::Timestamp;

/// Heartbeat of a thread, checked from time to time.
#[derive(Debug, Default)]
pub(super) struct ThreadHeartbeat {
    beats: Arc<AtomicU64>,
    seen: u64,
    checked_at: Timestamp,
    missed: u32,
}

/// Time between two beats, and minimum time between two checks that count.
pub(super) const HEARTBEAT_INTERVAL: Duration = Duration::from_millis(200);

/// Consecutive checks without a beat after which the thread counts as hung: about five seconds.
/// Checks are counted instead of time, so that a stall of the whole process does not count.
const MAX_MISSED_CHECKS: u32 = 25;

impl ThreadHeartbeat {
    /// The counter that the thread increments.
    pub(super) fn beats(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.beats)
    }

    /// Checks the thread; true if it hangs.
    pub(super) fn has_stopped(&mut self, now: Timestamp) -> bool {
        let beats = self.beats.load(Ordering::Relaxed);
        if beats != self.seen {
            self.seen = beats;
            self.checked_at = now;
            self.missed = 0;
        } else if now.since(self.checked_at) >= HEARTBEAT_INTERVAL {
            self.checked_at = now;
            self.missed += 1;
        }
        self.missed >= MAX_MISSED_CHECKS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missed_checks_mean_hanging_thread() {
        let mut heartbeat = ThreadHeartbeat::default();
        let beats = heartbeat.beats();
        let mut lost_at = |from_ms: u64, step_ms: u64| {
            beats.fetch_add(1, Ordering::Relaxed);
            (1..200)
                .map(|n| from_ms + n * step_ms)
                .find(|ms| heartbeat.has_stopped(Timestamp(ms * 1000)))
        };
        let after = |from: u64, at: Option<u64>| at.map(|at| at - from);
        assert_eq!(after(10_000, lost_at(10_000, 250)), Some(26 * 250));
        assert_eq!(
            after(100_000, lost_at(100_000, 10)),
            None,
            "many looks at once are few"
        );
        assert_eq!(
            after(200_000, lost_at(200_000, 60_000)),
            Some(26 * 60_000),
            "a stopped process checks no heartbeat"
        );
    }
}
