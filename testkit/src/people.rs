//! Boxes of people who walk on level ground.

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::view::PosedCamera;
use nalgebra::Point2;

/// Whole boxes in a frame of a camera at a time in seconds: eight people of several heights, who
/// walk 4 to 17 m in front of it.
pub fn walking_people(at_s: f64, mount: &Mount, camera: Intrinsics) -> Vec<Detection> {
    let width = f64::from(camera.width);
    let height = f64::from(camera.height);
    let heights_m = [1.58, 1.83, 1.66, 1.74, 1.55, 1.79, 1.62, 1.7];
    let level = Pose::new(0.0, 0.0, 0.0);
    let mut boxes = Vec::new();
    for (person, height_m) in (0u32..).zip(heights_m) {
        let phase = f64::from(person) * 1.9;
        let reach_m = 4.0 + f64::from(person % 3);
        let middle = Point2::new(
            11.0 + reach_m * (at_s * 0.25 + phase).sin(),
            3.0 * (at_s * 0.17 + 2.0 * phase).cos(),
        );
        let row = |up_m: f64, ahead_m: f64, left_m: f64| {
            let raised = Mount {
                height_m: mount.height_m.map(|height| height - up_m),
                ..*mount
            };
            PosedCamera::new(level, &raised, camera)
                .pixel(&Point2::new(middle.x + ahead_m, middle.y + left_m))
        };
        let seen: Option<Vec<_>> = [
            row(0.0, -0.25, 0.1),
            row(0.0, 0.2, -0.1),
            row(height_m, 0.0, 0.0),
            row(1.4, 0.0, 0.22),
            row(1.4, 0.0, -0.22),
        ]
        .into_iter()
        .collect();
        let Some(bounding_box) = seen.map(|points| BoundingBox::around(&points)) else {
            continue;
        };
        if bounding_box.x_min > 0.0
            && bounding_box.x_max < width
            && bounding_box.y_min > 0.0
            && bounding_box.y_max < height
        {
            boxes.push(Detection {
                label: "person".into(),
                confidence: 0.9,
                bounding_box,
                corners: None,
            });
        }
    }
    boxes
}
