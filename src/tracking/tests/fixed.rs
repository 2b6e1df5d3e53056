//! Fixed cameras, and the common error of all observers.

use super::*;

/// A camera: its position, and the error of its position and rotation.
struct Camera {
    node: String,
    place: Vector2<f64>,
    offset: Vector2<f64>,
    turned_rad: f64,
    is_posed: bool,
}

impl Camera {
    /// Cameras around a square, each with an error of some decimetres.
    fn around(count: usize, is_posed: bool, rng: &mut ChaCha8Rng) -> Vec<Self> {
        let camera = |n: usize| {
            let (sin, cos) = (n as f64 * std::f64::consts::TAU / count as f64 + 0.6).sin_cos();
            let place = Vector2::new(cos, sin) * 15.0;
            let offset = Vector2::new(noise(rng, 0.5), noise(rng, 0.5));
            Self {
                node: format!("camera-{n}"),
                place,
                offset,
                turned_rad: noise(rng, 0.01),
                is_posed,
            }
        };
        (0..count).map(camera).collect()
    }

    /// A report of the detected people, nine in ten.
    fn report(&self, frame: u64, people: &[Vector2<f64>], rng: &mut ChaCha8Rng) -> ObjectReport {
        let turned = nalgebra::Rotation2::new(self.turned_rad);
        let mut objects = Vec::new();
        for person in people {
            let seen = self.place + self.offset + turned * (person - self.place);
            let x_m = seen.x + noise(rng, 0.3);
            let y_m = seen.y + noise(rng, 0.3);
            if rng.random_bool(0.9) {
                objects.push(PerceivedObject::new("person", 0.8, x_m, y_m));
            }
        }
        let pose = WirePose::new(self.place.x, self.place.y, 0.0);
        ObjectReport {
            pose: self.is_posed.then_some(pose),
            ..report(&self.node, frame, objects)
        }
    }
}

/// Eight people who walk around in the square; frames are a tenth of a second apart.
fn people(frame: u64) -> Vec<Vector2<f64>> {
    let person = |n: u64| {
        let angle = (n as f64) * 0.8 + frame as f64 * 0.1 * 0.2;
        let (sin, cos) = angle.sin_cos();
        Vector2::new(cos, sin) * (3.0 + n as f64)
    };
    (0..8).map(person).collect()
}

/// Means of the corrections of all cameras: offsets, rotations and delays.
#[derive(Debug, Default)]
struct Common {
    offset: Vector2<f64>,
    rotation_rad: f64,
    delay_s: f64,
}

/// The common part of all corrections, and the largest remaining error between two cameras, each at the centre of its
/// rotation: metres and radians.
fn common_and_rest(
    tracker: &Tracker,
    round: &TracksRound,
    cameras: &[Camera],
) -> (Common, f64, f64) {
    let mut common = Common::default();
    let mut rests = Vec::new();
    for camera in cameras {
        let node = name(&camera.node);
        let Some(correction) = round.pose_corrections.get(&node) else {
            continue;
        };
        let arm = Vector2::from(correction.about_m) - camera.place;
        let wrong = camera.offset + nalgebra::Rotation2::new(camera.turned_rad) * arm - arm;
        let offset = Vector2::new(correction.dx_m, correction.dy_m);
        common.offset += offset;
        common.rotation_rad += correction.dheading_rad;
        let pose_bias = tracker
            .sensors
            .by_name(&node)
            .map(|sensor| &sensor.pose_bias);
        common.delay_s += pose_bias.map_or(0.0, |pose_bias| {
            pose_bias.delay_s(&TracksConfig::default().bias_prior())
        });
        rests.push((offset + wrong, correction.dheading_rad + camera.turned_rad));
    }
    let count = rests.len().max(1) as f64;
    common.offset /= count;
    common.rotation_rad /= count;
    common.delay_s /= count;
    let pairs = || rests.iter().flat_map(|a| rests.iter().map(move |b| (a, b)));
    let apart_m = pairs().map(|(a, b)| (a.0 - b.0).norm()).fold(0.0, f64::max);
    (
        common,
        apart_m,
        pairs().map(|(a, b)| (a.1 - b.1).abs()).fold(0.0, f64::max),
    )
}

/// An hour at two frames a second. A common rotation of a radian moves objects at 15 m by 15 m, and a common delay of a
/// second moves the fastest objects by 2 m.
#[test]
fn fixed_cameras_hold_map() {
    for (seed, count, is_posed) in [(1, 2, true), (2, 2, false), (3, 3, true)] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let cameras = Camera::around(count, is_posed, &mut rng);
        let mut tracker = tracker();
        let mut sums = [0.0; 5];
        let mut rounds = 0.0;
        for frame in (0..36_000).step_by(5) {
            for camera in &cameras {
                tracker.observe(camera.report(frame, &people(frame), &mut rng), at(frame));
            }
            let round = tracker.close(at(frame));
            let (common, apart_m, apart_rad) = common_and_rest(&tracker, &round, &cameras);
            if frame > 600 {
                assert_eq!(round.pose_corrections.len(), count, "at frame {frame}");
                let Common {
                    offset,
                    rotation_rad,
                    delay_s,
                } = common;
                let figures = [
                    offset.norm(),
                    15.0 * rotation_rad.abs(),
                    2.0 * delay_s.abs(),
                    apart_m,
                    apart_rad,
                ];
                sums.iter_mut()
                    .zip(figures)
                    .for_each(|(sum, figure)| *sum += figure);
                rounds += 1.0;
            }
        }
        let [shifted_m, turned_m, delayed_m, apart_m, apart_rad] = sums.map(|sum| sum / rounds);
        let scene = format!("{count} cameras, poses {is_posed}");
        let common = [shifted_m, turned_m, delayed_m];
        assert!(
            common.iter().all(|moved_m| *moved_m < 0.02),
            "{scene}: {common:?} m in common"
        );
        assert!(
            apart_m < 0.1 && apart_rad < 0.005,
            "{scene}: {apart_m} m and {apart_rad} rad apart"
        );
    }
}

/// Cameras that state that they do not move, with estimated poses or without poses, keep their corrections without
/// passing objects.
#[test]
fn standing_camera_stays_aligned() {
    for is_posed in [false, true] {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let cameras = Camera::around(2, is_posed, &mut rng);
        let mut tracker = tracker();
        let mut corrections = Vec::new();
        for frame in (0..8000).step_by(5) {
            let people = if frame < 500 {
                people(frame)
            } else {
                Vec::new()
            };
            for camera in &cameras {
                let mut report = ObjectReport {
                    moving: Some(false),
                    ..camera.report(frame, &people, &mut rng)
                };
                report
                    .pose
                    .iter_mut()
                    .for_each(|pose| pose.x_m += noise(&mut rng, 0.01));
                tracker.observe(report, at(frame));
            }
            let round = tracker.close(at(frame));
            if matches!(frame, 500 | 7995) {
                let kept = cameras
                    .iter()
                    .filter_map(|camera| round.pose_corrections.get(&name(&camera.node)));
                corrections.push(
                    kept.map(|kept| Vector2::new(kept.dx_m, kept.dy_m))
                        .collect::<Vec<_>>(),
                );
                let (_, apart_m, _) = common_and_rest(&tracker, &round, &cameras);
                assert!(
                    apart_m < 0.2,
                    "poses {is_posed}: {apart_m} m apart at frame {frame}"
                );
            }
        }
        let [before, after] = &corrections[..] else {
            panic!("{corrections:?}")
        };
        assert_eq!((before.len(), after.len()), (2, 2), "{corrections:?}");
        let is_kept = before.iter().zip(after).all(|(a, b)| (a - b).norm() < 0.02);
        assert!(is_kept, "poses {is_posed}: from {before:?} to {after:?}");
    }
}

/// A camera with a correct pose and a vehicle with a pose error of 0.4 m, for five minutes.
#[test]
fn camera_ignores_vehicle_error() {
    for camera_every in [1, 2] {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut observers = Camera::around(2, true, &mut rng);
        for (observer, east_m) in observers.iter_mut().zip([0.0, 0.4]) {
            observer.offset = Vector2::new(east_m, 0.0);
            observer.turned_rad = 0.0;
        }
        let mut tracker = tracker();
        let mut corrected_m = Vec::new();
        for frame in 0..3000 {
            if frame % camera_every == 0 {
                tracker.observe(
                    observers[0].report(frame, &people(frame), &mut rng),
                    at(frame),
                );
            }
            let mut report = observers[1].report(frame, &people(frame), &mut rng);
            // Estimates of a pose vary while the vehicle waits.
            report
                .pose
                .iter_mut()
                .for_each(|pose| pose.x_m += noise(&mut rng, 0.01));
            tracker.observe(report, at(frame));
            let round = tracker.close(at(frame));
            if frame >= 2000 {
                let [camera, vehicle] =
                    [0, 1].map(|n| round.pose_corrections[&name(&observers[n].node)].dx_m);
                corrected_m.push(Vector2::new(camera, vehicle));
            }
        }
        let mean = corrected_m.iter().sum::<Vector2<f64>>() / corrected_m.len() as f64;
        let is_left_alone = mean.x.abs() < 0.1 && (-0.5..-0.2).contains(&mean.y);
        assert!(
            is_left_alone,
            "every {camera_every}: camera and vehicle are corrected by {mean:?}"
        );
    }
}

/// Mean offset of the objects of a map from the nearest people.
fn off(round: &TracksRound, people: &[Vector2<f64>]) -> Vector2<f64> {
    let cars = sure(round)
        .into_iter()
        .filter(|object| object.vehicle.is_none());
    let offset = |object: &FusedObject| {
        let offsets = people
            .iter()
            .map(|person| Vector2::new(object.x_m, object.y_m) - person);
        offsets
            .min_by(|a, b| a.norm().total_cmp(&b.norm()))
            .unwrap_or_default()
    };
    let offsets: Vec<_> = cars.map(offset).collect();
    offsets.iter().sum::<Vector2<f64>>() / offsets.len().max(1) as f64
}

/// The error of the third of three cameras is 0.9 m larger.
#[test]
fn map_stays_when_camera_leaves() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut cameras = Camera::around(3, true, &mut rng);
    cameras[2].offset.x += 0.9;
    let mut tracker = tracker();
    let mut with = Vec::new();
    let mut without = Vec::new();
    for frame in 0..900 {
        for camera in &cameras[..if frame < 600 { 3 } else { 2 }] {
            tracker.observe(camera.report(frame, &people(0), &mut rng), at(frame));
        }
        let off = off(&tracker.close(at(frame)), &people(0));
        match frame {
            500..600 => with.push(off),
            610.. => without.push(off),
            _ => {}
        }
    }
    let [with, without] =
        [with, without].map(|off| off.iter().sum::<Vector2<f64>>() / off.len() as f64);
    assert!(
        (with - without).norm() < 0.05,
        "from {with:?} to {without:?}"
    );
}

/// Two cameras stand for an hour; then a third camera joins, whose error is 0.9 m larger.
#[test]
fn late_camera_is_aligned_to_others() {
    for is_posed in [true, false] {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let mut cameras = Camera::around(3, is_posed, &mut rng);
        cameras[2].offset.x += 0.9;
        let mut tracker = tracker();
        let mut before = Vec::new();
        let mut after = Vec::new();
        let mut rest_m = 0.0_f64;
        for frame in (0..39_000).step_by(5) {
            let people = people(frame);
            for camera in &cameras[..if frame < 36_000 { 2 } else { 3 }] {
                tracker.observe(camera.report(frame, &people, &mut rng), at(frame));
            }
            let round = tracker.close(at(frame));
            let (common, rest, _) = common_and_rest(&tracker, &round, &cameras[..2]);
            match frame {
                35_000..36_000 => before.push(common.offset),
                38_000.. => {
                    after.push(common.offset);
                    rest_m = rest_m
                        .max(rest)
                        .max(common_and_rest(&tracker, &round, &cameras).1);
                }
                _ => {}
            }
        }
        let [before, after] =
            [before, after].map(|common| common.iter().sum::<Vector2<f64>>() / common.len() as f64);
        assert!(
            (after - before).norm() < 0.05,
            "poses {is_posed}: from {before:?} to {after:?}"
        );
        assert!(rest_m < 0.2, "poses {is_posed}: {rest_m} m apart");
    }
}
