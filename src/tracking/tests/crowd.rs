//! People close together, observed by several cameras with misses and false detections.

use super::*;

/// Number of people in the square.
const PEOPLE: usize = 12;

/// Position of a person: each person walks back and forth on a separate line, a metre from the next, at 1 m/s.
fn place(person: usize, t_s: f64) -> Vector2<f64> {
    let phase = (t_s + 2.7 * person as f64).rem_euclid(20.0);
    let along_m = if phase < 10.0 { phase } else { 20.0 - phase };
    Vector2::new(along_m - 5.0, person as f64 - 6.0)
}

/// Map of the crowd over all rounds.
struct Crowd {
    /// Objects with a confidence of at least 0.5, on average per round.
    published: f64,
    /// Number of times that the object nearest to a person differed from the object in the round before.
    switches: usize,
}

/// Four cameras about the square at 2 Hz for a minute. A camera misses each person with a probability of `missed`, and reports
/// an empty place with a probability of 0.5 in each frame.
fn crowd(missed: f64) -> Crowd {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut tracker = tracker();
    let mut nearest: Vec<Option<Uuid>> = vec![None; PEOPLE];
    let mut crowd = Crowd {
        published: 0.0,
        switches: 0,
    };
    let rounds = 120;
    for round in 0..rounds {
        let frame = 5 * round;
        let t_s = frame as f64 * 0.1;
        for (camera, (x_m, y_m, heading_rad)) in [
            (-12.0, 0.0, 0.0),
            (12.0, 0.0, std::f64::consts::PI),
            (0.0, -14.0, std::f64::consts::FRAC_PI_2),
            (0.0, 14.0, -std::f64::consts::FRAC_PI_2),
        ]
        .into_iter()
        .enumerate()
        {
            let mut objects = Vec::new();
            for person in 0..PEOPLE {
                if !rng.random_bool(missed) {
                    let seen = place(person, t_s);
                    let x_m = seen.x + noise(&mut rng, 0.2);
                    let y_m = seen.y + noise(&mut rng, 0.2);
                    objects.push(PerceivedObject::new("person", 0.8, x_m, y_m));
                }
            }
            if rng.random_bool(0.5) {
                let x_m = noise(&mut rng, 7.0);
                let y_m = noise(&mut rng, 7.0);
                objects.push(PerceivedObject::new("person", 0.6, x_m, y_m));
            }
            let seen = ObjectReport {
                pose: Some(WirePose::new(x_m, y_m, heading_rad)),
                view: Some(FieldOfView {
                    range_m: 40.0,
                    angle_rad: 2.0,
                }),
                moving: Some(false),
                ..report(&format!("camera{camera}"), frame, objects)
            };
            tracker.observe(seen, at(frame));
        }
        let map = tracker.close(at(frame));
        let objects = sure(&map);
        crowd.published += objects.len() as f64 / f64::from(rounds as u32);
        for (person, before) in nearest.iter_mut().enumerate() {
            let here = place(person, t_s);
            let distance_m =
                |object: &FusedObject| (object.x_m - here.x).hypot(object.y_m - here.y);
            let found = objects
                .iter()
                .min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))
                .filter(|object| distance_m(object) < 0.7)
                .map(|object| object.id);
            if let (Some(found), Some(before)) = (found, *before) {
                crowd.switches += usize::from(found != before);
            }
            *before = found.or(*before);
        }
    }
    crowd
}

#[test]
fn people_keep_their_identities() {
    let Crowd {
        published,
        switches,
    } = crowd(0.0);
    assert!(
        (published - PEOPLE as f64).abs() < 0.5,
        "{published} objects"
    );
    assert_eq!(switches, 0);
}

#[test]
fn misses_and_ghosts_cost_little() {
    let Crowd {
        published,
        switches,
    } = crowd(0.3);
    assert!(
        (published - PEOPLE as f64).abs() < 0.8,
        "{published} objects"
    );
    assert!(switches <= 8, "{switches} switches");
}

/// A person walks behind a wall for five seconds.
#[test]
fn person_out_of_sight_keeps_identity() {
    let mut tracker = tracker();
    let mut seen = |frames: std::ops::Range<u64>, is_visible: bool| {
        let mut last = TracksRound::default();
        for frame in frames {
            let mut objects = vec![PerceivedObject::new("person", 0.8, 0.0, 6.0)];
            if is_visible {
                let x_m = 0.05 * frame as f64;
                objects.push(PerceivedObject::new("person", 0.8, x_m, 0.0));
            }
            tracker.observe(report("euclid", frame, objects), at(frame));
            last = tracker.close(at(frame));
        }
        last
    };
    let id = |round: &TracksRound| {
        let walking = |object: &&&FusedObject| object.y_m < 3.0;
        sure(round).iter().find(walking).map(|object| object.id)
    };
    let before = id(&seen(0..50, true));
    assert_eq!(
        id(&seen(50..100, false)),
        None,
        "the hidden person is not published"
    );
    let after = id(&seen(100..120, true));
    assert!(before.is_some() && before == after, "{before:?} {after:?}");
}
