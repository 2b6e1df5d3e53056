//! What a stated confidence is worth, learned from agreement with the other vehicles.

use std::collections::BTreeSet;

const BANDS: usize = 10;
const STEPS: usize = 20;
/// Weight, in votes, of the middle rank against a vehicle's own record of confidences.
const RANK_PRIOR_VOTES: f64 = 5.0;
/// Weight, in votes, of the overall rate of agreement against a band's own.
const BAND_PRIOR_VOTES: f64 = 100.0;
/// Spread of pooled bands, in variances of one vote, that is not taken for knowledge: three times what ten equal bands
/// come to by chance, 1/2 + … + 1/10 (Barlow et al. 1972).
const NOISE: f64 = 6.0;
/// Votes over which the memory of what confidences are worth fades to 1/e.
const MEMORY_VOTES: f64 = 20_000.0;
/// Least and most that a vote weighs for its confidence.
const WEIGHT_RANGE: (f64, f64) = (0.1, 3.0);

/// Agreement of votes with what the others say, by band.
#[derive(Debug, Clone, Default, PartialEq)]
struct Bands {
    agreed: [f64; BANDS],
    votes: [f64; BANDS],
}

impl Bands {
    fn add(&mut self, band: usize, agreement: f64, sign: f64) {
        self.votes[band] += sign;
        self.agreed[band] += sign * agreement;
    }

    fn fade(&mut self, factor: f64) {
        self.votes.iter_mut().chain(&mut self.agreed).for_each(|n| *n *= factor);
    }
}

/// How often a vehicle stated which confidence.
#[derive(Debug, Clone, Default)]
struct Scale {
    stated: [f64; STEPS],
    total: f64,
}

/// What confidences are worth.
///
/// A detector's confidence orders its detections but is no probability, and one vehicle's 0.6 may be another's 0.9.
/// How good a vehicle is on the whole is its reputation; its confidence tells which of its votes are the better ones.
/// So a vote's band is the rank of its confidence among all of the vehicle's. Its weight is the log-odds of being right
/// in that band against the log-odds over all bands, made non-decreasing by pooling adjacent violators (Barlow et al.
/// 1972; Zadrozny & Elkan 2002): confidence that misleads ends up weighing nothing. Of what then differs between bands
/// only the part beyond chance is kept (James & Stein 1961): confidence that says nothing ends up so too. Until there is
/// evidence, the weight is the stated confidence against the mean of all.
#[derive(Debug, Clone)]
pub(super) struct Calibration {
    live: Bands,
    settled: Bands,
    scales: Vec<Scale>,
    /// Sum and number of all stated confidences.
    stated: (f64, f64),
    prior_votes: f64,
}

impl Calibration {
    /// No evidence yet; `prior_votes` is the weight of a stated confidence against evidence, in votes.
    pub(super) fn new(prior_votes: f64) -> Self {
        Self { live: Bands::default(), settled: Bands::default(), scales: Vec::new(), stated: (0.0, 0.0), prior_votes }
    }

    /// Takes in that a vehicle stated a confidence.
    pub(super) fn state(&mut self, vehicle: usize, confidence: f64) {
        if self.scales.len() <= vehicle {
            self.scales.resize(vehicle + 1, Scale::default());
        }
        self.stated = (self.stated.0 + confidence, self.stated.1 + 1.0);
        let scale = &mut self.scales[vehicle];
        scale.stated[step(confidence)] += 1.0;
        scale.total += 1.0;
    }

    /// Forgets which confidences vehicles stated; their numbers may stand for others from now on.
    pub(super) fn forget(&mut self, vehicles: &BTreeSet<usize>) {
        for &vehicle in vehicles {
            self.scales.get_mut(vehicle).into_iter().for_each(|scale| *scale = Scale::default());
        }
    }

    /// Band of a vote: the rank of its confidence among the vehicle's.
    pub(super) fn band(&self, vehicle: usize, confidence: f64) -> usize {
        let (stated, total) = self.scales.get(vehicle).map_or(([0.0; STEPS], 0.0), |s| (s.stated, s.total));
        let step = step(confidence);
        let below: f64 = stated[..step].iter().sum();
        let rank = (below + 0.5 * stated[step] + 0.5 * RANK_PRIOR_VOTES) / (total + RANK_PRIOR_VOTES);
        ((rank * BANDS as f64) as usize).min(BANDS - 1)
    }

    /// Counts that the others support a vote with probability `agreement`; `sign` −1 takes it back.
    pub(super) fn count(&mut self, band: usize, agreement: f64, sign: f64) {
        self.live.add(band, agreement, sign);
    }

    /// Counts a vote that is past.
    pub(super) fn settle(&mut self, band: usize, agreement: f64) {
        self.settled.fade(1.0 - 1.0 / MEMORY_VOTES);
        self.settled.add(band, agreement, 1.0);
    }

    /// Goes on with the live evidence of `other`.
    pub(super) fn take_live(&mut self, other: Self) {
        self.live = other.live;
    }

    /// Forgets the live evidence.
    pub(super) fn clear_live(&mut self) {
        self.live = Bands::default();
    }

    /// Weights of votes.
    pub(super) fn weights(&self) -> Weights {
        let mut bands = self.settled.clone();
        for band in 0..BANDS {
            bands.votes[band] = (bands.votes[band] + self.live.votes[band]).max(0.0);
            bands.agreed[band] = (bands.agreed[band] + self.live.agreed[band]).max(0.0);
        }
        let (agreed, votes) = (bands.agreed.iter().sum::<f64>(), bands.votes.iter().sum::<f64>());
        let rate = (agreed + 0.7) / (votes + 1.0);
        let shrunk = |agreed: f64, votes: f64| odds((agreed + BAND_PRIOR_VOTES * rate) / (votes + BAND_PRIOR_VOTES));
        let overall = shrunk(agreed, votes);
        let mut ratios = [1.0; BANDS];
        if overall > 0.1 {
            let mut band = 0;
            let pools = pooled(&bands);
            let kept = beyond_noise(&pools);
            for (agreed, votes, width) in pools {
                let ratio = 1.0 + kept * (shrunk(agreed, votes) / overall - 1.0);
                ratios[band..band + width].fill(ratio.clamp(WEIGHT_RANGE.0, WEIGHT_RANGE.1));
                band += width;
            }
        }
        Weights { ratios, votes, mean: self.stated.0 / self.stated.1.max(1.0), prior_votes: self.prior_votes }
    }
}

/// (agreed, votes, number of bands) of runs of bands in which agreement does not fall.
fn pooled(bands: &Bands) -> Vec<(f64, f64, usize)> {
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

/// Part of the difference between pools that is kept: James–Stein shrinkage (positive part) towards one rate for all.
fn beyond_noise(pools: &[(f64, f64, usize)]) -> f64 {
    let with_votes = || pools.iter().filter(|(_, votes, _)| *votes > 0.0);
    let (agreed, votes) = with_votes().fold((0.0, 0.0), |(a, n), (agreed, votes, _)| (a + agreed, n + votes));
    // Taking counts back leaves rounding errors: more may seem to have agreed than voted.
    let rate = (agreed / f64::max(votes, 1e-9)).clamp(0.0, 1.0);
    let spread: f64 = with_votes().map(|(agreed, votes, _)| votes * (agreed / votes - rate).powi(2)).sum();
    let noise = NOISE * rate * (1.0 - rate);
    if spread > noise { 1.0 - noise / spread } else { 0.0 }
}

fn odds(rate: f64) -> f64 {
    let rate = rate.clamp(1e-6, 1.0 - 1e-6);
    (rate / (1.0 - rate)).ln()
}

fn step(confidence: f64) -> usize {
    ((confidence * STEPS as f64) as usize).min(STEPS - 1)
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
    pub(super) fn of(&self, band: usize, confidence: f64) -> f64 {
        let n = self.votes;
        let (low, high) = WEIGHT_RANGE;
        let stated = if self.mean > 0.0 { (confidence / self.mean).clamp(low, high) } else { 1.0 };
        (n * self.ratios[band] + self.prior_votes * stated) / (n + self.prior_votes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn learned(votes: impl Iterator<Item = (usize, f64, bool)> + Clone) -> Calibration {
        let mut calibration = Calibration::new(10.0);
        votes.clone().for_each(|(vehicle, confidence, _)| calibration.state(vehicle, confidence));
        for (vehicle, confidence, agreed) in votes {
            calibration.settle(calibration.band(vehicle, confidence), f64::from(agreed));
        }
        calibration
    }

    fn weight(calibration: &Calibration, vehicle: usize, confidence: f64) -> f64 {
        calibration.weights().of(calibration.band(vehicle, confidence), confidence)
    }

    #[test]
    fn equal_confidences_weigh_one() {
        let calibration = learned((0..200).map(|n| (0, 1.0, n % 4 != 0)));
        assert!((weight(&calibration, 0, 1.0) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn weights_follow_what_a_band_is_worth() {
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
        let calibration = learned((0..4000).map(|n| if n % 2 == 0 { (0, 0.9, n % 4 == 0) } else { (0, 0.4, true) }));
        let (high, low) = (weight(&calibration, 0, 0.9), weight(&calibration, 0, 0.4));
        assert!((high - 1.0).abs() < 0.05 && (low - 1.0).abs() < 0.05, "{high} {low}");
    }

    #[test]
    fn confidence_that_says_nothing_weighs_nothing() {
        // Agreement and confidence repeat with periods that have no common factor.
        let calibration = learned((0..2000).map(|n| (0, f64::from(n % 19) / 19.0 + 0.02, n % 7 > 1)));
        for step in 0..19 {
            let weight = weight(&calibration, 0, f64::from(step) / 19.0 + 0.02);
            assert!((weight - 1.0).abs() < 0.02, "{weight}");
        }
    }

    #[test]
    fn counts_that_rounding_leaves_behind_give_weights() {
        let mut calibration = Calibration::new(10.0);
        calibration.count(3, 0.3, 1.0);
        calibration.count(3, 0.1 + 0.2, -1.0);
        calibration.count(5, 1.0 + 1e-12, 1.0);
        assert!(weight(&calibration, 0, 0.9).is_finite());
    }

    #[test]
    fn a_boastful_vehicle_weighs_no_more_than_a_modest_one() {
        let calibration = learned((0..8000).map(|n| (n % 2, if n % 2 == 0 { 0.99 } else { 0.5 }, n % 5 != 0)));
        assert!((weight(&calibration, 0, 0.99) - weight(&calibration, 1, 0.5)).abs() < 0.05);
    }
}
