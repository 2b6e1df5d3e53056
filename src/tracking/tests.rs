mod absent;
mod beside;
mod crowd;
mod fast;
mod fixed;
mod malicious;
mod neighbour_tracks;
mod passing;
mod shifted;
mod trust;

use std::collections::BTreeSet;
use std::sync::Arc;

use nalgebra::{Matrix2, Vector2};
use proptest::collection::vec;
use proptest::prelude::*;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use uuid::Uuid;

use super::class::ObjectClass;
use super::coverage::Coverage;
use super::kinematics::{KinematicState, Measurement};
use super::*;
use crate::model::epoch::Epoch;
use crate::model::geometry::Covariance;
use crate::reputation::ReputationConfig;
use crate::wire::{FieldOfView, GlobalMap, ObjectReport, PerceivedObject, WirePose};

const START: Timestamp = Timestamp(1_732_154_400_000_000);

fn at(frame: u64) -> Timestamp {
    Timestamp(START.0 + frame * 100_000)
}

fn name(node: &str) -> NodeName {
    NodeName::new(node).unwrap()
}

fn car(x_m: f64, y_m: f64) -> PerceivedObject {
    PerceivedObject::new("car", 0.8, x_m, y_m)
}

fn report(node: &str, frame: u64, objects: Vec<PerceivedObject>) -> ObjectReport {
    ObjectReport {
        objects,
        ..ObjectReport::new(name(node), frame, at(frame))
    }
}

fn tracker() -> Tracker {
    Tracker::new(TracksConfig::default(), ReputationConfig::default())
}

/// Objects with a confidence above 0.5.
fn sure(round: &TracksRound) -> Vec<&FusedObject> {
    round
        .objects
        .iter()
        .filter(|object| object.confidence > 0.5)
        .collect()
}

fn noise(rng: &mut ChaCha8Rng, m: f64) -> f64 {
    rng.random_range(-m..m)
}

/// Two cars, one standing and one going east at 10 m/s, seen by two vehicles; returns the last round.
fn two_cars(
    tracker: &mut Tracker,
    frames: std::ops::Range<u64>,
    seen: impl Fn(u64) -> bool,
) -> TracksRound {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut last = TracksRound::default();
    for frame in frames {
        for node in ["euclid", "gauss"] {
            let mut place =
                |x: f64, y: f64| car(x + noise(&mut rng, 0.3), y + noise(&mut rng, 0.3));
            let mut objects = vec![place(0.0, 20.0)];
            if seen(frame) {
                objects.push(place(frame as f64, 0.0));
            }
            tracker.observe(report(node, frame, objects), at(frame));
        }
        last = tracker.close(at(frame));
    }
    last
}

fn near(object: &FusedObject, x_m: f64, y_m: f64, within_m: f64) -> bool {
    (object.x_m - x_m).hypot(object.y_m - y_m) < within_m
}

#[test]
fn common_object_has_one_velocity() {
    let round = two_cars(&mut tracker(), 0..30, |_| true);
    let cars = sure(&round);
    assert_eq!(cars.len(), 2, "{cars:?}");
    assert!(
        near(cars[0], 0.0, 20.0, 0.3) && near(cars[1], 29.0, 0.0, 0.5),
        "{cars:?}"
    );
    let [east, north] = cars[1].velocity_mps.unwrap();
    assert!(
        (east - 10.0).abs() < 1.0 && north.abs() < 1.0,
        "{east} {north}"
    );
    assert_eq!(cars[1].contributors, [name("euclid"), name("gauss")]);
    assert_eq!((&*cars[1].label, cars[1].age_s), ("car", Some(0.0)));
}

#[test]
fn object_fades_but_survives_occlusion() {
    let mut tracker = tracker();
    let before = two_cars(&mut tracker, 0..30, |_| true);
    let hidden = two_cars(&mut tracker, 30..38, |_| false);
    let find = |round: &TracksRound| {
        round
            .objects
            .iter()
            .find(|object| object.y_m.abs() < 3.0)
            .cloned()
    };
    let seen = find(&before).unwrap();
    let coasting = find(&hidden).unwrap();
    assert_eq!(seen.id, coasting.id);
    assert!(near(&coasting, 37.0, 0.0, 2.0), "{coasting:?}");
    assert!(coasting.confidence < seen.confidence);
    let again = two_cars(&mut tracker, 38..45, |_| true);
    assert_eq!(find(&again).unwrap().id, seen.id);
    let gone = two_cars(&mut tracker, 45..90, |_| false);
    assert!(find(&gone).is_none());
}

#[test]
fn vehicle_is_not_its_obstacle() {
    let config = TracksConfig {
        vehicle_label: "van".into(),
        ..TracksConfig::default()
    };
    let mut tracker = Tracker::new(config, ReputationConfig::default());
    let mut round = TracksRound::default();
    for frame in 0..20 {
        let x_m = frame as f64 * 0.5;
        for (node, x_m, sees) in [("euclid", x_m, x_m + 0.4), ("gauss", 30.0, x_m - 0.5)] {
            // euclid detects its own bonnet, gauss detects euclid.
            let pose = Some(WirePose::new(x_m, 0.0, 0.0));
            tracker.observe(
                ObjectReport {
                    pose,
                    ..report(node, frame, vec![car(sees, 0.2)])
                },
                at(frame),
            );
        }
        round = tracker.close(at(frame));
    }
    let vehicles: Vec<_> = round
        .objects
        .iter()
        .map(|object| object.vehicle.clone())
        .collect();
    assert_eq!(
        vehicles,
        [Some(name("euclid")), Some(name("gauss"))],
        "{:?}",
        round.objects
    );
    assert!(near(&round.objects[0], 9.5, 0.0, 1.0));
    assert_eq!(
        (&*round.objects[0].label, &*round.objects[1].label),
        ("car", "van")
    );
}

#[test]
fn fixed_camera_is_no_object() {
    let mut tracker = Tracker::new(TracksConfig::default(), ReputationConfig::default());
    let mut round = TracksRound::default();
    for frame in 0..20 {
        let pose = Some(WirePose::new(0.0, 0.0, 0.0));
        // The tracker ignores an object at a landmark.
        let known = PerceivedObject {
            landmark: Some("gate".into()),
            ..car(5.0, 5.0)
        };
        let seen = ObjectReport {
            pose,
            moving: Some(false),
            ..report("mast", frame, vec![car(10.0, 0.2), known])
        };
        tracker.observe_only(Arc::new(seen), at(frame), |object| {
            object.landmark.is_none()
        });
        round = tracker.close(at(frame));
    }
    let [object] = &round.objects[..] else {
        panic!("{:?}", round.objects)
    };
    assert!(near(object, 10.0, 0.0, 1.0) && object.vehicle.is_none());
}

#[test]
fn jumping_vehicle_stays_one_object() {
    let mut tracker = tracker();
    let mut ids = BTreeSet::new();
    for frame in 0..40 {
        let x_m = if frame < 20 { 0.0 } else { 500.0 };
        let pose = Some(WirePose::new(x_m, 0.0, 0.0));
        tracker.observe(
            ObjectReport {
                pose,
                ..report("euclid", frame, vec![])
            },
            at(frame),
        );
        let round = tracker.close(at(frame));
        let [vehicle] = &*round.objects else {
            panic!("{:?}", round.objects)
        };
        assert!(near(vehicle, x_m, 0.0, 0.5), "{vehicle:?}");
        assert!(
            vehicle.velocity_mps.is_none_or(|[x, y]| x.hypot(y) < 2.0),
            "{vehicle:?}"
        );
        ids.insert(vehicle.id);
    }
    assert_eq!(ids.len(), 1);
}

#[test]
fn vacated_position_counts_no_misses() {
    let existence = |watchers: u32| {
        let mut tracker = tracker();
        let mut round = TracksRound::default();
        for frame in 0..=20 {
            let pose = |x_m| Some(WirePose::new(x_m, 0.0, 0.0));
            let place = pose(if frame < 20 { 0.0 } else { 500.0 });
            tracker.observe(
                ObjectReport {
                    pose: place,
                    ..report("euclid", frame, vec![])
                },
                at(frame),
            );
            let view = Some(FieldOfView {
                range_m: 60.0,
                angle_rad: std::f64::consts::TAU,
            });
            for watcher in (0..watchers).filter(|_| frame == 20) {
                let node = format!("watcher-{watcher}");
                let report = ObjectReport {
                    pose: pose(10.0),
                    view,
                    ..report(&node, frame, vec![])
                };
                tracker.observe(report, at(frame));
            }
            round = tracker.close(at(frame));
        }
        round
            .objects
            .iter()
            .find(|object| object.vehicle == Some(name("euclid")))
            .and_then(|object| object.existence)
    };
    assert!(existence(0).is_some());
    assert_eq!(existence(5), existence(0));
}

/// A vehicle's first pose counts once: it adds half of the evidence of a second pose.
#[test]
fn spawning_pose_counts_once() {
    let mut tracker = tracker();
    for frame in 0..2 {
        let pose = Some(WirePose::new(frame as f64, 0.0, 0.0));
        tracker.observe(
            ObjectReport {
                pose,
                ..report("euclid", 0, vec![])
            },
            at(0),
        );
        let round = tracker.close(at(0));
        let variance = round.objects[0].covariance_m2[0];
        let config = TracksConfig::default();
        let alone = (config.vehicle_radius_m / 2.0).powi(2) + config.common_m.powi(2);
        if frame == 0 {
            assert!((variance - alone).abs() < 1e-9, "{variance}");
        } else {
            assert!(
                (round.objects[0].x_m - 0.5).abs() < 0.02,
                "both poses weigh about alike"
            );
        }
    }
}

#[test]
fn repeated_velocities_gain_no_accuracy() {
    let config = TracksConfig {
        manoeuvre_mps: 2.0,
        ..TracksConfig::default()
    };
    let class = ObjectClass::of("car", &config);
    let mut state = KinematicState::new(at(5), &measurement(), class);
    let said = Vector2::new(10.0, 0.0);
    for _ in 0..1000 {
        state.update_velocity(at(5), said, 1.0);
    }
    assert!((state.velocity_covariance().trace() / 2.0 - 1.0).abs() < 1e-9);
    assert!((state.velocity.x - 10.0).abs() < 0.5);
    let mut late = KinematicState::new(at(5), &measurement(), class);
    late.update_velocity(at(0), said, 1.0);
    assert!(
        (late.velocity_covariance().trace() / 2.0 - 3.0).abs() < 1e-9,
        "half a second ago is less sure"
    );
}

fn measurement() -> Measurement {
    Measurement {
        position: Vector2::zeros(),
        independent: Matrix2::identity(),
        common_m: 0.2,
    }
}

#[test]
fn eastward_heading_averages_correctly() {
    let mut tracker = tracker();
    for frame in 0..30 {
        let heading_rad = Some(if frame % 2 == 0 { 359f64 } else { 1.0 }.to_radians());
        let seen = PerceivedObject {
            heading_rad,
            ..car(0.0, 0.0)
        };
        tracker.observe(report("euclid", frame, vec![seen]), at(frame));
        let round = tracker.close(at(frame));
        let heading_deg = round.objects[0].heading_rad.unwrap().to_degrees();
        assert!(heading_deg.abs() < 1.01, "{heading_deg}");
    }
}

/// Two vehicles that have left stated another heading of a car that has turned since.
#[test]
fn old_heading_does_not_count() {
    let turned = |heading_rad| PerceivedObject {
        heading_rad: Some(heading_rad),
        ..car(0.0, 0.0)
    };
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..60 {
        if frame < 20 {
            for node in ["euclid", "riemann"] {
                let seen = vec![turned(0.0)];
                tracker.observe(report(node, frame, seen), at(frame));
            }
        } else {
            let seen = vec![turned(1.5)];
            tracker.observe(report("gauss", frame, seen), at(frame));
        }
        round = tracker.close(at(frame));
    }
    let heading_rad = round.objects[0].heading_rad.unwrap();
    assert!((heading_rad - 1.5).abs() < 0.1, "{heading_rad}");
}

#[test]
fn late_report_counts_within_bound() {
    for frame_m in [1.5, 2.8] {
        a_late_report_of_a_car_that_goes_so_far_in_a_frame(frame_m);
    }
}

fn a_late_report_of_a_car_that_goes_so_far_in_a_frame(frame_m: f64) {
    let mut on_time = tracker();
    let mut late = tracker();
    for frame in 0..30 {
        let x_m = frame as f64 * frame_m;
        for tracker in [&mut on_time, &mut late] {
            tracker.observe(report("euclid", frame, vec![car(x_m, 0.0)]), at(frame));
        }
        on_time.observe(report("gauss", frame, vec![car(x_m, 0.0)]), at(frame));
        if frame >= 3 {
            late.observe(
                report("gauss", frame - 3, vec![car(x_m - 3.0 * frame_m, 0.0)]),
                at(frame - 3),
            );
        }
        on_time.close(at(frame));
        late.close(at(frame));
    }
    let [a, b] = [&mut on_time, &mut late].map(|tracker| tracker.close(at(30)));
    assert_eq!(
        (a.objects.len(), b.objects.len()),
        (1, 1),
        "{:?}",
        b.objects
    );
    assert!(
        near(&b.objects[0], a.objects[0].x_m, a.objects[0].y_m, 0.3),
        "held against where it was then"
    );
    assert_eq!(b.objects[0].contributors.len(), 2);
    late.observe(report("gauss", 20, vec![car(0.0, 0.0)]), at(20));
    assert_eq!(late.losses().late, 1);
}

#[test]
fn jumped_vehicle_looks_from_new_position() {
    let mut coverage = Coverage::default();
    let place = |x_m: f64| vec![car(x_m - 20.0, 0.0), car(x_m + 20.0, 0.0)];
    for frame in 0..10 {
        assert!(!coverage.observe(&report("euclid", frame, place(0.0))));
    }
    assert!(coverage.observe(&report("euclid", 10, place(5_000.0))));
    assert!(
        (coverage.range_m() - 20.0).abs() < 1e-9,
        "{}",
        coverage.range_m()
    );
    assert!(coverage.rates_at(&Vector2::new(4_990.0, 0.0)).is_some());
    assert!(coverage.rates_at(&Vector2::new(10.0, 0.0)).is_none());
}

#[test]
fn view_angle_is_limited_to_circle() {
    let sees = |angle_rad: f64, bearing_rad: f64| {
        let mut coverage = Coverage::default();
        let pose = Some(WirePose::new(10.0, -5.0, 2.0));
        let stated = Some(FieldOfView {
            range_m: 50.0,
            angle_rad,
        });
        coverage.observe(&ObjectReport {
            pose,
            view: stated,
            ..report("euclid", 0, vec![])
        });
        coverage
            .rates_at(
                &(Vector2::new(10.0, -5.0)
                    + Vector2::new(bearing_rad.cos(), bearing_rad.sin()) * 20.0),
            )
            .is_some()
    };
    assert!(sees(1.0, 2.0) && sees(1.0, 2.45) && sees(1.0, 1.55));
    assert!(!sees(1.0, 2.55) && !sees(1.0, 1.45) && !sees(1.0, 5.1));
    for angle_rad in [
        std::f64::consts::TAU,
        7.0,
        2.0 * std::f64::consts::TAU,
        360.0,
    ] {
        assert!(
            (0..36).all(|n| sees(angle_rad, f64::from(n) * 0.18)),
            "{angle_rad}"
        );
    }
}

#[test]
fn jump_discards_pose_offset() {
    let mut tracker = tracker();
    let place = |x_m: f64| {
        (0..4)
            .map(|n| car(x_m + 10.0 * f64::from(n), 0.0))
            .collect::<Vec<_>>()
    };
    for frame in 0..30 {
        tracker.observe(report("euclid", frame, place(0.0)), at(frame));
        tracker.observe(report("gauss", frame, place(0.5)), at(frame));
        tracker.close(at(frame));
    }
    tracker.observe(report("euclid", 30, place(0.0)), at(30));
    tracker.observe(report("gauss", 30, place(0.5)), at(30));
    tracker.observe(report("gauss", 31, place(5_000.0)), at(31));
    let corrections = tracker.close(at(31)).pose_corrections;
    assert!(
        corrections.contains_key(&name("euclid")) && !corrections.contains_key(&name("gauss")),
        "{corrections:?}"
    );
}

/// Twelve parked cars detected by both vehicles; `gauss` is off by an offset and a rotation. Returns the last round.
fn misaligned(config: TracksConfig) -> TracksRound {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut tracker = Tracker::new(config, ReputationConfig::default());
    let mut round = TracksRound::default();
    for frame in 0..60 {
        let place = |n: u64| ((n % 4) as f64 * 12.0 - 18.0, (n / 4) as f64 * 14.0 - 14.0);
        for (node, dx, turn) in [("euclid", 0.0, 0.0), ("gauss", 0.7, 0.01f64)] {
            let mut seen = |n| {
                let (x, y): (f64, f64) = place(n);
                let (sin, cos) = turn.sin_cos();
                car(
                    cos * x - sin * y + dx + noise(&mut rng, 0.2),
                    sin * x + cos * y + noise(&mut rng, 0.2),
                )
            };
            let objects = (0..12).map(&mut seen).collect();
            tracker.observe(report(node, frame, objects), at(frame));
        }
        round = tracker.close(at(frame));
    }
    round
}

#[test]
fn pose_offsets_and_rotations_are_published() {
    let round = misaligned(TracksConfig::default());
    assert_eq!(sure(&round).len(), 12);
    let [a, b] = ["euclid", "gauss"].map(|node| round.pose_corrections[&name(node)]);
    assert!((a.dx_m - b.dx_m - 0.7).abs() < 0.15, "{a:?} {b:?}");
    assert!(
        (a.dheading_rad - b.dheading_rad - 0.01).abs() < 0.004,
        "{a:?} {b:?}"
    );
    let off = misaligned(TracksConfig {
        align: false,
        ..TracksConfig::default()
    });
    assert!(off.pose_corrections.is_empty());
}

#[test]
fn equal_input_gives_equal_identities() {
    let mut leader = tracker();
    let mut standby = tracker();
    let mut newcomer = tracker();
    let map = two_cars(&mut leader, 0..30, |_| true);
    assert_eq!(two_cars(&mut standby, 0..30, |_| true), map);
    let other = two_cars(&mut newcomer, 20..30, |_| true);
    let ids = |round: &TracksRound| {
        sure(round)
            .iter()
            .map(|object| object.id)
            .collect::<BTreeSet<Uuid>>()
    };
    assert!(ids(&map).is_disjoint(&ids(&other)));
    let unseen = FusedObject {
        existence: Some(0.9),
        ..FusedObject::new(
            Uuid::from_u128(7),
            "bus",
            0.9,
            60.0,
            60.0,
            Covariance::isotropic(0.2),
        )
    };
    let objects = map.objects.into_iter().chain([unseen]).collect();
    let map = GlobalMap {
        objects,
        ..GlobalMap::new(&Epoch::new(1, name("edge")), 30, at(29))
    };
    newcomer.adopt_map(&map, at(29));
    let adopted = two_cars(&mut newcomer, 30..31, |_| true);
    assert!(ids(&adopted).is_superset(&map.objects[..2].iter().map(|object| object.id).collect()));
    let taken_over = adopted
        .objects
        .iter()
        .find(|object| object.id == Uuid::from_u128(7))
        .unwrap();
    assert!(taken_over.existence.unwrap() > 0.8, "{taken_over:?}");
    let later = two_cars(&mut newcomer, 31..80, |_| true);
    assert_eq!(later.objects.len(), 2, "a map alone does not keep tracks");
}

#[test]
fn person_near_car_stays_separate() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..20 {
        let person = PerceivedObject {
            scores: [("person".into(), 0.7), ("cyclist".into(), 0.2)].into(),
            ..PerceivedObject::new("person", 0.7, 1.2, 0.0)
        };
        let objects = if frame % 2 == 0 {
            vec![car(0.0, 0.0), person]
        } else {
            vec![person, car(0.0, 0.0)]
        };
        tracker.observe(report("euclid", frame, objects), at(frame));
        round = tracker.close(at(frame));
    }
    let labels: Vec<_> = sure(&round)
        .iter()
        .map(|object| (object.label.to_string(), object.x_m.round()))
        .collect();
    assert_eq!(
        labels,
        [("car".to_owned(), 0.0), ("person".to_owned(), 1.0)]
    );
    let person = sure(&round)[1];
    assert!(person.scores["person"] > 0.7 && person.scores["cyclist"] < 0.3);
}

#[test]
fn low_confidence_detector_is_calibrated() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..200 {
        let mut objects: Vec<_> = (0..10)
            .map(|n| PerceivedObject::new("car", rng.random_range(0.12..0.3), n as f64 * 10.0, 0.0))
            .collect();
        for _ in 0..5 {
            let x = rng.random_range(0.0..90.0);
            let y = rng.random_range(10.0..60.0);
            objects.push(PerceivedObject::new(
                "car",
                rng.random_range(0.02..0.08),
                x,
                y,
            ));
        }
        tracker.observe(report("euclid", frame, objects), at(frame));
        round = tracker.close(at(frame));
    }
    assert_eq!(sure(&round).len(), 10, "{:?}", sure(&round));
}

#[test]
fn object_density_is_bounded() {
    let config = TracksConfig {
        max_density: 4,
        max_tracks: 20,
        ..TracksConfig::default()
    };
    let mut tracker = Tracker::new(config, ReputationConfig::default());
    let crowd = (0..100)
        .map(|n| car((n % 10) as f64 * 0.3, (n / 10) as f64 * 0.3))
        .collect();
    tracker.observe(report("euclid", 0, crowd), at(0));
    let round = tracker.close(at(0));
    assert!(round.objects.len() <= 4, "{}", round.objects.len());
    let wide = (0..100).map(|n| car(n as f64 * 50.0, 0.0)).collect();
    tracker.observe(report("euclid", 1, wide), at(1));
    assert!(tracker.close(at(1)).objects.len() <= 20);
    assert!(tracker.losses().refused >= 150);
}

/// A vehicle confirms ever more objects that only it detects, and another vehicle comes with a few.
#[test]
fn vehicle_fills_only_its_share() {
    let config = TracksConfig {
        max_tracks: 400,
        ..TracksConfig::default()
    };
    let mut tracker = Tracker::new(config, ReputationConfig::default());
    let mut round = TracksRound::default();
    for frame in 0..120 {
        // Enough frames of each group in turn to confirm it.
        let first = frame / 8 * 100 % 800;
        let invented = (first..first + 100).map(|n| car(n as f64 * 10.0, 0.0));
        tracker.observe(report("mallory", frame, invented.collect()), at(frame));
        if frame >= 100 {
            let honest = (0..40).map(|n| car(n as f64 * 10.0, 500.0));
            tracker.observe(report("euclid", frame, honest.collect()), at(frame));
        }
        round = tracker.close(at(frame));
    }
    let honest = round.objects.iter().filter(|object| object.y_m > 400.0);
    assert_eq!(honest.count(), 40);
    assert!(tracker.losses().refused > 0);
}

/// At 60 images a second, every second detection confirms the track, which then has a velocity.
#[test]
fn fast_camera_confirms_its_tracks() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..30 {
        let captured_at_us = Timestamp(at(0).0 + frame * 16_667);
        let report = ObjectReport {
            captured_at_us,
            ..report("euclid", frame, vec![car(0.1 * frame as f64, 0.0)])
        };
        tracker.observe(report, captured_at_us);
        round = tracker.close(captured_at_us);
    }
    let velocity = round.objects[0].velocity_mps.unwrap();
    assert!((4.0..8.0).contains(&velocity[0]), "{velocity:?}");
}

/// Parts of a vehicle that report the same objects within microseconds are one observation, which
/// confirms no object: the tracks end early, so that the vehicle's share has room for others.
#[test]
fn simultaneous_parts_confirm_nothing() {
    let config = TracksConfig {
        max_tracks: 800,
        ..TracksConfig::default()
    };
    let mut tracker = Tracker::new(config, ReputationConfig::default());
    let row = |y: f64| (0..100).map(|n| car(n as f64 * 10.0, y)).collect();
    for part in 0..8 {
        let report = ObjectReport {
            captured_at_us: Timestamp(at(0).0 + part),
            ..report("mallory", part, row(0.0))
        };
        tracker.observe(report, at(0));
    }
    assert_eq!(tracker.close(at(0)).objects.len(), 100);
    tracker.close(at(35));
    tracker.observe(report("mallory", 36, row(500.0)), at(36));
    tracker.close(at(36));
    assert_eq!(tracker.losses().refused, 0);
}

prop_compose! {
    fn object()(
        label in prop_oneof![Just("car"), Just("person")],
        confidence in 0.0..=1.0f64,
        (x, y) in prop_oneof![(-20.0..20.0f64, -20.0..20.0f64), (-1e8..1e8f64, -1e8..1e8f64)],
        covariance_m2 in prop::option::of(prop_oneof![Just([0.0, 0.0, 0.0]), Just([1e12, 0.0, 1e-12]), Just([0.5, 0.5, 0.5])]),
        velocity_mps in prop::option::of([-1e4..1e4f64, -1e4..1e4f64]),
        heading_rad in prop::option::of(-1e6..1e6f64),
    ) -> PerceivedObject {
        PerceivedObject { covariance_m2, velocity_mps, heading_rad, ..PerceivedObject::new(label, confidence, x, y) }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_report_gives_finite_numbers(
        rounds in vec(vec((0..4u64, 0..9u64, vec(object(), 0..12), prop::option::of((-50.0..50.0f64, -4.0..4.0f64))), 0..6), 1..8),
    ) {
        let mut tracker = tracker();
        for (frame, reports) in rounds.into_iter().enumerate() {
            for (seq, (node, lag, objects, pose)) in reports.into_iter().enumerate() {
                let pose = pose.map(|(x_m, heading_rad)| WirePose::new(x_m, 0.0, heading_rad));
                let seq = (frame * 10 + seq) as u64;
                let report = ObjectReport { pose, seq, ..report(&format!("v{node}"), frame as u64, objects) };
                tracker.observe(report, at(frame as u64 + 10 - lag));
            }
            let round = tracker.close(at(frame as u64 + 10));
            let mut ids = BTreeSet::new();
            for object in &round.objects {
                prop_assert!(object.x_m.is_finite() && object.y_m.is_finite() && object.covariance().is_valid(), "{:?}", object);
                prop_assert!((0.0..=1.0).contains(&object.confidence) && (0.0..=1.0).contains(&object.existence.unwrap()));
                prop_assert!(object.velocity_mps.iter().flatten().all(|speed| speed.abs() <= 71.0), "{:?}", object);
                prop_assert!(object.covariance_m2[0] >= 1e-3 && object.covariance_m2[2] >= 1e-3, "floors hold");
                prop_assert!(ids.insert(object.id), "each once");
            }
        }
    }

    #[test]
    fn report_order_does_not_matter(
        rounds in vec(vec((0..4u64, vec(object(), 0..8)), 0..6), 1..6),
        seed in any::<u64>(),
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut straight = tracker();
        let mut shuffled = tracker();
        for (frame, reports) in rounds.into_iter().enumerate() {
            let frame = frame as u64;
            let mut reports: Vec<_> = reports
                .into_iter()
                .enumerate()
                .map(|(seq, (node, objects))| ObjectReport { seq: seq as u64, ..report(&format!("v{node}"), frame, objects) })
                .collect();
            assert!(reports.iter().all(|report| straight.observe(report.clone(), at(frame))));
            reports.shuffle(&mut rng);
            assert!(reports.iter().all(|report| shuffled.observe(report.clone(), at(frame))));
            prop_assert_eq!(straight.close(at(frame)), shuffled.close(at(frame)));
        }
    }
}
