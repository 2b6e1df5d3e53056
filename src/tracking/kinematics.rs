//! Where an object is and how it moves: nearly constant velocity, with an error of its own and one that it shares.
//!
//! The state is position and velocity, driven by white noise acceleration of density q (Bar-Shalom, Li, Kirubarajan,
//! "Estimation with Applications to Tracking and Navigation", 2001, section 6.2.2). The covariance is split in two
//! (Julier, Uhlmann, "General decentralized data fusion with covariance intersection", 2001, section 12.4): the part
//! that is independent from one report to the next shrinks as reports come in, by Joseph's form, which holds for any
//! gain. The part that may be common to them in any way, such as an error of a vehicle's pose, never shrinks below what
//! the best of the reports has: of errors of standard deviations b₁, b₂ that are weighted by k and 1−k, the standard
//! deviation is at most k·b₁ + (1−k)·b₂, whatever their correlation.

use nalgebra::{Matrix2, Vector2};

use crate::time::Timestamp;

/// What is measured of an object in one frame, with its errors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Measurement {
    pub(super) position: Vector2<f64>,
    /// Independent part of the position's covariance, m².
    pub(super) independent: Matrix2<f64>,
    /// Standard deviation in metres of the part that may be common to many frames.
    pub(super) common_m: f64,
}

/// A measurement held against an object.
#[derive(Debug, Clone, Copy)]
pub(super) struct Innovation {
    /// The measured position less the expected one.
    pub(super) offset: Vector2<f64>,
    /// Covariance of the offset, m².
    pub(super) covariance: Matrix2<f64>,
    /// Squared Mahalanobis distance.
    pub(super) distance_squared: f64,
}

/// State and covariance at a point in time.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    pub(super) at: Timestamp,
    pub(super) position: Vector2<f64>,
    pub(super) velocity: Vector2<f64>,
    /// Covariances of position, of position and velocity, and of velocity: the independent part.
    pp: Matrix2<f64>,
    pv: Matrix2<f64>,
    vv: Matrix2<f64>,
    /// Standard deviation in metres of the position's common part.
    common_m: f64,
}

impl Motion {
    /// An object that was seen once and may move at `speed_mps` (standard deviation) in each direction.
    pub(super) fn new(at: Timestamp, seen: &Measurement, speed_mps: f64) -> Self {
        Self {
            at,
            position: seen.position,
            velocity: Vector2::zeros(),
            pp: seen.independent,
            pv: Matrix2::zeros(),
            vv: Matrix2::identity() * (speed_mps * speed_mps),
            common_m: seen.common_m,
        }
    }

    /// Seconds from the state to `at`.
    fn seconds_to(&self, at: Timestamp) -> f64 {
        at.micros_from(self.at) as f64 * 1e-6
    }

    /// The position at `at`, earlier or later.
    pub(super) fn position_at(&self, at: Timestamp) -> Vector2<f64> {
        self.position + self.velocity * self.seconds_to(at)
    }

    /// Covariance of the position at `at`, both parts, m².
    pub(super) fn covariance_at(&self, at: Timestamp, density: f64) -> Matrix2<f64> {
        self.independent_at(self.seconds_to(at), density) + common(self.common_m)
    }

    /// Covariance of the velocity, (m/s)².
    pub(super) fn velocity_covariance(&self) -> &Matrix2<f64> {
        &self.vv
    }

    fn independent_at(&self, dt: f64, density: f64) -> Matrix2<f64> {
        let drift = density * dt.abs().powi(3) / 3.0;
        self.pp + (self.pv + self.pv.transpose()) * dt + self.vv * (dt * dt) + Matrix2::identity() * drift
    }

    /// Moves the state to `at`; an earlier time changes nothing.
    pub(super) fn predict(&mut self, at: Timestamp, density: f64) {
        let dt = self.seconds_to(at);
        if dt <= 0.0 {
            return;
        }
        self.pp = self.independent_at(dt, density);
        self.pv += self.vv * dt + Matrix2::identity() * (density * dt * dt / 2.0);
        self.vv += Matrix2::identity() * (density * dt);
        self.position += self.velocity * dt;
        self.at = at;
    }

    /// Holds a measurement taken at `at` against the state.
    pub(super) fn innovation(&self, at: Timestamp, seen: &Measurement, density: f64) -> Innovation {
        let offset = seen.position - self.position_at(at);
        let covariance = self.covariance_at(at, density) + seen.independent + common(seen.common_m);
        let distance_squared = inverse(&covariance).map_or(f64::INFINITY, |inverse| offset.dot(&(inverse * offset)));
        Innovation { offset, covariance, distance_squared }
    }

    /// Takes a measurement in. One taken before the state's time is held against where the object was then (Bar-Shalom,
    /// "Update with out-of-sequence measurements in tracking", 2002, with the process noise in between counted in
    /// full).
    pub(super) fn update(&mut self, at: Timestamp, seen: &Measurement, density: f64) {
        self.predict(at, density);
        let dt = self.seconds_to(at).min(0.0);
        let noise = self.independent_at(dt, density) + seen.independent;
        let Some(inverse) = inverse(&(noise + common(self.common_m) + common(seen.common_m))) else { return };
        let offset = seen.position - self.position_at(at);
        let at_position = self.pp + self.pv * dt;
        let at_velocity = self.pv.transpose() + self.vv * dt;
        let position_gain = (at_position + common(self.common_m)) * inverse;
        let velocity_gain = at_velocity * inverse;
        self.position += position_gain * offset;
        self.velocity += velocity_gain * offset;
        self.joseph([at_position, at_velocity], [position_gain, velocity_gain], &noise);
        let share = (position_gain.trace() / 2.0).clamp(0.0, 1.0);
        self.common_m = (1.0 - share) * self.common_m + share * seen.common_m;
    }

    /// Takes in what the velocity was at `at`, not after the state, of standard deviation `sigma_mps` in each
    /// direction. As errors of all that is said of it may be the same, the velocity is never better known for it than
    /// one says.
    pub(super) fn update_velocity(&mut self, at: Timestamp, velocity: Vector2<f64>, sigma_mps: f64, density: f64) {
        let stated = sigma_mps * sigma_mps + density * self.seconds_to(at).abs();
        let known = self.vv.trace() / 2.0;
        if known <= stated {
            return;
        }
        // With this variance, what comes of it has the stated one.
        let enough = known * stated / (known - stated);
        let noise = self.vv + Matrix2::identity() * enough;
        let Some(inverse) = inverse(&noise) else { return };
        let offset = velocity - self.velocity;
        let gains = [self.pv * inverse, self.vv * inverse];
        self.position += gains[0] * offset;
        self.velocity += gains[1] * offset;
        self.joseph([self.pv, self.vv], gains, &noise);
    }

    /// The covariance after any gain, given those of the state with what was measured, and of the innovation.
    fn joseph(&mut self, with: [Matrix2<f64>; 2], gain: [Matrix2<f64>; 2], noise: &Matrix2<f64>) {
        let kept = [0, 1].map(|i| gain[i] * noise - with[i]);
        let after = |i: usize, j: usize| kept[i] * gain[j].transpose() - gain[i] * with[j].transpose();
        self.pp = symmetric(self.pp + after(0, 0));
        self.pv += after(0, 1);
        self.vv = symmetric(self.vv + after(1, 1));
    }

    /// The velocity may be another one altogether, by a standard deviation of `speed_mps` in each direction.
    pub(super) fn doubt_velocity(&mut self, speed_mps: f64) {
        self.vv += Matrix2::identity() * (speed_mps * speed_mps);
    }

    /// Keeps the speed within what an object can have.
    pub(super) fn limit_speed(&mut self, most_mps: f64) {
        let speed = self.velocity.norm();
        if speed > most_mps {
            self.velocity *= most_mps / speed;
        }
    }
}

fn common(sigma_m: f64) -> Matrix2<f64> {
    Matrix2::identity() * (sigma_m * sigma_m)
}

fn symmetric(matrix: Matrix2<f64>) -> Matrix2<f64> {
    (matrix + matrix.transpose()) * 0.5
}

/// The inverse of a covariance that has one.
fn inverse(matrix: &Matrix2<f64>) -> Option<Matrix2<f64>> {
    let determinant = matrix.determinant();
    (determinant > 0.0 && determinant.is_finite())
        .then(|| Matrix2::new(matrix.m22, -matrix.m12, -matrix.m21, matrix.m11) / determinant)
}
