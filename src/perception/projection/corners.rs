//! Ranging by the solved corners of a square target.

use nalgebra::Point3;

use super::{LineOfSight, ObjectSize, Projection, ProjectionError};
use crate::model::detection::Detection;

/// The line of sight to the middle of the target, which is given in the camera frame in metres.
pub(super) fn line_of_sight(
    detection: &Detection,
    target: &Point3<f64>,
    size: &ObjectSize,
    projection: &Projection,
) -> Result<LineOfSight, ProjectionError> {
    let level = projection.to_level * target.coords;
    let is_finite = level.iter().all(|c| c.is_finite());
    if !is_finite || target.z <= 0.0 {
        return Err(ProjectionError::InvalidCorners(detection.label.clone()));
    }
    Ok(projection.line_of_sight(level.x, level.y, detection.bounding_box.height(), size))
}
