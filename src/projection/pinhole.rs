//! Distances by the pinhole camera.

use nalgebra::Point3;

use super::{ObjectSize, ProjectionError, Sight};
use crate::camera::Intrinsics;
use crate::detection::{BoundingBox, Detection};

/// A box this near to the image's edge, in pixels, is taken as cut by it.
const EDGE_PX: f64 = 1.0;

/// Whether the image's upper or lower edge cuts the box.
pub(super) fn is_cut_in_height(bounds: &BoundingBox, camera: &Intrinsics) -> bool {
    bounds.y_min < EDGE_PX || bounds.y_max > f64::from(camera.height) - EDGE_PX
}

/// Whether the image's left or right edge cuts the box.
pub(super) fn is_cut_in_width(bounds: &BoundingBox, camera: &Intrinsics) -> bool {
    bounds.x_min < EDGE_PX || bounds.x_max > f64::from(camera.width) - EDGE_PX
}

/// The distance is given by the solved corners.
pub(super) fn from_target(detection: &Detection, target: &Point3<f64>) -> Result<Sight, ProjectionError> {
    let finite = target.iter().all(|c| c.is_finite());
    if !finite || target.z <= 0.0 {
        return Err(ProjectionError::InvalidCorners(detection.label.clone()));
    }
    Ok(in_plane(target.z, -target.x, detection.bounding_box.height()))
}

/// Similar triangles on the height, which lies parallel to the image's columns: z = f_y · height / box height.
pub(super) fn from_height(detection: &Detection, size: &ObjectSize, camera: &Intrinsics) -> Sight {
    let bounds = &detection.bounding_box;
    let forward_m = camera.fy * size.height_m / bounds.height();
    let left_m = forward_m * (camera.cx - bounds.center().x) / camera.fx;
    in_plane(forward_m, left_m, bounds.height())
}

/// An isosceles triangle whose base is the width and whose tip is the camera: d = s / (2 tan(α/2)); the sight halves
/// the angle between the edges' bearings.
pub(super) fn from_width(detection: &Detection, size: &ObjectSize, camera: &Intrinsics) -> Sight {
    let bounds = &detection.bounding_box;
    let (left, right) = (camera.bearing(bounds.x_min), camera.bearing(bounds.x_max));
    let half_alpha = (left - right) / 2.0;
    Sight {
        bearing_rad: (left + right) / 2.0,
        distance_m: size.width_m / (2.0 * half_alpha.tan()),
        extent_px: bounds.width(),
    }
}

fn in_plane(forward_m: f64, left_m: f64, extent_px: f64) -> Sight {
    Sight { bearing_rad: left_m.atan2(forward_m), distance_m: forward_m.hypot(left_m), extent_px }
}
