//! Vehicles that pass objects, and vehicles with low trust.

use super::*;
use crate::tracking::trust::TrustCounts;

/// `euclid` detects a car all the time. Twenty other vehicles are elsewhere. If they pass the car, each observes it for
/// half a second, one after the other. Returns the probability that the car exists 20 s after the last of these times.
fn existence_of_a_car(is_passed: bool) -> f64 {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..300 {
        tracker.observe(report("euclid", frame, vec![car(0.0, 0.0)]), at(frame));
        for n in 0..20 {
            let is_passing = is_passed && frame / 5 == n;
            let x_m = if is_passing {
                0.0
            } else {
                1000.0 + 50.0 * n as f64
            };
            tracker.observe(
                report(&format!("v{n:02}"), frame, vec![car(x_m, 0.0)]),
                at(frame),
            );
        }
        round = tracker.close(at(frame));
    }
    round
        .objects
        .iter()
        .find(|object| near(object, 0.0, 0.0, 1.0))
        .unwrap()
        .existence
        .unwrap()
}

#[test]
fn passing_vehicle_counts_no_misses() {
    let [passed, alone] = [true, false].map(existence_of_a_car);
    assert!(
        passed > alone - 0.001,
        "existence is {passed} after twenty vehicles have passed, {alone} without passing vehicles"
    );
}

/// Existence of a car that `claimant` reports alone or together with `liar`, while two vehicles observe an empty place.
fn existence_of_false_car(is_liar_present: bool) -> f64 {
    let mut tracker = tracker();
    tracker.sensors.dormant.keep([(
        name("liar"),
        TrustCounts::new(0.0, 40.0, &ReputationConfig::default()),
    )]);
    let mut round = TracksRound::default();
    for frame in 0..15 {
        let reporters = ["claimant", "liar"]
            .into_iter()
            .take(1 + usize::from(is_liar_present));
        for node in reporters {
            tracker.observe(report(node, frame, vec![car(0.0, 20.0)]), at(frame));
        }
        for (n, node) in ["a", "b"].into_iter().enumerate() {
            let pose = Some(WirePose::new(
                10.0 * n as f64,
                0.0,
                std::f64::consts::FRAC_PI_2,
            ));
            let view = Some(FieldOfView {
                range_m: 60.0,
                angle_rad: 3.0,
            });
            let seen = vec![car(5.0, 8.0), car(-20.0, 30.0), car(30.0, 30.0)];
            tracker.observe(
                ObjectReport {
                    pose,
                    view,
                    ..report(node, frame, seen)
                },
                at(frame),
            );
        }
        round = tracker.close(at(frame));
    }
    let ghost = round
        .objects
        .iter()
        .find(|object| near(object, 0.0, 20.0, 1.0));
    ghost.map_or(0.0, |object| object.existence.unwrap())
}

#[test]
fn faulty_vehicle_is_no_second_witness() {
    let [with_liar, without] = [true, false].map(existence_of_false_car);
    assert!(
        with_liar < without + 0.02,
        "{with_liar} with a malicious vehicle, {without} without"
    );
}

#[test]
fn low_trust_increases_no_existence() {
    let existence = |wrong: f64| {
        let mut tracker = tracker();
        tracker.sensors.dormant.keep([(
            name("fool"),
            TrustCounts::new(0.0, wrong, &ReputationConfig::default()),
        )]);
        let mut round = TracksRound::default();
        for frame in 0..20 {
            tracker.observe(report("fool", frame, vec![car(0.0, 0.0)]), at(frame));
            round = tracker.close(at(frame));
        }
        round
            .objects
            .first()
            .map_or(0.0, |object| object.existence.unwrap())
    };
    let by_distrust: Vec<f64> = [0.0, 3.0, 5.0, 6.0].map(existence).into();
    println!("{by_distrust:?}");
    assert!(
        by_distrust.is_sorted_by(|more, less| more >= less) && by_distrust[3] < 0.5,
        "{by_distrust:?}"
    );
}

/// In its last frame, the leaving vehicle detected a duplicate of a parked car. The two remaining vehicles detect the
/// car a metre apart.
#[test]
fn duplicate_ends_with_its_vehicle() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..100 {
        for (node, x_m) in [("b", -0.5), ("c", 0.5)] {
            let pose = Some(WirePose::new(x_m, -20.0, std::f64::consts::FRAC_PI_2));
            let view = Some(FieldOfView {
                range_m: 60.0,
                angle_rad: 1.0,
            });
            tracker.observe(
                ObjectReport {
                    pose,
                    view,
                    ..report(node, frame, vec![car(x_m, 0.0)])
                },
                at(frame),
            );
        }
        let seen = if frame < 5 {
            vec![car(-0.5, 0.0), car(0.5, 0.0)]
        } else {
            vec![car(1000.0, 0.0)]
        };
        tracker.observe(report("a", frame, seen), at(frame));
        round = tracker.close(at(frame));
    }
    let cars = sure(&round)
        .iter()
        .filter(|object| near(object, 0.0, 0.0, 2.0))
        .count();
    assert_eq!(cars, 1, "{:?}", sure(&round));
}

#[test]
fn foreign_heading_yields_to_course() {
    let mut leader = tracker();
    let mut newcomer = tracker();
    let drive =
        |tracker: &mut Tracker, frames: std::ops::Range<u64>, place: fn(f64) -> [f64; 2]| {
            let mut round = TracksRound::default();
            for frame in frames {
                let [x_m, y_m] = place(frame as f64);
                tracker.observe(report("euclid", frame, vec![car(x_m, y_m)]), at(frame));
                round = tracker.close(at(frame));
            }
            round
        };
    let east = drive(&mut leader, 0..30, |frame| [frame, 0.0]);
    let heading_rad = sure(&east)[0].heading_rad.unwrap();
    assert!(heading_rad.abs() < 0.1, "{heading_rad}");
    let map = GlobalMap {
        objects: east.objects,
        ..GlobalMap::new(&Epoch::new(1, name("edge")), 30, at(29))
    };
    newcomer.adopt_map(&map, at(29));
    let taken_over = newcomer.close(at(29));
    assert_eq!(
        taken_over.objects[0].heading_rad,
        Some(heading_rad),
        "until more evidence arrives"
    );
    let north = drive(&mut newcomer, 30..70, |frame| [30.0, frame - 30.0]);
    let heading_rad = sure(&north)[0].heading_rad.unwrap();
    assert!(
        (heading_rad - std::f64::consts::FRAC_PI_2).abs() < 0.2,
        "{heading_rad}"
    );
}
