//! Configuration of a vehicle's camera.

use std::path::PathBuf;

use ecod::config::{ConfigError, check_range};
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::projection::ProjectionConfig;
use ecod::perception::view::ViewConfig;
use serde::{Deserialize, Serialize};

use super::calibrate::{Calibration, CalibrationError};
use super::detect::DetectorConfig;
use super::frame_source::SourceConfig;
use super::frame_source::capture::CaptureConfig;
use super::lens::Lens;

/// A vehicle's camera and the processing of its frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Source of frames.
    pub source: SourceConfig,
    /// Stall timeout and retries of the source.
    #[serde(default)]
    pub capture: CaptureConfig,
    /// Image size and field of view. Frames of the same aspect ratio are scaled; others are rejected.
    #[serde(default)]
    pub optics: OpticsConfig,
    /// Position of the camera on the vehicle.
    #[serde(default)]
    pub mount: MountConfig,
    /// Detector of objects in frames.
    pub detector: DetectorConfig,
    /// Projection of detections into the world.
    #[serde(default)]
    pub projection: ProjectionConfig,
    /// Conditions for a location to be in view.
    #[serde(default)]
    pub view: ViewConfig,
    /// True if to vote on objects at known locations, in a cell that runs VOTE. Default true.
    #[serde(default = "yes")]
    pub votes: bool,
}

fn yes() -> bool {
    true
}

/// Image size and field of view, or a calibration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OpticsConfig {
    /// Calibration file of `ecod-node calibrate`, which replaces the other keys. Default none.
    pub calibration: Option<PathBuf>,
    /// Image width in pixels. Default 640.
    pub width_px: u32,
    /// Image height in pixels. Default 480.
    pub height_px: u32,
    /// Horizontal field of view in degrees. Default 62.2, the Raspberry Pi Camera Module 2.
    pub horizontal_fov_deg: f64,
    /// Vertical field of view in degrees. Default 48.8, the Raspberry Pi Camera Module 2.
    pub vertical_fov_deg: f64,
}

/// Position of the camera on the vehicle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MountConfig {
    /// Metres ahead of the vehicle's reference point. Default 0.
    pub forward_m: f64,
    /// Metres to the left of it. Default 0.
    pub left_m: f64,
    /// Angle of the axis from the vehicle's heading in degrees, counter-clockwise. Default 0.
    pub pan_deg: f64,
}

impl Default for OpticsConfig {
    fn default() -> Self {
        Self { calibration: None, width_px: 640, height_px: 480, horizontal_fov_deg: 62.2, vertical_fov_deg: 48.8 }
    }
}

impl CameraConfig {
    /// Checks every value; files and devices are checked when they are opened.
    ///
    /// # Errors
    /// [`ConfigError`] naming the key, the value and what is allowed.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.source.validate().map_err(|error| error.within("source"))?;
        self.capture.validate().map_err(|error| error.within("capture"))?;
        if let SourceConfig::Images { fps, .. } = self.source
            && fps * self.capture.stall_timeout_s <= 1.0
        {
            let least = format!("above 1 / capture.stall_timeout_s, {}", 1.0 / self.capture.stall_timeout_s);
            return Err(ConfigError::new("source.fps", fps, least));
        }
        check_range("optics.width_px", f64::from(self.optics.width_px), 16.0, 16_384.0)?;
        check_range("optics.height_px", f64::from(self.optics.height_px), 16.0, 16_384.0)?;
        check_range("optics.horizontal_fov_deg", self.optics.horizontal_fov_deg, 1.0, 175.0)?;
        check_range("optics.vertical_fov_deg", self.optics.vertical_fov_deg, 1.0, 175.0)?;
        check_range("mount.forward_m", self.mount.forward_m, -100.0, 100.0)?;
        check_range("mount.left_m", self.mount.left_m, -100.0, 100.0)?;
        check_range("mount.pan_deg", self.mount.pan_deg, -360.0, 360.0)?;
        self.detector.validate().map_err(|error| error.within("detector"))?;
        self.projection.validate().map_err(|error| error.within("projection"))?;
        self.view.validate().map_err(|error| error.within("view"))
    }
}

impl OpticsConfig {
    /// Intrinsics and distortion, from the calibration file if there is one.
    ///
    /// # Errors
    /// [`CalibrationError`] when the file cannot be used.
    pub fn lens(&self) -> Result<Lens, CalibrationError> {
        match &self.calibration {
            Some(path) => Ok(Calibration::read(path)?.lens()),
            None => Ok(Lens::ideal(Intrinsics::from_field_of_view(
                self.width_px,
                self.height_px,
                self.horizontal_fov_deg.to_radians(),
                self.vertical_fov_deg.to_radians(),
            ))),
        }
    }
}

impl From<MountConfig> for Mount {
    fn from(mount: MountConfig) -> Self {
        Self { forward_m: mount.forward_m, left_m: mount.left_m, pan_rad: mount.pan_deg.to_radians() }
    }
}
