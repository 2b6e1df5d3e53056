//! Clock offset from the minimum delay of a one-way stream.

use std::time::Duration;

use crate::model::time::Timestamp;

/// The minimum delay from sending to receipt over the last one to two spans.
///
/// The minimum is the clock offset plus the shortest transit; any delay above it is queueing (Moon,
/// Skelly, Towsley, "Estimation and removal of clock skew", INFOCOM 1999). Unlike there, skew
/// within a span is neglected.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct MinimumDelay {
    span: Duration,
    span_start: Timestamp,
    current_us: i64,
    previous_us: i64,
    observed: u64,
}

impl MinimumDelay {
    /// An estimate without delays, over spans of ten seconds.
    pub fn new(now: Timestamp) -> Self {
        Self::over(Duration::from_secs(10), now)
    }

    /// An estimate without delays, over spans of this length.
    pub fn over(span: Duration, now: Timestamp) -> Self {
        Self {
            span,
            span_start: now,
            current_us: i64::MAX,
            previous_us: i64::MAX,
            observed: 0,
        }
    }

    /// Processes the delay of one message in microseconds, which is negative if the sender's clock
    /// is ahead.
    pub fn observe(&mut self, delay_us: i64, now: Timestamp) {
        if now.since(self.span_start) >= self.span {
            self.previous_us = self.current_us;
            self.current_us = i64::MAX;
            self.span_start = now;
        }
        self.current_us = self.current_us.min(delay_us);
        self.observed += 1;
    }

    /// The minimum delay in microseconds; `i64::MAX` without delays.
    pub fn least(&self) -> i64 {
        self.current_us.min(self.previous_us)
    }

    /// Number of delays in the estimate.
    pub fn observed(&self) -> u64 {
        self.observed
    }
}
