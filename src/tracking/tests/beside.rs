//! Objects next to, behind and in front of each other.

use super::*;

fn person(x_m: f64, y_m: f64) -> PerceivedObject {
    PerceivedObject::new("person", 0.8, x_m, y_m)
}

#[test]
fn two_adjacent_people_stay_two() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let mut tracker = tracker();
    let mut ids = BTreeSet::new();
    for frame in 0..120 {
        let walked_m = frame as f64 * 0.12;
        let mut objects = vec![person(walked_m, 0.0), person(walked_m, 0.9)];
        objects.retain(|_| rng.random_bool(0.9));
        tracker.observe(report("euclid", frame, objects), at(frame));
        let round = tracker.close(at(frame));
        if frame > 20 {
            ids.extend(sure(&round).iter().map(|object| object.id));
            assert_eq!(
                sure(&round).len(),
                2,
                "in frame {frame}: {:?}",
                round.objects
            );
        }
    }
    assert_eq!(ids.len(), 2);
}

#[test]
fn person_at_vehicle_stays_separate() {
    let mut tracker = tracker();
    for frame in 0..40 {
        let pose = Some(WirePose::new(0.0, 0.0, 0.0));
        let objects = if frame % 4 == 3 {
            vec![]
        } else {
            vec![person(0.0, 1.6)]
        };
        tracker.observe(
            ObjectReport {
                pose,
                ..report("euclid", frame, objects)
            },
            at(frame),
        );
        let round = tracker.close(at(frame));
        if frame > 10 {
            let mut labels: Vec<_> = sure(&round)
                .iter()
                .map(|object| object.label.to_string())
                .collect();
            labels.sort();
            assert_eq!(
                labels,
                ["car", "person"],
                "in frame {frame}: {:?}",
                round.objects
            );
        }
    }
}

/// Next to a parked car that others detect, a vehicle appears whose own body has not been detected yet.
#[test]
fn arriving_vehicle_absorbs_no_person() {
    let mut tracker = tracker();
    let mut of_person = BTreeSet::new();
    for frame in 0..40 {
        tracker.observe(report("gauss", frame, vec![person(0.0, 2.0)]), at(frame));
        if frame >= 20 {
            let pose = Some(WirePose::new(0.8 * (frame - 20) as f64, 0.0, 0.0));
            tracker.observe(
                ObjectReport {
                    pose,
                    ..report("euclid", frame, vec![])
                },
                at(frame),
            );
        }
        let round = tracker.close(at(frame));
        of_person.extend(
            sure(&round)
                .iter()
                .filter(|object| object.label == "person")
                .map(|object| object.id),
        );
    }
    assert_eq!(of_person.len(), 1);
}

/// Behind a row of trucks that `hidden` detects, the other vehicles detect people.
#[test]
fn occluded_objects_count_no_misses() {
    let mut tracker = tracker();
    let mut wrong = 0;
    for frame in 0..150 {
        let trucks: Vec<_> = (0..5)
            .map(|n| car(f64::from(n) * 8.0 - 16.0, 10.0))
            .collect();
        let people = (0..5).map(|n| person(f64::from(n) * 16.0 - 32.0, 20.0));
        let all: Vec<_> = trucks.iter().cloned().chain(people).collect();
        let view = Some(FieldOfView {
            range_m: 60.0,
            angle_rad: std::f64::consts::TAU,
        });
        for (node, y_m, objects) in [
            ("hidden", 0.0, trucks),
            ("left", 15.0, all.clone()),
            ("right", 16.0, all),
        ] {
            let pose = Some(WirePose::new(if y_m > 0.0 { 50.0 } else { 0.0 }, y_m, 0.0));
            tracker.observe(
                ObjectReport {
                    pose,
                    view,
                    ..report(node, frame, objects)
                },
                at(frame),
            );
        }
        let evidence = tracker.close(at(frame)).evidence;
        wrong += evidence
            .iter()
            .filter(|word| word.node == name("hidden") && !word.correct)
            .count();
    }
    assert_eq!(wrong, 0);
}
