//! Ranging by the ground on WILDTRACK: the foot of each box by [`Projection`], beside the annotated place of a person.
//!
//! MVDeTr found the people, and its boxes are the rectangles of the annotation at the places that it found. So its errors
//! count too. The rectangles show an upright card of 0.5 by 1.8 m in the middle of a person: their lower edge is below the
//! middle and not at the near side. Therefore a card without depth is judged, and beside it a person of usual depth.

use anyhow::Context;
use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::projection::{ObjectSize, ObjectSizes, Projection, ProjectionConfig, Ranging};
use nalgebra::{Complex, Matrix3, Point2, Vector3};

use super::wildtrack::Wildtrack;

/// Image size in pixels.
const IMAGE: [u32; 2] = [1920, 1080];
/// Range in metres up to which places are judged.
const MAX_RANGE_M: f64 = 20.0;
const CARD: ObjectSize = ObjectSize { width_m: 0.0, height_m: 1.8, length_m: Some(0.0), relative_sigma: 0.02 };

/// Prints a table of errors in metres, by camera and in all.
pub(super) fn print(data: &Wildtrack) -> anyhow::Result<()> {
    println!("| WILDTRACK camera | height | pitch | boxes within 20 m | median | 90 % | median with usual depth |");
    println!("|---|---|---|---|---|---|---|");
    let mut all = [Vec::new(), Vec::new()];
    for (number, homography) in data.homographies.iter().enumerate() {
        let camera =
            GroundCamera::new(homography).with_context(|| format!("camera {}: no pinhole camera", number + 1))?;
        let errors = [Some(CARD), None].map(|size| camera.errors(data, number, size));
        let Mount { height_m, pitch_rad, .. } = camera.mount;
        let (height_m, pitch_deg) = (height_m.unwrap_or_default(), pitch_rad.to_degrees());
        row(&format!("{} | {height_m:.2} m | {pitch_deg:.1}°", number + 1), &errors);
        for (all, errors) in all.iter_mut().zip(errors) {
            all.extend(errors);
        }
    }
    row("all | |", &all);
    println!();
    Ok(())
}

fn row(name: &str, [card, person]: &[Vec<f64>; 2]) {
    let share = |errors: &Vec<f64>, share: f64| {
        let mut sorted = errors.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get((sorted.len() as f64 * share) as usize).map_or_else(|| "-".to_owned(), |error| format!("{error:.2}"))
    };
    println!("| {name} | {} | {} | {} | {} |", card.len(), share(card, 0.5), share(card, 0.9), share(person, 0.5));
}

/// A calibrated camera over the ground.
struct GroundCamera {
    intrinsics: Intrinsics,
    pose: Pose,
    mount: Mount,
}

impl GroundCamera {
    /// The camera of square pixels that maps the ground in centimetres so: H = K (r₁ r₂ t). `None` if there is none.
    ///
    /// With u the vertical and s the sine of the axis over the horizon, M = h₁h₁ᵀ + h₂h₂ᵀ = K (I - u uᵀ) Kᵀ. Columns and rows
    /// as complex numbers leave a quadratic equation for K u, whose other root puts the principal point far off.
    fn new(homography: &Matrix3<f64>) -> Option<Self> {
        let [h1, h2, h3] = [0, 1, 2].map(|column| homography.column(column).into_owned());
        let moments = h1 * h1.transpose() + h2 * h2.transpose();
        let (middle, cos_square) = (Complex::new(moments.m13, moments.m23), moments.m33);
        let sin = -(1.0 - cos_square).sqrt();
        let difference = Complex::new(moments.m11 - moments.m22, 2.0 * moments.m12);
        let root = (middle * middle - difference * cos_square).sqrt();
        let verticals = [root, -root].map(|root| (middle * sin + root) / cos_square);
        let principal = |vertical: &Complex<f64>| middle + vertical * sin;
        let [columns, rows] = IMAGE.map(f64::from);
        let off = |vertical: &Complex<f64>| (principal(vertical) - Complex::new(columns, rows) / 2.0).norm();
        let vertical = verticals.into_iter().min_by(|a, b| off(a).total_cmp(&off(b)))?;
        let (Complex { re: cx, im: cy }, [width, height]) = (principal(&vertical), IMAGE);
        let focal = (moments.m11 - cx * cx + vertical.re * vertical.re).sqrt();
        let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, cx, cy };
        let [r1, r2, t] = [h1, h2, h3].map(|h| Vector3::new((h.x - cx * h.z) / focal, (h.y - cy * h.z) / focal, h.z));
        let to_world = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]).transpose();
        let position = -to_world * t / 100.0;
        let (right, down, axis) = (to_world.column(0), to_world.column(1), to_world.column(2));
        let mount = Mount {
            height_m: Some(position.z),
            pitch_rad: (-axis.z).asin(),
            roll_rad: (-right.z).atan2(-down.z),
            ..Mount::default()
        };
        let pose = Pose::new(position.x, position.y, axis.y.atan2(axis.x));
        let is_camera = [focal, position.z, mount.pitch_rad].into_iter().all(|value| value.is_finite() && value > 0.0);
        is_camera.then_some(Self { intrinsics, pose, mount })
    }

    /// Distances of its places from the nearest annotated ones; without a size, people have the usual one.
    fn errors(&self, data: &Wildtrack, number: usize, size: Option<ObjectSize>) -> Vec<f64> {
        let labels = size.map(|size| ("person".into(), size)).into_iter().collect();
        let config = ProjectionConfig {
            ranging: Ranging::Ground,
            sizes: ObjectSizes { labels, default: None },
            ..ProjectionConfig::default()
        };
        let projection = Projection::new(config, self.intrinsics, self.mount);
        let mut errors = Vec::new();
        for (frame, boxes) in &data.boxes {
            for [left, top, width, height, ..] in boxes.iter().filter(|cells| cells[5] as usize == number) {
                // The middles of whole pixels.
                let (x_min, y_min) = (left + 0.5, top + 0.5);
                let bounding_box = BoundingBox { x_min, y_min, x_max: x_min + width, y_max: y_min + height };
                let detection = Detection { label: "person".into(), confidence: 1.0, bounding_box, corners: None };
                let cut = projection.cut(&detection);
                let Ok(placed) = projection.place(&detection, cut, None, &self.pose) else { continue };
                let place = Point2::new(placed.x_m, placed.y_m);
                let people = data.positions.get(frame).into_iter().flatten();
                let nearest =
                    people.min_by(|a, b| nalgebra::distance(*a, &place).total_cmp(&nalgebra::distance(*b, &place)));
                if let Some(person) = nearest
                    && !cut.side
                    && nalgebra::distance(person, &self.pose.position) <= MAX_RANGE_M
                {
                    errors.push(nalgebra::distance(person, &place));
                }
            }
        }
        errors
    }
}
