//! VOTE compared with the majority on generated label sets: over balance of the classes, habits of the annotators,
//! number of labels and confidences.
//!
//! All sets: `make eval-generated`. A set is drawn anew until it has enough items. VOTE falls short where it is below the
//! expected majority by more than half a point and two standard errors of the difference, item by item.

mod sets;

use std::collections::BTreeMap;
use std::thread;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::vote::{Vote, VoteConfig, WeightedConfig};
use ecod::wire::{ObjectReport, PerceivedObject, Verdict};
use sets::{Item, Kind};

const START: Timestamp = Timestamp(1_700_000_000_000_000);
/// Points below the majority, or of passes below one pass, that are allowed.
const TOLERANCE: f64 = 0.5;
const SETS: u64 = 200;
const PASSES: u32 = 30;
/// Sets that fall short: a quarter of the annotators copies, always states one class, or some do each, and few votes of each
/// annotator distinguish them from good ones.
const KNOWN_SHORT: [u64; 13] = [22, 24, 72, 80, 82, 132, 134, 135, 136, 161, 162, 164, 198];

/// A sum of differences of items.
#[derive(Debug, Clone, Copy, Default)]
struct Difference {
    items: f64,
    sum: f64,
    squares: f64,
}

impl Difference {
    fn add(&mut self, difference: f64) {
        self.items += 1.0;
        self.sum += difference;
        self.squares += difference * difference;
    }

    /// Mean in points.
    fn points(&self) -> f64 {
        100.0 * self.sum / self.items
    }

    fn standard_error(&self) -> f64 {
        100.0
            * (self.squares / self.items - (self.sum / self.items).powi(2))
                .max(0.0)
                .sqrt()
            / self.items.sqrt()
    }

    fn falls_short(&self) -> bool {
        self.points() < -TOLERANCE - 2.0 * self.standard_error()
    }
}

/// One pass and passes compared with the majority, and passes compared with one pass.
struct Score {
    majority: f64,
    online: Difference,
    passes: Difference,
    passes_beside_online: Difference,
}

impl Score {
    fn falls_short(&self) -> bool {
        [self.online, self.passes, self.passes_beside_online]
            .iter()
            .any(Difference::falls_short)
    }

    /// True if any difference is below the tolerance, by chance or not.
    fn is_below(&self) -> bool {
        [self.online, self.passes, self.passes_beside_online]
            .iter()
            .any(|difference| difference.points() < -TOLERANCE)
    }

    fn row(&self, number: u64, kind: &Kind) -> String {
        let of = |d: Difference| format!("{:+.2} ± {:.2}", d.points(), d.standard_error());
        let majority = self.majority;
        let online = of(self.online);
        let passes = of(self.passes);
        let beside = of(self.passes_beside_online);
        format!(
            "set {number}: majority {majority:.2} %, online {online}, passes {passes}, passes - online {beside}; {kind:?}"
        )
    }
}

/// Chance that the most frequent label, drawn at random on a tie, is right.
fn chance_of_majority(item: &Item) -> f64 {
    let mut votes: BTreeMap<usize, usize> = BTreeMap::new();
    item.labels
        .iter()
        .for_each(|label| *votes.entry(label.class).or_default() += 1);
    let most = votes.values().max().copied().unwrap_or(0);
    let first = votes.values().filter(|n| **n == most).count();
    if votes.get(&item.truth) == Some(&most) {
        1.0 / first as f64
    } else {
        0.0
    }
}

fn landmark(place: usize) -> String {
    format!("item-{place:05}")
}

/// As with annotators: the items follow one another, and votes do not become stale.
fn vote_on(items: &[Item]) -> Vote {
    let weighted = WeightedConfig {
        freshness_s: 1e9,
        smoothing_share: 0.0,
        hysteresis: 0.0,
        ..WeightedConfig::default()
    };
    let limits = VoteConfig {
        max_landmarks: 100_000,
        max_vehicles: 10_000,
        ..VoteConfig::default()
    };
    let mut vote = Vote::new(VoteConfig { weighted, ..limits }, Vec::new());
    for (place, item) in items.iter().enumerate() {
        let now = START + Duration::from_millis(100 * place as u64);
        for label in &item.labels {
            let class = format!("class-{}", label.class);
            let object = PerceivedObject {
                landmark: Some(landmark(place).as_str().into()),
                ..PerceivedObject::new(class.as_str(), label.confidence, 0.0, 0.0)
            };
            let node = NodeName::new(format!("annotator-{}", label.annotator)).unwrap();
            let report = ObjectReport {
                objects: vec![object],
                ..ObjectReport::new(node, place as u64, now)
            };
            vote.observe(&report, now).unwrap();
        }
        vote.close(now);
    }
    vote
}

fn right(items: &[Item], verdicts: impl Iterator<Item = Verdict>) -> Vec<f64> {
    let is_right = |(item, verdict): (&Item, Verdict)| {
        f64::from(verdict.label.as_deref() == Some(format!("class-{}", item.truth).as_str()))
    };
    let right: Vec<f64> = items.iter().zip(verdicts).map(is_right).collect();
    assert_eq!(right.len(), items.len());
    right
}

/// The score of a kind over as many sets as have `items` items.
fn score(number: u64, items: usize) -> Score {
    let kind = sets::kind(number);
    let mut majority = Difference::default();
    let mut online = Difference::default();
    let mut passes = Difference::default();
    let mut passes_beside_online = Difference::default();
    let mut draw = 0;
    while majority.items < items as f64 {
        let set = kind.generate(1000 * number + draw, items);
        draw += 1;
        let mut vote = vote_on(&set);
        let one_pass = right(&set, vote.verdicts());
        let refined = right(&set, vote.refine(PASSES));
        for ((item, one_pass), refined) in set.iter().zip(one_pass).zip(refined) {
            let of_majority = chance_of_majority(item);
            majority.add(of_majority);
            online.add(one_pass - of_majority);
            passes.add(refined - of_majority);
            passes_beside_online.add(refined - one_pass);
        }
    }
    Score {
        majority: majority.points(),
        online,
        passes,
        passes_beside_online,
    }
}

/// Scores sets on all processors; prints the sets that fall short and the means. Returns the number of sets that fall
/// short.
fn short_of(numbers: &[u64], items: usize) -> Vec<u64> {
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let of_thread = |thread: usize| {
        let numbers = numbers.iter().skip(thread).step_by(threads);
        numbers
            .map(|&number| (number, score(number, items)))
            .collect::<Vec<_>>()
    };
    let scores: BTreeMap<u64, Score> = thread::scope(|scope| {
        let running: Vec<_> = (0..threads)
            .map(|thread| scope.spawn(move || of_thread(thread)))
            .collect();
        running
            .into_iter()
            .flat_map(|thread| thread.join().unwrap())
            .collect()
    });
    let mean = |of: fn(&Score) -> Difference| {
        scores.values().map(|score| of(score).points()).sum::<f64>() / scores.len() as f64
    };
    println!(
        "{} sets: online {:+.2}, passes {:+.2} points",
        scores.len(),
        mean(|s| s.online),
        mean(|s| s.passes)
    );
    let below = scores.values().filter(|score| score.is_below()).count();
    println!(
        "{below} of {} sets are below by more than {TOLERANCE} points, chance included",
        scores.len()
    );
    let short: Vec<_> = scores
        .iter()
        .filter(|(_, score)| score.falls_short())
        .map(|(&number, score)| (number, score.row(number, &sets::kind(number))))
        .collect();
    let rows: Vec<_> = short.iter().map(|(_, row)| row.as_str()).collect();
    println!(
        "{} of {} sets fall short:\n{}",
        short.len(),
        scores.len(),
        rows.join("\n")
    );
    short.into_iter().map(|(number, _)| number).collect()
}

#[test]
fn ninth_of_sets_matches_known_deficits() {
    // Each balance is combined with each habit in about one of 56 sets, so a ninth of the sets covers all of them.
    let numbers: Vec<u64> = (1..SETS).step_by(9).collect();
    let unknown: Vec<_> = short_of(&numbers, 600)
        .into_iter()
        .filter(|n| !KNOWN_SHORT.contains(n))
        .collect();
    assert!(unknown.is_empty(), "{unknown:?}");
}

#[test]
#[ignore = "takes minutes; `make eval-generated`"]
fn generated_sets_match_known_deficits() {
    assert_eq!(short_of(&(0..SETS).collect::<Vec<_>>(), 1000), KNOWN_SHORT);
}
