//! Ranging by the ground on WILDTRACK: compares the position of each box's foot, by [`Projection`], with the annotated
//! position of a person.
//!
//! MVDeTr detected the people, and its boxes are the annotation's rectangles at the detected positions, so the figures
//! include its errors. Each rectangle shows an upright card of 0.5 by 1.8 m in the middle of a person: its lower edge
//! is below the middle of the person, not at the near side. Therefore both a card without depth and a person of usual
//! depth are evaluated.

use ecod::model::detection::{BoundingBox, Detection};
use ecod::perception::camera::Mount;
use ecod::perception::projection::{
    ObjectSize, ObjectSizes, Projection, ProjectionConfig, Ranging,
};
use nalgebra::Point2;

use super::ground_camera::GroundCamera;
use super::wildtrack::Wildtrack;

/// Range in metres up to which positions are judged.
const MAX_RANGE_M: f64 = 20.0;
const CARD: ObjectSize = ObjectSize {
    width_m: 0.0,
    height_m: 1.8,
    length_m: Some(0.0),
    relative_sigma: 0.02,
};

/// Prints a table of errors in metres, by camera and in total.
pub(super) fn print(data: &Wildtrack) {
    println!(
        "| WILDTRACK camera | height | pitch | boxes within 20 m | median | 90 % | median with usual depth |"
    );
    println!("|---|---|---|---|---|---|---|");
    let mut all = [Vec::new(), Vec::new()];
    for (number, camera) in data.cameras.iter().enumerate() {
        let errors = [Some(CARD), None].map(|size| errors(camera, data, number, size));
        let Mount {
            height_m,
            pitch_rad,
            ..
        } = camera.mount;
        let height_m = height_m.unwrap_or_default();
        let pitch_deg = pitch_rad.to_degrees();
        row(
            &format!("{} | {height_m:.2} m | {pitch_deg:.1}°", number + 1),
            &errors,
        );
        for (all, errors) in all.iter_mut().zip(errors) {
            all.extend(errors);
        }
    }
    row("all | |", &all);
    println!();
}

fn row(name: &str, [card, person]: &[Vec<f64>; 2]) {
    let share = |errors: &Vec<f64>, share: f64| {
        let mut sorted = errors.clone();
        sorted.sort_by(f64::total_cmp);
        sorted
            .get((sorted.len() as f64 * share) as usize)
            .map_or_else(|| "-".to_owned(), |error| format!("{error:.2}"))
    };
    println!(
        "| {name} | {} | {} | {} | {} |",
        card.len(),
        share(card, 0.5),
        share(card, 0.9),
        share(person, 0.5)
    );
}

/// Distances of the camera's positions from the nearest annotated positions; without a size, people have the default
/// size.
fn errors(
    camera: &GroundCamera,
    data: &Wildtrack,
    number: usize,
    size: Option<ObjectSize>,
) -> Vec<f64> {
    let labels = size
        .map(|size| ("person".into(), size))
        .into_iter()
        .collect();
    let config = ProjectionConfig {
        ranging: Ranging::Ground,
        sizes: ObjectSizes {
            labels,
            default: None,
        },
        ..ProjectionConfig::default()
    };
    let projection = Projection::new(config, camera.intrinsics, camera.mount);
    let mut errors = Vec::new();
    for (frame, boxes) in &data.boxes {
        for [left, top, width, height, ..] in
            boxes.iter().filter(|cells| cells[5] as usize == number)
        {
            // The centres of whole pixels.
            let x_min = left + 0.5;
            let y_min = top + 0.5;
            let bounding_box = BoundingBox {
                x_min,
                y_min,
                x_max: x_min + width,
                y_max: y_min + height,
            };
            let detection = Detection {
                label: "person".into(),
                confidence: 1.0,
                bounding_box,
                corners: None,
            };
            let cut = projection.cut(&detection);
            let Ok(placed) = projection.place(&detection, cut, None, &camera.pose) else {
                continue;
            };
            let place = Point2::new(placed.x_m, placed.y_m);
            let people = data.positions.get(frame).into_iter().flatten();
            let nearest = people.min_by(|a, b| {
                nalgebra::distance(*a, &place).total_cmp(&nalgebra::distance(*b, &place))
            });
            if let Some(person) = nearest
                && !cut.side
                && nalgebra::distance(person, &camera.pose.position) <= MAX_RANGE_M
            {
                errors.push(nalgebra::distance(person, &place));
            }
        }
    }
    errors
}
