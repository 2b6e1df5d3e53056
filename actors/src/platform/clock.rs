//! The node's clocks: a steady one for everything that happens inside the node, and the machine's
//! wall clock.

use std::sync::OnceLock;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ecod::model::time::Timestamp;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// The current time of the steady clock in microseconds. This clock does not step.
///
/// It starts at the wall clock's value in the first call. From then on it follows the monotonic
/// clock that includes suspension. All durations, timers and times of arrival use this clock.
/// Messages that leave the node are dated by [`CellClock`](super::cell_clock::CellClock).
pub fn now() -> Timestamp {
    at(since_boot())
}

/// The steady clock's time in microseconds when the machine had run for `since_boot`. All processes
/// share that time.
pub fn at(since_boot: Duration) -> Timestamp {
    static ANCHOR: OnceLock<(Duration, Timestamp)> = OnceLock::new();
    let (started, wall) = ANCHOR.get_or_init(|| (self::since_boot(), wall()));
    *wall + since_boot.saturating_sub(*started)
}

/// The wall clock minus the steady clock in microseconds. It changes when the wall clock steps.
pub fn wall_offset_us() -> i64 {
    wall().micros_from(now())
}

/// The machine's wall clock in Unix microseconds, which may be wrong.
pub fn wall() -> Timestamp {
    Timestamp::default()
        + SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default()
}

/// Time since the machine started, including suspension.
pub fn since_boot() -> Duration {
    read(ClockId::Boottime)
}

/// The kernel's monotonic clock, which stamps pictures of cameras. It stands still in suspension: a
/// picture from before looks as if it were from after.
pub fn monotonic() -> Duration {
    read(ClockId::Monotonic)
}

fn read(clock: ClockId) -> Duration {
    let Timespec { tv_sec, tv_nsec } = clock_gettime(clock);
    Duration::new(
        u64::try_from(tv_sec).unwrap_or_default(),
        u32::try_from(tv_nsec).unwrap_or_default(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unix_time_is_monotonic() {
        let first = now();
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
        assert!(
            first
                .micros()
                .abs_diff(u64::try_from(wall.as_micros()).unwrap())
                < 1_000_000
        );
        let mut last = first;
        for _ in 0..1000 {
            let next = now();
            assert!(next >= last);
            last = next;
        }
    }
}
