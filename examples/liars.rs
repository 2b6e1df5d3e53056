//! Effect of malicious vehicles on verdicts: ⌊(n−1)/2⌋ of n vehicles make false statements, in four ways, by rejoining
//! under new names, and by forged evidence.
//!
//! `cargo run --release --example liars -- [--svg FILE] [--table FILE] [--write-table FILE] [--seeds N]`
//!
//! `--write-table` writes the rows of three sizes between the markers of the table in a document.
//!
//! Fails, and names the row, if the worst seed has less than 90 % right verdicts, if verdicts are less often right than
//! the majority of honest vehicles alone, or if forged evidence is accepted.
//!
//! Honest vehicles are right 80 % of the time, independently. Figures cover the rounds from 300 to 600 and all seeds,
//! and start 100 rounds after the last malicious vehicle has become active; `worst` is the worst seed. The drawing
//! shows the mean of all seeds.

use std::collections::BTreeMap;
use std::error::Error;
use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use ecod::leadership::ledger_resync::{LedgerResync, Merged};
use ecod::leadership::{Leadership, Position};
use ecod::model::epoch::Epoch;
use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::reputation::{Evidence, ReputationLedger};
use ecod::vote::{Vote, VoteConfig};
use ecod::wire::{
    LedgerEntry, LedgerShare, LedgerSignature, ObjectReport, PerceivedObject, SCHEMA_VERSION,
};
use ecod_lab::document::write_table;
use plotters::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const LABELS: [&str; 5] = ["car", "cup", "mouse", "sports ball", "vase"];
const SIZES: [usize; 5] = [3, 5, 7, 9, 15];
/// Sizes in the table of `--write-table`.
const SHOWN_SIZES: [usize; 3] = [3, 7, 15];
const SERIES: [(&str, RGBColor); 4] = [
    ("share of right majorities", RGBColor(150, 150, 150)),
    ("share of right verdicts", BLACK),
    ("reputation of the honest", BLUE),
    ("reputation of liars", RED),
];
const LANDMARKS: usize = 6;
const ROUNDS: u64 = 600;
const SETTLED: u64 = 300;
const FAULTS: [Fault; 6] = [
    Fault::Random,
    Fault::Constant,
    Fault::Copying,
    Fault::Turning,
    Fault::Rejoining,
    Fault::Forging,
];
/// Round before which the aggregator restarts, in runs with forged evidence.
const RESTART: u64 = 150;
/// Rounds of 12 s in which another candidate follows the forger. A leader renews its term after 10 s at most.
const MISLED: Range<u64> = 102..114;
/// These rounds and the 5 s in which the last message of a former leader is accepted.
const MISLED_WITH_LAST_WORD: Range<u64> = MISLED.start..MISLED.end + 10;
/// Minimum percentage of right verdicts for a row's worst seed.
const MIN_WORST: f64 = 90.0;
const HONEST_ACCURACY: f64 = 0.8;
const PERIOD: Duration = Duration::from_millis(500);

#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// A wrong label at random.
    Random,
    /// Always the same label.
    Constant,
    /// All malicious vehicles state one wrong label.
    Copying,
    /// Honest for a third of the time, then copying.
    Turning,
    /// Copying, under a new name every ten rounds.
    Rejoining,
    /// Copying; the first malicious vehicle is a candidate that publishes every round that malicious vehicles are right
    /// and others wrong.
    Forging,
}

/// A candidate in a cell with certificates. The signatures are assumed to be verified.
struct Candidate {
    resync: LedgerResync,
    ledger: ReputationLedger,
    leadership: Leadership,
}

impl Candidate {
    fn new(name: &str) -> Result<Self, Box<dyn Error>> {
        let resync = LedgerResync::signed(NodeName::new(name)?, 10);
        let ledger = ReputationLedger::default();
        Ok(Self {
            resync,
            ledger,
            leadership: Leadership::default(),
        })
    }

    /// Leads, or follows a leader.
    fn go_by(&mut self, term: u64, leader: &str, position: Position) -> Result<(), Box<dyn Error>> {
        let epoch = Some(Epoch::new(term, NodeName::new(leader)?));
        self.leadership = Leadership {
            position,
            epoch,
            term,
            ..Leadership::default()
        };
        Ok(())
    }

    /// Processes a share of another candidate.
    fn merge(&mut self, share: &LedgerShare, now: Timestamp) -> Result<Merged, Box<dyn Error>> {
        let candidates = std::slice::from_ref(&share.node);
        Ok(self.resync.merge(
            share,
            &mut self.ledger,
            candidates,
            &self.leadership,
            now,
            now,
        )?)
    }
}

/// The honest candidates: the aggregator, and a candidate that has led before.
struct Cell {
    edge: Candidate,
    euclid: Candidate,
    /// Shares of `euclid` in transit.
    passed_on: Vec<LedgerShare>,
}

impl Cell {
    fn new() -> Result<Self, Box<dyn Error>> {
        let mut edge = Candidate::new("edge")?;
        let mut euclid = Candidate::new("euclid")?;
        edge.go_by(2, "edge", Position::Leading)?;
        euclid.resync.lead(Epoch::new(1, NodeName::new("euclid")?));
        euclid.resync.step_down();
        euclid.go_by(2, "edge", Position::Following)?;
        Ok(Self {
            edge,
            euclid,
            passed_on: Vec::new(),
        })
    }

    /// Counts the evidence of a round, and sends it to the other candidate.
    fn record(&mut self, evidence: &[Evidence], now: Timestamp) -> Result<(), Box<dyn Error>> {
        let Some(epoch) = &self.edge.leadership.epoch else {
            return Ok(());
        };
        for share in self
            .edge
            .resync
            .record(epoch, evidence, &mut self.edge.ledger)
        {
            self.passed_on
                .extend(self.euclid.merge(&signed(share), now)?.shares);
        }
        Ok(())
    }

    /// The first malicious vehicle announces leaderships of its own to both candidates. One candidate starts, and
    /// follows it until the aggregator renews its term. Fails if the aggregator accepts any evidence.
    fn forge(
        &mut self,
        round: u64,
        vehicles: usize,
        faulty: usize,
        now: Timestamp,
    ) -> Result<(), Box<dyn Error>> {
        if round == MISLED.start {
            self.euclid.go_by(3, "liar-0", Position::Following)?;
        } else if round == MISLED.end {
            self.edge.go_by(4, "edge", Position::Leading)?;
            self.euclid.go_by(4, "edge", Position::Following)?;
        }
        for term in 1..=3 {
            let share = forged(term, vehicles, faulty)?;
            let merged = self.edge.merge(&share, now)?;
            let is_taken = self.euclid.merge(&share, now)?.is_news;
            if merged.is_news
                || merged.refused.is_empty()
                || (is_taken && !MISLED_WITH_LAST_WORD.contains(&round))
            {
                return Err(
                    format!("round {round}: forged evidence of term {term} was taken").into(),
                );
            }
        }
        let Candidate {
            resync,
            ledger,
            leadership,
        } = &mut self.euclid;
        self.passed_on
            .extend(resync.tick(ledger, leadership, now).shares);
        for share in self.passed_on.drain(..).map(signed) {
            if self.edge.merge(&share, now)?.is_news {
                return Err(format!("round {round}: forged evidence was passed on").into());
            }
        }
        Ok(())
    }
}

/// The share as its aggregator signs it.
fn signed(share: LedgerShare) -> LedgerShare {
    let signature = LedgerSignature {
        certificate: String::new(),
        signature: "valid".into(),
    };
    LedgerShare {
        signed: Some(signature).filter(|_| !share.is_empty()),
        ..share
    }
}

/// Evidence of a leadership of the first malicious vehicle: all malicious vehicles are right and all others wrong.
fn forged(term: u64, vehicles: usize, faulty: usize) -> Result<LedgerShare, Box<dyn Error>> {
    let forger = NodeName::new("liar-0")?;
    let entry = |vehicle: usize, label: &str| {
        let is_faulty = vehicle < faulty;
        let node = NodeName::new(format!(
            "{}-{vehicle}",
            if is_faulty { "liar" } else { "honest" }
        ))?;
        let (correct, incorrect) = if is_faulty {
            (1_000_000, 0)
        } else {
            (0, 1_000_000)
        };
        Ok(LedgerEntry {
            epoch: term,
            aggregator: forger.clone(),
            node,
            label: label.into(),
            correct,
            incorrect,
        })
    };
    let pairs = (0..vehicles).flat_map(|vehicle| LABELS.map(|label| (vehicle, label)));
    let entries = pairs
        .map(|(vehicle, label)| entry(vehicle, label))
        .collect::<Result<_, Box<dyn Error>>>()?;
    let epoch = (term == 3).then_some(term);
    let schema = SCHEMA_VERSION;
    let marks = Vec::new();
    Ok(signed(LedgerShare {
        schema,
        node: forger,
        epoch,
        entries,
        marks,
        signed: None,
        reset_at_us: None,
    }))
}

struct Course {
    /// Share of right verdicts, and of right majorities of all vehicles, for each ten rounds.
    accuracy: Vec<(f64, f64)>,
    /// Mean reputation of the honest and of the malicious vehicles at the end of each ten rounds.
    reputation: Vec<(f64, f64)>,
    /// Percentages after the start phase: right verdicts, right majorities of all votes, and right majorities of the
    /// honest votes.
    settled: f64,
    majority: f64,
    honest: f64,
}

/// The courses of all seeds.
struct Case {
    vehicles: usize,
    fault: Fault,
    courses: Vec<Course>,
}

impl Case {
    fn mean(&self, of: impl Fn(&Course) -> f64) -> f64 {
        self.courses.iter().map(of).sum::<f64>() / self.courses.len().max(1) as f64
    }

    fn faulty(&self) -> usize {
        (self.vehicles - 1) / 2
    }

    fn fault_name(&self) -> String {
        match self.fault {
            Fault::Forging => "forges evidence".into(),
            fault => format!("{fault:?}").to_lowercase(),
        }
    }

    /// Title of the panel.
    fn name(&self) -> String {
        format!(
            "{}, {} of {} lie",
            self.fault_name(),
            self.faulty(),
            self.vehicles
        )
    }

    fn worst(&self) -> f64 {
        self.courses
            .iter()
            .map(|c| c.settled)
            .fold(f64::INFINITY, f64::min)
    }

    /// The violation, if malicious vehicles have more effect than the bound allows.
    fn flaw(&self) -> Option<String> {
        let worst = self.worst();
        let verdicts = self.mean(|c| c.settled);
        let honest = self.mean(|c| c.honest);
        let is_good = worst >= MIN_WORST && verdicts >= honest;
        let bound = format!("at least {MIN_WORST} and {honest:.1}, the honest majority's");
        (!is_good).then(|| {
            format!(
                "{}: worst {worst:.1} %, mean {verdicts:.1} %, to be {bound}",
                self.name()
            )
        })
    }

    fn row(&self) -> String {
        let worst = self.worst();
        let last = |c: &Course| c.reputation.last().copied().unwrap_or_default();
        format!(
            "| {} | {} | {} | {:.1} | {:.1} | {:.1} | {worst:.1} | {:.2} | {:.2} |\n",
            self.vehicles,
            self.faulty(),
            self.fault_name(),
            self.mean(|c| c.majority),
            self.mean(|c| c.honest),
            self.mean(|c| c.settled),
            self.mean(|c| last(c).0),
            self.mean(|c| last(c).1),
        )
    }
}

fn other(rng: &mut ChaCha8Rng, truth: usize) -> usize {
    (truth + rng.random_range(1..LABELS.len())) % LABELS.len()
}

/// Chance that `truth` wins a majority vote, ties broken at random.
fn chance_of_most(votes: &[usize], truth: usize) -> f64 {
    let most = votes.iter().max().copied().unwrap_or(0);
    let first = votes.iter().filter(|n| **n == most).count();
    if votes[truth] == most {
        1.0 / first as f64
    } else {
        0.0
    }
}

fn run(vehicles: usize, fault: Fault, seed: u64) -> Result<Course, Box<dyn Error>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let faulty = (vehicles - 1) / 2;
    let mut vote = Vote::new(VoteConfig::default(), Vec::new());
    let mut course = Course {
        accuracy: Vec::new(),
        reputation: Vec::new(),
        settled: 0.0,
        majority: 0.0,
        honest: 0.0,
    };
    let mut right = 0;
    let mut right_most = 0.0;
    let mut settled = 0;
    let mut majority = 0.0;
    let mut honest = 0.0;
    let mut now = Timestamp(1_700_000_000_000_000);
    let mut truths = [0; LANDMARKS];
    let mut cell = Cell::new()?;
    for round in 0..ROUNDS {
        now = now + PERIOD;
        if fault == Fault::Forging {
            if round == RESTART {
                vote = Vote::new(VoteConfig::default(), Vec::new());
            }
            cell.forge(round, vehicles, faulty, now)?;
            if round == RESTART {
                vote.adopt(&cell.edge.ledger);
            }
        }
        // The objects are exchanged when the votes on the last objects are stale.
        if round % 6 == 0 {
            now = now + Duration::from_secs(3);
            truths
                .iter_mut()
                .for_each(|t| *t = rng.random_range(0..LABELS.len()));
        }
        let common: Vec<usize> = truths.iter().map(|&t| other(&mut rng, t)).collect();
        let mut said = vec![[0usize; LABELS.len()]; LANDMARKS];
        let mut said_honestly = said.clone();
        for vehicle in 0..vehicles {
            let is_false = vehicle < faulty && !(fault == Fault::Turning && round < ROUNDS / 3);
            let name = match fault {
                Fault::Rejoining if is_false => format!("liar-{vehicle}-{}", round / 10),
                _ => format!(
                    "{}-{vehicle}",
                    if vehicle < faulty { "liar" } else { "honest" }
                ),
            };
            let mut objects = Vec::new();
            for (place, &truth) in truths.iter().enumerate() {
                let label = match fault {
                    _ if !is_false => {
                        if rng.random_bool(HONEST_ACCURACY) {
                            truth
                        } else {
                            other(&mut rng, truth)
                        }
                    }
                    Fault::Random => other(&mut rng, truth),
                    Fault::Constant => 0,
                    Fault::Copying | Fault::Turning | Fault::Rejoining | Fault::Forging => {
                        common[place]
                    }
                };
                said[place][label] += 1;
                said_honestly[place][label] += usize::from(vehicle >= faulty);
                objects.push(PerceivedObject {
                    landmark: Some(format!("place-{place}").into()),
                    ..PerceivedObject::new(LABELS[label], 0.8, 0.0, 0.0)
                });
            }
            let node = NodeName::new(name)?;
            let report = ObjectReport {
                objects,
                ..ObjectReport::new(node, round, now)
            };
            vote.observe(&report, now)?;
        }
        let closed = vote.close(now);
        cell.record(&closed.evidence, now)?;
        let verdicts: BTreeMap<_, Option<Label>> = closed
            .verdicts
            .into_iter()
            .map(|v| (v.landmark, v.label))
            .collect();
        for (place, &truth) in truths.iter().enumerate() {
            let label = verdicts
                .get(format!("place-{place}").as_str())
                .cloned()
                .flatten();
            let good = usize::from(label.as_deref() == Some(LABELS[truth]));
            let most = chance_of_most(&said[place], truth);
            right += good;
            right_most += most;
            if round >= SETTLED {
                settled += good;
                majority += most;
                honest += chance_of_most(&said_honestly[place], truth);
            }
        }
        if round % 10 == 9 {
            let judged = (10 * LANDMARKS) as f64;
            course
                .accuracy
                .push((right as f64 / judged, right_most / judged));
            right = 0;
            right_most = 0.0;
            let reputations = vote.reputations();
            let mean = |prefix: &str| {
                let scores: Vec<f64> = reputations
                    .iter()
                    .filter(|(n, _)| n.as_str().starts_with(prefix))
                    .map(|(_, r)| r.score)
                    .collect();
                scores.iter().sum::<f64>() / scores.len().max(1) as f64
            };
            course.reputation.push((mean("honest"), mean("liar")));
        }
    }
    let judged = (ROUNDS - SETTLED) as f64 * LANDMARKS as f64;
    course.settled = 100.0 * settled as f64 / judged;
    course.majority = 100.0 * majority / judged;
    course.honest = 100.0 * honest / judged;
    Ok(course)
}

/// A column for each number of vehicles, a row for each attack.
fn draw(path: &str, cases: &[Case]) -> Result<(), Box<dyn Error>> {
    let columns = SIZES.len();
    let area = SVGBackend::new(path, (320 * columns as u32, 1200)).into_drawing_area();
    area.fill(&WHITE)?;
    let (legend, panels) = area.split_vertically(32);
    let mut x = 12;
    for (name, color) in SERIES {
        legend.draw(&PathElement::new(
            [(x, 16), (x + 28, 16)],
            color.stroke_width(3),
        ))?;
        legend.draw(&Text::new(name, (x + 34, 8), ("sans-serif", 17)))?;
        x += 270;
    }
    for (place, area) in panels
        .split_evenly((FAULTS.len(), columns))
        .iter()
        .enumerate()
    {
        let Some(case) = cases.get(place % columns * FAULTS.len() + place / columns) else {
            continue;
        };
        let mut chart = ChartBuilder::on(area)
            .margin(8)
            .margin_right(24)
            .caption(case.name(), ("sans-serif", 17))
            .x_label_area_size(36)
            .y_label_area_size(36)
            .build_cartesian_2d(0.0..ROUNDS as f64, 0.0..1.04)?;
        chart
            .configure_mesh()
            .x_labels(4)
            .x_label_formatter(&|x| format!("{x:.0}"))
            .y_labels(6)
            .y_label_formatter(&|y| format!("{y:.1}"))
            .x_desc("round")
            .label_style(("sans-serif", 14))
            .light_line_style(WHITE)
            .draw()?;
        let course = |of: fn(&Course, usize) -> f64| {
            (0..(ROUNDS / 10) as usize)
                .map(move |n| (n as f64 * 10.0 + 10.0, case.mean(|c| of(c, n))))
        };
        let courses: [fn(&Course, usize) -> f64; SERIES.len()] = [
            |c, n| c.accuracy[n].1,
            |c, n| c.accuracy[n].0,
            |c, n| c.reputation[n].0,
            |c, n| c.reputation[n].1,
        ];
        for ((_, color), of) in SERIES.iter().zip(courses) {
            chart.draw_series(LineSeries::new(course(of), color.stroke_width(2)))?;
        }
    }
    area.present()?;
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut svg = None;
    let mut file = None;
    let mut text = None;
    let mut seeds = 5;
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args.next().ok_or_else(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--svg" => svg = Some(value),
            "--table" => file = Some(value),
            "--write-table" => text = Some(PathBuf::from(value)),
            "--seeds" => seeds = value.parse()?,
            _ => return Err(format!("unknown option {key}").into()),
        }
    }
    let header = "| vehicles | faulty | kind | majority % | honest majority % | verdicts % | worst % | honest | faulty |\n\
         |---|---|---|---|---|---|---|---|---|\n";
    let mut table = header.to_owned();
    let mut shown = header.to_owned();
    let mut cases = Vec::new();
    for vehicles in SIZES {
        for fault in FAULTS {
            let courses = (1..=seeds)
                .map(|seed| run(vehicles, fault, seed))
                .collect::<Result<_, _>>()?;
            let case = Case {
                vehicles,
                fault,
                courses,
            };
            table.push_str(&case.row());
            if SHOWN_SIZES.contains(&vehicles) {
                shown.push_str(&case.row());
            }
            cases.push(case);
        }
    }
    print!("{table}");
    if let Some(path) = file {
        std::fs::write(path, &table)?;
    }
    if let Some(path) = text {
        write_table(&path, "liars", &shown)?;
    }
    if let Some(path) = svg {
        draw(&path, &cases)?;
    }
    let flaws: Vec<_> = cases.iter().filter_map(Case::flaw).collect();
    if flaws.is_empty() {
        Ok(())
    } else {
        Err(flaws.join("\n").into())
    }
}
