//! Calibration of a vehicle's confidences, learnt from which detections recur.
//!
//! There are no labels of real detections. But a real object is detected again at the next look more often than clutter,
//! and the share that recurs rises with the confidence in much the same way for all detectors. Where [`EVEN_REHITS`] of
//! the detections recur, about half are real: the even confidence. The spread of the confidences above it gives their
//! scale.

use super::existence::logistic;

/// Share of detections that recur where half are real.
const EVEN_REHITS: f64 = 0.62;

/// Log-odds of a real detection for each nat of its confidence's log-odds, at the usual spread of confidences.
const SLOPE: f64 = 1.75;

/// Usual distance of the median confidence above the even one from it, nats.
const USUAL_SPREAD: f64 = 1.9;

/// Deviation of the even confidence that differences between scenes explain, nats. More is due to the detector.
const EVEN_TOLERANCE: f64 = 0.7;

/// The same for the logarithm of the spread.
const SPREAD_TOLERANCE: f64 = 0.5;

/// Number of looks that the usual rates count as in each bin.
const PRIOR_LOOKS: f64 = 10.0;

/// Number of looks in a bin beyond which earlier ones are forgotten.
const MEMORY: f64 = 400.0;

/// Number of looks between two fits.
const REFIT: u32 = 25;

const BINS: usize = 48;
const BIN_NATS: f64 = 0.4;
const MIN_NATS: f64 = -9.6;

/// Learnt relation between confidence and probability of one vehicle.
#[derive(Debug, Clone)]
pub(super) struct DetectionCalibration {
    /// Numbers of detections that recurred, and of all, by log-odds of their confidence.
    bins: [(f64, f64); BINS],
    /// Log-odds of the even confidence: assumed and learnt.
    assumed: f64,
    even: f64,
    slope: f64,
    since_fit: u32,
}

/// Log-odds of a confidence, bounded.
pub(super) fn log_odds(confidence: f64) -> f64 {
    let confidence = bounded(confidence);
    (confidence / (1.0 - confidence)).ln()
}

fn bounded(confidence: f64) -> f64 {
    confidence.clamp(1e-4, 1.0 - 1e-4)
}

impl DetectionCalibration {
    /// A calibration that assumes the even confidence.
    pub(super) fn new(even_confidence: f64) -> Self {
        let assumed = log_odds(even_confidence);
        Self {
            bins: [(0.0, 0.0); BINS],
            assumed,
            even: assumed,
            slope: SLOPE,
            since_fit: 0,
        }
    }

    /// Log-odds that a detection is real, by the log-odds of its confidence.
    pub(super) fn nats(&self, log_odds: f64) -> f64 {
        (self.slope * (log_odds - self.even)).clamp(-4.0, 4.0)
    }

    /// Log-odds of the even confidence above the assumed one.
    pub(super) fn even_excess(&self) -> f64 {
        self.even - self.assumed
    }

    /// A test for confidences of detections that are likelier real than not.
    pub(super) fn likely(&self) -> impl Fn(f64) -> bool + use<> {
        let even_confidence = logistic(self.even);
        move |confidence| bounded(confidence) > even_confidence
    }

    /// Learns whether a detection recurred at the next look.
    pub(super) fn learn(&mut self, log_odds: f64, has_recurred: bool) {
        let bin = (((log_odds - MIN_NATS) / BIN_NATS) as usize).min(BINS - 1);
        let (rehits, looks) = &mut self.bins[bin];
        *rehits += f64::from(u8::from(has_recurred));
        *looks += 1.0;
        let kept = (MEMORY / *looks).min(1.0);
        *rehits *= kept;
        *looks *= kept;
        self.since_fit += 1;
        if self.since_fit >= REFIT {
            self.since_fit = 0;
            self.fit();
        }
    }

    fn fit(&mut self) {
        let total: f64 = self.bins.iter().map(|(_, looks)| looks).sum();
        let median = self.median_above(f64::NEG_INFINITY).unwrap_or(self.assumed);
        // From the highest confidence down, until too few recur.
        let mut above: Option<(f64, f64)> = None;
        let mut found = None;
        for (bin, (rehits, looks)) in self.bins.iter().enumerate().rev() {
            if *looks < 0.002 * total || *looks < 1.0 {
                continue;
            }
            let middle = MIN_NATS + BIN_NATS * (bin as f64 + 0.5);
            let rate = (rehits + PRIOR_LOOKS * self.usual(middle)) / (looks + PRIOR_LOOKS);
            if rate < EVEN_REHITS {
                let (high, high_rate) = above.unwrap_or((middle + BIN_NATS, 1.0));
                let share = (EVEN_REHITS - rate) / (high_rate - rate).max(1e-6);
                found = Some(middle + share.min(1.0) * (high - middle));
                break;
            }
            above = Some((middle, rate));
        }
        let lowest = above.map_or(self.assumed, |(lowest, _)| lowest);
        let even = found
            .unwrap_or_else(|| self.assumed.min(lowest - BIN_NATS))
            .min(median);
        let spread = self
            .median_above(even)
            .map_or(USUAL_SPREAD, |median| median - even);
        let trust = total / (total + 10.0 * PRIOR_LOOKS);
        let wider = trust * (spread.max(0.1) / USUAL_SPREAD).ln();
        self.even = self.assumed + beyond_tolerance(even - self.assumed, EVEN_TOLERANCE);
        self.slope = (SLOPE / beyond_tolerance(wider, SPREAD_TOLERANCE).exp()).clamp(0.5, 8.0);
    }

    /// The usual share of detections that recur.
    fn usual(&self, log_odds: f64) -> f64 {
        0.92 / (1.0 + (-(1.6 * (log_odds - self.assumed) + 0.75)).exp())
    }

    /// The median of all log-odds above a limit.
    fn median_above(&self, limit: f64) -> Option<f64> {
        let middle = |bin: usize| MIN_NATS + BIN_NATS * (bin as f64 + 0.5);
        let above = || {
            self.bins
                .iter()
                .enumerate()
                .filter(|(bin, _)| middle(*bin) > limit)
        };
        let half = above().map(|(_, (_, looks))| looks).sum::<f64>() / 2.0;
        let mut sum = 0.0;
        above().find_map(|(bin, (_, looks))| {
            sum += looks;
            (sum > half).then(|| middle(bin))
        })
    }
}

/// A deviation, reduced by a third at the tolerance, and to almost nothing well within it.
fn beyond_tolerance(deviation: f64, tolerance: f64) -> f64 {
    deviation * (1.0 - (-(deviation / tolerance).powi(2)).exp())
}
