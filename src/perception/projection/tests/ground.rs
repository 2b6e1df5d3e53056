//! Boxes around objects on the ground, projected exactly, as cameras of any height and pitch see
//! them.

use std::f64::consts::PI;
use std::time::Duration;

use nalgebra::{Rotation2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::model::time::Timestamp;

const HEIGHTS_M: [f64; 4] = [0.2, 1.2, 2.5, 6.0];
const PITCHES_DEG: [f64; 6] = [0.0, 10.0, 20.0, 30.0, 40.0, 45.0];
/// Of a squared Mahalanobis distance in the plane.
const CHI_SQUARED_95: f64 = 5.991;

fn camera() -> Intrinsics {
    Intrinsics::from_field_of_view(1280, 720, 70f64.to_radians(), 43f64.to_radians())
}

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

/// Objects that a camera of this height typically sees.
fn kinds(height_m: f64) -> Vec<(&'static str, ObjectSize)> {
    let kind = |label, width_m, length_m, height_m, relative_sigma| {
        (
            label,
            ObjectSize {
                width_m,
                length_m: Some(length_m),
                height_m,
                relative_sigma,
            },
        )
    };
    if height_m < 1.0 {
        return vec![
            kind("cup", 0.08, 0.08, 0.1, 0.1),
            kind("bottle", 0.07, 0.07, 0.25, 0.1),
        ];
    }
    vec![
        kind("person", 0.5, 0.3, 1.7, 0.06),
        kind("bicycle", 0.6, 1.7, 1.1, 0.1),
        kind("car", 1.8, 4.5, 1.5, 0.06),
    ]
}

fn projection(ranging: Ranging, mount: Mount, config: &ProjectionConfig) -> Projection {
    let labels = kinds(mount.height_m.unwrap_or(1.2))
        .into_iter()
        .map(|(label, size)| (label.into(), size))
        .collect();
    let sizes = ObjectSizes {
        labels,
        ..ObjectSizes::default()
    };
    Projection::new(
        ProjectionConfig {
            ranging,
            sizes,
            ..config.clone()
        },
        camera(),
        mount,
    )
}

/// The part in the image of the box around an upright cuboid on the ground; `None` if its foot is
/// outside.
fn seen(
    label: &str,
    size: &ObjectSize,
    at: Point2<f64>,
    yaw_rad: f64,
    mount: &Mount,
) -> Option<Detection> {
    let half_width = size.width_m / 2.0;
    let half_length = size.length_m.unwrap_or(size.width_m) / 2.0;
    let turn = Rotation2::new(yaw_rad);
    let to_camera = mount.to_level().transpose();
    let mut corners = Vec::new();
    for (along, across) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let on_ground = at + turn * Vector2::new(along * half_length, across * half_width);
        for up_m in [0.0, size.height_m] {
            let level = Vector3::new(on_ground.x, on_ground.y, up_m - mount.height_m.unwrap());
            corners.push(camera().project(&Point3::from(to_camera * level))?);
        }
    }
    let mut visible: Vec<Point2<f64>> = corners
        .iter()
        .copied()
        .filter(|corner| corner.y >= 0.0)
        .collect();
    for (above, below) in corners
        .iter()
        .flat_map(|a| corners.iter().map(move |b| (a, b)))
    {
        if above.y < 0.0 && below.y >= 0.0 {
            visible.push(above + (below - above) * (above.y / (above.y - below.y)));
        }
    }
    let bounding_box = BoundingBox::around(&visible);
    let BoundingBox {
        x_min,
        x_max,
        y_max,
        ..
    } = bounding_box;
    let is_in_image = x_min > 1.0 && x_max < 1279.0 && y_max < 718.0 && bounding_box.height() > 8.0;
    is_in_image.then(|| Detection {
        bounding_box,
        ..detection_of(label)
    })
}

fn detection_of(label: &str) -> Detection {
    let bounding_box = BoundingBox {
        x_min: 0.0,
        y_min: 0.0,
        x_max: 0.0,
        y_max: 0.0,
    };
    Detection {
        label: label.into(),
        confidence: 0.9,
        bounding_box,
        corners: None,
    }
}

/// Random kinds of objects at random places in view, with their true places.
struct Street {
    dice: ChaCha8Rng,
    height_m: f64,
}

impl Street {
    fn new(height_m: f64) -> Self {
        Self {
            dice: ChaCha8Rng::seed_from_u64(20),
            height_m,
        }
    }

    fn normal(&mut self) -> f64 {
        let u: f64 = self.dice.random();
        let v: f64 = self.dice.random();
        (-2.0 * (1.0 - u).ln()).sqrt() * (2.0 * PI * v).cos()
    }

    /// An object in view of a camera with this mount, its sizes varied as `spread` times its
    /// kind's.
    fn next(&mut self, mount: &Mount, spread: f64, max_range: f64) -> (Detection, Point2<f64>) {
        let kinds = kinds(self.height_m);
        loop {
            let (label, kind) = &kinds[self.dice.random_range(0..kinds.len())];
            let grown = 1.0 + spread * kind.relative_sigma * self.normal();
            let [width_m, height_m] = [kind.width_m, kind.height_m].map(|side| side * grown);
            let size = ObjectSize {
                width_m,
                height_m,
                length_m: kind.length_m.map(|side| side * grown),
                ..*kind
            };
            let range_m = self.height_m * self.dice.random_range(0.8..max_range);
            let bearing_rad = self.dice.random_range(-0.6..0.6);
            let yaw_rad = self.dice.random_range(0.0..PI);
            // Nearer, the unknown yaw counts more than the camera.
            if range_m < 2.0 * (size.width_m + size.length_m.unwrap()) {
                continue;
            }
            let at = Point2::new(
                range_m * f64::cos(bearing_rad),
                range_m * f64::sin(bearing_rad),
            );
            if let Some(detection) = seen(label, &size, at, yaw_rad, mount) {
                return (detection, at);
            }
        }
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn pixel_boxes_within_two_percent() {
    for (height_m, ranging) in HEIGHTS_M
        .into_iter()
        .flat_map(|h| [(h, Ranging::Ground), (h, Ranging::Auto)])
    {
        for pitch_deg in PITCHES_DEG {
            for roll_deg in [0.0, 6.0] {
                let mount = mount(height_m, pitch_deg, roll_deg);
                let mut street = Street::new(height_m);
                let config = ProjectionConfig {
                    pixel_sigma_px: 0.5,
                    tilt_sigma_rad: 1e-4,
                    ..ProjectionConfig::default()
                };
                let projection = projection(ranging, mount, &config);
                let mut errors = Vec::new();
                for _ in 0..400 {
                    let (mut detection, at) = street.next(&mount, 0.0, 20.0);
                    let b = &mut detection.bounding_box;
                    for edge in [&mut b.x_min, &mut b.y_min, &mut b.x_max, &mut b.y_max] {
                        *edge = edge.round();
                    }
                    let cut = projection.cut(&detection);
                    let placed = projection
                        .place(&detection, cut, None, &Pose::new(0.0, 0.0, 0.0))
                        .unwrap();
                    errors.push(offset_m(&placed, at) / at.coords.norm());
                }
                let error = median(errors);
                assert!(
                    error <= 0.02,
                    "{ranging:?} at {height_m} m, {pitch_deg}°, {roll_deg}°: {error:.4}"
                );
            }
        }
    }
}

/// The share of places within their 95 % ellipse, with every error as large as configured.
fn coverage(
    ranging: Ranging,
    height_m: f64,
    pitch_deg: f64,
    tilt_sigma_rad: f64,
    max_range: f64,
) -> f64 {
    let mut street = Street::new(height_m);
    let stated = mount(height_m, pitch_deg, 0.0);
    let config = ProjectionConfig {
        pixel_sigma_px: 2.0,
        tilt_sigma_rad,
        height_sigma_m: 0.02 * height_m,
        floor_m: 1e-4,
        ..ProjectionConfig::default()
    };
    let projection = projection(ranging, stated, &config);
    let mut covered = 0;
    let mut all = 0;
    for _ in 0..3000 {
        let mut off = |sigma: f64| sigma * street.normal();
        let mut real = stated;
        real.pitch_rad += off(tilt_sigma_rad);
        real.roll_rad += off(tilt_sigma_rad);
        real.height_m = real
            .height_m
            .map(|height_m| height_m + off(config.height_sigma_m));
        let pose = Pose::new(
            off(config.position_sigma_m),
            off(config.position_sigma_m),
            off(config.heading_sigma_rad),
        );
        let (mut detection, at) = street.next(&real, 1.0, max_range);
        let cut = projection.cut(&detection);
        let b = &mut detection.bounding_box;
        for edge in [&mut b.x_min, &mut b.y_min, &mut b.x_max, &mut b.y_max] {
            *edge += config.pixel_sigma_px * street.normal();
        }
        let Ok(placed) = projection.place(&detection, cut, None, &pose) else {
            continue;
        };
        let offset = Vector2::new(placed.x_m, placed.y_m) - at.coords;
        all += 1;
        covered += usize::from(
            placed
                .covariance()
                .unwrap()
                .mahalanobis_squared(&offset, 0.0)
                <= CHI_SQUARED_95,
        );
    }
    assert!(
        all > 2400,
        "{ranging:?} at {height_m} m, {pitch_deg}°: {all} of 3000 have a place"
    );
    f64::from(u32::try_from(covered).unwrap()) / f64::from(all)
}

#[test]
fn covariance_covers_95_percent() {
    for (height_m, ranging) in HEIGHTS_M
        .into_iter()
        .flat_map(|h| [(h, Ranging::Ground), (h, Ranging::Auto)])
    {
        for (tilt_deg, max_range) in [(0.1, 20.0), (1.0, 12.0)] {
            for pitch_deg in [0.0, 20.0, 45.0] {
                let share = coverage(
                    ranging,
                    height_m,
                    pitch_deg,
                    f64::to_radians(tilt_deg),
                    max_range,
                );
                println!(
                    "{ranging:?} at {height_m} m, {pitch_deg}°, tilt ± {tilt_deg}°: {share:.3}"
                );
                assert!(
                    (share - 0.95).abs() <= 0.03,
                    "{ranging:?} at {height_m} m, {pitch_deg}°, {tilt_deg}°: {share}"
                );
            }
        }
    }
}

/// A person of the usual size ahead of a camera.
fn person_ahead(range_m: f64, mount: &Mount) -> Detection {
    let (label, size) = kinds(1.2)[0];
    seen(label, &size, Point2::new(range_m, 0.0), 0.4, mount).unwrap()
}

fn range_m(projection: &Projection, detection: &Detection) -> Result<f64, ProjectionError> {
    let placed = projection.place(
        detection,
        projection.cut(detection),
        None,
        &Pose::new(0.0, 0.0, 0.0),
    )?;
    Ok(placed.x_m.hypot(placed.y_m))
}

#[test]
fn cut_off_person_is_placed() {
    let mount = mount(1.2, 5.0, 0.0);
    let both = projection(Ranging::Auto, mount, &ProjectionConfig::default());
    let whole = person_ahead(6.0, &mount);
    for (name, bounds, tolerance_m) in [
        (
            "no feet",
            BoundingBox {
                y_max: 720.0,
                ..whole.bounding_box
            },
            1.0,
        ),
        (
            "no head",
            BoundingBox {
                y_min: 0.0,
                ..whole.bounding_box
            },
            0.3,
        ),
    ] {
        let cut = Detection {
            bounding_box: bounds,
            ..whole.clone()
        };
        let found = range_m(&both, &cut).unwrap();
        assert!((found - 6.0).abs() < tolerance_m, "{name}: {found}");
    }
    let neither = BoundingBox {
        y_min: 0.0,
        y_max: 720.0,
        ..whole.bounding_box
    };
    let neither = Detection {
        bounding_box: neither,
        ..whole.clone()
    };
    let by_width = range_m(&both, &neither).unwrap();
    assert!((by_width - 6.0).abs() < 1.5, "{by_width}");
    let nothing = BoundingBox {
        x_min: 0.0,
        ..neither.bounding_box
    };
    let nothing = Detection {
        bounding_box: nothing,
        ..neither
    };
    assert_eq!(range_m(&both, &nothing).unwrap_err().as_str(), "clipped");
    let ground = projection(Ranging::Ground, mount, &ProjectionConfig::default());
    let no_feet = Detection {
        bounding_box: BoundingBox {
            y_max: 720.0,
            ..whole.bounding_box
        },
        ..whole
    };
    assert_eq!(range_m(&ground, &no_feet).unwrap_err().as_str(), "clipped");
}

#[test]
fn horizon_foot_is_ranged_by_height() {
    let mount = mount(1.2, 5.0, 0.0);
    let person = person_ahead(9.0, &mount);
    let horizon_px = camera().cy - camera().fy * 5f64.to_radians().tan();
    let height_px = person.bounding_box.height();
    for above_px in [2.0, 12.0] {
        let y_max = horizon_px - above_px;
        let bounding_box = BoundingBox {
            y_min: y_max - height_px,
            y_max,
            ..person.bounding_box
        };
        let raised = Detection {
            bounding_box,
            ..person.clone()
        };
        let ground = projection(Ranging::Ground, mount, &ProjectionConfig::default());
        assert_eq!(
            range_m(&ground, &raised).unwrap_err().as_str(),
            "above_horizon"
        );
        let both = projection(Ranging::Auto, mount, &ProjectionConfig::default());
        let found = range_m(&both, &raised).unwrap();
        assert!((found - 9.0).abs() < 0.9, "{found}");
    }
    let unknown = Detection {
        label: "QR1".into(),
        ..person_ahead(9.0, &mount)
    };
    let ground = projection(Ranging::Ground, mount, &ProjectionConfig::default());
    assert!(
        (range_m(&ground, &unknown).unwrap() - 9.0).abs() < 0.3,
        "the ground needs no size"
    );
}

#[test]
fn person_on_platform_uses_height() {
    let mount = mount(1.2, 5.0, 0.0);
    let config = ProjectionConfig {
        tilt_sigma_rad: 0.005,
        ..ProjectionConfig::default()
    };
    let both = projection(Ranging::Auto, mount, &config);
    let ground = projection(Ranging::Ground, mount, &config);
    let (label, size) = kinds(1.2)[0];
    for (raised_m, ground_error_m) in [(0.6, 4.0), (0.05, 0.2)] {
        // Seen from as much lower.
        let lower = Mount {
            height_m: Some(1.2 - raised_m),
            ..mount
        };
        let detection = seen(label, &size, Point2::new(6.0, 0.0), 0.4, &lower).unwrap();
        assert!(range_m(&ground, &detection).unwrap() > 6.0 + ground_error_m);
        let found = range_m(&both, &detection).unwrap();
        assert!((found - 6.0).abs() < 0.25, "{raised_m} m: {found}");
    }
}

#[test]
fn corners_ignore_ground_ranging() {
    let config = ProjectionConfig::default();
    let level = projection(Ranging::Auto, Mount::default(), &config);
    let by_height = projection(Ranging::BoxHeight, Mount::default(), &config);
    let person = person_ahead(6.0, &mount(1.2, 5.0, 0.0));
    let pose = Pose::new(1.0, 2.0, 0.3);
    let place =
        |projection: &Projection| projection.place(&person, projection.cut(&person), None, &pose);
    assert_eq!(place(&level), place(&by_height));
    let target = Point3::new(0.3, 0.2, 4.0);
    let posed = projection(Ranging::Auto, mount(1.2, 0.0, 0.0), &config);
    let corners = projection(Ranging::Corners, Mount::default(), &config);
    let place =
        |projection: &Projection| projection.place(&person, Cut::default(), Some(&target), &pose);
    assert_eq!(place(&posed), place(&corners));
}

#[test]
fn tilted_camera_ranges_objects_and_corners() {
    let tilted = Mount {
        height_m: None,
        ..mount(1.2, 8.0, 5.0)
    };
    let (label, size) = kinds(1.2)[0];
    let at = Point2::new(6.0, -0.5);
    let detection = seen(label, &size, at, 0.0, &mount(1.2, 8.0, 5.0)).unwrap();
    let by_height = projection(Ranging::BoxHeight, tilted, &ProjectionConfig::default());
    let found = range_m(&by_height, &detection).unwrap();
    assert!((found - at.coords.norm()).abs() < 0.3, "{found}");
    let level = Vector3::new(at.x, at.y, -0.4);
    let target = Point3::from(tilted.to_level().transpose() * level);
    let corners = projection(Ranging::Corners, tilted, &ProjectionConfig::default());
    let placed = corners
        .place(
            &detection,
            Cut::default(),
            Some(&target),
            &Pose::new(0.0, 0.0, 0.0),
        )
        .unwrap();
    assert!(offset_m(&placed, at) < 1e-9);
}

/// The angle found from a minute of the street, with a box each half second, for a camera that is
/// mounted differently than stated.
fn measured_turn_rad(mounted: &Mount, said: Mount) -> Option<f64> {
    let mut street = Street::new(said.height_m.unwrap());
    let projection = projection(
        Ranging::Auto,
        said,
        &ProjectionConfig {
            pixel_sigma_px: 2.0,
            ..ProjectionConfig::default()
        },
    );
    let mut check = MountCheck::default();
    let mut found_rad = None;
    for half_seconds in 0..120 {
        let (mut detection, _) = street.next(mounted, 1.0, 10.0);
        detection.bounding_box.y_max += 2.0 * street.normal();
        let boxes = [(&detection, projection.cut(&detection))];
        found_rad = check.add(
            boxes,
            Timestamp::default() + Duration::from_millis(500 * half_seconds),
            &projection,
        );
    }
    found_rad
}

#[test]
fn turned_camera_is_detected() {
    for (height_m, pitch_deg) in [(1.2, 0.0), (1.2, 10.0), (2.5, 10.0), (6.0, 20.0)] {
        let said = mount(height_m, pitch_deg, 0.0);
        for turned_deg in [-8.0, -5.0, 5.0, 8.0] {
            let off_rad = measured_turn_rad(&mount(height_m, pitch_deg - turned_deg, 0.0), said);
            let off_deg = off_rad.map(f64::to_degrees);
            assert!(
                off_deg.is_some_and(|off_deg| (off_deg - turned_deg).abs() < 1.0),
                "{height_m} m, {pitch_deg}° turned by {turned_deg}°: {off_deg:?}"
            );
        }
        for turned_deg in [-1.5, 0.0, 1.5] {
            let off_rad = measured_turn_rad(&mount(height_m, pitch_deg - turned_deg, 1.5), said);
            assert_eq!(
                off_rad, None,
                "{height_m} m, {pitch_deg}° turned by {turned_deg}°"
            );
        }
    }
}

#[test]
fn turned_camera_is_detected_in_crowd() {
    let mounted = mount(1.5, -6.0, 0.0);
    let said = mount(1.5, 0.0, 0.0);
    let mut street = Street::new(1.5);
    let mut check = MountCheck::default();
    let mut found_rad = None;
    let projection = projection(Ranging::Auto, said, &ProjectionConfig::default());
    for half_seconds in 0..40 {
        let crowd: Vec<_> = (0..20)
            .map(|_| street.next(&mounted, 1.0, 10.0).0)
            .collect();
        let boxes = crowd
            .iter()
            .map(|detection| (detection, projection.cut(detection)));
        found_rad = check.add(
            boxes,
            Timestamp::default() + Duration::from_millis(500 * half_seconds),
            &projection,
        );
    }
    let off_deg = found_rad.map(f64::to_degrees);
    assert!(
        off_deg.is_some_and(|off_deg| (off_deg - 6.0).abs() < 1.0),
        "{off_deg:?}"
    );
}

#[test]
fn hanging_objects_indicate_no_turn() {
    let projection = projection(
        Ranging::Auto,
        mount(1.5, 0.0, 0.0),
        &ProjectionConfig::default(),
    );
    let lamp = ObjectSizes::default().of("traffic light").copied().unwrap();
    let above = Mount {
        height_m: Some(1.5 - 4.0),
        ..Mount::default()
    };
    let mut check = MountCheck::default();
    for seconds in 0..60u32 {
        let at = Point2::new(16.0 + f64::from(seconds % 8), 1.0);
        let hanging = seen("traffic light", &lamp, at, 0.0, &above).unwrap();
        let found_rad = check.add(
            [(&hanging, Cut::default())],
            Timestamp::default() + Duration::from_secs(seconds.into()),
            &projection,
        );
        assert_eq!(found_rad, None);
    }
}

#[test]
fn raised_objects_indicate_no_turn() {
    let projection = projection(
        Ranging::Auto,
        mount(1.2, 0.0, 0.0),
        &ProjectionConfig::default(),
    );
    let mut check = MountCheck::default();
    let hanging = Detection {
        bounding_box: moved(&person_ahead(8.0, &mount(1.2, 0.0, 0.0)), -80.0),
        ..detection_of("person")
    };
    for seconds in 0..60u32 {
        let found_rad = check.add(
            [(&hanging, Cut::default())],
            Timestamp::default() + Duration::from_secs(seconds.into()),
            &projection,
        );
        assert_eq!(found_rad, None);
    }
}

fn moved(detection: &Detection, down_px: f64) -> BoundingBox {
    let BoundingBox {
        x_min,
        y_min,
        x_max,
        y_max,
    } = detection.bounding_box;
    BoundingBox {
        x_min,
        y_min: y_min + down_px,
        x_max,
        y_max: y_max + down_px,
    }
}
