//! Time per vote of a VOTE round and of a reputation update, and memory per tracked landmark.

mod figures;

use std::time::{Duration, Instant};

use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::reputation::{Evidence, ReputationConfig, ReputationLedger};
use ecod::vote::{Vote, VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, PerceivedObject};

use figures::Figures;

const NOON: Timestamp = Timestamp(1_732_154_400_000_000);
const LABELS: [&str; 5] = ["car", "cup", "mouse", "sports ball", "vase"];
/// Vehicles that see each landmark.
const WITNESSES: usize = 8;
/// Objects that a vehicle reports.
const OBJECTS: usize = 32;

fn main() {
    let mut figures = Figures::new("vote");
    rounds(&mut figures);
    many_labels(&mut figures);
    ledgers(&mut figures);
    memory(&mut figures);
    figures.save();
}

/// Rounds of 10² to 10⁵ votes, eight vehicles a landmark; one in five votes is wrong.
fn rounds(figures: &mut Figures) {
    println!(
        "{:<10} {:>8} {:>10} {:>10}",
        "mode", "votes", "round ms", "ns/vote"
    );
    for (name, mode) in [("weighted", VoteMode::Weighted), ("paper", VoteMode::Paper)] {
        let costs = [100, 1_000, 10_000, 100_000].map(|votes| {
            let mut vote = Vote::new(config(mode), Vec::new());
            let repeats = if votes > 10_000 { 5 } else { 21 };
            let least = (0..repeats)
                .map(|round| {
                    let now = NOON + Duration::from_secs(3 * round);
                    let reports = reports(votes, round, now, LABELS.len());
                    round_time(&mut vote, &reports, now)
                })
                .min()
                .expect("there are rounds");
            record(figures, &format!("{name}_round"), votes, least)
        });
        figures.flat(&format!("vote_{name}_cost_per_vote"), &costs);
    }
}

/// Rounds of 10,000 votes for 5 and for 256 labels, of which every vehicle has confused many: what labels cost a vote.
fn many_labels(figures: &mut Figures) {
    let costs = [LABELS.len(), 256].map(|labels| {
        let mut vote = Vote::new(config(VoteMode::Weighted), Vec::new());
        let rounds = (0..21).map(|round| {
            let now = NOON + Duration::from_secs(3 * round);
            round_time(&mut vote, &reports(10_000, round, now, labels), now)
        });
        let least = rounds.skip(5).min().expect("there are rounds");
        record(
            figures,
            &format!("weighted_round_{labels}_labels"),
            10_000,
            least,
        )
    });
    figures.insert(
        "vote_weighted_cost_of_256_labels_against_5",
        (costs[1] / costs[0]).into(),
    );
    println!(
        "256 labels cost {:.1} times as much as {}",
        costs[1] / costs[0],
        LABELS.len()
    );
}

fn round_time(vote: &mut Vote, reports: &[ObjectReport], now: Timestamp) -> Duration {
    time(|| {
        for report in reports {
            vote.observe(report, now).expect("reports are in order");
        }
        std::hint::black_box(vote.close(now));
    })
}

/// Settled votes written into a ledger, and the reputations that follow.
fn ledgers(figures: &mut Figures) {
    let aggregator = NodeName::new("edge").expect("a valid name");
    let costs = [100, 1_000, 10_000, 100_000].map(|votes| {
        let evidence: Vec<_> = (0..votes)
            .map(|n| Evidence {
                node: node(n % 64),
                label: LABELS[n % LABELS.len()].into(),
                correct: !n.is_multiple_of(5),
            })
            .collect();
        let mut ledger = ReputationLedger::default();
        let least = (0..21)
            .map(|epoch| {
                time(|| {
                    evidence
                        .iter()
                        .for_each(|e| ledger.record(epoch / 10, &aggregator, e));
                })
            })
            .min()
            .expect("there are rounds");
        let publishing = (0..21)
            .map(|_| {
                time(|| {
                    std::hint::black_box(ledger.reputations(&ReputationConfig::default()));
                })
            })
            .min()
            .expect("there are rounds");
        record(
            figures,
            "reputations_of_64_vehicles_after",
            votes,
            publishing,
        );
        record(figures, "ledger_update", votes, least)
    });
    figures.flat("ledger_update_cost_per_vote", &costs);
}

#[expect(clippy::disallowed_methods, reason = "a benchmark reads the clock")]
fn time(run: impl FnOnce()) -> Duration {
    let begin = Instant::now();
    run();
    begin.elapsed()
}

fn record(figures: &mut Figures, name: &str, votes: usize, time: Duration) -> f64 {
    let per_vote = time.as_secs_f64() * 1e9 / votes as f64;
    println!(
        "{name:<10} {votes:>8} {:>10.3} {per_vote:>10.1}",
        time.as_secs_f64() * 1e3
    );
    let value =
        serde_json::json!({ "round_ms": time.as_secs_f64() * 1e3, "ns_per_vote": per_vote });
    figures.insert(format!("{name}_{votes}_votes"), value);
    per_vote
}

/// Growth of the process per landmark that has eight fresh votes, from the resident set; Linux only.
fn memory(figures: &mut Figures) {
    let resident = || -> Option<f64> {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
        line.split_whitespace()
            .nth(1)?
            .parse::<f64>()
            .ok()
            .map(|kib| kib * 1024.0)
    };
    let landmarks = 50_000;
    let reports = reports(landmarks * WITNESSES, 0, NOON, LABELS.len());
    let Some(before) = resident() else { return };
    let mut vote = Vote::new(config(VoteMode::Weighted), Vec::new());
    for report in &reports {
        vote.observe(report, NOON).expect("reports are in order");
    }
    drop(vote.close(NOON));
    let Some(after) = resident() else { return };
    let bytes = (after - before) / landmarks as f64;
    println!("memory: {bytes:.0} bytes a landmark with {WITNESSES} votes");
    figures.insert("bytes_per_landmark_of_8_votes", bytes.into());
    drop(vote);
}

fn config(mode: VoteMode) -> VoteConfig {
    VoteConfig {
        mode,
        max_landmarks: 1_000_000,
        max_vehicles: 100_000,
        ..VoteConfig::default()
    }
}

fn label(n: usize) -> Label {
    LABELS
        .get(n)
        .map_or_else(|| format!("label-{n}").into(), |name| (*name).into())
}

fn node(n: usize) -> NodeName {
    NodeName::new(format!("v{n}")).expect("a valid name")
}

/// Eight reports for every group of 32 landmarks, from vehicles that drive on from group to group.
fn reports(votes: usize, round: u64, at: Timestamp, labels: usize) -> Vec<ObjectReport> {
    let landmarks = votes.div_ceil(WITNESSES);
    let mut reports = Vec::new();
    for group in 0..landmarks.div_ceil(OBJECTS) {
        for witness in 0..WITNESSES {
            let vehicle = group % 32 * WITNESSES + witness;
            let object = |place: usize| {
                let wrong = (place * 7 + witness * 13 + round as usize * 3).is_multiple_of(5);
                PerceivedObject {
                    landmark: Some(format!("place-{place}").into()),
                    ..PerceivedObject::new(
                        label((place + usize::from(wrong) * (1 + witness % 4)) % labels),
                        0.5 + 0.5 * ((place * 31 + witness * 17) % 97) as f64 / 97.0,
                        0.0,
                        0.0,
                    )
                }
            };
            reports.push(ObjectReport {
                objects: (group * OBJECTS..landmarks.min((group + 1) * OBJECTS))
                    .map(object)
                    .collect(),
                ..ObjectReport::new(
                    node(vehicle),
                    round * 1_000_000 + group as u64,
                    at + Duration::from_micros(group as u64),
                )
            });
        }
    }
    reports
}
