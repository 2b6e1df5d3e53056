//! The virtual time of a replay, which is the time of the newest plausible line, and the unit of a
//! recording's times.

use std::fmt;
use std::time::Duration;

use crate::model::time::Timestamp;

/// Maximum gap before the last line of a recording.
const LAST_STEP: Duration = Duration::from_secs(3600);

/// A clock that moves forward with the lines and does not go back.
#[derive(Debug, Clone)]
pub(super) struct VirtualClock {
    now: Option<Timestamp>,
    /// Maximum difference between clocks.
    tolerance: Duration,
}

impl VirtualClock {
    pub(super) fn new(tolerance_s: f64) -> Self {
        Self {
            now: None,
            tolerance: Duration::from_secs_f64(tolerance_s),
        }
    }

    /// The time of the newest line taken; zero before the first.
    pub(super) fn now(&self) -> Timestamp {
        self.now.unwrap_or_default()
    }

    /// True if a line is ahead of the current time, or of most lines that follow, by at most the
    /// tolerance.
    pub(super) fn is_plausible(
        &self,
        at: Timestamp,
        following: impl Iterator<Item = Timestamp>,
    ) -> bool {
        if self.now.is_some_and(|now| at.since(now) <= self.tolerance) {
            return true;
        }
        let mut following: Vec<Timestamp> = following.collect();
        if following.is_empty() {
            return self.now.is_none_or(|now| at.since(now) <= LAST_STEP);
        }
        let middle = (following.len() - 1) / 2;
        let (_, median, _) = following.select_nth_unstable(middle);
        at.since(*median) <= self.tolerance
    }

    /// Moves to the time of a line; returns true if the line is late, that is, before the current
    /// time.
    pub(super) fn advance(&mut self, at: Timestamp) -> bool {
        let is_late = self.now.is_some_and(|now| at < now);
        if !is_late {
            self.now = Some(at);
        }
        is_late
    }
}

/// A unit of times that are not in microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeUnit {
    /// 10⁶ µs.
    Seconds,
    /// 10³ µs.
    Milliseconds,
    /// 10⁻³ µs.
    Nanoseconds,
}

/// Seconds of the Unix time in which recordings begin: from September 2001 until 2096.
const RECORDED_S: std::ops::Range<u64> = 1_000_000_000..4_000_000_000;

impl TimeUnit {
    /// The unit in which a recording's first time is a date; `None` if it is a date in
    /// microseconds. A time relative to the beginning of a recording is not a date in any unit.
    pub fn of(first: Timestamp) -> Option<Self> {
        let units = [
            (Self::Seconds, 1),
            (Self::Milliseconds, 1000),
            (Self::Nanoseconds, 1_000_000_000),
        ];
        units
            .into_iter()
            .find(|(_, in_second)| RECORDED_S.contains(&(first.micros() / in_second)))
            .map(|(unit, _)| unit)
    }
}

impl fmt::Display for TimeUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Seconds => "seconds",
            Self::Milliseconds => "milliseconds",
            Self::Nanoseconds => "nanoseconds",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn date_units_differ_from_relative_times() {
        for (first, unit) in [
            (1_732_154_400, Some(TimeUnit::Seconds)),
            (1_732_154_400_123, Some(TimeUnit::Milliseconds)),
            (1_732_154_400_123_456, None),
            (1_732_154_400_123_456_789, Some(TimeUnit::Nanoseconds)),
            (0, None),
            (60_000_000, None),
        ] {
            assert_eq!(TimeUnit::of(Timestamp(first)), unit, "{first}");
        }
    }

    const HOUR: u64 = 3_600_000_000;

    fn accepted(times: &[u64]) -> Vec<u64> {
        let mut clock = VirtualClock::new(2.0);
        let mut taken = Vec::new();
        for (index, &at) in times.iter().enumerate() {
            if clock.is_plausible(
                Timestamp(at),
                times[index + 1..].iter().copied().map(Timestamp),
            ) {
                clock.advance(Timestamp(at));
                taken.push(at);
            }
        }
        taken
    }

    #[test]
    fn wrong_clock_differs_from_silence() {
        let ahead = 9 * HOUR;
        for (times, wrong) in [
            (&[1, 2, ahead, 3, 4, 5][..], &[ahead][..]),
            (&[ahead, 1, 2, 3], &[ahead]),
            (
                &[1, ahead, 2, ahead + 1, 3, ahead + 2, 4],
                &[ahead, ahead + 1, ahead + 2],
            ),
            (&[1, 2, ahead], &[ahead]),
            (&[1, 2, u64::MAX], &[u64::MAX]),
            (&[1, 2, ahead, ahead + 1, ahead + 2], &[]),
            (&[1, 2, HOUR], &[]),
            (&[ahead], &[]),
            (&[5, 1, 9], &[]),
        ] {
            let expected: Vec<u64> = times
                .iter()
                .copied()
                .filter(|at| !wrong.contains(at))
                .collect();
            assert_eq!(accepted(times), expected, "{times:?}");
        }
    }
}
