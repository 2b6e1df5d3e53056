//! Generated scenes: observers with each mistake, and right observers where scenes are symmetric.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI, TAU};

use nalgebra::{Point2, Vector2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::aggregator::{Aggregator, Algorithms, FusionConfig};
use crate::model::geometry::Pose;
use crate::wire::{PerceivedObject, ReportKind, WirePose};

const START: Timestamp = Timestamp(1_732_154_400_000_000);

/// An object that moves along a straight line or stands.
#[derive(Debug, Clone, Copy)]
struct Body {
    start: Point2<f64>,
    velocity: Vector2<f64>,
    /// Where the line begins again, metres from its start; infinite for standing objects.
    length_m: f64,
}

impl Body {
    fn standing(x_m: f64, y_m: f64) -> Self {
        Self {
            start: Point2::new(x_m, y_m),
            velocity: Vector2::zeros(),
            length_m: f64::INFINITY,
        }
    }

    fn at(&self, seconds: f64) -> Point2<f64> {
        let speed = self.velocity.norm();
        if speed == 0.0 {
            return self.start;
        }
        let passed_m = (speed * seconds) % self.length_m;
        self.start + self.velocity / speed * passed_m
    }
}

/// A camera with its true pose, a field of view of 80°, and the mistake of its operator.
#[derive(Debug, Clone, Copy)]
struct Camera {
    name: &'static str,
    pose: Pose,
    range_m: f64,
    mistake: Option<Mistake>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Mistake {
    CompassHeading,
    HeadingOff(f64),
    RadiansAsDegrees,
    MirroredImage,
    ExchangedAxes,
    DownwardY,
}

impl Camera {
    fn new(name: &'static str, x_m: f64, y_m: f64, heading_rad: f64) -> Self {
        Self {
            name,
            pose: Pose::new(x_m, y_m, heading_rad),
            range_m: 60.0,
            mistake: None,
        }
    }

    fn with(self, mistake: Mistake) -> Self {
        Self {
            mistake: Some(mistake),
            ..self
        }
    }

    fn report(
        &self,
        bodies: &[Point2<f64>],
        seq: u64,
        at: Timestamp,
        rng: &mut ChaCha8Rng,
    ) -> ObjectReport {
        let mut noise = |range_m: f64| {
            let sigma_m = 0.15 + 0.01 * range_m;
            sigma_m * (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>()
        };
        let heading_rad = self.pose.heading_rad;
        let stated = match self.mistake {
            Some(Mistake::CompassHeading) => FRAC_PI_2 - heading_rad,
            Some(Mistake::HeadingOff(off_rad)) => heading_rad + off_rad,
            Some(Mistake::RadiansAsDegrees) => heading_rad.to_radians(),
            _ => heading_rad,
        };
        let stated = Pose {
            heading_rad: stated,
            ..self.pose
        };
        let in_frame = |point: Point2<f64>| match self.mistake {
            Some(Mistake::ExchangedAxes) => Point2::new(point.y, point.x),
            Some(Mistake::DownwardY) => Point2::new(point.x, -point.y),
            _ => point,
        };
        let seen = bodies.iter().filter_map(|body| {
            let (range_m, bearing_rad) = self.pose.range_bearing(body);
            let is_seen = range_m < self.range_m && bearing_rad.abs() < 40_f64.to_radians();
            is_seen.then(|| {
                let mut place = self.pose.ahead_left(body);
                place += Vector2::new(noise(range_m), noise(range_m));
                if self.mistake == Some(Mistake::MirroredImage) {
                    place.y = -place.y;
                }
                let place = in_frame(stated.transform(place.x, place.y));
                PerceivedObject::new("car", 0.9, place.x, place.y)
            })
        });
        let objects = seen.collect();
        let heading_rad = match self.mistake {
            Some(Mistake::ExchangedAxes) => FRAC_PI_2 - heading_rad,
            Some(Mistake::DownwardY) => -heading_rad,
            _ => stated.heading_rad,
        };
        let place = in_frame(stated.position);
        ObjectReport {
            pose: Some(WirePose::new(
                place.x,
                place.y,
                crate::model::geometry::wrap_angle(heading_rad),
            )),
            objects,
            ..ObjectReport::new(NodeName::from_static(self.name), seq, at)
        }
    }
}

/// Runs cameras of ten reports a second over moving objects; returns the mistakes that were found,
/// by camera.
fn found(
    cameras: &[Camera],
    seconds: u64,
    rng: &mut ChaCha8Rng,
    bodies: impl Fn(f64) -> Vec<Point2<f64>>,
) -> BTreeMap<&'static str, String> {
    let mut orientation = OrientationCheck::default();
    let mut found = BTreeMap::new();
    for number in 0..10 * seconds {
        for (order, camera) in cameras.iter().enumerate() {
            let passed_us = number * 100_000 + 17_000 * order as u64;
            let at = Timestamp(START.0 + passed_us);
            let report = camera.report(&bodies(passed_us as f64 * 1e-6), number, at, rng);
            orientation.observe(&Arc::new(report), at);
            if let Some(misreading) =
                orientation.misreading(&NodeName::from_static(camera.name), at)
            {
                found.insert(camera.name, misreading.to_string());
            }
        }
    }
    found
}

/// Traffic on both roads of a crossing, with people on its corners.
fn crossing(rng: &mut ChaCha8Rng) -> Vec<Body> {
    let mut bodies = Vec::new();
    for direction in 0..4 {
        let along = Vector2::new(
            (FRAC_PI_2 * f64::from(direction)).cos(),
            (FRAC_PI_2 * f64::from(direction)).sin(),
        );
        let right = Vector2::new(along.y, -along.x);
        for _ in 0..6 {
            let speed = rng.random_range(6.0..12.0);
            bodies.push(Body {
                start: Point2::from(right * 2.0 - along * rng.random_range(80.0..180.0)),
                velocity: along * speed,
                length_m: 200.0,
            });
        }
        for _ in 0..2 {
            let direction = rng.random_range(0.0..TAU);
            bodies.push(Body {
                start: Point2::from(
                    along * rng.random_range(6.0..14.0) + right * rng.random_range(6.0..14.0),
                ),
                velocity: Vector2::new(f64::cos(direction), f64::sin(direction)) * 1.2,
                length_m: 12.0,
            });
        }
    }
    bodies
}

fn places(bodies: &[Body], seconds: f64) -> Vec<Point2<f64>> {
    bodies.iter().map(|body| body.at(seconds)).collect()
}

/// Three cameras on corners of a crossing that all see its middle.
fn corners() -> [Camera; 3] {
    [
        Camera::new("euclid", -20.0, -18.0, FRAC_PI_4),
        Camera::new("gauss", 22.0, -16.0, 2.5),
        Camera::new("watson", 4.0, 24.0, -1.7),
    ]
}

fn found_at_crossing(cameras: &[Camera], seed: u64) -> BTreeMap<&'static str, String> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let bodies = crossing(&mut rng);
    found(cameras, 120, &mut rng, |seconds| places(&bodies, seconds))
}

#[test]
fn each_mistake_is_named() {
    let agree = "its objects agree with the objects of euclid and gauss ";
    for (mistake, words) in [
        (
            Mistake::CompassHeading,
            "after a turn by about 75° at its position, as if its heading were clockwise from north",
        ),
        (
            Mistake::HeadingOff(PI),
            "after a turn by about 180° at its position",
        ),
        (
            Mistake::HeadingOff(FRAC_PI_2),
            "after a turn by about -90° at its position",
        ),
        (
            Mistake::HeadingOff(0.6),
            "after a turn by about -35° at its position",
        ),
        (
            Mistake::RadiansAsDegrees,
            "as if its heading were radians in place of degrees",
        ),
        (
            Mistake::MirroredImage,
            "if left and right of its image are swapped",
        ),
        (
            Mistake::ExchangedAxes,
            "if x and y are exchanged in its pose and positions",
        ),
        (
            Mistake::DownwardY,
            "if y is negated in its pose and positions",
        ),
    ] {
        for seed in 0..4 {
            let [euclid, gauss, watson] = corners();
            let found = found_at_crossing(&[euclid, gauss, watson.with(mistake)], seed);
            let text = found.get("watson").expect("the mistake is found");
            assert!(text.starts_with(agree), "{text}");
            assert!(text.contains(words), "{mistake:?}: {text}");
            assert_eq!(found.len(), 1, "{found:?}");
        }
    }
}

#[test]
fn mistake_of_all_is_named() {
    for (mistake, words) in [
        (
            Mistake::CompassHeading,
            "as if all headings were clockwise from north",
        ),
        (
            Mistake::MirroredImage,
            "if left and right of all images are swapped",
        ),
        (
            Mistake::HeadingOff(-FRAC_PI_2),
            "after a turn of all headings by 90°",
        ),
    ] {
        let cameras = corners().map(|camera| camera.with(mistake));
        let found = found_at_crossing(&cameras, 1);
        assert!(
            found.values().any(|text| text.contains(words)),
            "{mistake:?}: {found:?}"
        );
    }
}

/// A turn about one camera explains the other only if both stand together.
#[test]
fn two_cameras_name_only_turned_one() {
    let [euclid, _, watson] = corners();
    let turned = watson.with(Mistake::HeadingOff(FRAC_PI_2));
    let found = found_at_crossing(&[euclid, turned], 1);
    let text = "its objects agree with the objects of euclid after a turn by about -90° at its position; if its \
        pose and camera are right, check euclid";
    assert_eq!(found, BTreeMap::from([("watson", text.to_owned())]));
}

/// A change of the frame explains both cameras alike.
#[test]
fn two_cameras_with_other_axes_are_named() {
    let [euclid, _, watson] = corners();
    for (mistake, words) in [
        (Mistake::ExchangedAxes, "x and y are exchanged"),
        (Mistake::DownwardY, "y is negated"),
    ] {
        let found = found_at_crossing(&[euclid, watson.with(mistake)], 1);
        let text = |other: &str| {
            format!(
                "its objects agree with the objects of {other} if {words} in its pose and positions; if its axes are \
                 right, check {other}"
            )
        };
        let of_both = [("euclid", text("watson")), ("watson", text("euclid"))];
        assert_eq!(found, BTreeMap::from(of_both));
    }
}

/// People who walk about in a yard, at other places and paces for each seed.
fn walkers(people: u32, rng: &mut ChaCha8Rng) -> impl Fn(f64) -> Vec<Point2<f64>> + use<> {
    let paths: Vec<_> = (0..people)
        .map(|_| {
            let mut number = |range: std::ops::Range<f64>| rng.random_range(range);
            let reach_m = Vector2::new(number(4.0..8.0), number(4.0..8.0));
            let rates = Vector2::new(number(0.1..0.2), number(0.1..0.2));
            let phases = Vector2::new(number(0.0..TAU), number(0.0..TAU));
            (reach_m, rates, phases)
        })
        .collect();
    move |seconds| {
        let place = |(reach_m, rates, phases): &(Vector2<f64>, Vector2<f64>, Vector2<f64>)| {
            let angles = rates * seconds + phases;
            Point2::from(angles.map(f64::sin).component_mul(reach_m))
        };
        paths.iter().map(place).collect()
    }
}

/// One or two people walk before two cameras, as on the day on which these are mounted.
#[test]
fn mistake_shows_by_walking_person() {
    let euclid = Camera::new("euclid", -12.0, -10.0, FRAC_PI_4);
    let watson = Camera::new("watson", 3.0, 14.0, -1.7);
    for (mistake, words) in [
        (
            Mistake::CompassHeading,
            "as if its heading were clockwise from north",
        ),
        (
            Mistake::HeadingOff(PI),
            "after a turn by about 180° at its position",
        ),
        (
            Mistake::MirroredImage,
            "if left and right of its image are swapped",
        ),
    ] {
        for (seed, people) in [(0, 1), (1, 1), (2, 2), (3, 3)] {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let bodies = walkers(people, &mut rng);
            let found = found(&[euclid, watson.with(mistake)], 300, &mut rng, bodies);
            let text = found.get("watson").map_or("", |text| text);
            assert!(text.contains(words), "{mistake:?}, {seed}: {found:?}");
            assert_eq!(found.len(), 1, "{found:?}");
        }
    }
}

/// Right cameras with the same people in view, and with other people in each view.
#[test]
fn walking_people_accuse_no_right_camera() {
    for seed in 0..12 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let people = 1 + seed as u32 % 3;
        let bodies = walkers(people, &mut rng);
        let found_here = found(&corners(), 300, &mut rng, bodies);
        assert_eq!(found_here, BTreeMap::new(), "{seed}");
        let (here, there) = (walkers(people, &mut rng), walkers(people, &mut rng));
        let apart = Vector2::new(60.0, 0.0);
        let cameras = [
            Camera::new("euclid", -20.0, -6.0, 0.3),
            Camera::new("gauss", 78.0, 8.0, -2.7),
        ];
        let found_apart = found(&cameras, 600, &mut rng, |seconds| {
            let there = there(seconds).into_iter().map(|place| place + apart);
            here(seconds).into_iter().chain(there).collect()
        });
        assert_eq!(found_apart, BTreeMap::new(), "{seed}");
    }
}

/// Single cars on both sides of a narrow or a wide road, and cameras that look both ways.
#[test]
fn sparse_traffic_accuses_no_right_camera() {
    for seed in 0..12 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let side_m = if seed % 2 == 0 { 1.8 } else { 5.4 };
        let bodies: Vec<_> = [-1.0, 1.0, -1.0, 1.0]
            .into_iter()
            .map(|direction| Body {
                start: Point2::new(
                    -direction * rng.random_range(80.0..200.0),
                    -side_m * direction,
                ),
                velocity: Vector2::new(direction * rng.random_range(12.0..14.0), 0.0),
                length_m: 400.0,
            })
            .collect();
        let cameras = [
            Camera::new("ahead", 25.0, 6.0, -0.1),
            Camera::new("behind", -25.0, -6.0, PI - 0.1),
        ];
        let found = found(&cameras, 600, &mut rng, |seconds| places(&bodies, seconds));
        assert_eq!(found, BTreeMap::new(), "{seed}");
    }
}

/// Right cameras on opposite corners of a crossing whose arms look alike, each with a view of
/// another arm: a change of the frame would exchange the arms.
#[test]
fn alike_corners_are_not_confused() {
    for seed in 0..6 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let bodies = crossing(&mut rng);
        let cameras = [
            ("east", 14.0, 14.0, -0.2),
            ("north", -14.0, 14.0, FRAC_PI_2 - 0.2),
            ("west", -14.0, -14.0, PI - 0.2),
            ("south", 14.0, -14.0, -FRAC_PI_2 - 0.2),
        ]
        .map(|(name, x_m, y_m, heading_rad)| Camera::new(name, x_m, y_m, heading_rad));
        let found = found(&cameras, 300, &mut rng, |seconds| places(&bodies, seconds));
        assert_eq!(found, BTreeMap::new(), "{seed}");
    }
}

/// A malicious vehicle reports the objects of a right camera turned about the camera's position.
#[test]
fn false_reports_accuse_no_vehicle_alone() {
    let [euclid, _, watson] = corners();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let bodies = crossing(&mut rng);
    let mut orientation = OrientationCheck::default();
    let mut found = None;
    for number in 0..1000 {
        let at = Timestamp(START.0 + number * 100_000);
        let report = watson.report(&places(&bodies, number as f64 * 0.1), number, at, &mut rng);
        let mut copied = report.clone();
        copied.node = NodeName::from_static("mallory");
        copied.pose = Some(euclid.pose.into());
        for object in &mut copied.objects {
            let [east_m, north_m] = [
                object.x_m - watson.pose.position.x,
                object.y_m - watson.pose.position.y,
            ];
            object.x_m = watson.pose.position.x - north_m;
            object.y_m = watson.pose.position.y + east_m;
        }
        for report in [report, copied] {
            orientation.observe(&Arc::new(report), at);
        }
        let misreading = orientation.misreading(&NodeName::from_static("watson"), at);
        found = misreading.map(ToString::to_string).or(found);
    }
    let text = found.unwrap_or_default();
    assert!(
        text.ends_with("if its pose and camera are right, check mallory"),
        "{text}"
    );
}

/// A camera in another street has no objects that could confirm or contradict the turn.
#[test]
fn unrelated_camera_hinders_no_naming() {
    let [euclid, _, watson] = corners();
    let turned = watson.with(Mistake::HeadingOff(FRAC_PI_2));
    let elsewhere = Camera::new("noether", 320.0, 300.0, FRAC_PI_4);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let bodies = crossing(&mut rng);
    let found = found(&[euclid, turned, elsewhere], 120, &mut rng, |seconds| {
        let here = places(&bodies, seconds);
        let there = here.iter().map(|place| place + Vector2::new(330.0, 310.0));
        here.iter().copied().chain(there).collect()
    });
    assert_eq!(found.keys().collect::<Vec<_>>(), [&"watson"], "{found:?}");
}

/// Sixteen parts of a vehicle repeat the objects of a right camera, turned about its position.
#[test]
fn parts_are_one_witness() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let bodies = crossing(&mut rng);
    let mut orientation = OrientationCheck::default();
    for number in 0..1000 {
        let at = Timestamp(START.0 + number * 100_000);
        let places = places(&bodies, number as f64 * 0.1);
        let reports = corners().map(|camera| camera.report(&places, number, at, &mut rng));
        for part in 0..16 {
            let mut repeated = reports[2].clone();
            repeated.node = NodeName::new(format!("noether--{part}")).unwrap();
            let centre = repeated.pose.unwrap();
            for object in &mut repeated.objects {
                let east_m = object.x_m - centre.x_m;
                let north_m = object.y_m - centre.y_m;
                object.x_m = centre.x_m - north_m;
                object.y_m = centre.y_m + east_m;
            }
            orientation.observe(&Arc::new(repeated), at);
        }
        for report in reports {
            let report = Arc::new(report);
            orientation.observe(&report, at);
            assert_eq!(orientation.misreading(&report.node, at), None);
        }
    }
}

/// Right observers, also with the errors of their poses that localisation has.
#[test]
fn right_observers_are_not_named() {
    for seed in 0..6 {
        assert_eq!(found_at_crossing(&corners(), seed), BTreeMap::new());
        let [euclid, gauss, watson] = corners();
        let off = 3_f64.to_radians();
        let euclid = euclid.with(Mistake::HeadingOff(off));
        let watson = watson.with(Mistake::HeadingOff(-off));
        let found = found_at_crossing(&[euclid, gauss, watson], seed);
        assert_eq!(found, BTreeMap::new());
    }
}

/// Cameras on one mast, each with a view of one arm, where all arms look alike.
fn mast() -> [Camera; 4] {
    [
        ("east", 0.0),
        ("north", FRAC_PI_2),
        ("west", PI),
        ("south", -FRAC_PI_2),
    ]
    .map(|(name, heading_rad)| Camera::new(name, 0.0, 0.0, heading_rad))
}

#[test]
fn alike_arms_are_not_confused() {
    for seed in 0..6 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let bodies = crossing(&mut rng);
        let found = found(&mast(), 300, &mut rng, |seconds| places(&bodies, seconds));
        assert_eq!(found, BTreeMap::new(), "{seed}");
    }
}

/// Queues before red lights, which begin at equal distances and have nearly equal gaps.
#[test]
fn alike_queues_are_not_confused() {
    for seed in 0..6 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut bodies = Vec::new();
        for arm in 0..4 {
            let (sin, cos) = (FRAC_PI_2 * f64::from(arm)).sin_cos();
            for lane in [2.0, 5.5] {
                let mut along = 12.0;
                for _ in 0..6 {
                    bodies.push(Body::standing(
                        cos * along - sin * lane,
                        sin * along + cos * lane,
                    ));
                    along += rng.random_range(6.5..8.5);
                }
            }
        }
        let found = found(&mast(), 120, &mut rng, |seconds| places(&bodies, seconds));
        assert_eq!(found, BTreeMap::new(), "{seed}");
    }
}

/// Rows of parked cars on both sides of an aisle, with cameras that look both ways.
#[test]
fn alike_rows_are_not_confused() {
    for seed in 0..6 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut bodies = Vec::new();
        for bay in -16..=16 {
            for row in [-6.0, 6.0] {
                if rng.random_bool(0.7) {
                    bodies.push(Body::standing(f64::from(bay) * 2.5, row));
                }
            }
        }
        let cameras = [
            Camera::new("ahead", 1.0, 0.5, 0.0),
            Camera::new("behind", -3.0, -0.5, PI),
        ];
        let found = found(&cameras, 120, &mut rng, |seconds| places(&bodies, seconds));
        assert_eq!(found, BTreeMap::new(), "{seed}");
    }
}

/// Two lanes of free traffic, and cameras beside the road that look both ways.
#[test]
fn alike_lanes_are_not_confused() {
    for seed in 0..6 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut bodies = Vec::new();
        for direction in [-1.0, 1.0] {
            let speed = rng.random_range(12.0..15.0);
            for _ in 0..12 {
                bodies.push(Body {
                    start: Point2::new(
                        -direction * rng.random_range(100.0..300.0),
                        -1.8 * direction,
                    ),
                    velocity: Vector2::new(direction * (speed + rng.random_range(-1.0..1.0)), 0.0),
                    length_m: 400.0,
                });
            }
        }
        let cameras = [
            Camera::new("ahead", 2.0, 6.0, -0.1),
            Camera::new("behind", -2.0, -6.0, PI - 0.1),
        ];
        let found = found(&cameras, 600, &mut rng, |seconds| places(&bodies, seconds));
        assert_eq!(found, BTreeMap::new(), "{seed}");
    }
}

/// Vehicles that drive in platoons on both lanes of a straight road and see ahead or behind.
#[test]
fn alike_platoons_are_not_confused() {
    for seed in 0..6 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut bodies = Vec::new();
        for direction in [-1.0, 1.0] {
            let mut along_m = 0.0;
            for _ in 0..16 {
                along_m += rng.random_range(9.0..20.0);
                bodies.push(Body {
                    start: Point2::new(-direction * along_m, -1.8 * direction),
                    velocity: Vector2::new(13.0 * direction, 0.0),
                    length_m: 250.0,
                });
            }
        }
        let mut orientation = OrientationCheck::default();
        for number in 0..3000_u64 {
            let at = Timestamp(START.0 + number * 100_000);
            let places = places(&bodies, number as f64 * 0.1);
            for (name, vehicle, heading_rad) in [
                ("euclid", 3, PI),
                ("gauss", 9, 0.0),
                ("kepler", 19, 0.0),
                ("watson", 26, PI),
            ] {
                let own = places[vehicle];
                let others: Vec<_> = places
                    .iter()
                    .copied()
                    .filter(|place| *place != own)
                    .collect();
                let camera = Camera::new(name, own.x, own.y, heading_rad);
                let report = camera.report(&others, number, at, &mut rng);
                orientation.observe(&Arc::new(report), at);
                let found = orientation.misreading(&NodeName::from_static(name), at);
                assert_eq!(found, None, "{name}, {seed}");
            }
        }
    }
}

/// A vehicle that turns a corner with its heading by compass: the angle changes, the mistake does
/// not.
#[test]
fn mistake_of_moving_vehicle_is_named() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let bodies = crossing(&mut rng);
    let mut orientation = OrientationCheck::default();
    let mut found = None;
    for number in 0..1200_u64 {
        let at = Timestamp(START.0 + number * 100_000);
        let places = places(&bodies, number as f64 * 0.1);
        let leg = number / 150 % 2;
        let along = (number % 150) as f64 * 0.05;
        let pose = if leg == 0 {
            Pose::new(-24.0 + along, -6.0, 0.0)
        } else {
            Pose::new(-6.0, -24.0 + along, FRAC_PI_2)
        };
        let vehicle = Camera {
            pose,
            ..Camera::new("watson", 0.0, 0.0, 0.0).with(Mistake::CompassHeading)
        };
        for camera in corners().into_iter().take(2).chain([vehicle]) {
            let report = camera.report(&places, number, at, &mut rng);
            orientation.observe(&Arc::new(report), at);
        }
        let misreading = orientation.misreading(&NodeName::from_static("watson"), at);
        found = misreading.map(ToString::to_string).or(found);
    }
    let text = found.expect("the mistake is found");
    assert!(
        text.contains("as if its heading were clockwise from north"),
        "{text}"
    );
}

/// Reports to the aggregator of a cell that maps, and of a cell that only votes.
#[test]
fn every_algorithm_doubts_compass_heading() {
    for (algorithms, kind) in [
        (Algorithms::Pace, ReportKind::Detections),
        (Algorithms::Vote, ReportKind::VoteDetections),
    ] {
        let config = FusionConfig {
            algorithms,
            ..FusionConfig::default()
        };
        let edge = NodeName::from_static("edge");
        let mut cell = Aggregator::new(edge, 7, config, Vec::new(), START);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let bodies = crossing(&mut rng);
        let [euclid, gauss, watson] = corners();
        let cameras = [euclid, gauss, watson.with(Mistake::CompassHeading)];
        let mut doubts = BTreeMap::new();
        for number in 0..600 {
            let at = Timestamp(START.0 + number * 100_000);
            let places = places(&bodies, number as f64 * 0.1);
            for camera in &cameras {
                let report = Arc::new(camera.report(&places, number, at, &mut rng));
                cell.report(kind, &report, at).expect("a report is used");
                let texts = cell.doubts(kind, &report, at);
                doubts.extend(texts.map(|doubt| (camera.name, doubt.to_string())));
            }
        }
        assert_eq!(doubts.keys().collect::<Vec<_>>(), [&"watson"], "{doubts:?}");
        let text = &doubts["watson"];
        assert!(
            text.ends_with("as if its heading were clockwise from north"),
            "{text}"
        );
    }
}
