//! Classes of objects: their motion and their density.
//!
//! All classes move with nearly constant velocity (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking
//! and Navigation", 2001, section 6.2.2). Only the parameters depend on the class.

use super::config::TracksConfig;

/// Parameters of one class.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ObjectClass {
    /// Standard deviation of the change of velocity within a second, m/s.
    pub(super) manoeuvre_mps: f64,
    /// Standard deviation of the unknown velocity of a new object in each direction, m/s.
    pub(super) speed_mps: f64,
    /// Maximum speed, m/s.
    pub(super) max_speed_mps: f64,
    /// Standard deviation in metres of the error that all positions of an object may share. Averaging does not reduce
    /// this error.
    pub(super) common_m: f64,
    /// Density of new objects and clutter in one frame, 1/m².
    pub(super) new_per_m2: f64,
}

/// Labels of people on foot, in lower case.
const PERSON_LABELS: [&str; 2] = ["person", "pedestrian"];

/// People on foot: slow, and close together.
const PERSON: ObjectClass = ObjectClass {
    manoeuvre_mps: 0.4,
    speed_mps: 1.2,
    max_speed_mps: 10.0,
    common_m: 0.1,
    new_per_m2: 1e-2,
};

/// Density of new vehicles and clutter in one frame, 1/m².
const VEHICLES_PER_M2: f64 = 3e-4;

impl ObjectClass {
    /// The class of objects with this label: people for the labels of people, otherwise vehicles.
    pub(super) fn of(label: &str, config: &TracksConfig) -> Self {
        let vehicle = Self {
            manoeuvre_mps: config.manoeuvre_mps,
            speed_mps: config.speed_mps,
            max_speed_mps: config.max_speed_mps,
            common_m: config.common_m,
            new_per_m2: VEHICLES_PER_M2,
        };
        if PERSON_LABELS.contains(&label) {
            vehicle.at_most(&PERSON)
        } else {
            vehicle
        }
    }

    /// This class, no faster than another: a configuration for slow vehicles also slows people down.
    fn at_most(&self, other: &Self) -> Self {
        Self {
            manoeuvre_mps: self.manoeuvre_mps.min(other.manoeuvre_mps),
            speed_mps: self.speed_mps.min(other.speed_mps),
            max_speed_mps: self.max_speed_mps.min(other.max_speed_mps),
            common_m: self.common_m.min(other.common_m),
            new_per_m2: other.new_per_m2,
        }
    }

    /// Spectral density of the white noise acceleration, m²/s³.
    pub(super) fn acceleration_density(&self) -> f64 {
        self.manoeuvre_mps * self.manoeuvre_mps
    }
}
