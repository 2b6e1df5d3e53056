//! Ranging by the paper's formulas (PACE client, Algorithm 1, lines 8-14) to the letter.
//!
//! α = γ·w, d = s / tan α, θ = θ_v − γ·x_center, position = (x_v + d cos θ, y_v + d sin θ), with γ
//! the field of view over the image width, w and x_center the width and middle column of the box,
//! and s the object's width.
//!
//! Three things differ from the geometry of a camera:
//! - x_center counts from the left edge of the image, so θ_v is the direction of that edge. With
//!   the heading of the axis every object turns by half a field of view clockwise.
//! - The angle is spread evenly over the columns; a flat sensor spreads its tangent evenly.
//! - tan α takes the far leg of a right triangle, 2 tan(α/2) the base of an isosceles one.

use super::{LineOfSight, ObjectSize, Projection, ProjectionError};
use crate::model::detection::Detection;

pub(super) fn line_of_sight(
    detection: &Detection,
    size: &ObjectSize,
    projection: &Projection,
) -> Result<LineOfSight, ProjectionError> {
    let gamma = projection.intrinsics.angle_per_pixel();
    let width_px = detection.bounding_box.width();
    let alpha = gamma * width_px;
    let distance_m = size.width_m / alpha.tan();
    if !(distance_m.is_finite() && distance_m > 0.0) {
        return Err(ProjectionError::DegenerateBox(detection.label.clone()));
    }
    let x_center = detection.bounding_box.x_min + 0.5 * width_px;
    Ok(projection.sized(-(gamma * x_center), distance_m, width_px, size))
}
