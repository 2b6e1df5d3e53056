//! Ranging by the height of the box.

use super::{EDGE_PX, LineOfSight, ObjectSize};
use crate::model::detection::BoundingBox;
use crate::perception::camera::Intrinsics;

/// True if the image's upper or lower edge cuts the box.
pub(super) fn is_clipped(bounds: &BoundingBox, camera: &Intrinsics) -> bool {
    bounds.y_min < EDGE_PX || bounds.y_max > f64::from(camera.height) - EDGE_PX
}

/// Similar triangles on the height, which is parallel to the image's columns: z = f_y · height / box height.
pub(super) fn line_of_sight(bounds: &BoundingBox, size: &ObjectSize, camera: &Intrinsics) -> LineOfSight {
    let forward_m = camera.fy * size.height_m / bounds.height();
    let left_m = forward_m * (camera.cx - bounds.center().x) / camera.fx;
    LineOfSight::to(forward_m, left_m, bounds.height())
}
