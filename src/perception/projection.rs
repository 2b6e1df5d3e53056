//! Projection of a box or corners in an image to a position in the world, with its covariance.
//!
//! ```text
//! Detection --ranging--> forward, left of the camera --Pose--> PerceivedObject (east, north, covariance)
//! ```
//!
//! Each [`Ranging`] finds the distance in its own way, in a file of its own. All but
//! [`Ranging::Paper`] are exact for a pinhole camera, under the assumptions about the object that
//! it states.

mod auto;
mod box_height;
mod box_width;
mod coco_sizes;
mod config;
mod corners;
mod error_sources;
mod estimate;
mod ground;
mod level_sight;
mod mount_check;
mod mount_fit;
mod paper;

use nalgebra::{Matrix3, Point3};

pub use config::{NEURAL_PIXEL_SIGMA_PX, ObjectSize, ObjectSizes, ProjectionConfig, Ranging};
use ground::HalfDepth;
pub use mount_check::MountCheck;
pub use mount_fit::{MIN_BOXES, MountEstimate, MountFitError, fit_mount};

use crate::model::detection::{BoundingBox, Detection};
use crate::model::geometry::{Covariance, Pose};
use crate::model::names::Label;
use crate::perception::camera::{Intrinsics, Mount};
use crate::perception::polygon::Polygon;
use crate::wire::PerceivedObject;

/// The reason why a detection has no position.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ProjectionError {
    /// The configuration has no size for the label and no default size.
    #[error(
        "no known size for label {0:?} and no default size: set camera.projection.sizes, or camera.mount.height_m to \
         range it by the ground"
    )]
    UnknownSize(Label),
    /// The box has no area, is not finite, or gives no distance.
    #[error("the box of {0:?} gives no distance")]
    DegenerateBox(Label),
    /// The image's edge or a mask cuts the object: the box does not show its whole extent.
    #[error("the image's edge or a mask cuts the box of {0:?}")]
    Clipped(Label),
    /// The foot of the box is above the horizon, or so near it that the ground gives no distance.
    #[error(
        "the foot of {0:?} is not clearly below the horizon: check camera.mount.pitch_deg if it stands near"
    )]
    AboveHorizon(Label),
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
            Self::AboveHorizon(_) => "above_horizon",
            Self::InvalidCorners(_) => "invalid_corners",
        }
    }
}

/// The sides at which the image's edge or a mask cuts a box, so that it does not show the whole
/// object.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Cut {
    /// True if the box is cut at its upper side.
    pub upper: bool,
    /// True if the box is cut at its lower side.
    pub lower: bool,
    /// True if the box is cut at its left or its right side.
    pub side: bool,
}

/// The projection of one camera's detections to the world.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    config: ProjectionConfig,
    intrinsics: Intrinsics,
    mount: Mount,
    to_level: Matrix3<f64>,
    /// Masked parts of the raw image, in pixels.
    masks: Vec<Polygon>,
}

impl Projection {
    /// A projection for a camera; `config` is taken as valid.
    pub fn new(config: ProjectionConfig, intrinsics: Intrinsics, mount: Mount) -> Self {
        Self {
            config,
            intrinsics,
            mount,
            to_level: mount.to_level(),
            masks: Vec::new(),
        }
    }

    /// The projection of a camera with these parts of the raw image masked, in pixels.
    #[must_use]
    pub fn with_masks(self, masks: Vec<Polygon>) -> Self {
        Self { masks, ..self }
    }

    /// The settings with which this projection was created.
    pub fn config(&self) -> &ProjectionConfig {
        &self.config
    }

    /// Intrinsic parameters of the camera.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// The sides at which a box in the raw image, before distortion is removed, is cut. The corners
    /// of a target show the whole of it.
    pub fn cut(&self, detection: &Detection) -> Cut {
        if detection.corners.is_some() && self.config.ranging.uses_corners() {
            return Cut::default();
        }
        let bounds = &detection.bounding_box;
        let width = f64::from(self.intrinsics.width);
        let height = f64::from(self.intrinsics.height);
        let near_px = EDGE_PX + self.config.pixel_sigma_px;
        let at = |side: BoundingBox| {
            let around = BoundingBox {
                x_min: side.x_min - near_px,
                y_min: side.y_min - near_px,
                x_max: side.x_max + near_px,
                y_max: side.y_max + near_px,
            };
            self.masks.iter().any(|mask| mask.overlaps(&around))
        };
        let BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        } = *bounds;
        let upper = BoundingBox {
            y_max: y_min,
            ..*bounds
        };
        let lower = BoundingBox {
            y_min: y_max,
            ..*bounds
        };
        let left = BoundingBox {
            x_max: x_min,
            ..*bounds
        };
        let right = BoundingBox {
            x_min: x_max,
            ..*bounds
        };
        Cut {
            upper: y_min < EDGE_PX || at(upper),
            lower: y_max > height - EDGE_PX || at(lower),
            side: x_min < EDGE_PX || x_max > width - EDGE_PX || at(left) || at(right),
        }
    }

    /// Places a detection from `camera` whose distortion has been removed; for `cut` see
    /// [`Self::cut`].
    ///
    /// `target` is the middle of the detection's solved corners in the camera frame, in metres;
    /// only [`Ranging::Auto`] and [`Ranging::Corners`] use it.
    ///
    /// # Errors
    /// Returns a [`ProjectionError`] if the detection gives no position.
    pub fn place(
        &self,
        detection: &Detection,
        cut: Cut,
        target: Option<&Point3<f64>>,
        camera: &Pose,
    ) -> Result<PerceivedObject, ProjectionError> {
        let label = &detection.label;
        let bounds = &detection.bounding_box;
        if !bounds.is_valid() {
            return Err(ProjectionError::DegenerateBox(label.clone()));
        }
        let sight = self.line_of_sight_to(detection, cut, target)?;
        let direction_rad = camera.heading_rad + sight.bearing_rad;
        let (sin, cos) = direction_rad.sin_cos();
        let position = (
            camera.position.x + sight.distance_m * cos,
            camera.position.y + sight.distance_m * sin,
        );
        let covariance = self.covariance(&sight, direction_rad);
        if !(position.0.is_finite() && position.1.is_finite() && covariance.is_valid()) {
            return Err(ProjectionError::DegenerateBox(label.clone()));
        }
        Ok(PerceivedObject {
            covariance_m2: Some(covariance.into()),
            ..PerceivedObject::new(label.clone(), detection.confidence, position.0, position.1)
        })
    }

    fn line_of_sight_to(
        &self,
        detection: &Detection,
        cut: Cut,
        target: Option<&Point3<f64>>,
    ) -> Result<LineOfSight, ProjectionError> {
        let label = &detection.label;
        let bounds = &detection.bounding_box;
        let known = self.config.sizes.of(label);
        let size = known.ok_or_else(|| ProjectionError::UnknownSize(label.clone()));
        let whole = |is_cut| {
            if is_cut {
                Err(ProjectionError::Clipped(label.clone()))
            } else {
                Ok(())
            }
        };
        let degenerate = || ProjectionError::DegenerateBox(label.clone());
        match (self.config.ranging, target) {
            (Ranging::Auto | Ranging::Corners, Some(target)) => {
                corners::line_of_sight(detection, target, size?, self)
            }
            (Ranging::Auto, None) if self.mount.height_m.is_some() => {
                auto::line_of_sight(detection, cut, known, self)
            }
            (Ranging::Ground, _) => {
                whole(cut.lower)?;
                let (foot, head) = box_height::foot_and_head(bounds, self);
                let half = HalfDepth::of(known, bounds, &foot, self);
                let estimate = ground::from_foot(&foot, half, self)
                    .ok_or_else(|| ProjectionError::AboveHorizon(label.clone()))?;
                Ok(estimate.along(
                    &foot,
                    half.middle_sigma_m(estimate.distance_m, cut, &head, self),
                ))
            }
            (Ranging::BoxWidth, _) => {
                whole(cut.side)?;
                Ok(box_width::line_of_sight(bounds, size?, self))
            }
            (Ranging::Paper, _) => paper::line_of_sight(detection, size?, self),
            (Ranging::Auto | Ranging::Corners | Ranging::BoxHeight, _) => {
                whole(cut.upper || cut.lower)?;
                box_height::line_of_sight(bounds, size?, self).ok_or_else(degenerate)
            }
        }
    }

    /// The line of sight to a point `forward_m` ahead of and `left_m` left of the camera, as judged
    /// by an extent in the image.
    fn line_of_sight(
        &self,
        forward_m: f64,
        left_m: f64,
        extent_px: f64,
        size: &ObjectSize,
    ) -> LineOfSight {
        self.sized(
            left_m.atan2(forward_m),
            forward_m.hypot(left_m),
            extent_px,
            size,
        )
    }

    /// A line of sight whose distance is judged by an extent in the image: d ∝ size / extent. σ_d/d
    /// is the root of the sum of both squared relative errors, and both edges of the extent have
    /// pixel noise.
    fn sized(
        &self,
        bearing_rad: f64,
        distance_m: f64,
        extent_px: f64,
        size: &ObjectSize,
    ) -> LineOfSight {
        let pixel_sigma_px = self.config.pixel_sigma_px;
        let edges = std::f64::consts::SQRT_2 * pixel_sigma_px / extent_px;
        let along_m = distance_m * edges.hypot(size.relative_sigma);
        LineOfSight {
            bearing_rad,
            distance_m,
            along_m,
            turn_rad: pixel_sigma_px / self.intrinsics.fx,
        }
    }

    /// First-order error propagation along and across the line of sight. The heading's error turns
    /// it; the errors of the camera's position and the floor add to both.
    fn covariance(&self, sight: &LineOfSight, direction_rad: f64) -> Covariance {
        let ProjectionConfig {
            heading_sigma_rad,
            position_sigma_m,
            floor_m,
            ..
        } = self.config;
        let everywhere = position_sigma_m.hypot(floor_m);
        let along_m = sight.along_m.hypot(everywhere);
        let turn_rad = sight.turn_rad.hypot(heading_sigma_rad);
        Covariance::along_bearing(
            direction_rad,
            along_m,
            (sight.distance_m * turn_rad).hypot(everywhere),
        )
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
    /// Standard deviation of the distance.
    along_m: f64,
    /// Standard deviation of the bearing, excluding the error of the heading.
    turn_rad: f64,
}

#[cfg(test)]
mod tests;
