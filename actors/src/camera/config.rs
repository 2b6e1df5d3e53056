//! Configuration of a vehicle's camera.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use ecod::config::{ConfigError, check_range};
use ecod::model::names::{NodeName, PART_MARK};
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::projection::{ProjectionConfig, Ranging};
use ecod::perception::view::ViewConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::calibrate::{Calibration, CalibrationError};
use super::detect::DetectorConfig;
use super::frame_source::capture::{CaptureConfig, Opener};
use super::frame_source::masked::MaskedSource;
use super::frame_source::{FrameError, FrameSource, SourceConfig};
use super::image_size::ImageSize;
use super::lens::Lens;
use super::mask::Masks;

/// A vehicle's camera and the processing of its frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Name of the camera, unique among the cameras of its vehicle. Default: not set; the camera
    /// then reports under the vehicle's own name. With a name it reports as a part of the vehicle,
    /// such as `euclid--rear`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Source of the camera's frames: a device, a stream or files.
    pub source: SourceConfig,
    /// Polygons that are black in each picture, as corners in shares of its width and height. Default:
    /// no polygons. Masks need a size or a calibration in `optics`.
    #[serde(default, skip_serializing_if = "Masks::is_empty")]
    pub masks: Masks,
    /// Stall timeout and retries of the source.
    #[serde(default)]
    pub capture: CaptureConfig,
    /// Image size and field of view. Frames of the same aspect ratio are scaled. Others are
    /// rejected, unless only a field of view is given: it then holds for frames of any shape.
    #[serde(default)]
    pub optics: OpticsConfig,
    /// Position and attitude of the camera on the vehicle.
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
    /// Whether to vote on objects at landmarks, in a cell that runs VOTE. Default true.
    #[serde(default = "yes")]
    pub votes: bool,
}

/// Maximum length of a camera's name in bytes: the vehicle's name precedes it.
const MAX_CAMERA_NAME: usize = 24;

fn yes() -> bool {
    true
}

/// Image size and field of view, or a calibration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OpticsConfig {
    /// Calibration file of `ecod-node calibrate`, which replaces the other keys. Default: not set.
    /// Frames of another size are scaled, of another shape refused.
    pub calibration: Option<PathBuf>,
    /// Image width in pixels; without both sizes, frames may have any shape. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width_px: Option<u32>,
    /// Image height in pixels. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_px: Option<u32>,
    /// Horizontal field of view in degrees, by default of the Raspberry Pi Camera Module 2. Default
    /// 62.2.
    pub horizontal_fov_deg: f64,
    /// Vertical field of view in degrees; without it, pixels are square. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vertical_fov_deg: Option<f64>,
}

/// Position and attitude of the camera on the vehicle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MountConfig {
    /// Metres ahead of the vehicle's reference point. Default 0.
    pub forward_m: f64,
    /// Metres to the left of the reference point. Default 0.
    pub left_m: f64,
    /// Angle of the axis from the vehicle's heading in degrees, counter-clockwise. Default 0.
    pub pan_deg: f64,
    /// Height of the camera above the ground in metres, which ranging by the ground needs. Default:
    /// not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// Angle of the axis below the horizon in degrees. Default 0.
    pub pitch_deg: f64,
    /// Angle in degrees by which the camera leans to its right. Default 0.
    pub roll_deg: f64,
}

impl Default for OpticsConfig {
    fn default() -> Self {
        Self {
            calibration: None,
            width_px: None,
            height_px: None,
            horizontal_fov_deg: 62.2,
            vertical_fov_deg: None,
        }
    }
}

impl CameraConfig {
    /// Name under which the camera of a vehicle reports; the vehicle's name if both together are
    /// not a valid name.
    pub fn reporter(&self, vehicle: &NodeName) -> NodeName {
        let part = self
            .name
            .as_ref()
            .and_then(|name| NodeName::new(format!("{vehicle}{PART_MARK}{name}")).ok());
        part.unwrap_or_else(|| vehicle.clone())
    }

    /// Opens the source; may block as long as the camera does. All frames of a camera come from
    /// here, with black masks. `timeout` applies to all sources except files.
    ///
    /// # Errors
    /// Returns [`FrameError::Open`] with the source and the cause.
    pub fn open(&self, timeout: Duration) -> Result<Box<dyn FrameSource>, FrameError> {
        if self.masks.is_empty() {
            return self.source.open(timeout);
        }
        let origin = self.source.origin();
        let failed = |reason: String| FrameError::Open {
            origin: origin.clone(),
            reason,
        };
        let polygons = self.masks.polygons();
        let masks = polygons.map_err(|error| failed(error.to_string()))?;
        let lens = self
            .optics
            .lens()
            .map_err(|error| failed(error.to_string()))?;
        Ok(Box::new(MaskedSource {
            source: self.source.open(timeout)?,
            masks,
            shape: ImageSize::from(&lens.intrinsics),
            origin,
        }))
    }

    /// Opens the source with [`Self::open`], as often as needed.
    pub fn opener(&self, timeout: Duration) -> Opener {
        let camera = self.clone();
        Arc::new(move || camera.open(timeout))
    }

    /// Checks every value; files and devices are checked when they are opened.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if let Some(name) = self
            .name
            .as_ref()
            .filter(|name| name.len() > MAX_CAMERA_NAME || NodeName::new(name).is_err())
        {
            let allowed = format!("1 to {MAX_CAMERA_NAME} characters of A-Z, a-z, 0-9, _ and -");
            return Err(ConfigError::new("name", name, allowed));
        }
        self.source
            .validate()
            .map_err(|error| error.within("source"))?;
        self.capture
            .validate()
            .map_err(|error| error.within("capture"))?;
        if let SourceConfig::Images { fps, .. } = self.source
            && fps * self.capture.stall_timeout_s <= 1.0
        {
            let least = format!(
                "above 1 / capture.stall_timeout_s, {}",
                1.0 / self.capture.stall_timeout_s
            );
            return Err(ConfigError::new("source.fps", fps, least));
        }
        self.optics
            .validate()
            .map_err(|error| error.within("optics"))?;
        self.masks.polygons()?;
        if !self.masks.is_empty() && self.optics.has_any_shape() {
            let allowed = "the width of the picture on which `masks` were drawn: set both sizes or `optics.calibration`, because frames of another shape are refused";
            return Err(ConfigError::missing("optics.width_px", allowed));
        }
        self.mount
            .validate()
            .map_err(|error| error.within("mount"))?;
        if self.projection.ranging == Ranging::Ground && self.mount.height_m.is_none() {
            let allowed = "the camera's height above the ground, by which `projection.ranging = \"ground\"` places objects";
            return Err(ConfigError::missing("mount.height_m", allowed));
        }
        self.detector
            .validate()
            .map_err(|error| error.within("detector"))?;
        self.projection
            .validate()
            .map_err(|error| error.within("projection"))?;
        self.view.validate().map_err(|error| error.within("view"))
    }
}

impl OpticsConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        for (key, size_px) in [("width_px", self.width_px), ("height_px", self.height_px)] {
            size_px.map_or(Ok(()), |size_px| {
                check_range(key, f64::from(size_px), 16.0, 16_384.0)
            })?;
        }
        if self.width_px.is_some() != self.height_px.is_some() {
            let size =
                |size: Option<u32>| size.map_or_else(|| "none".to_owned(), |px| px.to_string());
            let given = format!("{}x{}", size(self.width_px), size(self.height_px));
            return Err(ConfigError::new(
                "width_px and height_px",
                given,
                "both or neither",
            ));
        }
        check_range("horizontal_fov_deg", self.horizontal_fov_deg, 1.0, 175.0)?;
        self.vertical_fov_deg.map_or(Ok(()), |angle_deg| {
            check_range("vertical_fov_deg", angle_deg, 1.0, 175.0)
        })
    }

    /// Intrinsics and distortion, from the calibration file if there is one. Without a size they
    /// apply to a frame of 640x480.
    ///
    /// # Errors
    /// Returns a [`CalibrationError`] if the file cannot be used.
    pub fn lens(&self) -> Result<Lens, CalibrationError> {
        if let Some(path) = &self.calibration {
            return Ok(Calibration::read(path)?.lens());
        }
        let width = self.width_px.unwrap_or(640);
        let height = self.height_px.unwrap_or(480);
        let horizontal_rad = self.horizontal_fov_deg.to_radians();
        let intrinsics = match self.vertical_fov_deg {
            Some(angle_deg) => Intrinsics::from_field_of_view(
                width,
                height,
                horizontal_rad,
                angle_deg.to_radians(),
            ),
            None => Intrinsics::with_square_pixels(width, height, horizontal_rad),
        };
        Ok(Lens {
            is_any_shape: self.has_any_shape() && self.vertical_fov_deg.is_none(),
            ..Lens::ideal(intrinsics)
        })
    }

    /// True if these optics state no aspect ratio of frames.
    fn has_any_shape(&self) -> bool {
        self.calibration.is_none() && self.width_px.is_none() && self.height_px.is_none()
    }
}

impl MountConfig {
    fn validate(&self) -> Result<(), ConfigError> {
        check_range("forward_m", self.forward_m, -100.0, 100.0)?;
        check_range("left_m", self.left_m, -100.0, 100.0)?;
        check_range("pan_deg", self.pan_deg, -360.0, 360.0)?;
        self.height_m.map_or(Ok(()), |height_m| {
            check_range("height_m", height_m, 0.01, 1000.0)
        })?;
        check_range("pitch_deg", self.pitch_deg, -90.0, 90.0)?;
        check_range("roll_deg", self.roll_deg, -180.0, 180.0)
    }

    /// A mount in the file's units, rounded to practical measuring accuracy.
    pub(crate) fn rounded(mount: &Mount) -> Self {
        let metres = |metres: f64| (metres * 1e3).round() / 1e3;
        let degrees = |angle_rad: f64| (angle_rad.to_degrees() * 1e2).round() / 1e2;
        Self {
            forward_m: metres(mount.forward_m),
            left_m: metres(mount.left_m),
            pan_deg: degrees(mount.pan_rad),
            height_m: mount.height_m.map(metres),
            pitch_deg: degrees(mount.pitch_rad),
            roll_deg: degrees(mount.roll_rad),
        }
    }

    /// The height and tilt of `other` at this place on the vehicle.
    pub(crate) fn placed(&self, other: &Mount) -> Mount {
        let here = Mount::from(*self);
        Mount {
            forward_m: here.forward_m,
            left_m: here.left_m,
            pan_rad: here.pan_rad,
            ..*other
        }
    }
}

impl From<MountConfig> for Mount {
    fn from(mount: MountConfig) -> Self {
        Self {
            forward_m: mount.forward_m,
            left_m: mount.left_m,
            pan_rad: mount.pan_deg.to_radians(),
            height_m: mount.height_m,
            pitch_rad: mount.pitch_deg.to_radians(),
            roll_rad: mount.roll_deg.to_radians(),
        }
    }
}
