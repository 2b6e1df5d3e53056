use std::collections::{BTreeMap, BTreeSet};

use ecod::replay::read_report;
use ecod::wire::Limits;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::eval::tracks::TrackTruth;

fn small() -> TrafficConfig {
    TrafficConfig {
        observers: 3,
        vehicles: 30,
        duration_s: 3.0,
        warm_up_s: 10.0,
        ..TrafficConfig::default()
    }
}

fn generated(config: &TrafficConfig, seed: u64) -> TrafficRecording {
    config.validate().unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    generate(config, &mut || rng.random())
}

/// Distance of every detection of a report to the nearest true object of the frame after.
fn errors(recording: &TrafficRecording) -> Vec<f64> {
    let mut errors = Vec::new();
    for ArrivedReport { report, .. } in &recording.reports {
        let is_after = |frame: &&TruthFrame| frame.t_us >= report.captured_at_us;
        let Some(frame) = recording.truth.frames.iter().find(is_after) else {
            continue;
        };
        for object in &report.objects {
            let distance =
                |truth: &TruthObject| (truth.x_m - object.x_m).hypot(truth.y_m - object.y_m);
            errors.extend(frame.objects.iter().map(distance).min_by(f64::total_cmp));
        }
    }
    errors
}

#[test]
fn equal_seeds_give_equal_traffic() {
    let one = generated(&small(), 7);
    let again = generated(&small(), 7);
    let other = generated(&small(), 8);
    assert_eq!(one, again);
    assert_ne!(one, other);
}

#[test]
fn written_recording_is_readable() {
    let recording = generated(&small(), 1);
    assert!(
        recording.reports.len() > 70,
        "{} reports of three observers in 3 s",
        recording.reports.len()
    );
    for arrived in &recording.reports {
        let line = serde_json::to_vec(arrived).unwrap();
        let (_, read) = read_report(&line, &Limits::default()).unwrap();
        assert_eq!(read, arrived.report);
        let received = arrived.received_at_us.unwrap();
        assert!(received.micros_from(arrived.report.captured_at_us) > 15_000);
    }
    assert!(
        recording
            .reports
            .is_sorted_by_key(|arrived| arrived.received_at_us)
    );
    let truth = TrackTruth::parse(&serde_json::to_string(&recording.truth).unwrap());
    assert!(truth.is_ok(), "{truth:?}");
}

#[test]
fn vehicles_move_stop_and_keep_distance() {
    let config = TrafficConfig {
        observers: 30,
        duration_s: 40.0,
        memory_s: 100.0,
        ..small()
    };
    let config = TrafficConfig {
        sensor: SensorConfig {
            rate_hz: 1.0,
            ..config.sensor.clone()
        },
        ..config
    };
    let recording = generated(&config, 3);
    let mut tracks: BTreeMap<usize, Vec<Point2<f64>>> = BTreeMap::new();
    let mut pairs = 0;
    let mut too_close = 0;
    for frame in &recording.truth.frames {
        let cars: Vec<_> = frame
            .objects
            .iter()
            .filter(|object| object.id < config.vehicles)
            .collect();
        for (number, car) in cars.iter().enumerate() {
            tracks
                .entry(car.id)
                .or_default()
                .push(Point2::new(car.x_m, car.y_m));
            pairs += 1;
            let near =
                |other: &&&TruthObject| (other.x_m - car.x_m).hypot(other.y_m - car.y_m) < 1.5;
            too_close += cars[..number].iter().filter(near).count();
        }
    }
    assert!(too_close * 500 < pairs, "{too_close} of {pairs} collide");
    let step = |track: &[Point2<f64>]| {
        track
            .windows(2)
            .map(|pair| (pair[1] - pair[0]).norm())
            .collect::<Vec<_>>()
    };
    let steps: Vec<f64> = tracks.values().flat_map(|track| step(track)).collect();
    assert!(
        steps.iter().all(|step| *step < 1.6),
        "positions are continuous"
    );
    let share = |of: &dyn Fn(&f64) -> bool| {
        steps.iter().filter(|step| of(step)).count() as f64 / steps.len() as f64
    };
    assert!(
        share(&|step| *step > 0.7) > 0.2,
        "{} drive",
        share(&|step| *step > 0.7)
    );
    assert!(
        (0.05..0.7).contains(&share(&|step| *step < 0.01)),
        "{} stand",
        share(&|step| *step < 0.01)
    );
    let turned = |track: &&Vec<Point2<f64>>| {
        let along = |axis: usize| {
            track
                .iter()
                .map(|at| at[axis])
                .fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(v), h.max(v)))
        };
        (0..2).all(|axis| along(axis).1 - along(axis).0 > 15.0)
    };
    assert!(tracks.values().filter(turned).count() > config.vehicles / 4);
}

#[test]
fn only_detections_are_near_truth() {
    let within = |config: &TrafficConfig, limit: f64| {
        let errors = errors(&generated(config, 5));
        errors.iter().filter(|error| **error < limit).count() as f64 / errors.len() as f64
    };
    let near = within(&small(), 2.0);
    let far = within(&small(), 4.0);
    assert!(
        near > 0.7 && far < 0.98,
        "{near} within 2 m, {far} within 4 m"
    );
    let sensor = SensorConfig {
        clutter: 0.0,
        ghosts_per_s: 0.0,
        lures: 0.0,
        ..small().sensor
    };
    let clean = within(&TrafficConfig { sensor, ..small() }, 4.0);
    assert!(clean > 0.99, "{clean} within 4 m without false alarms");
}

#[test]
fn more_observers_see_more() {
    let seen = |observers| {
        let truth = generated(
            &TrafficConfig {
                observers,
                ..small()
            },
            2,
        )
        .truth;
        truth.frames.last().map_or(0, |frame| frame.objects.len())
    };
    let few = seen(2);
    let many = seen(20);
    assert!(many > few + 20, "{few} and {many}");
}

#[test]
fn standing_vehicle_reports_from_one_place() {
    let recording = generated(
        &TrafficConfig {
            observers: 3,
            standing: 2,
            ..small()
        },
        4,
    );
    let mut poses: BTreeMap<NodeName, Vec<Point2<f64>>> = BTreeMap::new();
    for ArrivedReport { report, .. } in &recording.reports {
        let pose = report.pose.unwrap();
        poses
            .entry(report.node.clone())
            .or_default()
            .push(Point2::new(pose.x_m, pose.y_m));
    }
    let went_m = |number| {
        let poses = &poses[&observer_name(number)];
        poses
            .iter()
            .map(|pose| (pose - poses[0]).norm())
            .fold(0.0, f64::max)
    };
    assert_eq!(poses.len(), 5);
    assert!(
        (3..5).all(|number| went_m(number) < 2.0),
        "no farther than the pose errs"
    );
}

#[test]
fn two_vehicle_recording_has_two_reporters() {
    let config = TrafficConfig {
        duration_s: 2.0,
        ..TrafficConfig::two_vehicle_recording()
    };
    let recording = generated(&config, 1);
    let mut captures: BTreeMap<Timestamp, BTreeSet<NodeName>> = BTreeMap::new();
    for ArrivedReport {
        received_at_us,
        report,
    } in &recording.reports
    {
        assert!(received_at_us.is_none() && report.pose.is_none() && report.view.is_none());
        assert!(
            report
                .objects
                .iter()
                .all(|object| object.covariance_m2.is_none() && object.label == "car")
        );
        captures
            .entry(report.captured_at_us)
            .or_default()
            .insert(report.node.clone());
    }
    assert_eq!(captures.len(), 20);
    assert!(
        captures.values().filter(|nodes| nodes.len() == 2).count() > 15,
        "both capture together"
    );
    let times: Vec<Timestamp> = recording
        .truth
        .frames
        .iter()
        .map(|frame| frame.t_us)
        .collect();
    assert!(
        captures.keys().eq(&times),
        "a frame of truth for each capture"
    );
}
