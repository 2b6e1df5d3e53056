//! Ranging by the ground on rendered frames: posts before cameras of any height and pitch, boxed where they are lighter than
//! what is behind them.

use std::f64::consts::PI;
use std::ops::Range;

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::perception::camera::Mount;
use ecod::perception::projection::{
    ObjectSize, ObjectSizes, Projection, ProjectionConfig, Ranging,
};
use ecod_lab::testbed::camera::TestbedCamera;
use ecod_lab::testbed::{Cav, Spot, Testbed};
use nalgebra::{Point2, Vector2};
use opencv::core::Mat;
use opencv::imgproc;
use opencv::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const HEIGHTS_M: [f64; 4] = [0.2, 1.2, 2.5, 6.0];
/// Of a squared Mahalanobis distance in the plane.
const CHI_SQUARED_95: f64 = 5.991;
/// Standard deviation of an edge that is seen to the whole pixel, with how the threshold moves it.
const EDGE_SIGMA_PX: f64 = 0.5;
/// Standard deviation of a detector's edges beside that.
const DETECTOR_SIGMA_PX: f64 = 1.5;
/// Brightness of a pixel that paper half covers, between that before the wall and that before the floor.
const PAPER_FROM: f64 = 178.0;

fn mount(height_m: f64, pitch_deg: f64, roll_deg: f64) -> Mount {
    let pitch_rad = pitch_deg.to_radians();
    let roll_rad = roll_deg.to_radians();
    Mount {
        height_m: Some(height_m),
        pitch_rad,
        roll_rad,
        ..Mount::default()
    }
}

/// Posts of 0.25 m before a low camera, and as high as people otherwise; some pixels wide wherever they are.
fn post(camera_m: f64) -> ObjectSize {
    let (width_m, height_m) = if camera_m < 1.0 {
        (0.02, 0.25)
    } else {
        (0.1f64.max(0.05 * camera_m), 1.7)
    };
    ObjectSize {
        width_m,
        height_m,
        length_m: Some(0.0),
        relative_sigma: 0.002,
    }
}

/// A street with cards of the size of posts, and without any yet.
fn street(camera_m: f64) -> Testbed {
    let ObjectSize {
        width_m, height_m, ..
    } = post(camera_m);
    // The code is too small to be seen: dark pixels would cut a post.
    let [width_in, height_in, code_in] =
        [width_m, height_m, width_m / 50.0].map(|metres| metres / 0.0254);
    Testbed::from_json(&format!(
        r#"{{"camera": {{"image_width": 480, "image_height": 300, "horizontal_fov_deg": 70, "vertical_fov_deg": 47.3}},
        "placard": {{"qr_width": {code_in}, "qr_with_quiet_zone": {width_in}, "card_width": {width_in},
                     "card_height": {height_in}, "empty_text": "EMPTY"}},
        "scenes": [{{"name": "street", "cavs": [{{"id": "mast", "position": [0, 0], "camera_heading_deg": 0}}], "spots": [
        {{"id": 0, "occupied_placard": [900, 900], "truth": "P"}}]}}]}}"#
    ))
    .unwrap()
}

/// The boxes of a rendered frame with posts at these places, which are turned by up to 1 rad from the light.
fn boxes(testbed: &Testbed, places: &[Point2<f64>], mount: &Mount) -> Vec<BoundingBox> {
    let mut scene = testbed.scenes[0].clone();
    let spot = |(index, place): (usize, &Point2<f64>)| Spot {
        id: format!("slot-{index}").into(),
        occupied: *place,
        empty: None,
        facing_rad: 0.6 + (index as f64 * 0.7) % 2.0 - 1.0,
        truth: Some("P".into()),
    };
    scene.spots = places.iter().enumerate().map(spot).collect();
    // The camera looks at the fronts.
    let cav = Cav {
        pose: Pose::new(0.0, 0.0, HEADING_RAD),
        ..scene.cavs[0].clone()
    };
    let rendered = TestbedCamera::mounted(testbed, &scene, &cav, mount, 1).unwrap();
    let mut gray = Mat::default();
    let mut paper = Mat::default();
    imgproc::cvt_color_def(rendered.still(), &mut gray, imgproc::COLOR_BGR2GRAY).unwrap();
    imgproc::threshold(&gray, &mut paper, PAPER_FROM, 255.0, imgproc::THRESH_BINARY).unwrap();
    let mut labels = Mat::default();
    let mut stats = Mat::default();
    let mut middles = Mat::default();
    let count =
        imgproc::connected_components_with_stats_def(&paper, &mut labels, &mut stats, &mut middles)
            .unwrap();
    let found = (1..count).map(|row| {
        let [left, upper, width, height] =
            [0, 1, 2, 3].map(|column| f64::from(*stats.at_2d::<i32>(row, column).unwrap()));
        BoundingBox {
            x_min: left,
            y_min: upper,
            x_max: left + width,
            y_max: upper + height,
        }
    });
    found.filter(|bounds| bounds.height() >= 10.0).collect()
}

const HEADING_RAD: f64 = 0.6 + PI;

struct Dice(ChaCha8Rng);

impl Dice {
    fn normal(&mut self) -> f64 {
        let u: f64 = self.0.random();
        let v: f64 = self.0.random();
        (-2.0 * (1.0 - u).ln()).sqrt() * (2.0 * PI * v).cos()
    }

    /// Places ahead, one to each bearing, at ranges in heights of the camera.
    fn places(&mut self, camera_m: f64, ranges: Range<f64>) -> Vec<Point2<f64>> {
        let camera = Pose::new(0.0, 0.0, HEADING_RAD);
        let place = |bearing_deg: f64| {
            let range_m = camera_m * self.0.random_range(ranges.clone());
            let (sin, cos) = (bearing_deg + self.0.random_range(-3.0..3.0))
                .to_radians()
                .sin_cos();
            camera.transform(range_m * cos, range_m * sin)
        };
        [-25.0, -15.0, -5.0, 5.0, 15.0, 25.0].map(place).to_vec()
    }
}

/// Errors of the places of posts with these boxes, relative to their range, and squared Mahalanobis distances.
/// The node assumes the camera at `assumed`; `noise_px` are errors of edges of a detector.
fn errors(
    found: &[BoundingBox],
    places: &[Point2<f64>],
    projection: &Projection,
    assumed: &Pose,
    mut noise_px: impl FnMut() -> f64,
) -> Vec<(f64, f64)> {
    let pose = Pose::new(0.0, 0.0, HEADING_RAD);
    let placed = found.iter().filter_map(|bounding_box| {
        let mut detection = Detection {
            label: "post".into(),
            confidence: 0.9,
            bounding_box: *bounding_box,
            corners: None,
        };
        let cut = projection.cut(&detection);
        if cut.lower || cut.side {
            return None;
        }
        let bounds = &mut detection.bounding_box;
        for edge in [
            &mut bounds.x_min,
            &mut bounds.y_min,
            &mut bounds.x_max,
            &mut bounds.y_max,
        ] {
            *edge += noise_px();
        }
        let placed = projection.place(&detection, cut, None, assumed).ok()?;
        let position = Vector2::new(placed.x_m, placed.y_m);
        // Bearings identify the post.
        let bearing_rad = |at: &Point2<f64>| pose.range_bearing(at).1;
        let own = bearing_rad(&Point2::from(position));
        let post = places.iter().min_by(|a, b| {
            (bearing_rad(a) - own)
                .abs()
                .total_cmp(&(bearing_rad(b) - own).abs())
        })?;
        let off = position - post.coords;
        Some((
            off.norm() / post.coords.norm(),
            placed.covariance()?.mahalanobis_squared(&off, 0.0),
        ))
    });
    placed.collect()
}

const RANGINGS: [Ranging; 2] = [Ranging::Ground, Ranging::Auto];

fn config(
    camera_m: f64,
    ranging: Ranging,
    pixel_sigma_px: f64,
    Unknown { tilt_rad, height }: Unknown,
) -> ProjectionConfig {
    let sizes = ObjectSizes {
        labels: [("post".into(), post(camera_m))].into(),
        ..ObjectSizes::default()
    };
    ProjectionConfig {
        ranging,
        sizes,
        pixel_sigma_px,
        tilt_sigma_rad: tilt_rad,
        height_sigma_m: height * camera_m,
        floor_m: 1e-4,
        ..ProjectionConfig::default()
    }
}

/// Standard deviations of the stated mount: of pitch and roll in radians, and of the height, relative.
#[derive(Debug, Clone, Copy)]
struct Unknown {
    tilt_rad: f64,
    height: f64,
}

const EXACT: Unknown = Unknown {
    tilt_rad: 1e-4,
    height: 1e-4,
};
const A_DEGREE: Unknown = Unknown {
    tilt_rad: std::f64::consts::PI / 180.0,
    height: 0.02,
};

#[test]
fn rendered_posts_within_two_percent() {
    let mut dice = Dice(ChaCha8Rng::seed_from_u64(7));
    for camera_m in HEIGHTS_M {
        let testbed = street(camera_m);
        let mut all = [Vec::new(), Vec::new()];
        for (pitch_deg, roll_deg, ranges) in [
            (0.0, 5.0, 3.5..6.0),
            (20.0, 0.0, 1.5..5.0),
            (45.0, -5.0, 1.0..2.2),
        ] {
            let mount = mount(camera_m, pitch_deg, roll_deg);
            let places = dice.places(camera_m, ranges);
            let found = boxes(&testbed, &places, &mount);
            for (ranging, all) in RANGINGS.into_iter().zip(&mut all) {
                let config = config(camera_m, ranging, EDGE_SIGMA_PX, EXACT);
                let projection = Projection::new(config, testbed.camera.intrinsics, mount);
                all.extend(
                    errors(
                        &found,
                        &places,
                        &projection,
                        &Pose::new(0.0, 0.0, HEADING_RAD),
                        || 0.0,
                    )
                    .iter()
                    .map(|(error, _)| *error),
                );
            }
        }
        for (ranging, mut errors) in RANGINGS.into_iter().zip(all) {
            errors.sort_by(f64::total_cmp);
            let median = errors[errors.len() / 2];
            println!(
                "{ranging:?}, {camera_m} m: {:.2} % of {} posts",
                100.0 * median,
                errors.len()
            );
            assert!(
                errors.len() >= 15 && median <= 0.02,
                "{ranging:?}, {camera_m} m: {errors:?}"
            );
        }
    }
}

#[test]
fn covariance_covers_95_percent() {
    let mut dice = Dice(ChaCha8Rng::seed_from_u64(8));
    let mut failures = Vec::new();
    for camera_m in HEIGHTS_M {
        let testbed = street(camera_m);
        for (pitch_deg, roll_deg, ranges) in TILTS {
            let real = mount(camera_m, pitch_deg, roll_deg);
            let frames: Vec<_> = (0..FRAMES)
                .map(|_| {
                    let places = dice.places(camera_m, ranges.clone());
                    (boxes(&testbed, &places, &real), places)
                })
                .collect();
            for unknown in [EXACT, A_DEGREE] {
                let shares = shares(&frames, &testbed, &real, unknown, &mut dice);
                for (ranging, (share, all)) in RANGINGS.into_iter().zip(shares) {
                    let cell = format!(
                        "{ranging:?} at {camera_m} m, {pitch_deg}°, {roll_deg}°, ±{:.2}°: {:.1} % of {all}",
                        unknown.tilt_rad.to_degrees(),
                        100.0 * share
                    );
                    println!("{cell}");
                    if all < 2000 || (share - 0.95).abs() > 0.03 {
                        failures.push(cell);
                    }
                }
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

/// The share of errors within the ellipse of 95 % and their number, by way of ranging.
fn shares(
    frames: &[(Vec<BoundingBox>, Vec<Point2<f64>>)],
    testbed: &Testbed,
    real: &Mount,
    unknown: Unknown,
    dice: &mut Dice,
) -> [(f64, usize); 2] {
    let camera_m = real.height_m.unwrap();
    let ProjectionConfig {
        position_sigma_m,
        heading_sigma_rad,
        ..
    } = ProjectionConfig::default();
    let mut covered = [0, 0];
    let mut all = [0, 0];
    for _ in 0..MOUNTS {
        for (found, places) in frames {
            let mut off = |sigma: f64| sigma * dice.normal();
            let stated = Mount {
                height_m: Some(camera_m * (1.0 + off(unknown.height))),
                pitch_rad: real.pitch_rad + off(unknown.tilt_rad),
                roll_rad: real.roll_rad + off(unknown.tilt_rad),
                ..*real
            };
            let assumed = Pose::new(
                off(position_sigma_m),
                off(position_sigma_m),
                HEADING_RAD + off(heading_sigma_rad),
            );
            for (index, ranging) in RANGINGS.into_iter().enumerate() {
                let config = config(
                    camera_m,
                    ranging,
                    DETECTOR_SIGMA_PX.hypot(EDGE_SIGMA_PX),
                    unknown,
                );
                let projection = Projection::new(config, testbed.camera.intrinsics, stated);
                let errors = errors(found, places, &projection, &assumed, || {
                    DETECTOR_SIGMA_PX * dice.normal()
                });
                all[index] += errors.len();
                covered[index] += errors
                    .iter()
                    .filter(|(_, squared)| *squared <= CHI_SQUARED_95)
                    .count();
            }
        }
    }
    [0, 1].map(|index| (covered[index] as f64 / all[index] as f64, all[index]))
}

/// Pitches and rolls in degrees, and ranges in heights of the camera.
const TILTS: [(f64, f64, Range<f64>); 5] = [
    (0.0, 0.0, 3.0..6.0),
    (10.0, 5.0, 2.0..5.0),
    (20.0, 0.0, 1.7..4.0),
    (32.0, -5.0, 1.3..3.0),
    (45.0, 0.0, 1.0..2.2),
];
/// Frames of each camera, and mounts that are stated for each frame, with errors of their own.
const FRAMES: usize = 2;
const MOUNTS: usize = 200;
