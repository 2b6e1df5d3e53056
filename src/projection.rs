//! From a box or corners in an image to a position in the world, with its covariance.
//!
//! ```text
//! Detection --ranging--> forward, left of the camera --Pose--> PerceivedObject (east, north, covariance)
//! ```
//!
//! [`Ranging`] names the ways to find the distance. All but [`Ranging::Paper`] are exact for a pinhole camera; what
//! they assume about the object is said at each.

mod config;
mod pinhole;

use nalgebra::Point3;

pub use config::{ObjectSize, ObjectSizes, ProjectionConfig, Ranging};

use crate::camera::Intrinsics;
use crate::detection::Detection;
use crate::geometry::{Covariance, Pose};
use crate::names::Label;
use crate::wire::PerceivedObject;

/// Why a detection has no position.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProjectionError {
    /// Neither a size for the label nor a default size is configured.
    #[error("no known size for label {0:?} and no default size")]
    UnknownSize(Label),
    /// The box has no area, is not finite, or no distance follows from it.
    #[error("no distance follows from the box of {0:?}")]
    DegenerateBox(Label),
    /// The image's edge cuts the object, so the box does not show its whole extent.
    #[error("the image's edge cuts the box of {0:?}")]
    Clipped(Label),
    /// The target's corners place it behind the camera or nowhere.
    #[error("the corners of {0:?} place it nowhere before the camera")]
    InvalidCorners(Label),
}

impl ProjectionError {
    /// The reason as a counter's label.
    pub fn as_str(&self) -> &'static str {
        match self {
            Self::UnknownSize(_) => "unknown_size",
            Self::DegenerateBox(_) => "degenerate_box",
            Self::Clipped(_) => "clipped",
            Self::InvalidCorners(_) => "invalid_corners",
        }
    }
}

/// Places detections of one camera in the world.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    config: ProjectionConfig,
    intrinsics: Intrinsics,
}

impl Projection {
    /// A projection for a camera; `config` is taken as valid.
    pub fn new(config: ProjectionConfig, intrinsics: Intrinsics) -> Self {
        Self { config, intrinsics }
    }

    /// The configuration.
    pub fn config(&self) -> &ProjectionConfig {
        &self.config
    }

    /// The camera.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Places a detection seen from `camera`.
    ///
    /// `target` is the middle of the detection's corners in the camera frame, in metres, where corners have been
    /// solved for it; used by [`Ranging::Corners`] only.
    ///
    /// # Errors
    /// [`ProjectionError`] when no position follows.
    pub fn place(
        &self,
        detection: &Detection,
        target: Option<&Point3<f64>>,
        camera: &Pose,
    ) -> Result<PerceivedObject, ProjectionError> {
        let label = &detection.label;
        if !detection.bounding_box.is_valid() {
            return Err(ProjectionError::DegenerateBox(label.clone()));
        }
        let size = self.config.sizes.of(label).ok_or_else(|| ProjectionError::UnknownSize(label.clone()))?;
        let sight = match (self.config.ranging, target) {
            (Ranging::Corners, Some(target)) => pinhole::from_target(detection, target)?,
            (Ranging::Corners | Ranging::BoxHeight, _) => pinhole::from_height(detection, size, &self.intrinsics)?,
            (Ranging::BoxWidth, _) => pinhole::from_width(detection, size, &self.intrinsics)?,
            (Ranging::Paper, _) => paper(detection, size, &self.intrinsics)?,
        };
        let direction_rad = camera.heading_rad + sight.bearing_rad;
        let (sin, cos) = direction_rad.sin_cos();
        let position = (camera.position.x + sight.distance_m * cos, camera.position.y + sight.distance_m * sin);
        let covariance = self.covariance(&sight, size, direction_rad);
        if !(position.0.is_finite() && position.1.is_finite() && covariance.is_valid()) {
            return Err(ProjectionError::DegenerateBox(label.clone()));
        }
        Ok(PerceivedObject {
            covariance_m2: Some([covariance.xx, covariance.xy, covariance.yy]),
            ..PerceivedObject::new(label.clone(), detection.confidence, position.0, position.1)
        })
    }

    /// First-order error propagation along and across the sight.
    ///
    /// Along: d ∝ size / extent, so σ_d/d is the root of the squared relative errors of the two; both edges of the
    /// extent carry pixel noise. Across: pixel noise and heading error turn the sight. The camera's position error
    /// and the floor add to both.
    fn covariance(&self, sight: &Sight, size: &ObjectSize, direction_rad: f64) -> Covariance {
        let ProjectionConfig { pixel_sigma_px, heading_sigma_rad, position_sigma_m, floor_m, .. } = self.config;
        let edges = std::f64::consts::SQRT_2 * pixel_sigma_px / sight.extent_px;
        let everywhere = position_sigma_m.hypot(floor_m);
        let along_m = (sight.distance_m * edges.hypot(size.relative_sigma)).hypot(everywhere);
        let turn_rad = (pixel_sigma_px / self.intrinsics.fx).hypot(heading_sigma_rad);
        Covariance::along_bearing(direction_rad, along_m, (sight.distance_m * turn_rad).hypot(everywhere))
    }
}

/// An object as seen from the camera, in the plane.
#[derive(Debug, Clone, Copy)]
struct Sight {
    /// Off the axis, counter-clockwise positive.
    bearing_rad: f64,
    distance_m: f64,
    /// What the distance was judged by.
    extent_px: f64,
}

/// The paper's Algorithm 1, lines 8-14, to the letter; see [`Ranging::Paper`].
fn paper(detection: &Detection, size: &ObjectSize, camera: &Intrinsics) -> Result<Sight, ProjectionError> {
    let gamma = camera.angle_per_pixel();
    let width_px = detection.bounding_box.width();
    let alpha = gamma * width_px;
    let distance_m = size.width_m / alpha.tan();
    if !(distance_m.is_finite() && distance_m > 0.0) {
        return Err(ProjectionError::DegenerateBox(detection.label.clone()));
    }
    let x_center = detection.bounding_box.x_min + 0.5 * width_px;
    Ok(Sight { bearing_rad: -(gamma * x_center), distance_m, extent_px: width_px })
}

#[cfg(test)]
mod tests;
