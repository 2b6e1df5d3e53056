//! Vehicles that report all positions with a shift and nearly zero covariance.

use super::*;

/// Vehicles that detect four standing or moving cars. The last `false_ones` report every position `shift_m` too far
/// east.
struct Scene {
    vehicles: usize,
    false_ones: usize,
    shift_m: f64,
    speed_mps: f64,
    has_pose: bool,
    /// True if the false vehicles repeat one pose, and the poses of the others vary.
    false_ones_stand: bool,
}

impl Scene {
    fn of(vehicles: usize, false_ones: usize, shift_m: f64) -> Self {
        Self {
            vehicles,
            false_ones,
            shift_m,
            speed_mps: 0.0,
            has_pose: false,
            false_ones_stand: false,
        }
    }

    fn cars(&self, frame: u64) -> [Vector2<f64>; 4] {
        let along_m = self.speed_mps * (frame as f64 * 0.1 - 15.0);
        [
            Vector2::new(20.0, along_m),
            Vector2::new(along_m, 20.0),
            Vector2::new(-20.0, 5.0 - along_m),
            Vector2::new(5.0 - along_m, -20.0),
        ]
    }

    /// The largest mean error of a car in the maps of the last 15 of 30 s, metres, and the correct and incorrect statements of
    /// each vehicle.
    fn drag(&self) -> (f64, Vec<(u32, u32)>) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let mut tracker = tracker();
        let mut sums = [(Vector2::zeros(), 0.0); 4];
        let mut counts = vec![(0, 0); self.vehicles];
        let nodes: Vec<_> = (0..self.vehicles).map(|n| format!("v{n}")).collect();
        for frame in 0..300 {
            let cars = self.cars(frame);
            for (n, node) in nodes.iter().enumerate() {
                let is_false = n >= self.vehicles - self.false_ones;
                let (shift_m, sigma_m) = if is_false {
                    (self.shift_m, 0.01)
                } else {
                    (0.0, 0.3)
                };
                // Of a uniform distribution with this standard deviation.
                let reach_m = sigma_m * 3.0_f64.sqrt();
                let objects = cars.map(|place| PerceivedObject {
                    covariance_m2: Some([sigma_m * sigma_m, 0.0, sigma_m * sigma_m]),
                    ..car(
                        place.x + shift_m + noise(&mut rng, reach_m),
                        place.y + noise(&mut rng, reach_m),
                    )
                });
                let jitter_m = if is_false && self.false_ones_stand {
                    0.0
                } else {
                    noise(&mut rng, 0.01)
                };
                let pose = WirePose::new(2.0 + jitter_m, n as f64, 0.0);
                let report = ObjectReport {
                    pose: self.has_pose.then_some(pose),
                    ..report(node, frame, objects.into())
                };
                tracker.observe(report, at(frame));
            }
            let round = tracker.close(at(frame));
            for evidence in &round.evidence {
                let node = nodes.iter().position(|node| name(node) == evidence.node);
                let (right, wrong) = &mut counts[node.unwrap()];
                *(if evidence.correct { right } else { wrong }) += 1;
            }
            for (place, (sum, count)) in cars.iter().zip(&mut sums).filter(|_| frame >= 150) {
                let offsets = round
                    .objects
                    .iter()
                    .filter(|object| object.vehicle.is_none())
                    .map(|object| Vector2::new(object.x_m, object.y_m) - place);
                let offset = offsets
                    .min_by(|a, b| a.norm().total_cmp(&b.norm()))
                    .unwrap();
                *sum += offset;
                *count += 1.0;
            }
        }
        let drag = |(sum, count): (Vector2<f64>, f64)| sum.norm() / count;
        (sums.map(drag).into_iter().fold(0.0, f64::max), counts)
    }
}

#[test]
fn shifted_vehicle_hardly_moves_map() {
    for (vehicles, has_pose, speed_mps) in [
        (4, false, 0.0),
        (4, true, 0.0),
        (4, true, 3.0),
        (9, false, 0.0),
    ] {
        for shift_m in [0.0, 0.5, 1.0, 1.5] {
            let scene = Scene {
                speed_mps,
                has_pose,
                ..Scene::of(vehicles, 1, shift_m)
            };
            let (drag_m, counts) = scene.drag();
            println!(
                "one of {vehicles}, poses {has_pose}, {speed_mps} m/s, shift {shift_m} m: {drag_m:.3} m, {counts:?}"
            );
            assert!(
                drag_m < 0.05,
                "{drag_m} m by {shift_m} m of one of {vehicles}"
            );
            let (false_one, honest) = counts.split_last().unwrap();
            assert!(
                honest
                    .iter()
                    .all(|(right, wrong)| *right > 20 && *wrong == 0)
            );
            if shift_m >= 1.0 {
                assert!(false_one.1 > false_one.0, "{false_one:?} by {shift_m} m");
            }
        }
    }
}

/// A standing vehicle has a higher weight in the common motion, and the usual weight in the choice of the majority.
#[test]
fn standing_shifted_vehicle_is_outvoted() {
    let scene = Scene {
        has_pose: true,
        false_ones_stand: true,
        ..Scene::of(4, 1, 1.0)
    };
    let (drag_m, counts) = scene.drag();
    println!("one of 4 stands, shift 1 m: {drag_m:.3} m, {counts:?}");
    assert!(drag_m < 0.05, "{drag_m} m");
    let (false_one, honest) = counts.split_last().unwrap();
    assert!(honest.iter().all(|(_, wrong)| *wrong == 0), "{honest:?}");
    assert!(false_one.1 > false_one.0, "{false_one:?}");
}

/// The largest minority, with one common shift.
#[test]
fn shifted_minority_moves_map_little() {
    for (vehicles, false_ones) in [(3, 1), (5, 2), (7, 3), (9, 4)] {
        for shift_m in [0.5, 1.0] {
            let (drag_m, counts) = Scene::of(vehicles, false_ones, shift_m).drag();
            println!("{false_ones} of {vehicles}, shift {shift_m} m: {drag_m:.3} m, {counts:?}");
            let share = false_ones as f64 / vehicles as f64;
            assert!(drag_m < share * shift_m, "{drag_m} m");
        }
    }
}
