//! Vehicles that fabricate or hide objects.

use super::*;
use crate::tracking::detection_history::DetectionHistory;
use crate::tracking::handles::SensorId;
use crate::tracking::sensors::Sensors;
use crate::tracking::trust::{DormantCounts, TrustCounts};

#[test]
fn fabricating_or_hiding_costs_trust() {
    let mut tracker = tracker();
    let counts = run_faulty_vehicles(&mut tracker);
    for honest in ["a", "b", "c", "d"] {
        let (right, wrong) = counts[&name(honest)];
        assert!(right > 20 && wrong == 0, "{honest} {right} {wrong}");
    }
    for false_one in ["hider", "liar"] {
        let (right, wrong) = counts[&name(false_one)];
        assert!(
            wrong > 10 && wrong > 2 * right,
            "{false_one} {right} {wrong}"
        );
    }
    let round = tracker.close(at(150));
    let invented = sure(&round)
        .iter()
        .filter(|object| (object.y_m - 25.0).abs() < 3.0)
        .count();
    assert_eq!(invented, 0, "invented objects are not published");
}

#[test]
fn first_contributors_are_judged_at_limit() {
    let mut tracker = tracker();
    let mut judged = BTreeSet::new();
    let mut contributors = 0;
    for frame in 0..40 {
        for vehicle in 0..50 {
            tracker.observe(
                report(&format!("v{vehicle:02}"), frame, vec![car(0.0, 0.0)]),
                at(frame),
            );
        }
        let round = tracker.close(at(frame));
        contributors = round.objects[0].contributors.len();
        judged.extend(
            round
                .evidence
                .into_iter()
                .filter(|word| word.correct)
                .map(|word| word.node),
        );
    }
    assert_eq!((judged.len(), contributors), (32, 32));
}

#[test]
fn observers_precede_vehicles_that_miss() {
    let mut sensors = Sensors::new(ReputationConfig::default());
    let mut id = |n: u32| {
        sensors
            .receive(&name(&format!("v{n}")), at(0), &TracksConfig::default())
            .0
            .id
    };
    let ids: Vec<SensorId> = (0..=100).map(&mut id).collect();
    let mut history = DetectionHistory::default();
    let with_slot = ids[..100]
        .iter()
        .filter(|id| history.for_observation(**id, at(0)).is_some())
        .count();
    assert!(with_slot < 100 && history.for_observation(ids[100], at(1)).is_none());
    assert!(history.for_hit(ids[100], at(1)).is_some());
    assert!(history.get(ids[100]).is_some() && history.get(ids[0]).is_none());
    assert!(!history.has_room(at(1)));
}

#[test]
fn silent_vehicle_loses_its_slot() {
    let mut sensors = Sensors::new(ReputationConfig::default());
    let mut id = |n: u32| {
        sensors
            .receive(&name(&format!("v{n}")), at(0), &TracksConfig::default())
            .0
            .id
    };
    let [silent, newcomer] = [0, 100].map(&mut id);
    let others: Vec<SensorId> = (1..32).map(&mut id).collect();
    let mut history = DetectionHistory::default();
    for vehicle in [silent].iter().chain(&others) {
        assert!(history.for_observation(*vehicle, at(0)).is_some());
    }
    for vehicle in &others {
        let slot = history.for_observation(*vehicle, at(5));
        slot.unwrap().miss(at(5), 0.0);
    }
    assert!(!history.has_room(at(10)) && history.has_room(at(11)));
    assert!(history.for_observation(newcomer, at(11)).is_some());
    assert!(history.get(silent).is_none() && !history.has_room(at(15)));
    assert!(history.has_room(at(16)));
}

/// Four vehicles observe the place. One vehicle that otherwise agrees with them reports an object there with high
/// confidence.
#[test]
fn sure_vehicle_cannot_outweigh_misses() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..30 {
        let view = Some(FieldOfView {
            range_m: 60.0,
            angle_rad: std::f64::consts::TAU,
        });
        for (n, node) in ["a", "b", "c", "d", "liar"].into_iter().enumerate() {
            let pose = Some(WirePose::new(n as f64 * 6.0, 0.0, 0.0));
            let mut objects: Vec<_> = (0..5)
                .map(|n| car(f64::from(n) * 8.0 - 4.0, -15.0))
                .collect();
            if node == "liar" {
                objects.push(PerceivedObject::new("car", 0.99, 12.0, 25.0));
            }
            tracker.observe(
                ObjectReport {
                    pose,
                    view,
                    ..report(node, frame, objects)
                },
                at(frame),
            );
        }
        round = tracker.close(at(frame));
    }
    assert!(
        sure(&round).iter().all(|object| object.y_m < 10.0),
        "{:?}",
        sure(&round)
    );
    assert!(sure(&round).len() >= 5);
}

/// A malicious vehicle returns after all its other data was removed. It alone reports its object, and a newcomer alone
/// reports another object; many other vehicles have no counts.
#[test]
fn distrust_survives_silence() {
    let mut tracker = tracker();
    run_faulty_vehicles(&mut tracker);
    let mut round = tracker.close(at(400));
    assert!(
        round.objects.is_empty() && tracker.sensors.iter().next().is_none(),
        "all vehicles are removed"
    );
    let strangers =
        (0..2 * DormantCounts::MAX).map(|n| (name(&format!("z{n}")), TrustCounts::default()));
    tracker.sensors.dormant.keep(strangers.collect::<Vec<_>>());
    for frame in 400..420 {
        tracker.observe(report("liar", frame, vec![car(0.0, 25.0)]), at(frame));
        tracker.observe(report("newcomer", frame, vec![car(50.0, 25.0)]), at(frame));
        round = tracker.close(at(frame));
    }
    let accepted: Vec<_> = sure(&round)
        .iter()
        .map(|object| object.x_m.round())
        .collect();
    assert_eq!(accepted, [50.0], "{:?}", round.objects);
}

#[test]
fn least_evidence_is_dropped_first() {
    let mut dormant = DormantCounts::default();
    let config = ReputationConfig::default();
    dormant.keep([
        (name("liar"), TrustCounts::new(0.0, 40.0, &config)),
        (name("hero"), TrustCounts::new(40.0, 0.0, &config)),
    ]);
    dormant.keep(
        (0..2 * DormantCounts::MAX)
            .map(|n| (name(&format!("a{n}")), TrustCounts::new(1.0, 0.0, &config))),
    );
    assert_eq!(
        (
            dormant.of(&name("liar")).trust(&config),
            dormant.of(&name("hero")).trust(&config)
        ),
        (0.0, 1.0)
    );
    let known = (0..2 * DormantCounts::MAX)
        .filter(|n| dormant.of(&name(&format!("a{n}"))) != TrustCounts::default());
    assert_eq!(known.count(), DormantCounts::MAX - 2);
}

/// Evidence settled by VOTE lowers the trust in tracking, like the counts of the ledger.
#[test]
fn wrong_votes_lower_track_trust() {
    let mut tracker = tracker();
    let wrong = |node: &str| Evidence {
        node: name(node),
        label: "cup".into(),
        correct: false,
    };
    let mut round = TracksRound::default();
    for frame in 0..20 {
        tracker.observe(report("liar", frame, vec![car(0.0, 25.0)]), at(frame));
        tracker.observe(report("gauss", frame, vec![car(50.0, 25.0)]), at(frame));
        tracker.learn(&[wrong("liar"), wrong("unheard")]);
        round = tracker.close(at(frame));
    }
    let accepted: Vec<_> = sure(&round)
        .iter()
        .map(|object| object.x_m.round())
        .collect();
    assert_eq!(accepted, [50.0], "{:?}", round.objects);
}

/// Four honest vehicles, one vehicle that hides most objects and one that invents objects; returns the correct and
/// incorrect statements.
fn run_faulty_vehicles(tracker: &mut Tracker) -> BTreeMap<NodeName, (u32, u32)> {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let view = Some(FieldOfView {
        range_m: 60.0,
        angle_rad: std::f64::consts::TAU,
    });
    let mut counts: BTreeMap<NodeName, (u32, u32)> = BTreeMap::new();
    for frame in 0..150 {
        for (n, node) in ["a", "b", "c", "d", "hider", "liar"]
            .into_iter()
            .enumerate()
        {
            let pose = Some(WirePose::new(n as f64 * 6.0, 0.0, 0.0));
            let places =
                (0..10).map(|n| (n as f64 * 4.0 - 4.0, if n % 2 == 0 { 12.0 } else { -12.0 }));
            let mut objects: Vec<_> = places
                .map(|(x, y)| car(x + noise(&mut rng, 0.2), y))
                .collect();
            match node {
                "hider" => objects.truncate(2),
                "liar" => objects = (0..10).map(|n| car(n as f64 * 5.0, 25.0)).collect(),
                _ => {}
            }
            let report = ObjectReport {
                pose,
                view,
                ..report(node, frame, objects)
            };
            tracker.observe(report, at(frame));
        }
        for evidence in tracker.close(at(frame)).evidence {
            let (right, wrong) = counts.entry(evidence.node).or_default();
            *(if evidence.correct { right } else { wrong }) += 1;
        }
    }
    counts
}

/// Clutter of one vehicle does not affect the detections of others.
#[test]
fn clutter_barely_affects_other_objects() {
    let least_existence = |invented: usize| {
        let mut tracker = tracker();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut round = TracksRound::default();
        for frame in 0..50 {
            tracker.observe(
                report(
                    "a",
                    frame,
                    (0..5).map(|n| car(f64::from(n) * 8.0, 0.0)).collect(),
                ),
                at(frame),
            );
            let mut place = || 1500.0 + noise(&mut rng, 500.0);
            let clutter = (0..invented)
                .map(|_| PerceivedObject::new("car", 0.5, place(), place()))
                .collect();
            tracker.observe(report("flooder", frame, clutter), at(frame));
            round = tracker.close(at(frame));
        }
        let cars = round.objects.iter().filter(|object| object.x_m < 100.0);
        cars.map(|object| object.existence.unwrap())
            .fold(1.0, f64::min)
    };
    let without = least_existence(0);
    let beside = least_existence(300);
    assert!(
        without > 0.5 && beside > without - 0.1,
        "{without:.2} without, {beside:.2} with 300 invented objects a frame"
    );
}
