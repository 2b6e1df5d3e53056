//! What a stated confidence is worth, learned from agreement with verdicts.

const BANDS: usize = 10;

/// Agreement of votes with verdicts by band of stated confidence.
///
/// A detector's confidence orders its detections but is no probability. The weight of a vote is the log-odds of being
/// right in its band against the log-odds over all bands, made non-decreasing by pooling adjacent violators (Barlow et
/// al. 1972; Zadrozny & Elkan 2002). Until a band has evidence, the weight is the stated confidence against the mean.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    agreed: [f64; BANDS],
    votes: [f64; BANDS],
    confidence: f64,
    prior_votes: f64,
}

impl Calibration {
    /// No evidence yet; `prior_votes` is the weight of a stated confidence against evidence, in votes.
    pub fn new(prior_votes: f64) -> Self {
        Self { agreed: [0.0; BANDS], votes: [0.0; BANDS], confidence: 0.0, prior_votes }
    }

    fn band(confidence: f64) -> usize {
        ((confidence * BANDS as f64) as usize).min(BANDS - 1)
    }

    /// Takes in that a vote of `confidence` agreed with the verdict with probability `agreement`.
    pub fn observe(&mut self, confidence: f64, agreement: f64) {
        let band = Self::band(confidence);
        self.votes[band] += 1.0;
        self.agreed[band] += agreement;
        self.confidence += confidence;
    }

    /// Weight of a vote by band, 0.1 to 2, and the mean stated confidence that unlearned weights refer to.
    pub fn weights(&self) -> Weights {
        let votes: f64 = self.votes.iter().sum();
        let agreed: f64 = self.agreed.iter().sum();
        let overall = log_odds((agreed + 7.0) / (votes + 10.0));
        let mut pools: Vec<(f64, f64, usize)> = Vec::with_capacity(BANDS);
        for (&agreed, &votes) in self.agreed.iter().zip(&self.votes) {
            let mut pool = (agreed, votes, 1);
            while let Some(&(a, v, n)) = pools.last()
                && (v == 0.0 || pool.1 == 0.0 || a / v >= pool.0 / pool.1)
            {
                pool = (a + pool.0, v + pool.1, n + pool.2);
                pools.pop();
            }
            pools.push(pool);
        }
        let mut ratios = [1.0; BANDS];
        let mut band = 0;
        for (a, v, n) in pools {
            let rate = (a + 7.0) / (v + 10.0);
            for ratio in &mut ratios[band..band + n] {
                *ratio = if overall > 0.1 { (log_odds(rate) / overall).clamp(0.1, 2.0) } else { 1.0 };
            }
            band += n;
        }
        Weights { ratios, votes: self.votes, mean: (self.confidence / votes.max(1.0)), prior_votes: self.prior_votes }
    }
}

/// Weights of votes, fixed for a round.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    ratios: [f64; BANDS],
    votes: [f64; BANDS],
    mean: f64,
    prior_votes: f64,
}

impl Weights {
    /// Weight of a vote of the stated confidence; 1 when all votes have the same confidence.
    pub fn of(&self, confidence: f64) -> f64 {
        let band = Calibration::band(confidence);
        let n = self.votes[band];
        let stated = if self.mean > 0.0 { (confidence / self.mean).clamp(0.1, 2.0) } else { 1.0 };
        (n * self.ratios[band] + self.prior_votes * stated) / (n + self.prior_votes)
    }
}

fn log_odds(p: f64) -> f64 {
    (p / (1.0 - p)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_confidences_weigh_one() {
        let mut calibration = Calibration::new(50.0);
        for n in 0..200 {
            calibration.observe(1.0, f64::from(n % 4 != 0));
        }
        assert!((calibration.weights().of(1.0) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn weights_follow_what_a_band_is_worth_and_never_fall() {
        let mut calibration = Calibration::new(10.0);
        for n in 0..2000 {
            calibration.observe(0.95, f64::from(n % 20 != 0));
            calibration.observe(0.55, f64::from(n % 2 == 0));
            calibration.observe(0.75, f64::from(n % 3 == 0));
        }
        let weights = calibration.weights();
        assert!(weights.of(0.95) > 1.3);
        assert!(weights.of(0.55) < 0.3);
        assert!(weights.of(0.75) >= weights.of(0.55) - 0.05);
    }
}
