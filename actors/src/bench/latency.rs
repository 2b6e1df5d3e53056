//! Distribution of latencies.

use hdrhistogram::Histogram;
use serde::Serialize;

use super::two_hop::latencies;

/// What came back and how long it took.
#[derive(Debug, Clone)]
pub struct Latencies {
    /// Nanoseconds. What never came back counts with the time for which it was waited.
    pub histogram: Histogram<u64>,
    /// Answers that never came.
    pub missing: u64,
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
    /// How many there are.
    pub n: u64,
    /// How many of them never came back.
    pub missing: u64,
}

impl Default for Latencies {
    fn default() -> Self {
        Self { histogram: latencies(), missing: 0 }
    }
}

impl Latencies {
    /// Takes those of another run in.
    pub fn add(&mut self, other: &Self) {
        // Both have the same bounds.
        self.histogram.add(&other.histogram).unwrap_or_default();
        self.missing += other.missing;
    }

    /// What is usually said of a distribution.
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
