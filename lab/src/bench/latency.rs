//! Distribution of latencies.

use std::time::{Duration, Instant};

use hdrhistogram::Histogram;
use serde::Serialize;

use super::two_hop::latencies;

/// Answers of a cell with their latencies.
#[derive(Debug, Clone)]
pub struct Latencies {
    /// Nanoseconds. A missing answer counts with the time for which it was waited for.
    pub histogram: Histogram<u64>,
    /// Number of missing answers.
    pub missing: u64,
}

/// Latencies of one kind of answer.
#[derive(Debug, Clone, Default)]
pub struct Answers {
    /// Latencies of the answers as maps.
    pub map: Latencies,
    /// Latencies as verdicts; empty in a cell without votes.
    pub verdict: Latencies,
}

/// Quantiles of a distribution.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Quantiles {
    /// Median in microseconds.
    pub p50_us: f64,
    /// 99 of 100 take at most as many microseconds.
    pub p99_us: f64,
    /// 999 of 1000 take at most as many microseconds.
    pub p999_us: f64,
    /// Number of answers, missing ones included.
    pub n: u64,
    /// Number of missing answers.
    pub missing: u64,
}

impl Quantiles {
    /// Share of missing answers, in percent.
    pub fn missing_percent(&self) -> f64 {
        100.0 * self.missing as f64 / self.n.max(1) as f64
    }
}

impl Default for Latencies {
    fn default() -> Self {
        Self {
            histogram: latencies(),
            missing: 0,
        }
    }
}

impl Latencies {
    /// Adds the answers of another run.
    pub fn add(&mut self, other: &Self) {
        // The addition cannot fail, because both have the same bounds.
        let _ = self.histogram.add(&other.histogram);
        self.missing += other.missing;
    }

    /// Adds one answer that was due, or the time for which it was waited for.
    pub(super) fn record_arrival(
        &mut self,
        due: Instant,
        arrival: Option<Instant>,
        waited_until: Instant,
    ) {
        let taken = |end: Instant| end.saturating_duration_since(due);
        self.record_time(arrival.map(taken), taken(waited_until));
    }

    /// Adds the time of one answer, or the time for which it was waited for.
    pub(super) fn record_time(&mut self, taken: Option<Duration>, waited: Duration) {
        self.missing += u64::from(taken.is_none());
        let nanos = taken.unwrap_or(waited).as_nanos();
        self.histogram
            .saturating_record(u64::try_from(nanos).unwrap_or(u64::MAX));
    }

    /// Usual quantiles of the distribution.
    pub fn quantiles(&self) -> Quantiles {
        let micros = |quantile| self.histogram.value_at_quantile(quantile) as f64 / 1000.0;
        Quantiles {
            p50_us: micros(0.5),
            p99_us: micros(0.99),
            p999_us: micros(0.999),
            n: self.histogram.len(),
            missing: self.missing,
        }
    }
}

impl Answers {
    /// Adds the answers of another run.
    pub fn add(&mut self, other: &Self) {
        self.map.add(&other.map);
        self.verdict.add(&other.verdict);
    }
}
