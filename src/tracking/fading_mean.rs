//! Mean of the latest values, for everything that is estimated by counting.

/// Weighted mean of values; beyond [`Self::MEMORY`] values, earlier ones are discounted.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FadingMean {
    sum: f64,
    weight: f64,
}

impl FadingMean {
    /// Number of values beyond which earlier values are discounted.
    pub(super) const MEMORY: f64 = 500.0;

    /// An initial mean with the weight of this number of values.
    pub(super) fn new(mean: f64, weight: f64) -> Self {
        Self {
            sum: mean * weight,
            weight,
        }
    }

    /// Adds a value that counts as `weight` values.
    pub(super) fn add(&mut self, value: f64, weight: f64) {
        self.sum += weight * value;
        self.weight += weight;
        let kept = (Self::MEMORY / self.weight).min(1.0);
        self.sum *= kept;
        self.weight *= kept;
    }

    /// Adds a positive or negative result that counts as `weight` results: the mean is the share of positive ones.
    pub(super) fn count(&mut self, is_positive: bool, weight: f64) {
        self.add(f64::from(u8::from(is_positive)), weight);
    }

    /// The mean of at least one value.
    pub(super) fn mean(&self) -> f64 {
        self.sum / self.weight
    }

    /// The mean with a prior that counts as `weight` values.
    pub(super) fn mean_with(&self, prior: f64, weight: f64) -> f64 {
        (prior * weight + self.sum) / (weight + self.weight)
    }

    /// Number of values, at most [`Self::MEMORY`].
    pub(super) fn weight(&self) -> f64 {
        self.weight
    }
}
