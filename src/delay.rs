//! The least delay of a one-way stream, which tells clock offset from queueing.

use std::time::Duration;

use crate::time::Timestamp;

/// Least delay from sending to receipt over the last one to two spans of ten seconds.
///
/// The least delay of a one-way stream is the clock offset plus the shortest transit, so later arrivals stand out by
/// their queueing alone (Moon, Skelly, Towsley, "Estimation and removal of clock skew", INFOCOM 1999).
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct MinimumDelay {
    span_start: Timestamp,
    current_us: i64,
    previous_us: i64,
    observed: u64,
}

impl MinimumDelay {
    const SPAN: Duration = Duration::from_secs(10);

    /// No delay is known yet.
    pub fn new(now: Timestamp) -> Self {
        Self { span_start: now, current_us: i64::MAX, previous_us: i64::MAX, observed: 0 }
    }

    /// Takes the delay of one message, in microseconds; negative when the sender's clock is ahead.
    pub fn observe(&mut self, delay_us: i64, now: Timestamp) {
        if now.since(self.span_start) >= Self::SPAN {
            self.previous_us = self.current_us;
            self.current_us = i64::MAX;
            self.span_start = now;
        }
        self.current_us = self.current_us.min(delay_us);
        self.observed += 1;
    }

    /// The least delay in microseconds; `i64::MAX` without any.
    pub fn least(&self) -> i64 {
        self.current_us.min(self.previous_us)
    }

    /// How many delays the estimate has been given.
    pub fn observed(&self) -> u64 {
        self.observed
    }

    /// Microseconds to add to the sender's clock to get the receiver's; 0 within `tolerance_us`.
    pub fn clock_offset(&self, tolerance_us: i64) -> i64 {
        let least = self.least();
        if least == i64::MAX || least.abs() <= tolerance_us { 0 } else { least }
    }
}
