//! The node's clock. It never goes backwards.

use std::sync::OnceLock;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ecod::model::time::Timestamp;
use rustix::time::{ClockId, Timespec, clock_gettime};

/// The present time in Unix microseconds.
///
/// The wall clock is read once, at the first call. From then on time passes by the monotonic clock that includes
/// suspension. A later step of the wall clock, such as by NTP's first synchronisation, takes effect at the next restart.
/// Aggregators estimate each vehicle's offset, so that a constant error up to `max_clock_offset_s` does no harm.
pub fn now() -> Timestamp {
    static ANCHOR: OnceLock<(Duration, Timestamp)> = OnceLock::new();
    let (started, wall) = ANCHOR.get_or_init(|| {
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        (since_boot(), Timestamp::default() + since_epoch)
    });
    *wall + since_boot().saturating_sub(*started)
}

fn since_boot() -> Duration {
    let Timespec { tv_sec, tv_nsec } = clock_gettime(ClockId::Boottime);
    Duration::new(u64::try_from(tv_sec).unwrap_or_default(), u32::try_from(tv_nsec).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_is_unix_time_and_never_goes_back() {
        let first = now();
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
        assert!(first.micros().abs_diff(u64::try_from(wall.as_micros()).unwrap()) < 1_000_000);
        let mut last = first;
        for _ in 0..1000 {
            let next = now();
            assert!(next >= last);
            last = next;
        }
    }
}
