//! Objects of neighbouring cells: hand-over of identities, and cells with false reports.

use std::collections::BTreeMap;

use super::*;
use crate::wire::NeighbourObject;

fn stated(cell: &str, age_s: f64, object: FusedObject) -> NeighbourObject {
    NeighbourObject {
        cell: name(cell),
        age_s,
        object,
    }
}

/// A car that a neighbouring cell follows.
fn neighbour_car(number: u128, x_m: f64, y_m: f64, velocity_mps: [f64; 2]) -> FusedObject {
    FusedObject {
        existence: Some(0.97),
        scores: BTreeMap::from([("car".into(), 1.0)]),
        velocity_mps: Some(velocity_mps),
        age_s: Some(0.05),
        first_seen_us: Some(Timestamp(START.0 - 20_000_000)),
        ..FusedObject::new(
            Uuid::from_u128(number),
            "car",
            0.95,
            x_m,
            y_m,
            Covariance::isotropic(0.3),
        )
    }
}

/// A report with a view in all directions from the middle of the scene.
fn watching(node: &str, frame: u64, objects: Vec<PerceivedObject>) -> ObjectReport {
    let pose = crate::model::geometry::Pose::new(0.0, -8.0, 0.0).into();
    let view = FieldOfView {
        range_m: 60.0,
        angle_rad: std::f64::consts::TAU,
    };
    ObjectReport {
        pose: Some(pose),
        moving: Some(false),
        view: Some(view),
        ..report(node, frame, objects)
    }
}

#[test]
fn neighbours_object_keeps_identity_and_velocity() {
    let mut tracker = tracker();
    let mut ids = BTreeSet::new();
    for frame in 0..30 {
        // The car drives east at 10 m/s. This cell's vehicle detects it from 1 s on, the neighbour until 1.5 s. Maps
        // take 100 ms.
        let x_m = frame as f64 - 20.0;
        if frame % 5 == 0 && frame <= 15 {
            let car = stated("west", 0.1, neighbour_car(7, x_m - 1.0, 0.0, [10.0, 0.0]));
            tracker.on_neighbours(std::slice::from_ref(&car), at(frame));
            assert_eq!(
                tracker.hides(&car),
                frame > 10,
                "shown as the neighbour's until it is this cell's"
            );
        }
        let seen = if frame < 10 {
            Vec::new()
        } else {
            vec![car(x_m, 0.1), car(0.0, 20.0)]
        };
        tracker.observe(report("euclid", frame, seen), at(frame));
        let round = tracker.close(at(frame));
        assert!(
            frame >= 10 || round.objects.is_empty(),
            "a neighbour's object is no object of this cell"
        );
        if frame == 11 {
            let velocity = round
                .objects
                .iter()
                .find_map(|object| object.velocity_mps)
                .unwrap();
            assert!(
                (velocity[0] - 10.0).abs() < 2.5,
                "after two detections: {velocity:?}"
            );
        }
        if frame >= 10 {
            let here = round
                .objects
                .iter()
                .filter(|object| near(object, x_m, 0.0, 1.5));
            ids.extend(here.map(|object| (object.id.as_u128(), object.first_seen_us)));
        }
    }
    assert_eq!(
        ids,
        BTreeSet::from([(7, Some(Timestamp(START.0 - 20_000_000)))])
    );
    assert_eq!(
        tracker.hand_overs(),
        HandOvers {
            begun: 1,
            renamed: 0
        }
    );
}

/// Two cells that detect eight common cars; the second cell begins `later` frames after the first. The cells exchange
/// maps twice a second. Returns the identities of both cells at the end and at their beginnings, by position.
fn two_cells(later: u64) -> [Vec<Uuid>; 2] {
    let mut cells = [tracker(), tracker()];
    let mut maps: [Vec<FusedObject>; 2] = Default::default();
    let mut begun: Vec<Uuid> = Vec::new();
    let mut changes = 0;
    let ids = |objects: &[FusedObject]| {
        let mut placed: Vec<_> = objects
            .iter()
            .map(|object| (object.x_m.round() as i64, object.id))
            .collect();
        placed.sort_unstable();
        placed.into_iter().map(|(_, id)| id).collect::<Vec<Uuid>>()
    };
    for frame in 0..150 {
        let before = maps.clone();
        for (number, cell) in cells
            .iter_mut()
            .enumerate()
            .filter(|(number, _)| *number == 0 || frame >= later)
        {
            if frame % 5 == 0 && frame > later + 10 {
                let theirs = before[1 - number]
                    .iter()
                    .map(|object| stated("other", 0.1, object.clone()));
                cell.on_neighbours(&theirs.collect::<Vec<_>>(), at(frame));
            }
            for node in ["euclid", "gauss"] {
                let cars =
                    (0..8).map(|place| car(10.0 * f64::from(place) - 35.0, 0.05 * number as f64));
                cell.observe(
                    watching(&format!("{node}-{number}"), frame, cars.collect()),
                    at(frame),
                );
            }
            let objects: Vec<FusedObject> = cell.close(at(frame)).objects;
            let objects: Vec<_> = objects
                .into_iter()
                .filter(|object| object.confidence > 0.5)
                .collect();
            let known = ids(&before[number]);
            if known.len() == 8 && objects.len() == 8 {
                changes += known
                    .iter()
                    .zip(ids(&objects))
                    .filter(|(before, after)| *before != after)
                    .count();
            }
            maps[number] = objects;
        }
        if frame == later + 10 {
            begun = maps.iter().flat_map(|objects| ids(objects)).collect();
        }
    }
    let ends: Vec<Uuid> = maps.iter().flat_map(|objects| ids(objects)).collect();
    assert_eq!((begun.len(), ends.len()), (16, 16));
    assert!(
        begun[..8].iter().all(|id| !begun[8..].contains(id)),
        "each cell began with its own identities"
    );
    assert!(
        changes <= 8,
        "each object changes its identity once, in one of the cells: {changes} changes"
    );
    assert_eq!(
        cells.map(|cell| cell.trust_in_cell(&name("other"))),
        [1.0, 1.0]
    );
    [ends, begun]
}

#[test]
fn two_cells_share_older_identity() {
    let [ends, begun] = two_cells(30);
    assert_eq!(ends[..8], begun[..8]);
    assert_eq!(ends[8..], begun[..8]);
}

#[test]
fn smaller_identity_wins_at_equal_age() {
    let [ends, begun] = two_cells(0);
    let smaller: Vec<Uuid> = (0..8)
        .map(|place| begun[place].min(begun[8 + place]))
        .collect();
    assert_eq!(ends[..8], smaller);
    assert_eq!(ends[8..], smaller);
}

/// Four moving and two standing cars, detected by three vehicles. In each of its maps the neighbour states the objects
/// that `lie` returns. Returns the positions of the certain objects of each round.
fn run_with_false_reports(
    tracker: &mut Tracker,
    mut lie: impl FnMut(u64, &[FusedObject]) -> Vec<NeighbourObject>,
) -> Vec<Vec<[f64; 2]>> {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut rounds = Vec::new();
    let mut objects: Vec<FusedObject> = Vec::new();
    for frame in 0..120 {
        if frame % 2 == 0 {
            tracker.on_neighbours(&lie(frame, &objects), at(frame));
        }
        for node in ["euclid", "gauss", "noether"] {
            let cars = (0..6).map(|place| {
                let speed_mps = [10.0, -10.0, 5.0, -5.0, 0.0, 0.0][place];
                let x_m = speed_mps * (frame as f64 / 10.0 - 6.0) * 0.5;
                car(
                    x_m + noise(&mut rng, 0.3),
                    8.0 * place as f64 + noise(&mut rng, 0.3),
                )
            });
            tracker.observe(watching(node, frame, cars.collect()), at(frame));
        }
        let round = tracker.close(at(frame));
        let mut sure: Vec<[f64; 2]> = sure(&round)
            .iter()
            .map(|object| [object.x_m, object.y_m])
            .collect();
        sure.sort_by(|a, b| a[1].total_cmp(&b[1]));
        rounds.push(sure);
        objects = round.objects;
    }
    rounds
}

#[test]
fn unconfirmed_cell_loses_trust() {
    let mut tracker = tracker();
    let ghost = |number: u128| {
        stated(
            "liar",
            0.1,
            neighbour_car(number, 4.0 * number as f64 - 20.0, -20.0, [0.0, 0.0]),
        )
    };
    run_with_false_reports(&mut tracker, |_, _| (0..8).map(ghost).collect());
    assert_eq!(tracker.trust_in_cell(&name("liar")), 0.0);
    assert!(tracker.hides(&ghost(1)));
    // The ghost is not handed over: a car that comes to its position has an identity of this cell.
    for frame in 120..125 {
        tracker.on_neighbours(&[ghost(1)], at(frame));
        tracker.observe(
            watching("euclid", frame, vec![car(-16.0, -20.0)]),
            at(frame),
        );
        let round = tracker.close(at(frame));
        assert!(
            round
                .objects
                .iter()
                .all(|object| object.id != Uuid::from_u128(1))
        );
    }
}

#[test]
fn identity_changes_do_not_evade_judgement() {
    let mut tracker = tracker();
    run_with_false_reports(&mut tracker, |frame, _| {
        let ghost = |number: u128| {
            neighbour_car(
                1000 * u128::from(frame) + number,
                4.0 * number as f64 - 20.0,
                -20.0,
                [0.0; 2],
            )
        };
        (0..8)
            .map(|number| stated("liar", 0.1, ghost(number)))
            .collect()
    });
    assert_eq!(tracker.trust_in_cell(&name("liar")), 0.0);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// Ghosts near this cell's objects or at their positions, with any velocity, age and precision, and with the
    /// identities of the objects.
    #[test]
    fn false_cell_harms_no_object(seed in prop_oneof![1 => Just(4_861_703_545_525_720_796), 5 => any::<u64>()]) {
        let honest = run_with_false_reports(&mut tracker(), |_, _| Vec::new());
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let deceived = run_with_false_reports(&mut tracker(), |frame, own| {
            let ghost = |number: u128, rng: &mut ChaCha8Rng| {
                let copied = own.get(rng.random_range(0..8_usize));
                let [x_m, y_m] = copied.map_or([noise(rng, 40.0), noise(rng, 40.0)], |own| [own.x_m, own.y_m]);
                let id = copied.filter(|_| rng.random()).map_or(Uuid::from_u128(number), |own| own.id);
                let velocity_mps = [noise(rng, 30.0), noise(rng, 30.0)];
                let first_seen_us = Some(Timestamp(rng.random_range(0..START.0)));
                let sigma_m = 10_f64.powf(noise(rng, 2.0));
                let covariance_m2 = Covariance::isotropic(sigma_m).into();
                let ghost = neighbour_car(number, x_m + noise(rng, 2.0), y_m + noise(rng, 2.0), velocity_mps);
                FusedObject { id, first_seen_us, covariance_m2, ..ghost }
            };
            let number = |place: u64| u128::from(if frame % 4 == 0 { place } else { 100 * frame + place });
            (0..12).map(|place| stated("liar", 1.4 * rng.random::<f64>(), ghost(number(place), &mut rng))).collect()
        });
        for (frame, (honest, deceived)) in honest.iter().zip(&deceived).enumerate().skip(5) {
            prop_assert_eq!(honest.len(), deceived.len(), "frame {}: {:?} and {:?}", frame, honest, deceived);
            for (honest, deceived) in honest.iter().zip(deceived) {
                let off_m = (honest[0] - deceived[0]).hypot(honest[1] - deceived[1]);
                prop_assert!(off_m < 0.3, "frame {frame}: {off_m} m");
            }
        }
    }
}
