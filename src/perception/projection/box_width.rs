//! Ranging by the width of the box.

use nalgebra::Point2;

use super::{LineOfSight, ObjectSize, Projection};
use crate::model::detection::BoundingBox;

/// An isosceles triangle with the width as its base and the camera at its tip: d = s / (2
/// tan(α/2)). The line of sight halves the angle between the bearings of the two edges.
pub(super) fn line_of_sight(
    bounds: &BoundingBox,
    size: &ObjectSize,
    projection: &Projection,
) -> LineOfSight {
    let bearing = |x_px| {
        let ray = projection.to_level
            * projection
                .intrinsics
                .ray(&Point2::new(x_px, bounds.center().y));
        ray.y.atan2(ray.x)
    };
    let left = bearing(bounds.x_min);
    let right = bearing(bounds.x_max);
    let half_alpha = (left - right) / 2.0;
    projection.sized(
        (left + right) / 2.0,
        size.width_m / (2.0 * half_alpha.tan()),
        bounds.width(),
        size,
    )
}
