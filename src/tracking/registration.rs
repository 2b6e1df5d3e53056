//! By how much a vehicle's positions and stamps are off, from what others see of the same objects.
//!
//! The error is an offset, a rotation and a delay, small and changing slowly: a Gauss-Markov process of four states with
//! a known spread at rest, so that what all vehicles are off by together, which nobody can see, decays. A delay puts
//! what moves one way too far ahead and what moves the other way too far behind; taken for offsets, those of two
//! vehicles that each heed one direction would pull each other along without end. Every round is
//! one step of an extended Kalman filter in information form over all pairs, reweighted against wrong ones by Cauchy's
//! function (Holland, Welsch, "Robust regression using iteratively reweighted least-squares", 1977).

use nalgebra::{Matrix2, Matrix4, Rotation2, Vector2, Vector4};

use crate::geometry::wrap_angle;
use crate::time::Timestamp;
use crate::wire::PoseCorrection;

/// A position as a vehicle reported it, and where others saw the same object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pair {
    pub(super) reported: Vector2<f64>,
    pub(super) reference: Vector2<f64>,
    /// How fast the object goes, m/s.
    pub(super) velocity: Vector2<f64>,
    /// Variance of the difference in each direction, m²: what is independent from pair to pair.
    pub(super) variance: f64,
    /// Variance of what the references may be off by together, m².
    pub(super) common: f64,
}

/// The spread of pose errors and how fast they change.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spread {
    pub(super) offset_m: f64,
    pub(super) heading_rad: f64,
    pub(super) delay_s: f64,
    pub(super) memory_s: f64,
}

impl Spread {
    fn covariance(&self) -> Matrix4<f64> {
        let deviations = Vector4::new(self.offset_m, self.offset_m, self.heading_rad, self.delay_s);
        Matrix4::from_diagonal(&deviations.component_mul(&deviations))
    }
}

/// The estimate for one vehicle.
#[derive(Debug, Clone)]
pub(super) struct Alignment {
    at: Timestamp,
    about: Vector2<f64>,
    /// East, north, rotation, and seconds by which stamps are late.
    error: Vector4<f64>,
    covariance: Matrix4<f64>,
    pairs: f64,
}

/// How often pairs are weighted anew in a round.
const ITERATIONS: usize = 3;

/// Residual, in standard deviations, at which a pair counts half.
const CAUCHY: f64 = 2.0;

/// Largest delay, in standard deviations.
const MOST_DELAY: f64 = 3.0;

/// Fewest pairs that a correction is published for.
const MIN_PAIRS: f64 = 3.0;

impl Alignment {
    pub(super) fn new(at: Timestamp, spread: &Spread) -> Self {
        Self { at, about: Vector2::zeros(), error: Vector4::zeros(), covariance: spread.covariance(), pairs: 0.0 }
    }

    /// The vehicle is there now, or what it sees: the error of its pose goes with it.
    pub(super) fn turn_about(&mut self, about: Vector2<f64>) {
        self.about = about;
    }

    /// Where a reported position belongs.
    pub(super) fn correct(&self, reported: &Vector2<f64>) -> Vector2<f64> {
        self.correction()(reported)
    }

    /// The same for many.
    pub(super) fn correction(&self) -> impl Fn(&Vector2<f64>) -> Vector2<f64> + use<> {
        let (about, rotation, offset) = (self.about, self.rotation(), self.error.xy());
        move |reported| about + rotation * (reported - about) + offset
    }

    /// A reported direction as it should be.
    pub(super) fn correct_heading(&self, heading_rad: f64) -> f64 {
        wrap_angle(heading_rad + self.error.z)
    }

    /// A reported velocity as it should be.
    pub(super) fn turned(&self, vector: &Vector2<f64>) -> Vector2<f64> {
        self.rotation() * vector
    }

    fn rotation(&self) -> Rotation2<f64> {
        Rotation2::new(self.error.z)
    }

    /// Seconds by which stamps are late.
    pub(super) fn delay_s(&self) -> f64 {
        self.error.w
    }

    /// Variance of a corrected position in each direction, on average, m², of what goes at `velocity` m/s.
    pub(super) fn variance_at(&self, reported: &Vector2<f64>, velocity: &Vector2<f64>) -> f64 {
        let lever = (reported - self.about).norm_squared();
        let turned_and_moved = lever * self.covariance.m33 + velocity.norm_squared() * self.covariance.m44;
        (self.covariance.m11 + self.covariance.m22 + turned_and_moved) / 2.0
    }

    /// Takes the pairs of a report in, whose references are where the objects were at `at`: the report's stamp, less
    /// `delay_s`.
    pub(super) fn observe(&mut self, at: Timestamp, delay_s: f64, pairs: &[Pair], spread: &Spread) {
        self.fade(at, spread);
        let Some(prior_information) = self.covariance.try_inverse().filter(|_| !pairs.is_empty()) else { return };
        let prior = self.error;
        let mut counted = 0.0;
        for _ in 0..ITERATIONS {
            let (rotation, offset) = (self.rotation(), self.error.xy());
            let mut normal = Normal::default();
            counted = 0.0;
            for pair in pairs {
                let arm = rotation * (pair.reported - self.about);
                let later = pair.velocity * (self.error.w - delay_s);
                let residual = pair.reference - (self.about + arm + offset) - later;
                let squared = residual.norm_squared() / (pair.variance + pair.common);
                let trust = 1.0 / (1.0 + squared / (CAUCHY * CAUCHY));
                // What the references share is no better known for their number.
                let weight = trust / (pair.variance + pair.common * pairs.len() as f64);
                normal.add(&Matrix2::from_columns(&[Vector2::new(-arm.y, arm.x), pair.velocity]), &residual, weight);
                counted += trust;
            }
            let (information, gradient) = (normal.information(), normal.gradient());
            let Some(covariance) = (prior_information + information).try_inverse() else { return };
            self.error = covariance * (prior_information * prior + information * self.error + gradient);
            // Nobody's stamps move the time at which all reports are fused.
            let most_s = MOST_DELAY * spread.delay_s;
            self.error.w = self.error.w.clamp(-most_s, most_s);
            self.covariance = (covariance + covariance.transpose()) * 0.5;
        }
        self.pairs += counted;
    }

    /// Forgets with time.
    fn fade(&mut self, at: Timestamp, spread: &Spread) {
        let kept = (-at.since(self.at).as_secs_f64() / spread.memory_s).exp();
        self.error *= kept;
        self.covariance = self.covariance * (kept * kept) + spread.covariance() * (1.0 - kept * kept);
        self.pairs *= kept;
        self.at = self.at.max(at);
    }

    /// For the map, if there is anything to say.
    pub(super) fn published(&self) -> Option<PoseCorrection> {
        (self.pairs >= MIN_PAIRS).then(|| PoseCorrection {
            about_m: [self.about.x, self.about.y],
            dx_m: self.error.x,
            dy_m: self.error.y,
            dheading_rad: self.error.z,
            pairs: self.pairs,
        })
    }
}

/// Sums over pairs for the normal equations. A residual's derivatives are the identity by the offset, and those by
/// rotation and delay, which are the columns of a matrix: no more than these blocks has to be summed.
#[derive(Default)]
struct Normal {
    /// With w for the weights, r for the residuals and D for their derivatives by rotation and delay: Σw, ΣwD, ΣwDᵀD,
    /// Σwr, ΣwDᵀr.
    weight: f64,
    first: Matrix2<f64>,
    second: Matrix2<f64>,
    residual: Vector2<f64>,
    turned: Vector2<f64>,
}

impl Normal {
    fn add(&mut self, by_rotation_and_delay: &Matrix2<f64>, residual: &Vector2<f64>, weight: f64) {
        let weighted = by_rotation_and_delay * weight;
        self.weight += weight;
        self.first += weighted;
        self.second += weighted.tr_mul(by_rotation_and_delay);
        self.residual += residual * weight;
        self.turned += weighted.tr_mul(residual);
    }

    fn information(&self) -> Matrix4<f64> {
        let mut information = Matrix4::from_diagonal_element(self.weight);
        information.fixed_view_mut::<2, 2>(0, 2).copy_from(&self.first);
        information.fixed_view_mut::<2, 2>(2, 0).copy_from(&self.first.transpose());
        information.fixed_view_mut::<2, 2>(2, 2).copy_from(&self.second);
        information
    }

    fn gradient(&self) -> Vector4<f64> {
        Vector4::new(self.residual.x, self.residual.y, self.turned.x, self.turned.y)
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
    fn three_wrong_pairs_in_ten_do_not_mislead() {
        let spread = Spread { offset_m: 0.5, heading_rad: 0.01, delay_s: 0.02, memory_s: 10.0 };
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let start = Timestamp(1_732_154_400_000_000);
        let mut alignment = Alignment::new(start, &spread);
        let error = Vector2::new(0.6, -0.4);
        for round in 0..50 {
            let pair = |n: u32| {
                let reported = Vector2::new(f64::from(n % 4) * 15.0 - 22.0, f64::from(n / 4) * 20.0 - 20.0);
                let mut noise = || rng.random_range(-0.2..0.2);
                let reference = reported + error + Vector2::new(noise(), noise());
                let wrong = if rng.random_bool(0.3) { rng.random_range(2.0..4.0) } else { 0.0 };
                let reference = reference + Vector2::new(0.0, wrong);
                Pair { reported, reference, velocity: Vector2::zeros(), variance: 0.04, common: 0.02 }
            };
            let pairs: Vec<_> = (0..12).map(pair).collect();
            alignment.observe(Timestamp(start.0 + round * 100_000), 0.0, &pairs, &spread);
        }
        let off = alignment.correct(&Vector2::zeros()) - error;
        assert!(off.norm() < 0.15, "off by {off:?}");
        assert!(alignment.published().is_some_and(|correction| correction.dheading_rad.abs() < 0.004));
    }
}
