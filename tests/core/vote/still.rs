//! VOTE without motion: vehicles observe the same objects repeatedly and misread a frame now and then.

use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{ObjectReport, PerceivedObject};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const LABELS: [&str; 5] = ["car", "cup", "mouse", "sports ball", "vase"];
const PERIOD: Duration = Duration::from_millis(100);
const ROUNDS: u64 = 600;

/// Vehicles of which the first `faulty` state the same wrong labels always; the others are right in 80 % of frames.
struct Cell {
    vehicles: usize,
    faulty: usize,
    landmarks: usize,
}

/// Percent of right verdicts in the second half of a minute, and changes of verdicts in it.
fn run(cell: &Cell, seed: u64) -> (f64, usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let truths: Vec<usize> = (0..cell.landmarks)
        .map(|_| rng.random_range(0..LABELS.len()))
        .collect();
    let mut now = Timestamp(1_700_000_000_000_000);
    let mut right = 0;
    let mut changes = 0;
    let mut shown = vec![None; cell.landmarks];
    for round in 0..ROUNDS {
        now = now + PERIOD;
        for vehicle in 0..cell.vehicles {
            let mut see = |truth: usize| {
                let is_right = rng.random_bool(0.8);
                if vehicle < cell.faulty {
                    (truth + 1) % LABELS.len()
                } else if is_right {
                    truth
                } else {
                    (truth + rng.random_range(1..LABELS.len())) % LABELS.len()
                }
            };
            let objects = truths
                .iter()
                .enumerate()
                .map(|(place, &truth)| PerceivedObject {
                    landmark: Some(format!("place-{place}").into()),
                    ..PerceivedObject::new(LABELS[see(truth)], 0.8, 0.0, 0.0)
                });
            let node = NodeName::new(format!("vehicle-{vehicle}")).unwrap();
            let report = ObjectReport {
                objects: objects.collect(),
                ..ObjectReport::new(node, round, now)
            };
            vote.observe(&report, now).unwrap();
        }
        for verdict in vote.close(now).verdicts {
            let place: usize = verdict.landmark["place-".len()..].parse().unwrap();
            if round >= ROUNDS / 2 {
                right += usize::from(verdict.label.as_deref() == Some(LABELS[truths[place]]));
                changes += usize::from(shown[place] != verdict.label);
            }
            shown[place] = verdict.label;
        }
    }
    (
        100.0 * right as f64 / (ROUNDS as usize / 2 * cell.landmarks) as f64,
        changes,
    )
}

#[test]
fn stationary_objects_have_steady_verdicts() {
    for (vehicles, faulty) in [(3, 0), (5, 0), (3, 1), (5, 2), (9, 4)] {
        for landmarks in [1, 3, 6] {
            for seed in 1..=3 {
                let (right, changes) = run(
                    &Cell {
                        vehicles,
                        faulty,
                        landmarks,
                    },
                    seed,
                );
                let cell = format!(
                    "{vehicles} vehicles, {faulty} faulty, {landmarks} landmarks, seed {seed}"
                );
                assert!(right >= 99.0, "{cell}: {right} % right");
                assert!(changes <= landmarks, "{cell}: {changes} changes");
            }
        }
    }
}

#[test]
fn wavering_votes_cannot_outvote_sure() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let mut now = Timestamp(1_700_000_000_000_000);
    let mut right = 0;
    for round in 0..ROUNDS {
        now = now + PERIOD;
        for (vehicle, bowl) in [("riemann", 0.6), ("galileo", 0.55), ("watson", 0.0)] {
            let label = if rng.random_bool(bowl) {
                "bowl"
            } else {
                "sports ball"
            };
            let object = PerceivedObject {
                landmark: Some("place".into()),
                ..PerceivedObject::new(label, 0.5, 0.0, 0.0)
            };
            let node = NodeName::new(vehicle).unwrap();
            vote.observe(
                &ObjectReport {
                    objects: vec![object],
                    ..ObjectReport::new(node, round, now)
                },
                now,
            )
            .unwrap();
        }
        right += usize::from(vote.close(now).verdicts[0].label.as_deref() == Some("sports ball"));
    }
    assert!(
        right as f64 >= 0.95 * ROUNDS as f64,
        "{right} of {ROUNDS} right"
    );
}
