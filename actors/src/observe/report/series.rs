//! Time series and distributions.

use ecod::model::time::Timestamp;

/// Values in order of time.
#[derive(Debug, Clone, Default)]
pub(super) struct Samples {
    values: Vec<(Timestamp, f64)>,
}

impl Samples {
    pub(super) fn push(&mut self, at: Timestamp, value: f64) {
        self.values.push((at, value));
    }

    /// Points by seconds since `start`. Of each of `parts` time slices, only minimum and maximum
    /// remain, so that peaks survive.
    pub(super) fn points(&self, start: Timestamp, seconds: f64, parts: usize) -> Vec<(f64, f64)> {
        let points: Vec<_> = self
            .values
            .iter()
            .map(|(at, value)| (at.since(start).as_secs_f64(), *value))
            .collect();
        let slice = |x: f64| (x / seconds.max(1e-9) * parts as f64) as usize;
        points
            .chunk_by(|a, b| slice(a.0) == slice(b.0))
            .flat_map(extremes)
            .collect()
    }

    pub(super) fn values(&self) -> Vec<f64> {
        self.values.iter().map(|(_, value)| *value).collect()
    }

    pub(super) fn newest(&self) -> Option<f64> {
        self.values.last().map(|(_, value)| *value)
    }
}

/// Minimum and maximum in order of time.
fn extremes(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let by_value = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
    let mut extremes: Vec<_> = points
        .iter()
        .min_by(by_value)
        .into_iter()
        .chain(points.iter().max_by(by_value))
        .copied()
        .collect();
    extremes.sort_by(|a, b| a.0.total_cmp(&b.0));
    extremes.dedup();
    extremes
}

/// The quantile for `share`, by nearest rank; `None` without values.
pub(super) fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let place = (share * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(place).copied()
}

/// Cumulative distribution in percent, in at most `parts` steps.
pub(super) fn distribution(values: &[f64], parts: usize) -> Vec<(f64, f64)> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let count = sorted.len();
    let step = count.div_ceil(parts).max(1);
    let mut points: Vec<_> = (0..count)
        .step_by(step)
        .map(|n| (sorted[n], 100.0 * (n + 1) as f64 / count as f64))
        .collect();
    points.extend(sorted.last().map(|last| (*last, 100.0)));
    points
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_every_peak() {
        let mut samples = Samples::default();
        for n in 0..10_000u64 {
            samples.push(Timestamp(n * 1000), if n == 4321 { 9.0 } else { 0.1 });
        }
        let points = samples.points(Timestamp(0), 10.0, 100);
        assert!(
            points.len() <= 202 && points.contains(&(4.321, 9.0)),
            "{}",
            points.len()
        );
    }

    #[test]
    fn quantiles_end_at_maximum() {
        let values = [3.0, 1.0, 2.0];
        assert_eq!(
            [0.0, 0.5, 1.0].map(|share| quantile(&values, share)),
            [Some(1.0), Some(2.0), Some(3.0)]
        );
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!(distribution(&values, 10).last(), Some(&(3.0, 100.0)));
        assert!(distribution(&[], 10).is_empty());
    }
}
