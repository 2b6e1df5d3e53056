//! Ranging by all information in a box without corners: its foot on the ground, its height, and its
//! head.

use super::ground::{self, HalfDepth};
use super::{Cut, LineOfSight, ObjectSize, Projection, ProjectionError, box_height, box_width};
use crate::model::detection::Detection;

/// The line of sight to the middle of an object on the ground.
///
/// Foot and height are weighted by their covariance. If they contradict each other, the object does
/// not stand on the ground, or the ground is not level, and its height alone counts. If the head is
/// above the image, only the foot is used. If the foot is below the image, the head or the width is
/// used, whichever is more precise.
pub(super) fn line_of_sight(
    detection: &Detection,
    cut: Cut,
    size: Option<&ObjectSize>,
    projection: &Projection,
) -> Result<LineOfSight, ProjectionError> {
    let label = &detection.label;
    let bounds = &detection.bounding_box;
    let unknown_size = || ProjectionError::UnknownSize(label.clone());
    let clipped = || ProjectionError::Clipped(label.clone());
    let (foot, head) = box_height::foot_and_head(bounds, projection);
    let half = HalfDepth::of(size, bounds, &foot, projection);
    let on_ground = || ground::from_foot(&foot, half, projection);
    if cut.lower {
        let size = size.ok_or_else(clipped)?;
        let from_head = if cut.upper {
            None
        } else {
            ground::from_head(&head, size, half, projection)
        };
        let by_head = from_head.map(|estimate| {
            estimate.along(
                &head,
                half.middle_sigma_m(estimate.distance_m, cut, &head, projection),
            )
        });
        let by_width = || box_width::line_of_sight(bounds, &half.seen_width(size), projection);
        let ways = [by_head, (!cut.side).then(by_width)];
        let best = ways
            .into_iter()
            .flatten()
            .min_by(|a, b| a.along_m.total_cmp(&b.along_m));
        return best.ok_or_else(clipped);
    }
    let estimate = if cut.upper {
        on_ground().ok_or_else(clipped)?
    } else if let Some(size) = size {
        let upright = box_height::upright(&foot, &head, size, half)
            .ok_or_else(|| ProjectionError::DegenerateBox(label.clone()))?;
        on_ground()
            .and_then(|grounded| grounded.combined_with(&upright))
            .unwrap_or(upright)
    } else {
        on_ground().ok_or_else(unknown_size)?
    };
    Ok(estimate.along(
        &foot,
        half.middle_sigma_m(estimate.distance_m, cut, &head, projection),
    ))
}
