//! Calibration: the weight of a stated confidence, estimated from agreement with the other
//! vehicles.

use std::collections::BTreeSet;

use super::parameters::{
    BAND_NOISE, BAND_PRIOR_VOTES, BANDS, LONG_MEMORY, MAX_CONFIDENCE_WEIGHT, MIN_CONFIDENCE_WEIGHT,
    RANK_PRIOR_VOTES,
};

/// Bins of the histogram of a vehicle's confidences.
const BINS: usize = 20;

/// Index of a band.
pub(super) type Band = u8;

/// Agreement of votes with the other vehicles' votes, by band.
#[derive(Debug, Clone, Default, PartialEq)]
struct BandCounts {
    agreed: [f64; BANDS],
    votes: [f64; BANDS],
}

impl BandCounts {
    fn add(&mut self, band: Band, agreement: f64, sign: f64) {
        self.votes[usize::from(band)] += sign;
        self.agreed[usize::from(band)] += sign * agreement;
    }

    fn fade(&mut self, factor: f64) {
        self.votes
            .iter_mut()
            .chain(&mut self.agreed)
            .for_each(|n| *n *= factor);
    }
}

/// Number of times that a vehicle stated each confidence.
#[derive(Debug, Clone, Default)]
struct ConfidenceHistogram {
    stated: [f64; BINS],
    total: f64,
}

/// Weights of confidences.
///
/// A detector's confidence orders its detections but is not a probability: one vehicle's 0.6 may be
/// another's 0.9. A vehicle's overall quality is its reputation; its confidence ranks its votes by
/// quality.
///
/// - A vote's band is the rank of its confidence among all of the vehicle's.
/// - Its weight is the log-odds of being right in that band, divided by the log-odds over all
///   bands.
/// - The weights are made non-decreasing by pooling adjacent violators (Barlow et al. 1972;
///   Zadrozny & Elkan 2002): confidence that misleads has no effect.
/// - Of the differences between bands only the part beyond chance is kept (James & Stein 1961):
///   confidence that is uninformative has no effect.
/// - Until there is evidence, the weight is the stated confidence divided by the mean of all.
#[derive(Debug, Clone, Default)]
pub(super) struct ConfidenceCalibration {
    live: BandCounts,
    settled: BandCounts,
    histograms: Vec<ConfidenceHistogram>,
    /// Sum and number of all stated confidences.
    stated: (f64, f64),
    prior_votes: f64,
}

impl ConfidenceCalibration {
    /// No evidence yet; `prior_votes` is the weight of a stated confidence against evidence, in
    /// votes.
    pub(super) fn new(prior_votes: f64) -> Self {
        Self {
            prior_votes,
            ..Self::default()
        }
    }

    /// Applies another weight of stated confidences.
    pub(super) fn configure(&mut self, prior_votes: f64) {
        self.prior_votes = prior_votes;
    }

    /// Counts that a vehicle stated a confidence.
    pub(super) fn record_confidence(&mut self, vehicle: usize, confidence: f64) {
        if self.histograms.len() <= vehicle {
            self.histograms
                .resize(vehicle + 1, ConfidenceHistogram::default());
        }
        self.stated = (self.stated.0 + confidence, self.stated.1 + 1.0);
        let histogram = &mut self.histograms[vehicle];
        histogram.stated[bin(confidence)] += 1.0;
        histogram.total += 1.0;
    }

    /// Removes the confidences of vehicles, whose indices may be reused.
    pub(super) fn remove_vehicles(&mut self, vehicles: &BTreeSet<usize>) {
        for &vehicle in vehicles {
            if let Some(histogram) = self.histograms.get_mut(vehicle) {
                *histogram = ConfidenceHistogram::default();
            }
        }
    }

    /// Band of a vote: the rank of its confidence among the vehicle's.
    pub(super) fn band(&self, vehicle: usize, confidence: f64) -> Band {
        let bin = bin(confidence);
        let counts = self.histograms.get(vehicle).map_or((0.0, 0.0, 0.0), |all| {
            (all.stated[..bin].iter().sum(), all.stated[bin], all.total)
        });
        let (below, equal, total) = counts;
        let rank = (below + 0.5 * equal + 0.5 * RANK_PRIOR_VOTES) / (total + RANK_PRIOR_VOTES);
        ((rank * BANDS as f64) as Band).min(BANDS as Band - 1)
    }

    /// Counts a live vote that the others support with probability `agreement`; with `sign` −1
    /// subtracts it.
    pub(super) fn count(&mut self, band: Band, agreement: f64, sign: f64) {
        self.live.add(band, agreement, sign);
    }

    /// Counts a settled vote.
    pub(super) fn settle(&mut self, band: Band, agreement: f64) {
        self.settled.fade(1.0 - 1.0 / LONG_MEMORY);
        self.settled.add(band, agreement, 1.0);
    }

    /// Replaces the live evidence by the live evidence of `other`.
    pub(super) fn merge_live(&mut self, other: Self) {
        self.live = other.live;
    }

    /// Clears the live evidence.
    pub(super) fn clear_live(&mut self) {
        self.live = BandCounts::default();
    }

    /// The current weights of votes.
    pub(super) fn weights(&self) -> Weights {
        let mut bands = self.settled.clone();
        for band in 0..BANDS {
            bands.votes[band] = (bands.votes[band] + self.live.votes[band]).max(0.0);
            bands.agreed[band] = (bands.agreed[band] + self.live.agreed[band]).max(0.0);
        }
        let agreed = bands.agreed.iter().sum::<f64>();
        let votes = bands.votes.iter().sum::<f64>();
        let rate = (agreed + 0.7) / (votes + 1.0);
        let shrunk = |agreed: f64, votes: f64| {
            odds((agreed + BAND_PRIOR_VOTES * rate) / (votes + BAND_PRIOR_VOTES))
        };
        let overall = shrunk(agreed, votes);
        let mut ratios = [1.0; BANDS];
        if overall > 0.1 {
            let mut band = 0;
            let pools = pool_adjacent_violators(&bands);
            let kept = shrinkage(&pools);
            for (agreed, votes, width) in pools {
                let ratio = 1.0 + kept * (shrunk(agreed, votes) / overall - 1.0);
                ratios[band..band + width]
                    .fill(ratio.clamp(MIN_CONFIDENCE_WEIGHT, MAX_CONFIDENCE_WEIGHT));
                band += width;
            }
        }
        Weights {
            ratios,
            votes,
            mean: self.stated.0 / self.stated.1.max(1.0),
            prior_votes: self.prior_votes,
        }
    }
}

/// Runs of bands between which agreement rises, as (agreed, votes, number of bands).
fn pool_adjacent_violators(bands: &BandCounts) -> Vec<(f64, f64, usize)> {
    let mut pools: Vec<(f64, f64, usize)> = Vec::with_capacity(BANDS);
    for (&agreed, &votes) in bands.agreed.iter().zip(&bands.votes) {
        let mut pool = (agreed, votes, 1);
        while let Some(&(a, v, n)) = pools.last()
            && (v <= 0.0 || pool.1 <= 0.0 || a / v >= pool.0 / pool.1)
        {
            pool = (a + pool.0, v + pool.1, n + pool.2);
            pools.pop();
        }
        pools.push(pool);
    }
    pools
}

/// Kept part of the difference between pools: positive-part James–Stein shrinkage towards one rate
/// for all.
fn shrinkage(pools: &[(f64, f64, usize)]) -> f64 {
    let with_votes = || pools.iter().filter(|(_, votes, _)| *votes > 0.0);
    let (agreed, votes) = with_votes().fold((0.0, 0.0), |(a, n), (agreed, votes, _)| {
        (a + agreed, n + votes)
    });
    // Subtracted counts leave rounding errors: more votes may seem to have agreed than there are.
    let rate = (agreed / f64::max(votes, 1e-9)).clamp(0.0, 1.0);
    let spread: f64 = with_votes()
        .map(|(agreed, votes, _)| votes * (agreed / votes - rate).powi(2))
        .sum();
    let noise = BAND_NOISE * rate * (1.0 - rate);
    if spread > noise {
        1.0 - noise / spread
    } else {
        0.0
    }
}

fn odds(rate: f64) -> f64 {
    let rate = rate.clamp(1e-6, 1.0 - 1e-6);
    (rate / (1.0 - rate)).ln()
}

fn bin(confidence: f64) -> usize {
    ((confidence * BINS as f64) as usize).min(BINS - 1)
}

/// Weights of votes, fixed for a round.
#[derive(Debug, Clone)]
pub(super) struct Weights {
    ratios: [f64; BANDS],
    votes: f64,
    mean: f64,
    prior_votes: f64,
}

impl Weights {
    /// Weight of a vote of the stated confidence; 1 when all votes have the same confidence.
    pub(super) fn of(&self, band: Band, confidence: f64) -> f64 {
        let n = self.votes;
        let stated = if self.mean > 0.0 {
            (confidence / self.mean).clamp(MIN_CONFIDENCE_WEIGHT, MAX_CONFIDENCE_WEIGHT)
        } else {
            1.0
        };
        (n * self.ratios[usize::from(band)] + self.prior_votes * stated) / (n + self.prior_votes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn learned(votes: impl Iterator<Item = (usize, f64, bool)> + Clone) -> ConfidenceCalibration {
        let mut calibration = ConfidenceCalibration::new(10.0);
        votes.clone().for_each(|(vehicle, confidence, _)| {
            calibration.record_confidence(vehicle, confidence);
        });
        for (vehicle, confidence, agreed) in votes {
            calibration.settle(calibration.band(vehicle, confidence), f64::from(agreed));
        }
        calibration
    }

    fn weight(calibration: &ConfidenceCalibration, vehicle: usize, confidence: f64) -> f64 {
        calibration
            .weights()
            .of(calibration.band(vehicle, confidence), confidence)
    }

    #[test]
    fn equal_confidences_weigh_one() {
        let calibration = learned((0..200).map(|n| (0, 1.0, n % 4 != 0)));
        assert!((weight(&calibration, 0, 1.0) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn weights_follow_band_accuracy() {
        let calibration = learned((0..6000).map(|n| match n % 3 {
            0 => (0, 0.95, n % 20 != 0),
            1 => (0, 0.75, n % 4 != 0),
            _ => (0, 0.55, n % 2 == 0),
        }));
        assert!(weight(&calibration, 0, 0.95) > 1.5);
        assert!(weight(&calibration, 0, 0.55) < 0.3);
        let middle = weight(&calibration, 0, 0.75);
        assert!((0.5..1.5).contains(&middle), "{middle}");
    }

    #[test]
    fn confidence_that_misleads_weighs_nothing() {
        let calibration = learned((0..4000).map(|n| {
            if n % 2 == 0 {
                (0, 0.9, n % 4 == 0)
            } else {
                (0, 0.4, true)
            }
        }));
        let high = weight(&calibration, 0, 0.9);
        let low = weight(&calibration, 0, 0.4);
        assert!(
            (high - 1.0).abs() < 0.05 && (low - 1.0).abs() < 0.05,
            "{high} {low}"
        );
    }

    #[test]
    fn uninformative_confidence_has_no_weight() {
        // Agreement and confidence repeat with periods that have no common factor.
        let calibration =
            learned((0..2000).map(|n| (0, f64::from(n % 19) / 19.0 + 0.02, n % 7 > 1)));
        for bin in 0..19 {
            let weight = weight(&calibration, 0, f64::from(bin) / 19.0 + 0.02);
            assert!((weight - 1.0).abs() < 0.02, "{weight}");
        }
    }

    #[test]
    fn rounding_residue_keeps_weights_finite() {
        let mut calibration = ConfidenceCalibration::new(10.0);
        calibration.count(3, 0.3, 1.0);
        calibration.count(3, 0.1 + 0.2, -1.0);
        calibration.count(5, 1.0 + 1e-12, 1.0);
        assert!(weight(&calibration, 0, 0.9).is_finite());
    }

    #[test]
    fn boastful_vehicle_gains_no_weight() {
        let calibration =
            learned((0..8000).map(|n| (n % 2, if n % 2 == 0 { 0.99 } else { 0.5 }, n % 5 != 0)));
        assert!((weight(&calibration, 0, 0.99) - weight(&calibration, 1, 0.5)).abs() < 0.05);
    }
}
