//! Ranging by the solved corners of a square target.

use nalgebra::Point3;

use super::{LineOfSight, ProjectionError};
use crate::model::detection::Detection;

/// The line of sight to the middle of the target, which is given in the camera frame in metres.
pub(super) fn line_of_sight(detection: &Detection, target: &Point3<f64>) -> Result<LineOfSight, ProjectionError> {
    let is_finite = target.iter().all(|c| c.is_finite());
    if !is_finite || target.z <= 0.0 {
        return Err(ProjectionError::InvalidCorners(detection.label.clone()));
    }
    Ok(LineOfSight::to(target.z, -target.x, detection.bounding_box.height()))
}
