//! Ranging by the intersection of the foot of the box with the ground, for a camera of configured
//! height.

use super::error_sources::{Errors, Source};
use super::estimate::Estimate;
use super::level_sight::LevelSight;
use super::{Cut, ObjectSize, Projection};
use crate::model::detection::BoundingBox;

/// Angle from the horizon, in standard deviations, below which a plane gives no distance.
const MIN_HORIZON_SIGMAS: f64 = 2.0;

/// Relative standard deviation of the depth of an object of unknown size.
const UNKNOWN_DEPTH_SIGMA: f64 = 0.5;

/// The half of an object's depth along the line of sight.
#[derive(Debug, Clone, Copy)]
pub(super) struct HalfDepth {
    pub(super) mean_m: f64,
    pub(super) sigma_m: f64,
}

impl HalfDepth {
    /// Half depth of a rectangular footprint of length l and width w at an unknown yaw φ: (l |cos
    /// φ| + w |sin φ|) / 2.
    pub(super) fn of_size(size: &ObjectSize) -> Self {
        use std::f64::consts::PI;
        let width = size.width_m;
        let length = size.length_m.unwrap_or(size.width_m);
        let mean_m = (length + width) / PI;
        let mean_square = (length * length + width * width) / 8.0 + length * width / (2.0 * PI);
        let spread = (mean_square - mean_m * mean_m).max(0.0).sqrt();
        Self {
            mean_m,
            sigma_m: spread.hypot(mean_m * size.relative_sigma),
        }
    }

    /// Half depth of an object of this size or, without a size, of an object that is as deep as its
    /// box is wide when its foot is on the ground.
    pub(super) fn of(
        size: Option<&ObjectSize>,
        bounds: &BoundingBox,
        foot: &LevelSight,
        projection: &Projection,
    ) -> Self {
        if let Some(size) = size {
            return Self::of_size(size);
        }
        let distance_m = projection.mount.height_m.unwrap_or(0.0) / foot.slope;
        let mean_m = distance_m * bounds.width() / projection.intrinsics.fx / 2.0;
        Self {
            mean_m,
            sigma_m: mean_m * UNKNOWN_DEPTH_SIGMA,
        }
    }

    /// Standard deviation in metres of the middle of a box from the middle of its object at this
    /// distance: the nearer side looks larger. Of an object whose footprint the upper edge of the
    /// image cuts, any part may be in view.
    pub(super) fn middle_sigma_m(
        &self,
        distance_m: f64,
        cut: Cut,
        head: &LevelSight,
        projection: &Projection,
    ) -> f64 {
        let far_m = distance_m + self.mean_m * head.depth_factor;
        let is_cut = cut.upper
            && projection
                .mount
                .height_m
                .is_some_and(|height_m| head.slope * far_m > height_m);
        let nearer_m = self.mean_m * self.mean_m / distance_m;
        if is_cut {
            nearer_m.max(self.mean_m / 3f64.sqrt())
        } else {
            nearer_m
        }
    }

    /// The size of the object with the width that is seen at an unknown yaw, which is distributed
    /// as its depth is.
    pub(super) fn seen_width(&self, size: &ObjectSize) -> ObjectSize {
        ObjectSize {
            width_m: 2.0 * self.mean_m,
            relative_sigma: self.sigma_m / self.mean_m,
            ..*size
        }
    }

    /// Half depth of a flat object.
    pub(super) fn flat() -> Self {
        Self {
            mean_m: 0.0,
            sigma_m: 0.0,
        }
    }
}

/// The middle of the object whose foot is on the ground; `None` without a foot clearly below the
/// horizon.
pub(super) fn from_foot(
    foot: &LevelSight,
    half: HalfDepth,
    projection: &Projection,
) -> Option<Estimate> {
    let drop_m = projection.mount.height_m?;
    let mut estimate = on_plane(foot, drop_m, &camera_height(projection))?;
    estimate.distance_m += half.mean_m * foot.depth_factor;
    estimate.errors[Source::Depth as usize] = half.sigma_m * foot.depth_factor;
    estimate.in_front()
}

/// The middle of the object whose head is as high as objects of its kind are; `None` for a head
/// near the horizon.
pub(super) fn from_head(
    head: &LevelSight,
    size: &ObjectSize,
    half: HalfDepth,
    projection: &Projection,
) -> Option<Estimate> {
    let drop_m = projection.mount.height_m? - size.height_m;
    let mut errors = camera_height(projection);
    errors[Source::ObjectHeight as usize] = -size.height_m * size.relative_sigma;
    let mut estimate = on_plane(head, drop_m, &errors)?;
    // From above, the far edge of the top is the upper one.
    let side = -head.slope.signum() * head.depth_factor;
    estimate.distance_m += side * half.mean_m;
    estimate.errors[Source::Depth as usize] = side * half.sigma_m;
    estimate.in_front()
}

fn camera_height(projection: &Projection) -> Errors {
    let mut errors = Errors::zeros();
    errors[Source::CameraHeight as usize] = projection.config.height_sigma_m;
    errors
}

/// The distance at which a line of sight meets a plane `drop_m` below the camera: d = drop / slope.
/// The slope's error is propagated to second order, because the distance grows without bound
/// towards the horizon.
fn on_plane(sight: &LevelSight, drop_m: f64, drop_errors: &Errors) -> Option<Estimate> {
    let distance_m = drop_m / sight.slope;
    let relative = sight.errors.norm() / sight.slope.abs();
    if distance_m.is_nan() || distance_m <= 0.0 || relative * MIN_HORIZON_SIGMAS > 1.0 {
        return None;
    }
    let slope_errors = sight.errors * (distance_m / sight.slope / (1.0 - relative * relative));
    Some(Estimate {
        distance_m,
        errors: drop_errors / sight.slope - slope_errors,
    })
}
