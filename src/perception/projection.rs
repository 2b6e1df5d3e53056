//! Projection of a box or corners in an image to a position in the world, with its covariance.
//!
//! ```text
//! Detection --ranging--> forward, left of the camera --Pose--> PerceivedObject (east, north, covariance)
//! ```
//!
//! Each [`Ranging`] finds the distance in its own way, in a file of its own. All but [`Ranging::Paper`] are exact for a
//! pinhole camera, under the assumptions about the object that it states.

mod box_height;
mod box_width;
mod config;
mod corners;
mod paper;

use nalgebra::Point3;

pub use config::{ObjectSize, ObjectSizes, ProjectionConfig, Ranging};

use crate::model::detection::Detection;
use crate::model::geometry::{Covariance, Pose};
use crate::model::names::Label;
use crate::perception::camera::Intrinsics;
use crate::wire::PerceivedObject;

/// The reason why a detection has no position.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProjectionError {
    /// Neither a size for the label nor a default size is configured.
    #[error("no known size for label {0:?} and no default size")]
    UnknownSize(Label),
    /// The box has no area, is not finite, or gives no distance.
    #[error("the box of {0:?} gives no distance")]
    DegenerateBox(Label),
    /// The image's edge cuts the object: the box does not show its whole extent.
    #[error("the image's edge cuts the box of {0:?}")]
    Clipped(Label),
    /// The target's corners give no position in front of the camera.
    #[error("the corners of {0:?} give no position in front of the camera")]
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

/// The projection of one camera's detections to the world.
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

    /// Checks that the image's edge does not cut the side of the box that gives the distance. Call it with the box in the
    /// raw image, before distortion is removed.
    ///
    /// # Errors
    /// [`ProjectionError::Clipped`].
    pub fn check_unclipped(&self, detection: &Detection) -> Result<(), ProjectionError> {
        let bounds = &detection.bounding_box;
        let is_clipped = match self.config.ranging {
            Ranging::Corners if detection.corners.is_some() => false,
            Ranging::Corners | Ranging::BoxHeight => box_height::is_clipped(bounds, &self.intrinsics),
            Ranging::BoxWidth => box_width::is_clipped(bounds, &self.intrinsics),
            Ranging::Paper => false,
        };
        if is_clipped { Err(ProjectionError::Clipped(detection.label.clone())) } else { Ok(()) }
    }

    /// Places a detection from `camera` whose distortion has been removed; see also [`Self::check_unclipped`].
    ///
    /// `target` is the middle of the detection's solved corners in the camera frame, in metres; only [`Ranging::Corners`]
    /// uses it.
    ///
    /// # Errors
    /// [`ProjectionError`] if the detection gives no position.
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
        let (bounds, intrinsics) = (&detection.bounding_box, &self.intrinsics);
        let sight = match (self.config.ranging, target) {
            (Ranging::Corners, Some(target)) => corners::line_of_sight(detection, target)?,
            (Ranging::Corners | Ranging::BoxHeight, _) => box_height::line_of_sight(bounds, size, intrinsics),
            (Ranging::BoxWidth, _) => box_width::line_of_sight(bounds, size, intrinsics),
            (Ranging::Paper, _) => paper::line_of_sight(detection, size, intrinsics)?,
        };
        let direction_rad = camera.heading_rad + sight.bearing_rad;
        let (sin, cos) = direction_rad.sin_cos();
        let position = (camera.position.x + sight.distance_m * cos, camera.position.y + sight.distance_m * sin);
        let covariance = self.covariance(&sight, size, direction_rad);
        if !(position.0.is_finite() && position.1.is_finite() && covariance.is_valid()) {
            return Err(ProjectionError::DegenerateBox(label.clone()));
        }
        Ok(PerceivedObject {
            covariance_m2: Some(covariance.into()),
            ..PerceivedObject::new(label.clone(), detection.confidence, position.0, position.1)
        })
    }

    /// First-order error propagation along and across the line of sight.
    ///
    /// Along it, d ∝ size / extent: σ_d/d is the root of the sum of both squared relative errors, and both edges of the
    /// extent have pixel noise. Across it, pixel noise and heading error turn the line of sight. The camera's position
    /// error and the floor add to both.
    fn covariance(&self, sight: &LineOfSight, size: &ObjectSize, direction_rad: f64) -> Covariance {
        let ProjectionConfig { pixel_sigma_px, heading_sigma_rad, position_sigma_m, floor_m, .. } = self.config;
        let edges = std::f64::consts::SQRT_2 * pixel_sigma_px / sight.extent_px;
        let everywhere = position_sigma_m.hypot(floor_m);
        let along_m = (sight.distance_m * edges.hypot(size.relative_sigma)).hypot(everywhere);
        let turn_rad = (pixel_sigma_px / self.intrinsics.fx).hypot(heading_sigma_rad);
        Covariance::along_bearing(direction_rad, along_m, (sight.distance_m * turn_rad).hypot(everywhere))
    }
}

/// Distance in pixels to the image's edge within which a box counts as cut by it.
const EDGE_PX: f64 = 1.0;

/// The line of sight from the camera to an object, in the plane.
#[derive(Debug, Clone, Copy)]
struct LineOfSight {
    /// Off the axis, counter-clockwise positive.
    bearing_rad: f64,
    distance_m: f64,
    /// Extent in the image that gives the distance.
    extent_px: f64,
}

impl LineOfSight {
    /// The line of sight to a point `forward_m` ahead of and `left_m` left of the camera.
    fn to(forward_m: f64, left_m: f64, extent_px: f64) -> Self {
        Self { bearing_rad: left_m.atan2(forward_m), distance_m: forward_m.hypot(left_m), extent_px }
    }
}

#[cfg(test)]
mod tests;
