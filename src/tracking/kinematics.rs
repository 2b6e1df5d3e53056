//! Position and velocity of a track: nearly constant velocity, with an independent and a common part of the error.
//!
//! White noise acceleration of density q drives the state (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications
//! to Tracking and Navigation", 2001, section 6.2.2). The covariance is split in two (Julier, Uhlmann, "General
//! decentralized data fusion with covariance intersection", 2001, section 12.4). The part that is independent from
//! report to report shrinks with every report, by Joseph's form, which is valid for any gain. The common part, such as
//! the error of a vehicle's pose, has the smallest common part of any report as its lower bound: two errors with
//! standard deviations b₁ and b₂ and weights k and 1−k have a standard deviation of at most k·b₁ + (1−k)·b₂ for any
//! correlation.

use nalgebra::{Matrix2, Vector2};

use super::class::ObjectClass;
use crate::model::time::Timestamp;

/// Standard deviation of stated velocities, m/s.
pub(super) const VELOCITY_SIGMA_MPS: f64 = 1.0;

/// Measured position of an object in one frame, with its errors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Measurement {
    pub(super) position: Vector2<f64>,
    /// Independent part of the position's covariance, m².
    pub(super) independent: Matrix2<f64>,
    /// Standard deviation in metres of the part that may be common to many frames.
    pub(super) common_m: f64,
}

/// Difference between a measurement and the state.
#[derive(Debug, Clone, Copy)]
pub(super) struct Innovation {
    /// Measured less predicted position, metres.
    pub(super) offset: Vector2<f64>,
    /// Squared Mahalanobis distance.
    pub(super) distance_squared: f64,
}

/// State and covariance of a track at a point in time.
#[derive(Debug, Clone)]
pub(super) struct KinematicState {
    pub(super) at: Timestamp,
    /// Motion parameters of the object's class.
    pub(super) class: ObjectClass,
    /// Metres.
    pub(super) position: Vector2<f64>,
    /// m/s.
    pub(super) velocity: Vector2<f64>,
    /// Independent covariances of position, of position and velocity, and of velocity.
    pp: Matrix2<f64>,
    pv: Matrix2<f64>,
    vv: Matrix2<f64>,
    /// Standard deviation in metres of the position's common part.
    common_m: f64,
}

impl KinematicState {
    /// The state after one measurement: the velocity is unknown.
    pub(super) fn new(at: Timestamp, measurement: &Measurement, class: ObjectClass) -> Self {
        Self {
            at,
            class,
            position: measurement.position,
            velocity: Vector2::zeros(),
            pp: measurement.independent,
            pv: Matrix2::zeros(),
            vv: Matrix2::identity() * class.speed_mps.powi(2),
            common_m: measurement.common_m,
        }
    }

    /// Seconds from the state to `at`.
    fn seconds_to(&self, at: Timestamp) -> f64 {
        at.micros_from(self.at) as f64 * 1e-6
    }

    /// The position at `at`, which may be before or after the time of the state.
    pub(super) fn position_at(&self, at: Timestamp) -> Vector2<f64> {
        self.position + self.velocity * self.seconds_to(at)
    }

    /// Covariance of the position at `at`, both parts, m².
    pub(super) fn covariance_at(&self, at: Timestamp) -> Matrix2<f64> {
        self.independent_at(self.seconds_to(at)) + isotropic(self.common_m)
    }

    /// Covariance of the velocity, (m/s)².
    pub(super) fn velocity_covariance(&self) -> &Matrix2<f64> {
        &self.vv
    }

    fn independent_at(&self, dt: f64) -> Matrix2<f64> {
        let drift = self.class.acceleration_density() * dt.abs().powi(3) / 3.0;
        self.pp
            + (self.pv + self.pv.transpose()) * dt
            + self.vv * (dt * dt)
            + Matrix2::identity() * drift
    }

    /// Moves the state to `at`; an earlier time has no effect.
    pub(super) fn predict(&mut self, at: Timestamp) {
        let dt = self.seconds_to(at);
        let density = self.class.acceleration_density();
        if dt <= 0.0 {
            return;
        }
        self.pp = self.independent_at(dt);
        self.pv += self.vv * dt + Matrix2::identity() * (density * dt * dt / 2.0);
        self.vv += Matrix2::identity() * (density * dt);
        self.position += self.velocity * dt;
        self.at = at;
    }

    /// The innovation of a measurement taken at `at`.
    pub(super) fn innovation(&self, at: Timestamp, measurement: &Measurement) -> Innovation {
        let offset = measurement.position - self.position_at(at);
        let covariance =
            self.covariance_at(at) + measurement.independent + isotropic(measurement.common_m);
        let distance_squared =
            inverse(&covariance).map_or(f64::INFINITY, |inverse| offset.dot(&(inverse * offset)));
        Innovation {
            offset,
            distance_squared,
        }
    }

    /// Updates the state with a measurement taken at `at`.
    ///
    /// A measurement from before the state's time is compared with the position at its own time (Bar-Shalom, "Update
    /// with out-of-sequence measurements in tracking", 2002). The process noise in between counts in full.
    pub(super) fn update(&mut self, at: Timestamp, measurement: &Measurement) {
        self.predict(at);
        let dt = self.seconds_to(at).min(0.0);
        let noise = self.independent_at(dt) + measurement.independent;
        let total = noise + isotropic(measurement.common_m);
        let Some(inverse) = inverse(&total) else {
            return;
        };
        let offset = measurement.position - self.position_at(at);
        let at_position = self.pp + self.pv * dt;
        let at_velocity = self.pv.transpose() + self.vv * dt;
        let position_gain = at_position * inverse;
        let velocity_gain = at_velocity * inverse;
        self.position += position_gain * offset;
        self.velocity += velocity_gain * offset;
        self.joseph(
            [at_position, at_velocity],
            [position_gain, velocity_gain],
            &noise,
        );
        let share = (position_gain.trace() / 2.0).clamp(0.0, 1.0);
        self.common_m = (1.0 - share) * self.common_m + share * measurement.common_m;
    }

    /// Updates the state with a velocity measured at `at`, not after the state; `sigma_mps` is its standard deviation
    /// in each direction.
    ///
    /// Errors of successive velocities may be equal, so the variance of the velocity remains at least the variance of
    /// one measurement.
    pub(super) fn update_velocity(
        &mut self,
        at: Timestamp,
        velocity: Vector2<f64>,
        sigma_mps: f64,
    ) {
        let stated =
            sigma_mps * sigma_mps + self.class.acceleration_density() * self.seconds_to(at).abs();
        let known = self.vv.trace() / 2.0;
        if known <= stated {
            return;
        }
        // A measurement of this variance results in the stated variance.
        let variance = known * stated / (known - stated);
        let noise = self.vv + Matrix2::identity() * variance;
        let Some(inverse) = inverse(&noise) else {
            return;
        };
        let offset = velocity - self.velocity;
        let gains = [self.pv * inverse, self.vv * inverse];
        self.position += gains[0] * offset;
        self.velocity += gains[1] * offset;
        self.joseph([self.pv, self.vv], gains, &noise);
    }

    /// True if a velocity stated at `at` is possible for the class, and if its normalised distance from
    /// the velocity of the state is within `gate`.
    pub(super) fn admits_velocity(
        &self,
        at: Timestamp,
        velocity: &Vector2<f64>,
        sigma_mps: f64,
        gate: f64,
    ) -> bool {
        let drift = self.class.acceleration_density() * self.seconds_to(at).abs();
        let noise = self.vv + Matrix2::identity() * (sigma_mps * sigma_mps + drift);
        let offset = velocity - self.velocity;
        let distance_squared = inverse(&noise).map(|inverse| offset.dot(&(inverse * offset)));
        self.is_possible(velocity) && distance_squared.is_some_and(|squared| squared <= gate)
    }

    /// True if objects of the class can have this velocity.
    pub(super) fn is_possible(&self, velocity: &Vector2<f64>) -> bool {
        velocity.norm() <= self.class.max_speed_mps
    }

    /// Joseph's form of the covariance update, for any gain.
    ///
    /// `cross` is the covariance of the state with the measured quantity, `noise` the covariance of the innovation.
    fn joseph(&mut self, cross: [Matrix2<f64>; 2], gain: [Matrix2<f64>; 2], noise: &Matrix2<f64>) {
        let kept = [0, 1].map(|i| gain[i] * noise - cross[i]);
        let change =
            |i: usize, j: usize| kept[i] * gain[j].transpose() - gain[i] * cross[j].transpose();
        self.pp = symmetric(self.pp + change(0, 0));
        self.pv += change(0, 1);
        self.vv = symmetric(self.vv + change(1, 1));
    }

    /// Adds a standard deviation of `speed_mps` in each direction to the velocity.
    pub(super) fn inflate_velocity_covariance(&mut self, speed_mps: f64) {
        self.vv += Matrix2::identity() * (speed_mps * speed_mps);
    }

    /// Adapts the covariance to a manoeuvre: a normalised innovation of `excess` times the expected value scales the
    /// covariance of the state by that factor (fading memory; Bar-Shalom et al. 2001, section 11.2) and adds the
    /// variance of the class's velocity change within a second.
    pub(super) fn adapt(&mut self, excess: f64) {
        self.pp *= excess;
        self.pv *= excess;
        self.vv *= excess;
        self.inflate_velocity_covariance(self.class.manoeuvre_mps);
    }

    /// Limits the speed to the maximum of the class.
    pub(super) fn limit_speed(&mut self) {
        let speed = self.velocity.norm();
        let max_mps = self.class.max_speed_mps;
        if speed > max_mps {
            self.velocity *= max_mps / speed;
        }
    }
}

fn isotropic(sigma_m: f64) -> Matrix2<f64> {
    Matrix2::identity() * (sigma_m * sigma_m)
}

fn symmetric(matrix: Matrix2<f64>) -> Matrix2<f64> {
    (matrix + matrix.transpose()) * 0.5
}

/// The inverse of a covariance; `None` unless its determinant is positive and finite.
pub(super) fn inverse(covariance: &Matrix2<f64>) -> Option<Matrix2<f64>> {
    let determinant = covariance.determinant();
    covariance
        .try_inverse()
        .filter(|_| determinant > 0.0 && determinant.is_finite())
}
