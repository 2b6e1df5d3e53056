//! Ranging by the height of the box.

use nalgebra::Point2;

use super::error_sources::{Errors, Source};
use super::estimate::Estimate;
use super::ground::HalfDepth;
use super::level_sight::LevelSight;
use super::{LineOfSight, ObjectSize, Projection};
use crate::model::detection::BoundingBox;

/// Similar triangles on the height. Of a level camera it is parallel to the image's columns: z =
/// f_y · height / box height.
pub(super) fn line_of_sight(
    bounds: &BoundingBox,
    size: &ObjectSize,
    projection: &Projection,
) -> Option<LineOfSight> {
    if projection.mount.is_tilted() {
        let (foot, head) = foot_and_head(bounds, projection);
        return upright(&foot, &head, size, HalfDepth::flat())
            .map(|estimate| estimate.along(&foot, 0.0));
    }
    let camera = &projection.intrinsics;
    let forward_m = camera.fy * size.height_m / bounds.height();
    let left_m = forward_m * (camera.cx - bounds.center().x) / camera.fx;
    Some(projection.line_of_sight(forward_m, left_m, bounds.height(), size))
}

/// The lines of sight to the foot and the head of an upright object.
///
/// Its sides meet in the vanishing point of verticals. A point of the foot in column x is below the
/// point of the head in column scale · x + shift. The width of the foot is therefore limited both
/// by its own edges and by the edges below the head.
pub(super) fn foot_and_head(
    bounds: &BoundingBox,
    projection: &Projection,
) -> (LevelSight, LevelSight) {
    let Projection {
        intrinsics: camera,
        to_level,
        ..
    } = projection;
    let BoundingBox {
        x_min,
        y_min,
        x_max,
        y_max,
    } = *bounds;
    let up = to_level.row(2);
    let vanishing = [
        camera.fx * up[0] + camera.cx * up[2],
        camera.fy * up[1] + camera.cy * up[2],
    ];
    let rise = (y_max - y_min) / (y_min * up[2] - vanishing[1]);
    let scale = 1.0 / (1.0 + rise * up[2]);
    let shift = rise * vanishing[0] * scale;
    let below = |x_px: f64| (x_px - shift) / scale;
    let foot_px = if scale > 0.0 {
        (x_min.max(below(x_min)) + x_max.min(below(x_max))) / 2.0
    } else {
        bounds.center().x
    };
    let foot = LevelSight::of(&Point2::new(foot_px, y_max), Source::FootRow, projection);
    let head = LevelSight::of(
        &Point2::new(scale * foot_px + shift, y_min),
        Source::HeadRow,
        projection,
    );
    (foot, head)
}

/// The middle of an upright object of given height, from the slopes to its foot and head.
///
/// The foot is its near edge. The head is its near edge from below and its far edge from above, so
/// that d = (height + half depth · (foot + |head|)) / (foot − head).
pub(super) fn upright(
    foot: &LevelSight,
    head: &LevelSight,
    size: &ObjectSize,
    half: HalfDepth,
) -> Option<Estimate> {
    let span = foot.slope - head.slope;
    let half_m = half.mean_m * foot.depth_factor;
    let depth_share = (foot.slope + head.slope.abs()) / span;
    let distance_m = size.height_m / span + half_m * depth_share;
    let mut errors: Errors = foot.errors * ((half_m - distance_m) / span)
        + head.errors * ((half_m * head.slope.signum() + distance_m) / span);
    errors[Source::ObjectHeight as usize] = size.height_m * size.relative_sigma / span;
    errors[Source::Depth as usize] = half.sigma_m * foot.depth_factor * depth_share;
    Estimate { distance_m, errors }.in_front()
}
