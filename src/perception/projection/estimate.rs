//! Estimates of one distance, the errors that they share, and their combination.

use super::LineOfSight;
use super::error_sources::Errors;
use super::level_sight::LevelSight;

/// One estimate of a horizontal distance, with its errors.
#[derive(Debug, Clone, Copy)]
pub(super) struct Estimate {
    pub(super) distance_m: f64,
    /// Change of the distance in metres for one standard deviation of each error source.
    pub(super) errors: Errors,
}

/// Difference of two estimates in standard deviations above which at least one estimate must be
/// based on a false assumption.
pub(super) const CONFLICT_SIGMAS: f64 = 3.0;

impl Estimate {
    /// The estimate, if it lies in front of the camera.
    pub(super) fn in_front(self) -> Option<Self> {
        (self.distance_m > 0.0 && self.distance_m.is_finite()).then_some(self)
    }

    /// The combination of least variance with another estimate of correlated errors (Bar-Shalom,
    /// Campo 1986, equation 8); `None` if the two contradict each other.
    pub(super) fn combined_with(&self, other: &Self) -> Option<Self> {
        let difference = self.errors - other.errors;
        let variance = difference.norm_squared();
        if (self.distance_m - other.distance_m).powi(2) > CONFLICT_SIGMAS.powi(2) * variance {
            return None;
        }
        let weight = if variance > 0.0 {
            (-other.errors.dot(&difference) / variance).clamp(0.0, 1.0)
        } else {
            0.5
        };
        Some(Self {
            distance_m: weight * self.distance_m + (1.0 - weight) * other.distance_m,
            errors: weight * self.errors + (1.0 - weight) * other.errors,
        })
    }

    /// The line of sight at this distance, in the direction of `sight`; `middle_m` is the standard
    /// deviation in metres between the centres of box and object.
    pub(super) fn along(&self, sight: &LevelSight, middle_m: f64) -> LineOfSight {
        LineOfSight {
            bearing_rad: sight.bearing_rad,
            distance_m: self.distance_m,
            along_m: self.errors.norm(),
            turn_rad: sight.turn_rad.hypot(middle_m / self.distance_m),
        }
    }
}
