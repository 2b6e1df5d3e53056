//! The mount of a camera for the browser in which its points were clicked.

use ecod::model::geometry::Pose;
use serde::{Deserialize, Serialize};

use crate::camera::calibrate::mount::PointFit;
use crate::camera::config::{MountConfig, OpticsConfig};
use crate::camera::image_size::ImageSize;
use crate::camera::mount_calibration::{
    MeasuredPoint, fit_mount_to_points, mount_table, vehicle_of,
};

/// Settings of a camera that fitting its mount needs, in addition to points.
#[derive(Debug, Clone)]
pub struct CameraSetup {
    /// Configured optics of the camera.
    pub optics: OpticsConfig,
    /// Configured mount, with which the camera's pose is reported.
    pub mount: MountConfig,
    /// True if the camera is an entry of `[[cameras]]`.
    pub is_one_of_several: bool,
}

/// Points on the ground that were clicked in a picture of the camera and on the map.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MountQuestion {
    /// Size of the camera's frames, of which the points are pixels.
    width_px: u32,
    height_px: u32,
    /// The points; places are in the cell's frame.
    points: Vec<MeasuredPoint>,
}

/// The mount that fits best.
#[derive(Debug, Serialize)]
pub(crate) struct MountAnswer {
    /// The table of the configuration.
    toml: String,
    /// Fit of each point, in their order.
    points: Vec<PointFit>,
}

impl MountQuestion {
    /// The mount of a camera that reports this pose.
    ///
    /// # Errors
    /// Returns the reason in a sentence, with the remedy.
    pub(crate) fn answer(&self, setup: &CameraSetup, camera: &Pose) -> Result<MountAnswer, String> {
        let lens = setup
            .optics
            .lens()
            .map_err(|error| format!("key `camera.optics.calibration`: {error}"))?;
        let picture = ImageSize {
            width: self.width_px,
            height: self.height_px,
        };
        let vehicle = vehicle_of(camera, &setup.mount.into());
        let fit = fit_mount_to_points(&self.points, picture, &lens, &vehicle)
            .map_err(|error| error.to_string())?;
        let toml = mount_table(&fit.estimate, setup.is_one_of_several)
            .map_err(|error| error.to_string())?;
        Ok(MountAnswer {
            toml,
            points: fit.points,
        })
    }
}
