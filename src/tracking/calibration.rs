//! Calibration of a vehicle's confidences: how much more likely each confidence is for an object than for clutter.
//!
//! Two histograms count the confidences of detections by the probability that their track is an object. That
//! probability follows from observations alone, so that confidences do not confirm themselves. Without evidence, a
//! confidence is the probability that it states, relative to `even_confidence`.

use super::fading_mean::FadingMean;

/// Estimated relation between confidence and evidence of one vehicle.
#[derive(Debug, Clone)]
pub(super) struct DetectionCalibration {
    /// Numbers of detections of objects and of clutter by confidence.
    objects: [f64; BINS],
    clutter: [f64; BINS],
}

/// Bins of equal width in log-odds.
const BINS: usize = 12;
const BIN_NATS: f64 = 0.8;
const MIN_NATS: f64 = -4.8;

/// Number of detections as which the prior counts in each bin.
const PRIOR: f64 = 4.0;

/// Maximum evidence of one confidence, nats.
const MAX_NATS: f64 = 4.0;

/// Log-odds of a confidence, bounded.
pub(super) fn log_odds(confidence: f64) -> f64 {
    let confidence = confidence.clamp(1e-4, 1.0 - 1e-4);
    (confidence / (1.0 - confidence)).ln()
}

fn bin(log_odds: f64) -> usize {
    (((log_odds - MIN_NATS) / BIN_NATS).max(0.0) as usize).min(BINS - 1)
}

impl DetectionCalibration {
    /// A calibration without evidence: a detection of `even_confidence` is equally likely to be an object and clutter.
    pub(super) fn new(even_confidence: f64) -> Self {
        let even = log_odds(even_confidence);
        let share = |bin: usize| {
            let middle = MIN_NATS + BIN_NATS * (bin as f64 + 0.5);
            1.0 / (1.0 + (even - middle).exp())
        };
        Self {
            objects: std::array::from_fn(|bin| PRIOR * share(bin)),
            clutter: std::array::from_fn(|bin| PRIOR * (1.0 - share(bin))),
        }
    }

    /// Evidence of a confidence by its log-odds, nats.
    pub(super) fn nats(&self, log_odds: f64) -> f64 {
        let bin = bin(log_odds);
        let [objects, clutter] =
            [&self.objects, &self.clutter].map(|counts| counts.iter().sum::<f64>());
        let ratio = self.objects[bin] / objects / (self.clutter[bin] / clutter);
        ratio.ln().clamp(-MAX_NATS, MAX_NATS)
    }

    /// Updates the relation with a detection of a track that is an object with a probability.
    pub(super) fn learn(&mut self, log_odds: f64, probability: f64) {
        let bin = bin(log_odds);
        self.objects[bin] += probability;
        self.clutter[bin] += 1.0 - probability;
        let total: f64 = self.objects.iter().chain(&self.clutter).sum();
        let kept = (FadingMean::MEMORY / total).min(1.0);
        if kept < 1.0 {
            let all = self.objects.iter_mut().chain(&mut self.clutter);
            all.for_each(|count| *count *= kept);
        }
    }
}
