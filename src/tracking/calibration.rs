//! What a vehicle's confidences are worth, learnt from which detections come again.
//!
//! Nobody says which detections are real. But what is real is detected again at the next look, and what is not, less
//! so, and the part that comes again rises with the confidence in much the same way for whatever detector: where
//! [`EVEN_REHITS`] of the detections come again, about half are real. That confidence is found from rates by
//! confidence, and the spread of the confidences above it gives their scale.

use super::existence::logistic;

/// Part of the detections that come again among those of which half are real.
const EVEN_REHITS: f64 = 0.62;

/// Nats by which a detection is likelier real, where confidences spread as usual, for each nat of its log-odds.
const SLOPE: f64 = 1.75;

/// The usual distance of the median from the even confidence, among confidences above it, in nats.
const USUAL_SPREAD: f64 = 1.9;

/// Departures from what was assumed that are within what scenes differ by: of the even confidence in nats, and of the
/// logarithm of the spread. What goes beyond is the detector's.
const EVEN_TOLERANCE: f64 = 0.7;
const SPREAD_TOLERANCE: f64 = 0.5;

/// Looks that the usual rates count as, in each bin.
const PRIOR_LOOKS: f64 = 10.0;

/// Looks in a bin beyond which earlier ones are forgotten.
const MEMORY: f64 = 400.0;

/// Looks after which the fit is made anew.
const REFIT: u32 = 25;

const BINS: usize = 24;
const BIN_NATS: f64 = 0.4;
const LOWEST_NATS: f64 = -4.8;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Calibration {
    /// Detections that came again, and all, by log-odds of their confidence.
    bins: [(f64, f64); BINS],
    /// Log-odds of the even confidence: as assumed, and as found.
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
    confidence.clamp(0.01, 0.99)
}

impl Calibration {
    /// As if detections of `even_confidence` were as likely real as not.
    pub(super) fn new(even_confidence: f64) -> Self {
        let assumed = log_odds(even_confidence);
        Self { bins: [(0.0, 0.0); BINS], assumed, even: assumed, slope: SLOPE, since_fit: 0 }
    }

    /// Log-odds that a detection is real whose confidence has so many.
    pub(super) fn nats(&self, log_odds: f64) -> f64 {
        (self.slope * (log_odds - self.even)).clamp(-4.0, 4.0)
    }

    /// Whether detections of a confidence are likelier real than not.
    pub(super) fn likely(&self) -> impl Fn(f64) -> bool + use<> {
        let even_confidence = logistic(self.even);
        move |confidence| bounded(confidence) > even_confidence
    }

    /// A detection of so many log-odds came again at the next look, or did not.
    pub(super) fn learn(&mut self, log_odds: f64, again: bool) {
        let bin = (((log_odds - LOWEST_NATS) / BIN_NATS) as usize).min(BINS - 1);
        let (rehits, looks) = &mut self.bins[bin];
        *rehits += f64::from(u8::from(again));
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
        let median = self.quantile_above(f64::NEG_INFINITY).unwrap_or(self.assumed);
        // From the surest detections down, until too few come again.
        let mut above: Option<(f64, f64)> = None;
        let mut found = None;
        for (bin, (rehits, looks)) in self.bins.iter().enumerate().rev() {
            if *looks < 0.002 * total || *looks < 1.0 {
                continue;
            }
            let middle = LOWEST_NATS + BIN_NATS * (bin as f64 + 0.5);
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
        let even = found.unwrap_or_else(|| self.assumed.min(lowest - BIN_NATS)).min(median);
        let spread = self.quantile_above(even).map_or(USUAL_SPREAD, |median| median - even);
        let trust = total / (total + 10.0 * PRIOR_LOOKS);
        let wider = trust * (spread.max(0.1) / USUAL_SPREAD).ln();
        self.even = self.assumed + beyond(even - self.assumed, EVEN_TOLERANCE);
        self.slope = (SLOPE / beyond(wider, SPREAD_TOLERANCE).exp()).clamp(0.5, 8.0);
    }

    /// The rate of detections that come again as it usually is.
    fn usual(&self, log_odds: f64) -> f64 {
        0.92 / (1.0 + (-(1.6 * (log_odds - self.assumed) + 0.75)).exp())
    }

    /// The median of all log-odds above a limit.
    fn quantile_above(&self, limit: f64) -> Option<f64> {
        let middle = |bin: usize| LOWEST_NATS + BIN_NATS * (bin as f64 + 0.5);
        let above = || self.bins.iter().enumerate().filter(|(bin, _)| middle(*bin) > limit);
        let half = above().map(|(_, (_, looks))| looks).sum::<f64>() / 2.0;
        let mut sum = 0.0;
        above().find_map(|(bin, (_, looks))| {
            sum += looks;
            (sum > half).then(|| middle(bin))
        })
    }
}

/// A departure, unless it is within the tolerance.
fn beyond(departure: f64, tolerance: f64) -> f64 {
    departure * (1.0 - (-(departure / tolerance).powi(2)).exp())
}
