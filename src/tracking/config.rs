//! Parameters of tracking.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::pose_bias::BiasPrior;
use crate::config::{ConfigError, check_range};
use crate::model::names::{Label, is_label};

/// The cells that track objects away from landmarks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum TracksMode {
    /// Cells without landmarks.
    #[default]
    Auto,
    /// All cells; objects that are not within PACE's gate of a landmark.
    On,
    /// No cells.
    Off,
}

/// Parameters of tracking. Lengths suit road traffic; a model car park needs smaller ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TracksConfig {
    /// Cells that track objects; `auto` means cells without landmarks. Default `auto`.
    pub mode: TracksMode,
    /// Standard deviation in metres of near positions without covariance, until it is estimated.
    /// Default 0.15. It applies to each direction, and grows by 0.012 m for each metre of distance.
    pub noise_m: f64,
    /// Minimum standard deviation in metres of any reported position. Default 0.1.
    pub noise_floor_m: f64,
    /// Standard deviation in metres of the error that all positions of a vehicle may share. Averaging does not reduce
    /// this error. Default 0.2. Trade-off: a larger value merges detections of vehicles with poor poses; a smaller
    /// value separates closer objects.
    pub common_m: f64,
    /// Maximum distance of a detection from its track in standard deviations. Default 3.5.
    pub gate_sigmas: f64,
    /// Maximum distance of a detection from its track in metres. Default 4.
    pub gate_m: f64,
    /// Standard deviation in metres per second of the change of velocity within a second. Default 2.2. Trade-off: a
    /// larger value follows manoeuvres; a smaller value smooths.
    pub manoeuvre_mps: f64,
    /// Standard deviation of an object's unknown velocity in metres per second. Default 8. It
    /// applies to each direction.
    pub speed_mps: f64,
    /// Maximum speed in metres per second. Default 70.
    pub max_speed_mps: f64,
    /// Maximum time in seconds for which an object is published after its last detection. Default 3.
    pub life_s: f64,
    /// Maximum time in seconds for which an object keeps its identity after its last detection.
    /// Default 8.
    pub latent_s: f64,
    /// Maximum time in seconds of a report behind the latest report that was fused. Default 0.5; later reports are
    /// counted.
    pub max_lag_s: f64,
    /// Confidence at which a detection is equally likely to be real and false, until it is estimated. Default 0.3.
    pub even_confidence: f64,
    /// Minimum confidence of a published object. Default 0.002: a user that needs certainty sets a higher limit.
    pub min_confidence: f64,
    /// Distance in metres from a vehicle's pose within which detections are of the vehicle itself. Default 1.5.
    pub vehicle_radius_m: f64,
    /// Label of a vehicle that no other vehicle has detected. Default `car`: the label that the cell's detectors give
    /// vehicles.
    pub vehicle_label: Label,
    /// Whether errors of vehicles' poses and stamps are estimated and corrected. Default true.
    pub align: bool,
    /// Standard deviation in metres of a pose's offset. Default 0.5.
    pub align_offset_m: f64,
    /// Standard deviation in radians of a pose's rotation. Default 0.01.
    pub align_heading_rad: f64,
    /// Standard deviation in seconds of the delay of a vehicle's stamps. Default 0.02. The delay
    /// adds to the measured offset of its clock; the correction is at most three times as large.
    pub align_delay_s: f64,
    /// Time constant in seconds of the errors of a pose. Default 10.
    pub align_memory_s: f64,
    /// Maximum number of objects; those that only one vehicle has detected take at most an eighth.
    /// Default 20000.
    pub max_tracks: usize,
    /// Maximum number of objects that one vehicle alone detects in a square with `gate_m` as side.
    /// Default 16. A square has room for twice as many objects in all.
    pub max_density: usize,
}

impl Default for TracksConfig {
    fn default() -> Self {
        Self {
            mode: TracksMode::Auto,
            noise_m: 0.15,
            noise_floor_m: 0.1,
            common_m: 0.2,
            gate_sigmas: 3.5,
            gate_m: 4.0,
            manoeuvre_mps: 2.2,
            speed_mps: 8.0,
            max_speed_mps: 70.0,
            life_s: 3.0,
            latent_s: 8.0,
            max_lag_s: 0.5,
            even_confidence: 0.3,
            min_confidence: 0.002,
            vehicle_radius_m: 1.5,
            vehicle_label: Label::new_static("car"),
            align: true,
            align_offset_m: 0.5,
            align_heading_rad: 0.01,
            align_delay_s: 0.02,
            align_memory_s: 10.0,
            max_tracks: 20_000,
            max_density: 16,
        }
    }
}

impl TracksConfig {
    /// Checks all values.
    ///
    /// # Errors
    /// [`ConfigError`] naming the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("noise_m", self.noise_m, 1e-3, 100.0)?;
        check_range("noise_floor_m", self.noise_floor_m, 1e-3, 100.0)?;
        check_range("common_m", self.common_m, 0.0, 100.0)?;
        check_range("gate_sigmas", self.gate_sigmas, 0.5, 10.0)?;
        check_range("gate_m", self.gate_m, 1e-2, 1e3)?;
        check_range("manoeuvre_mps", self.manoeuvre_mps, 1e-3, 100.0)?;
        check_range("speed_mps", self.speed_mps, 1e-3, 100.0)?;
        check_range("max_speed_mps", self.max_speed_mps, self.speed_mps, 1e3)?;
        check_range("life_s", self.life_s, 0.05, 60.0)?;
        check_range("latent_s", self.latent_s, self.life_s, 600.0)?;
        check_range("max_lag_s", self.max_lag_s, 0.0, 10.0)?;
        check_range("even_confidence", self.even_confidence, 0.01, 0.99)?;
        check_range("min_confidence", self.min_confidence, 0.0, 1.0)?;
        check_range("vehicle_radius_m", self.vehicle_radius_m, 0.0, 100.0)?;
        if !is_label(&self.vehicle_label) {
            return Err(ConfigError::new(
                "vehicle_label",
                &self.vehicle_label,
                "a label of 1 to 64 bytes",
            ));
        }
        check_range("align_offset_m", self.align_offset_m, 1e-3, 10.0)?;
        check_range("align_heading_rad", self.align_heading_rad, 1e-5, 0.5)?;
        check_range("align_delay_s", self.align_delay_s, 1e-6, 1.0)?;
        check_range("align_memory_s", self.align_memory_s, 0.1, 1e4)?;
        check_range("max_tracks", self.max_tracks as f64, 1.0, 1e6)?;
        check_range("max_density", self.max_density as f64, 1.0, 1e4)
    }

    /// Maximum squared Mahalanobis distance of a detection from its track.
    pub(super) fn gate(&self) -> f64 {
        self.gate_sigmas * self.gate_sigmas
    }

    /// Standard deviations of pose biases at rest.
    pub(super) fn bias_prior(&self) -> BiasPrior {
        BiasPrior {
            offset_m: self.align_offset_m,
            heading_rad: self.align_heading_rad,
            delay_s: self.align_delay_s,
            memory_s: self.align_memory_s,
        }
    }
}
