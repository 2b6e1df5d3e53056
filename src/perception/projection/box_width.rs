//! Ranging by the width of the box.

use super::{EDGE_PX, LineOfSight, ObjectSize};
use crate::model::detection::BoundingBox;
use crate::perception::camera::Intrinsics;

/// True if the image's left or right edge cuts the box.
pub(super) fn is_clipped(bounds: &BoundingBox, camera: &Intrinsics) -> bool {
    bounds.x_min < EDGE_PX || bounds.x_max > f64::from(camera.width) - EDGE_PX
}

/// An isosceles triangle with the width as its base and the camera at its tip: d = s / (2 tan(α/2)). The line of sight
/// halves the angle between the bearings of the two edges.
pub(super) fn line_of_sight(bounds: &BoundingBox, size: &ObjectSize, camera: &Intrinsics) -> LineOfSight {
    let (left, right) = (camera.bearing(bounds.x_min), camera.bearing(bounds.x_max));
    let half_alpha = (left - right) / 2.0;
    LineOfSight {
        bearing_rad: (left + right) / 2.0,
        distance_m: size.width_m / (2.0 * half_alpha.tan()),
        extent_px: bounds.width(),
    }
}
