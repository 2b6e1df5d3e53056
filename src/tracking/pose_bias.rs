//! Pose bias of one vehicle: the offset and the rotation of its pose, and the delay of its stamps.
//!
//! The biases are a Gauss-Markov process of four states with a slow change and a given spread at rest. Every report is
//! one step of an extended Kalman filter in information form over all correspondences. Cauchy's function reweights the
//! correspondences against wrong pairs (Holland, Welsch, "Robust regression using iteratively reweighted
//! least-squares", 1977).
//!
//! The delay is observable from the directions of traffic: it shifts oncoming objects and overtaking objects in
//! opposite directions. Without the delay, two vehicles that each observe one direction would estimate offsets instead,
//! and their corrections would drift together without bound.

use nalgebra::{Matrix2, Matrix4, Rotation2, Vector2, Vector4};

use crate::model::geometry::wrap_angle;
use crate::model::time::Timestamp;
use crate::wire::PoseCorrection;

/// Number of reweighting steps for a report.
const ITERATIONS: usize = 3;

/// Residual, in standard deviations, at which a correspondence counts half.
const CAUCHY: f64 = 2.0;

/// Maximum delay, in standard deviations.
const MAX_DELAY: f64 = 3.0;

/// Time in seconds after which a vehicle that repeats one pose counts as standing.
const STANDS_S: f64 = 1.0;

/// Maximum weight of a standing vehicle, as a multiple of the weight of a moving vehicle.
const MAX_WEIGHT: f64 = 100.0;

/// Time in seconds for which a vehicle observes an object from one side.
const SAME_SIDE_S: f64 = 10.0;

/// Minimum number of correspondences of a published correction.
const MIN_PAIRS: f64 = 3.0;

/// Standard deviations of pose biases at rest, and the time over which they change.
#[derive(Debug, Clone, Copy)]
pub(super) struct BiasPrior {
    pub(super) offset_m: f64,
    pub(super) heading_rad: f64,
    pub(super) delay_s: f64,
    pub(super) memory_s: f64,
}

impl BiasPrior {
    /// Distance of two errors in standard deviations.
    pub(super) fn deviations(&self, difference: &Vector4<f64>) -> f64 {
        let deviations = Vector4::new(self.offset_m, self.offset_m, self.heading_rad, self.delay_s);
        difference.component_div(&deviations).norm()
    }

    fn covariance(&self) -> Matrix4<f64> {
        let deviations = Vector4::new(self.offset_m, self.offset_m, self.heading_rad, self.delay_s);
        Matrix4::from_diagonal(&deviations.component_mul(&deviations))
    }
}

/// A reported position and the position at which other vehicles detected the object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Correspondence {
    pub(super) reported: Vector2<f64>,
    pub(super) reference: Vector2<f64>,
    /// Velocity of the object, m/s.
    pub(super) velocity: Vector2<f64>,
    /// Variance of the difference in each direction that is independent between correspondences, m².
    pub(super) variance: f64,
    /// Variance of the error that the references may share, m².
    pub(super) common: f64,
    /// Variance of the vehicle's error about this object, which is constant while the vehicle observes the object from
    /// one side, m².
    pub(super) of_object: f64,
}

/// Estimated pose bias of one vehicle.
#[derive(Debug, Clone)]
pub(super) struct PoseBias {
    at: Timestamp,
    /// Centre of the rotation, metres.
    pivot: Vector2<f64>,
    /// Offset east and north, rotation, and delay of the stamps in seconds.
    error: Vector4<f64>,
    covariance: Matrix4<f64>,
    /// Fading number of correspondences.
    pairs: f64,
    /// Time for which the vehicle has stood still, seconds.
    stood_s: f64,
    /// How well the errors agree with the errors of most other vehicles, 0 to 1.
    consistency: f64,
}

impl PoseBias {
    /// An estimate without correspondences.
    pub(super) fn new(at: Timestamp, prior: &BiasPrior) -> Self {
        Self {
            at,
            pivot: Vector2::zeros(),
            error: Vector4::zeros(),
            covariance: prior.covariance(),
            pairs: 0.0,
            stood_s: 0.0,
            consistency: 1.0,
        }
    }

    /// Sets the centre of the rotation, which moves with the vehicle; the bias is kept.
    pub(super) fn set_pivot(&mut self, pivot: Vector2<f64>) {
        self.pivot = pivot;
    }

    /// Records that the vehicle has stood still for another `passed_s`, or that it moves.
    pub(super) fn stand(&mut self, passed_s: Option<f64>) {
        self.stood_s = passed_s.map_or(0.0, |passed_s| self.stood_s + passed_s);
    }

    /// Offset east and north in metres, rotation in radians, and delay of the stamps in seconds.
    pub(super) fn error(&self) -> Vector4<f64> {
        self.error
    }

    /// Centre of the rotation, metres.
    pub(super) fn pivot(&self) -> Vector2<f64> {
        self.pivot
    }

    /// Weight in the common motion of all vehicles, which grows while the vehicle stands.
    pub(super) fn weight(&self, prior: &BiasPrior) -> f64 {
        (1.0 + self.stood_s / prior.memory_s).min(MAX_WEIGHT)
    }

    /// How well the errors agree with the errors of most vehicles that detect common objects: 1 within their spread, 0
    /// far from it. The value returns to 1 as the errors decay.
    pub(super) fn consistency(&self) -> f64 {
        self.consistency
    }

    /// Sets how well the errors agree with the errors of most other vehicles.
    pub(super) fn set_consistency(&mut self, consistency: f64) {
        self.consistency = consistency;
    }

    /// Subtracts a part of the error that the vehicle shares with other vehicles.
    pub(super) fn take_back(&mut self, common: &Vector4<f64>, prior: &BiasPrior) {
        self.error -= common;
        self.limit_delay(prior);
    }

    /// A function that corrects reported positions.
    pub(super) fn corrector(&self) -> impl Fn(&Vector2<f64>) -> Vector2<f64> + use<> {
        let pivot = self.pivot;
        let rotation = self.rotation();
        let offset = self.error.xy();
        move |reported| pivot + rotation * (reported - pivot) + offset
    }

    /// A reported heading, corrected.
    pub(super) fn correct_heading(&self, heading_rad: f64) -> f64 {
        wrap_angle(heading_rad + self.error.z)
    }

    /// A reported velocity, corrected.
    pub(super) fn correct_velocity(&self, velocity: &Vector2<f64>) -> Vector2<f64> {
        self.rotation() * velocity
    }

    fn rotation(&self) -> Rotation2<f64> {
        Rotation2::new(self.error.z)
    }

    /// Delay of the vehicle's stamps, seconds: the estimate if its marginal likelihood is greater than the likelihood
    /// without delay.
    ///
    /// The likelihood ratio equals the ratio of the densities of zero delay before and after the observations (Dickey,
    /// "The weighted likelihood ratio, linear hypotheses on normal location parameters", 1971). An estimate that is
    /// mostly noise would separate reports that were captured together.
    pub(super) fn delay_s(&self, prior: &BiasPrior) -> f64 {
        let before = prior.delay_s * prior.delay_s;
        let after = self.covariance.m44;
        let is_delayed = self.error.w * self.error.w > after * (before / after).ln();
        if is_delayed { self.error.w } else { 0.0 }
    }

    /// Mean variance of a corrected position in each direction, m², of an object with a velocity in m/s.
    pub(super) fn variance_at(&self, reported: &Vector2<f64>, velocity: &Vector2<f64>) -> f64 {
        let lever = (reported - self.pivot).norm_squared();
        let rotation_and_delay =
            lever * self.covariance.m33 + velocity.norm_squared() * self.covariance.m44;
        (self.covariance.m11 + self.covariance.m22 + rotation_and_delay) / 2.0
    }

    /// Updates the estimate; returns the part of the former error that remained at `at`. The references are valid for
    /// `at`, which is the report's stamp less `delay_s`.
    pub(super) fn observe(
        &mut self,
        at: Timestamp,
        delay_s: f64,
        pairs: &[Correspondence],
        prior: &BiasPrior,
    ) -> f64 {
        let passed_s = at.since(self.at).as_secs_f64().clamp(0.01, SAME_SIDE_S);
        let kept = self.fade(at, prior);
        self.fit(delay_s, pairs, SAME_SIDE_S / passed_s, prior);
        kept
    }

    /// Updates the estimate. An object is observed from one side in `frames` frames, which together count as one
    /// measurement of its own error.
    fn fit(&mut self, delay_s: f64, pairs: &[Correspondence], frames: f64, prior: &BiasPrior) {
        let Some(prior_information) = self.covariance.try_inverse().filter(|_| !pairs.is_empty())
        else {
            return;
        };
        let predicted = self.error;
        let mut counted = 0.0;
        for _ in 0..ITERATIONS {
            let rotation = self.rotation();
            let offset = self.error.xy();
            let mut normal = NormalEquations::default();
            counted = 0.0;
            for pair in pairs {
                let arm = rotation * (pair.reported - self.pivot);
                let later = pair.velocity * (self.error.w - delay_s);
                let residual = pair.reference - (self.pivot + arm + offset) - later;
                let variance = pair.variance + pair.of_object;
                let squared = residual.norm_squared() / (variance + pair.common);
                let trust = 1.0 / (1.0 + squared / (CAUCHY * CAUCHY));
                // The error that the references share remains with any number of references.
                let lasting_variance = pair.variance + frames * pair.of_object;
                let weight = trust / (lasting_variance + pair.common * pairs.len() as f64);
                normal.add(
                    &Matrix2::from_columns(&[Vector2::new(-arm.y, arm.x), pair.velocity]),
                    &residual,
                    weight,
                );
                counted += trust;
            }
            let information = normal.information();
            let gradient = normal.gradient();
            let Some(covariance) = (prior_information + information).try_inverse() else {
                return;
            };
            self.error =
                covariance * (prior_information * predicted + information * self.error + gradient);
            self.limit_delay(prior);
            self.covariance = (covariance + covariance.transpose()) * 0.5;
        }
        self.pairs += counted;
    }

    /// The stamps of one vehicle must not move the time at which all reports are fused.
    fn limit_delay(&mut self, prior: &BiasPrior) {
        let max_s = MAX_DELAY * prior.delay_s;
        self.error.w = self.error.w.clamp(-max_s, max_s);
    }

    /// Predicts the errors at `at`: they decay, and their covariance returns to the prior. Returns the part that
    /// remains.
    fn fade(&mut self, at: Timestamp, prior: &BiasPrior) -> f64 {
        let stood = 1.0 + self.stood_s / STANDS_S;
        let kept = (-at.since(self.at).as_secs_f64() / (prior.memory_s * stood * stood)).exp();
        self.error *= kept;
        self.covariance =
            self.covariance * (kept * kept) + prior.covariance() * (1.0 - kept * kept);
        self.pairs *= kept;
        self.consistency = 1.0 - (1.0 - self.consistency) * kept;
        self.at = self.at.max(at);
        kept
    }

    /// The correction for the map; `None` with too few correspondences.
    pub(super) fn correction(&self) -> Option<PoseCorrection> {
        (self.pairs >= MIN_PAIRS).then(|| PoseCorrection {
            about_m: [self.pivot.x, self.pivot.y],
            dx_m: self.error.x,
            dy_m: self.error.y,
            dheading_rad: wrap_angle(self.error.z),
            pairs: self.pairs,
        })
    }
}

/// Sums over correspondences for the normal equations. The derivatives of a residual by the offset are the identity, so
/// that these blocks are enough.
#[derive(Default)]
struct NormalEquations {
    /// Σw, ΣwD, ΣwDᵀD, Σwr, ΣwDᵀr: weights w, residuals r, derivatives D by rotation and delay.
    weight: f64,
    first: Matrix2<f64>,
    second: Matrix2<f64>,
    residual: Vector2<f64>,
    turned: Vector2<f64>,
}

impl NormalEquations {
    fn add(&mut self, by_rotation_and_delay: &Matrix2<f64>, residual: &Vector2<f64>, weight: f64) {
        let weighted = by_rotation_and_delay * weight;
        self.weight += weight;
        self.first += weighted;
        self.second += weighted.tr_mul(by_rotation_and_delay);
        self.residual += residual * weight;
        self.turned += weighted.tr_mul(residual);
    }

    /// Information matrix of translation (first two rows) and of rotation and delay (last two).
    fn information(&self) -> Matrix4<f64> {
        let mut information = Matrix4::from_diagonal_element(self.weight);
        information
            .fixed_view_mut::<2, 2>(0, 2)
            .copy_from(&self.first);
        information
            .fixed_view_mut::<2, 2>(2, 0)
            .copy_from(&self.first.transpose());
        information
            .fixed_view_mut::<2, 2>(2, 2)
            .copy_from(&self.second);
        information
    }

    fn gradient(&self) -> Vector4<f64> {
        Vector4::new(
            self.residual.x,
            self.residual.y,
            self.turned.x,
            self.turned.y,
        )
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Twelve objects in five seconds of rounds, of which every time other 30 % are paired with a neighbour two to
    /// four metres away, always on the same side.
    #[test]
    fn few_wrong_pairs_are_tolerated() {
        let prior = BiasPrior {
            offset_m: 0.5,
            heading_rad: 0.01,
            delay_s: 0.02,
            memory_s: 10.0,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let start = Timestamp(1_732_154_400_000_000);
        let mut pose_bias = PoseBias::new(start, &prior);
        let error = Vector2::new(0.6, -0.4);
        for round in 0..50 {
            let pair = |n: u32| {
                let reported = Vector2::new(
                    f64::from(n % 4) * 15.0 - 22.0,
                    f64::from(n / 4) * 20.0 - 20.0,
                );
                let mut noise = || rng.random_range(-0.2..0.2);
                let reference = reported + error + Vector2::new(noise(), noise());
                let wrong = if rng.random_bool(0.3) {
                    rng.random_range(2.0..4.0)
                } else {
                    0.0
                };
                let reference = reference + Vector2::new(0.0, wrong);
                Correspondence {
                    reported,
                    reference,
                    velocity: Vector2::zeros(),
                    variance: 0.04,
                    common: 0.02,
                    of_object: 0.0,
                }
            };
            let pairs: Vec<_> = (0..12).map(pair).collect();
            pose_bias.observe(Timestamp(start.0 + round * 100_000), 0.0, &pairs, &prior);
        }
        let off = pose_bias.corrector()(&Vector2::zeros()) - error;
        assert!(off.norm() < 0.15, "off by {off:?}");
        assert!(
            pose_bias
                .correction()
                .is_some_and(|correction| correction.dheading_rad.abs() < 0.004)
        );
    }

    /// Stamps late by `late_s`, and objects of 8 m/s each way, for `seconds` of ten rounds.
    fn delay_after(seconds: u64, late_s: f64) -> f64 {
        let prior = BiasPrior {
            offset_m: 0.5,
            heading_rad: 0.01,
            delay_s: 0.02,
            memory_s: 10.0,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let start = Timestamp(1_732_154_400_000_000);
        let mut pose_bias = PoseBias::new(start, &prior);
        for round in 0..10 * seconds {
            let delay_s = pose_bias.delay_s(&prior);
            let pair = |n: u32| {
                let velocity = Vector2::new(if n.is_multiple_of(2) { 8.0 } else { -8.0 }, 0.0);
                let reported = Vector2::new(f64::from(n) * 10.0 - 30.0, 5.0);
                let noise = Vector2::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5));
                let reference = reported + noise + velocity * (late_s - delay_s);
                Correspondence {
                    reported,
                    reference,
                    velocity,
                    variance: 0.08,
                    common: 0.02,
                    of_object: 0.0,
                }
            };
            let pairs: Vec<_> = (0..6).map(pair).collect();
            pose_bias.observe(
                Timestamp(start.0 + round * 100_000),
                delay_s,
                &pairs,
                &prior,
            );
        }
        pose_bias.delay_s(&prior)
    }

    #[test]
    fn only_likely_delay_moves_stamps() {
        assert!((1..5).all(|seconds| delay_after(seconds, 0.0) == 0.0));
        let found = delay_after(10, 0.05);
        assert!((found - 0.05).abs() < 0.01, "{found} s");
    }
}
