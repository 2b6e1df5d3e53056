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
