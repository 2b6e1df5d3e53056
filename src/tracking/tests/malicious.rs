//! One vehicle that states anything valid about the objects of others.

use super::*;

/// Time of a report in milliseconds after the start.
fn millis(ms: u64) -> Timestamp {
    Timestamp(START.0 + ms * 1000)
}

fn report_at(node: &str, ms: u64, objects: Vec<PerceivedObject>) -> ObjectReport {
    ObjectReport {
        captured_at_us: millis(ms),
        ..report(node, ms, objects)
    }
}

/// Runs rounds of 100 ms. `honest` gives the objects of euclid and gauss at a time in milliseconds, which both report
/// every 100 ms, `forged` the objects of mallory every 10 ms. Returns the last round.
fn attack(
    tracker: &mut Tracker,
    rounds: std::ops::Range<u64>,
    honest: impl Fn(u64) -> Vec<PerceivedObject>,
    forged: impl Fn(u64) -> Vec<PerceivedObject>,
) -> TracksRound {
    let mut last = TracksRound::default();
    for round in rounds {
        for part in 0..10 {
            let ms = 100 * round + 10 * part;
            if part == 0 {
                for node in ["euclid", "gauss"] {
                    tracker.observe(report_at(node, ms, honest(ms)), millis(ms));
                }
            }
            tracker.observe(report_at("mallory", ms + 1, forged(ms)), millis(ms + 1));
        }
        last = tracker.close(millis(100 * round + 99));
    }
    last
}

/// The objects that an honest vehicle has reported.
fn honest_objects(round: &TracksRound) -> Vec<&FusedObject> {
    let objects = sure(round).into_iter();
    objects
        .filter(|object| object.contributors.contains(&name("euclid")))
        .collect()
}

#[test]
fn stated_velocity_moves_no_track() {
    let mut tracker = tracker();
    let honest = |_| vec![car(0.0, 0.0)];
    let before = attack(&mut tracker, 0..20, honest, |_| Vec::new());
    for speed_mps in [10_000.0, 60.0] {
        let forged = |_| {
            let velocity_mps = Some([0.0, speed_mps]);
            vec![PerceivedObject {
                confidence: 0.9,
                velocity_mps,
                ..car(1.0, 0.0)
            }]
        };
        let after = attack(&mut tracker, 20..50, honest, forged);
        let objects = honest_objects(&after);
        assert_eq!(objects.len(), 1, "{objects:?}");
        assert_eq!(objects[0].id, before.objects[0].id);
        assert!(near(objects[0], 0.0, 0.0, 1.0), "{objects:?}");
    }
}

/// The forged velocity is stated from the first detection of the object on.
#[test]
fn stated_velocity_hinders_no_birth() {
    for speed_mps in [10_000.0, 60.0] {
        let forged = |_| {
            let velocity_mps = Some([0.0, speed_mps]);
            vec![PerceivedObject {
                velocity_mps,
                ..car(0.2, 0.0)
            }]
        };
        let round = attack(&mut tracker(), 0..20, |_| vec![car(0.0, 0.0)], forged);
        let objects = honest_objects(&round);
        let at_car = objects.iter().filter(|object| near(object, 0.0, 0.0, 1.0));
        assert_eq!(at_car.count(), 1, "{objects:?}");
    }
}

#[test]
fn two_vehicles_outweigh_frequent_third() {
    let honest = |ms: u64| {
        // Twice a second.
        let is_due = ms.is_multiple_of(500);
        let size_m = Some([4.0, 2.0]);
        let object = PerceivedObject {
            size_m,
            heading_rad: Some(0.5),
            ..car(0.0, 0.0)
        };
        is_due.then_some(object).into_iter().collect()
    };
    let forged = |_| {
        vec![PerceivedObject {
            confidence: 1.0,
            size_m: Some([100_000.0, 100_000.0]),
            heading_rad: Some(-2.0),
            ..PerceivedObject::new("person", 1.0, 0.1, 0.0)
        }]
    };
    let round = attack(&mut tracker(), 0..100, honest, forged);
    let objects = honest_objects(&round);
    assert_eq!(&*objects[0].label, "car", "{objects:?}");
    assert!(objects[0].size_m.unwrap()[0] < 10.0, "{objects:?}");
    assert!((objects[0].heading_rad.unwrap() - 0.5).abs() < 0.01);
}

/// An object that one camera detects twice a second stays, while another vehicle invents objects that come and go.
#[test]
fn invented_departures_remove_no_object() {
    let mut tracker = tracker();
    let mut round = TracksRound::default();
    for frame in 0..600 {
        let row = frame / 6 * 100;
        let invented = (0..100).map(|n| car(n as f64 * 10.0, 1000.0 + row as f64));
        tracker.observe(report("mallory", frame, invented.collect()), at(frame));
        if frame % 5 == 0 {
            tracker.observe(report("euclid", frame, vec![car(0.0, 0.0)]), at(frame));
        }
        round = tracker.close(at(frame));
    }
    let object = round.objects.iter().find(|object| object.y_m < 1.0);
    let existence = object.and_then(|object| object.existence);
    assert!(
        existence.is_some_and(|existence| existence > 0.7),
        "{existence:?}"
    );
}

/// Two vehicles detect a new object in a square that a third has filled with invented ones.
#[test]
fn invented_crowd_leaves_room() {
    let honest = |ms| {
        if ms < 2000 {
            vec![]
        } else {
            vec![car(3.5, 3.5)]
        }
    };
    let forged = |_| {
        let row = (0..16).map(|n| car(0.1 + 0.02 * f64::from(n), 0.1));
        row.collect()
    };
    let round = attack(&mut tracker(), 0..40, honest, forged);
    let objects = honest_objects(&round);
    assert!(
        objects.iter().any(|object| near(object, 3.5, 3.5, 0.5)),
        "{round:?}"
    );
}
