//! Vehicles that move on to another cell, and what the cells that they come from say of them.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::{Aggregator, Algorithms, Command, Fused, FusionConfig};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::reputation::{CellCounts, Counts, ForeignReputations, ReputationLedger};
use ecod::wire::{ObjectReport, PerceivedObject, ReportKind, WirePose};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const LABELS: [&str; 5] = ["car", "cup", "mouse", "sports ball", "vase"];
const LANDMARKS: usize = 6;
const HONEST_ACCURACY: f64 = 0.8;
const SEEDS: u64 = 20;

/// Rounds right after a move, twelve seconds, and a while later.
const AFTER_MOVE: [std::ops::Range<u64>; 2] = [0..12, 48..120];

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

/// A cell, and what it has counted.
struct Cell {
    aggregator: Aggregator,
    ledger: ReputationLedger,
    now: Timestamp,
    round: u64,
    truths: [usize; LANDMARKS],
    /// The label on which liars agree at each landmark.
    lies: [usize; LANDMARKS],
}

impl Cell {
    fn new(algorithms: Algorithms) -> Self {
        let now = Timestamp(1_700_000_000_000_000);
        let config = FusionConfig {
            algorithms,
            ..FusionConfig::default()
        };
        Self {
            aggregator: Aggregator::new(name("edge"), 1, config, Vec::new(), now),
            ledger: ReputationLedger::default(),
            now,
            round: 0,
            truths: [0; LANDMARKS],
            lies: [0; LANDMARKS],
        }
    }

    fn take(&mut self, reputations: ForeignReputations) {
        self.aggregator.command(
            &Command::TakeForeign {
                reputations: Arc::new(reputations),
            },
            self.now,
        );
    }

    /// Takes reports of all vehicles, and returns the rounds that they close, one at least. Evidence goes into the ledger.
    fn fuse(&mut self, kind: ReportKind, reports: Vec<ObjectReport>) -> Vec<Fused> {
        let now = self.now;
        let taken = reports.into_iter().map(|report| {
            self.aggregator
                .report(kind, &Arc::new(report), now)
                .unwrap()
        });
        let mut rounds: Vec<_> = taken.collect::<Vec<_>>().into_iter().flatten().collect();
        rounds.extend(self.aggregator.close_early(now));
        rounds.iter().for_each(|fused| self.record(fused));
        self.round += 1;
        rounds
    }

    fn record(&mut self, fused: &Fused) {
        fused
            .evidence
            .iter()
            .for_each(|vote| self.ledger.record(1, &name("edge"), vote));
    }

    /// A round of votes, half a second after the last; names of liars begin with `liar`. Returns the number of right verdicts.
    fn vote(&mut self, vehicles: &[String], rng: &mut ChaCha8Rng) -> usize {
        self.now = self.now + Duration::from_millis(500);
        let other = |truth: usize, rng: &mut ChaCha8Rng| {
            (truth + rng.random_range(1..LABELS.len())) % LABELS.len()
        };
        if self.round.is_multiple_of(6) {
            self.now = self.now + Duration::from_secs(3);
            self.truths = std::array::from_fn(|_| rng.random_range(0..LABELS.len()));
            self.lies = self.truths.map(|truth| other(truth, rng));
        }
        let mut reports = Vec::new();
        for vehicle in vehicles {
            let label = |place: usize, rng: &mut ChaCha8Rng| match vehicle.starts_with("liar") {
                true => self.lies[place],
                false if rng.random_bool(HONEST_ACCURACY) => self.truths[place],
                false => other(self.truths[place], rng),
            };
            let object = |place: usize| PerceivedObject {
                landmark: Some(format!("place-{place}").into()),
                ..PerceivedObject::new(LABELS[label(place, rng)], 0.8, 0.0, 0.0)
            };
            let objects = (0..LANDMARKS).map(object).collect();
            reports.push(ObjectReport {
                objects,
                ..ObjectReport::new(name(vehicle), self.round, self.now)
            });
        }
        let rounds = self.fuse(ReportKind::VoteDetections, reports);
        let verdicts = rounds
            .into_iter()
            .filter_map(|fused| fused.verdicts)
            .flat_map(|verdicts| verdicts.verdicts);
        let verdicts: BTreeMap<_, _> = verdicts
            .map(|verdict| (verdict.landmark, verdict.label))
            .collect();
        let is_right = |place: &usize| {
            let label = verdicts
                .get(format!("place-{place}").as_str())
                .cloned()
                .flatten();
            label.as_deref() == Some(LABELS[self.truths[*place]])
        };
        (0..LANDMARKS).filter(is_right).count()
    }

    /// What this cell tells others of all vehicles.
    fn told(&self, cell: &str, foreign: &mut ForeignReputations) {
        for (vehicle, counts) in self.ledger.cell_counts(500.0) {
            foreign.merge(&name(cell), &vehicle, counts);
        }
    }
}

fn vehicles(honest: usize, liars: usize) -> Vec<String> {
    let honest = (0..honest).map(|number| format!("honest-{number}"));
    honest
        .chain((0..liars).map(|number| format!("liar-{number}")))
        .collect()
}

/// Percent of right verdicts in a new cell [after](AFTER_MOVE) honest vehicles and liars have come to it. They come from so many
/// cells in which most are honest; a lying cell says the opposite of all.
fn after_move(honest: usize, liars: usize, cells: usize, has_lying_cell: bool) -> [f64; 2] {
    let movers = vehicles(honest, liars);
    let mut right = [0; 2];
    for seed in 0..SEEDS {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut foreign = ForeignReputations::default();
        for cell in 0..cells {
            let mut origin = Cell::new(Algorithms::Vote);
            let residents = (0..liars + 2).map(|number| format!("resident-{number}"));
            let present: Vec<_> = residents.chain(movers.clone()).collect();
            (0..120).for_each(|_| _ = origin.vote(&present, &mut rng));
            origin.told(&format!("cell-{cell}"), &mut foreign);
        }
        for vehicle in movers.iter().filter(|_| has_lying_cell) {
            let (correct, incorrect) = if vehicle.starts_with("liar") {
                (1_000_000, 0)
            } else {
                (0, 1_000_000)
            };
            let all = Counts { correct, incorrect };
            foreign.merge(
                &name("lying"),
                &name(vehicle),
                CellCounts {
                    all,
                    ..CellCounts::default()
                },
            );
        }
        let mut target = Cell::new(Algorithms::Vote);
        target.take(foreign);
        for round in 0..AFTER_MOVE[1].end {
            let verdicts = target.vote(&movers, &mut rng);
            for (right, rounds) in right.iter_mut().zip(&AFTER_MOVE) {
                *right += if rounds.contains(&round) { verdicts } else { 0 };
            }
        }
    }
    let percent = |n: usize| {
        100.0 * right[n] as f64
            / (SEEDS as usize * AFTER_MOVE[n].clone().count() * LANDMARKS) as f64
    };
    [percent(0), percent(1)]
}

/// As many liars as honest vehicles, whom nobody else watches.
#[test]
fn liars_that_move_on_together_are_no_newcomers_to_vote() {
    let [strangers, of_one, of_four] = [0, 1, 4].map(|cells| after_move(3, 3, cells, false));
    println!(
        "right verdicts of 3 honest and 3 liars in the first 12 s and later, %: strangers {strangers:.1?}, from one cell \
         {of_one:.1?}, from four {of_four:.1?}"
    );
    assert!(of_one[0] > strangers[0] + 30.0 && of_four[0] > 90.0);
    assert!(of_one[1] > strangers[1] && of_four[1] > 90.0);
}

#[test]
fn a_lying_cell_does_bounded_harm() {
    for (honest, liars) in [(5, 2), (4, 2), (4, 3)] {
        let strangers = after_move(honest, liars, 0, false);
        let slandered = after_move(honest, liars, 0, true);
        let disputed = after_move(honest, liars, 2, true);
        println!(
            "right verdicts of {honest} honest and {liars} liars in the first 12 s and later, %: strangers {strangers:.1?}, all \
             slandered by a lying cell {slandered:.1?}, and known to two honest ones {disputed:.1?}"
        );
        assert!(disputed[0] > strangers[0] - 5.0 && disputed[1] > 95.0);
        assert!(liars > 2 || slandered[1] > 90.0);
    }
}

/// Confidence of an invented car in the first map and after two seconds. A vehicle invents it where nobody else looks, and some
/// cells say of that vehicle how often it was right and wrong.
fn invented(said: &[(u64, u64)]) -> [f64; 2] {
    let mut cell = Cell::new(Algorithms::Pace);
    let mut foreign = ForeignReputations::default();
    for (number, (correct, incorrect)) in said.iter().enumerate() {
        let counts = CellCounts {
            all: Counts {
                correct: *correct,
                incorrect: *incorrect,
            },
            ..CellCounts::default()
        };
        foreign.merge(&name(&format!("cell-{number}")), &name("liar"), counts);
    }
    cell.take(foreign);
    let mut confidences = Vec::new();
    for round in 0..20 {
        cell.now = cell.now + Duration::from_millis(100);
        let report = |node: &str, x_m: f64| ObjectReport {
            pose: Some(WirePose::new(x_m - 20.0, 0.0, 0.0)),
            objects: vec![PerceivedObject::new("car", 0.8, x_m, 0.0)],
            ..ObjectReport::new(name(node), round, cell.now)
        };
        let reports = vec![report("liar", 0.0), report("newcomer", 500.0)];
        let map = cell
            .fuse(ReportKind::Detections, reports)
            .pop()
            .unwrap()
            .map
            .unwrap();
        let near = |x_m: f64| {
            let near = map
                .objects
                .iter()
                .filter(move |object| (object.x_m - x_m).abs() < 10.0);
            near.map(|object| object.confidence).fold(0.0, f64::max)
        };
        assert!(
            round < 3 || near(500.0) > 0.5,
            "a newcomer of whom nobody says anything is believed"
        );
        confidences.push(near(0.0));
    }
    [confidences[0], confidences[19]]
}

#[test]
fn a_liar_that_moves_on_is_no_newcomer_to_tracks() {
    let [stranger, of_one, of_three, proven] = [
        &[][..],
        &[(5, 60)],
        &[(5, 60), (8, 90), (0, 40)],
        &[(400, 3)],
    ]
    .map(invented);
    println!(
        "confidence of an invented car in the first map and after 2 s: of a stranger {stranger:.2?}, a liar by one cell \
         {of_one:.2?}, by three {of_three:.2?}, a proven vehicle {proven:.2?}"
    );
    assert!(
        stranger[1] > 0.9 && proven == stranger,
        "trust in a newcomer is full already"
    );
    assert!(of_one[0] < stranger[0] - 0.1 && of_one[1] < stranger[1] - 0.1);
    assert_eq!(of_three, [0.0, 0.0]);
}

/// The paper knows of one cell.
#[test]
fn in_paper_mode_nobody_hears_other_cells() {
    let mut votes = [false, true].map(|hears| {
        let mut config = FusionConfig {
            algorithms: Algorithms::Vote,
            ..FusionConfig::default()
        };
        config.vote.mode = ecod::vote::VoteMode::Paper;
        let mut cell = Cell {
            aggregator: Aggregator::new(
                name("edge"),
                1,
                config,
                Vec::new(),
                Timestamp(1_700_000_000_000_000),
            ),
            ..Cell::new(Algorithms::Vote)
        };
        let mut foreign = ForeignReputations::default();
        let all = Counts {
            correct: 0,
            incorrect: 1000,
        };
        foreign.merge(
            &name("a"),
            &name("honest-0"),
            CellCounts {
                all,
                ..CellCounts::default()
            },
        );
        if hears {
            cell.take(foreign);
        }
        let report = ObjectReport {
            objects: vec![PerceivedObject {
                landmark: Some("x".into()),
                ..PerceivedObject::new("cup", 0.8, 0.0, 0.0)
            }],
            ..ObjectReport::new(name("honest-0"), 1, cell.now)
        };
        cell.aggregator
            .report(ReportKind::VoteDetections, &Arc::new(report), cell.now)
            .unwrap();
        (
            cell.aggregator.end_packet(cell.now).unwrap(),
            cell.aggregator.reputations(),
        )
    });
    assert_eq!(
        std::mem::take(&mut votes[0].1),
        std::mem::take(&mut votes[1].1)
    );
    assert_eq!(votes[0].0, votes[1].0);
}
