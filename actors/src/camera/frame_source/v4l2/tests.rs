use std::sync::atomic::{AtomicBool, Ordering};

use moq_v4l::Timestamp;
use moq_v4l::buffer::Flags;

use super::*;

/// A buffer that a driver with these flags filled at 12.5 s.
fn stamped(flags: Flags) -> Metadata {
    Metadata {
        flags,
        timestamp: Timestamp::new(12, 500_000),
        ..Metadata::default()
    }
}

#[test]
fn monotonic_stamp_gives_age() {
    let now = Duration::from_millis(12_540);
    for source in [Flags::TSTAMP_SRC_SOE, Flags::TSTAMP_SRC_EOF] {
        let metadata = stamped(Flags::TIMESTAMP_MONOTONIC | source | Flags::DONE);
        assert_eq!(age(&metadata, now), Some(Duration::from_millis(40)));
    }
}

#[test]
fn implausible_stamp_is_refused() {
    let metadata = stamped(Flags::TIMESTAMP_MONOTONIC);
    let before = Duration::from_millis(12_499);
    assert_eq!(age(&metadata, before), None, "of the future");
    let late = Duration::from_millis(73_500);
    assert_eq!(
        age(&metadata, late),
        Some(Duration::from_secs(61)),
        "an old frame"
    );
    let now = Duration::from_millis(12_540);
    for flags in [Flags::TIMESTAMP_UNKNOWN, Flags::TIMESTAMP_COPY] {
        assert_eq!(age(&stamped(flags), now), None, "of another clock");
    }
    for timestamp in [Timestamp::new(-1, 0), Timestamp::new(i64::MAX, i64::MAX)] {
        let metadata = Metadata {
            timestamp,
            ..metadata
        };
        assert_eq!(age(&metadata, now), None, "{timestamp}");
    }
}

/// A stream of the library whose driver answers a stop by this error.
struct StoppingStream<'a> {
    error: Option<Errno>,
    is_dropped: &'a AtomicBool,
}

impl traits::Stream for StoppingStream<'_> {
    type Item = [u8];

    fn start(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn stop(&mut self) -> io::Result<()> {
        self.error.map_or(Ok(()), |error| Err(error.into()))
    }
}

impl Drop for StoppingStream<'_> {
    fn drop(&mut self) {
        self.is_dropped.store(true, Ordering::Relaxed);
        let error = self.error.filter(|error| *error != Errno::NODEV);
        assert_eq!(error, None, "the library panics");
    }
}

#[test]
fn refused_stop_ends_no_process() {
    for (error, expected) in [
        (None, true),
        (Some(Errno::NODEV), true),
        (Some(Errno::BUSY), false),
    ] {
        let is_dropped = AtomicBool::default();
        release(
            StoppingStream {
                error,
                is_dropped: &is_dropped,
            },
            "/dev/video0",
        );
        assert_eq!(is_dropped.load(Ordering::Relaxed), expected, "{error:?}");
    }
}
