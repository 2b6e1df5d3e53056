//! Accuracy of VOTE on label sets: one landmark per item, one vehicle per annotator, no geometry.
//!
//! `cargo run --release --example eval_labels -- [--data DIR] [--config FILE] [--passes N] [--seed S] [--keep FRACTION]
//! [--stream SET] [--write-table FILE]`
//!
//! The stream comes as from a drive: items one after the other in random order, all annotators of an item in random
//! order within the round in which the item is in view. `--keep` drops labels at random, to see what an accuracy rests
//! on; `--stream` prints one set's stream as lines for `ecod-node replay`.

use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use ecod::names::{LandmarkId, NodeName};
use ecod::time::Timestamp;
use ecod::vote::{Vote, VoteConfig, VoteMode};
use ecod::wire::{ObjectReport, PerceivedObject, SCHEMA_VERSION, Verdict};
use rand::RngExt;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// Name, majority and best published or recomputed accuracy in percent.
const SETS: [(&str, f64); 8] = [
    ("bluebird", 88.9),
    ("dog", 84.3),
    ("rte", 93.1),
    ("web", 85.9),
    ("trec", 70.5),
    ("product", 93.9),
    ("sentiment", 96.1),
    ("face", 64.0),
];

const START_US: u64 = 1_700_000_000_000_000;
const ROUND_US: u64 = 100_000;

struct Options {
    data: PathBuf,
    config: PathBuf,
    passes: u32,
    seed: u64,
    keep: f64,
    stream: Option<String>,
    table: Option<PathBuf>,
}

fn options() -> Result<Options, Box<dyn Error>> {
    let here = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let mut options = Options {
        data: here.join("crowd_labels"),
        config: here.join("labels.toml"),
        passes: 50,
        seed: 1,
        keep: 1.0,
        stream: None,
        table: None,
    };
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args.next().ok_or_else(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--data" => options.data = value.into(),
            "--config" => options.config = value.into(),
            "--passes" => options.passes = value.parse()?,
            "--seed" => options.seed = value.parse()?,
            "--keep" => options.keep = value.parse()?,
            "--stream" => options.stream = Some(value),
            "--write-table" => options.table = Some(value.into()),
            _ => return Err(format!("unknown option {key}").into()),
        }
    }
    Ok(options)
}

struct Set {
    /// One round of reports per item.
    rounds: Vec<Vec<ObjectReport>>,
    truth: BTreeMap<LandmarkId, String>,
}

fn rows(path: &Path) -> Result<Vec<Vec<String>>, Box<dyn Error>> {
    let text = fs::read_to_string(path).map_err(|e| format!("{}: {e}", path.display()))?;
    Ok(text.lines().skip(1).map(|line| line.split(',').map(|f| f.trim().to_owned()).collect()).collect())
}

fn load(folder: &Path, options: &Options) -> Result<Set, Box<dyn Error>> {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut items: BTreeMap<String, Vec<(String, String, f64)>> = BTreeMap::new();
    for row in rows(&folder.join("label.csv"))? {
        let [item, worker, label, rest @ ..] = row.as_slice() else { return Err("a row with too few columns".into()) };
        if rng.random_bool(options.keep) {
            let confidence = rest.first().map_or(Ok(1.0), |c| c.parse())?;
            items.entry(item.clone()).or_default().push((worker.clone(), label.clone(), confidence));
        }
    }
    let mut order: Vec<_> = items.into_iter().collect();
    order.shuffle(&mut rng);
    let mut sequence: HashMap<String, u64> = HashMap::new();
    let mut rounds = Vec::with_capacity(order.len());
    for (round, (item, mut labels)) in order.into_iter().enumerate() {
        labels.shuffle(&mut rng);
        let mut reports = Vec::with_capacity(labels.len());
        for (worker, label, confidence) in labels {
            let seq = sequence.entry(worker.clone()).or_default();
            *seq += 1;
            reports.push(ObjectReport {
                schema: SCHEMA_VERSION,
                node: NodeName::new(format!("w{worker}"))?,
                seq: *seq,
                captured_at_us: Timestamp(START_US + round as u64 * ROUND_US),
                pose: None,
                objects: vec![PerceivedObject {
                    label: label.into(),
                    confidence,
                    x_m: 0.0,
                    y_m: 0.0,
                    covariance_m2: None,
                    landmark: Some(item.clone().into()),
                }],
                seen: None,
            });
        }
        rounds.push(reports);
    }
    let truth = rows(&folder.join("truth.csv"))?.into_iter().map(|r| (r[0].clone().into(), r[1].clone())).collect();
    Ok(Set { rounds, truth })
}

fn percent(right: f64, all: usize) -> f64 {
    100.0 * right / all.max(1) as f64
}

/// Accuracy in percent over the items with a truth and votes.
fn accuracy(set: &Set, verdicts: &BTreeMap<LandmarkId, Verdict>) -> f64 {
    let judged: Vec<_> = set.truth.iter().filter_map(|(l, t)| verdicts.get(l).map(|v| (v, t))).collect();
    let right = judged.iter().filter(|(v, t)| v.label.as_deref() == Some(t.as_str())).count();
    percent(right as f64, judged.len())
}

/// Expected accuracy in percent of the most frequent label, ties broken at random.
fn majority(set: &Set) -> f64 {
    let (mut right, mut all) = (0.0, 0);
    for reports in &set.rounds {
        let mut votes: BTreeMap<&str, usize> = BTreeMap::new();
        for object in reports.iter().flat_map(|r| &r.objects) {
            *votes.entry(object.label.as_str()).or_default() += 1;
        }
        let item = reports.first().and_then(|r| r.objects[0].landmark.clone()).unwrap_or_default();
        let Some(truth) = set.truth.get(&item) else { continue };
        let most = votes.values().max().copied().unwrap_or(0);
        let first = votes.values().filter(|v| **v == most).count();
        all += 1;
        right += if votes.get(truth.as_str()) == Some(&most) { 1.0 / first as f64 } else { 0.0 };
    }
    percent(right, all)
}

fn run(set: &Set, config: VoteConfig) -> Result<(BTreeMap<LandmarkId, Verdict>, Vote), Box<dyn Error>> {
    let mut vote = Vote::new(config, Vec::new());
    let mut latest = BTreeMap::new();
    for reports in &set.rounds {
        for report in reports {
            vote.observe(report, report.captured_at_us)?;
        }
        let Some(now) = reports.first().map(|r| r.captured_at_us) else { continue };
        for verdict in vote.close(now).verdicts {
            latest.insert(verdict.landmark.clone(), verdict);
        }
    }
    Ok((latest, vote))
}

fn write_table(path: &Path, table: &str) -> Result<(), Box<dyn Error>> {
    const BEGIN: &str = "<!-- label table begin -->\n";
    const END: &str = "<!-- label table end -->";
    let text = fs::read_to_string(path)?;
    let (before, rest) = text.split_once(BEGIN).ok_or("no begin marker")?;
    let (_, after) = rest.split_once(END).ok_or("no end marker")?;
    Ok(fs::write(path, format!("{before}{BEGIN}{table}{END}{after}"))?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = options()?;
    let config: VoteConfig = toml::from_str(&fs::read_to_string(&options.config)?)?;
    config.validate()?;
    if let Some(name) = &options.stream {
        for report in load(&options.data.join(name), &options)?.rounds.iter().flatten() {
            let mut line = serde_json::to_value(report)?;
            line["topic"] = "vote_detections".into();
            println!("{line}");
        }
        return Ok(());
    }
    let mut table = String::from(
        "| set | majority | best known | `paper` | online, one pass | with passes |\n|---|---|---|---|---|---|\n",
    );
    print!("{table}");
    let mut names: Vec<_> =
        fs::read_dir(&options.data)?.filter_map(Result::ok).filter(|e| e.path().join("label.csv").is_file()).collect();
    let rank = |name: &str| SETS.iter().position(|(set, _)| *set == name).unwrap_or(SETS.len());
    names.sort_by_key(|e| (rank(&e.file_name().to_string_lossy()), e.file_name()));
    for entry in names {
        let name = entry.file_name().to_string_lossy().into_owned();
        let set = load(&entry.path(), &options)?;
        let paper = run(&set, VoteConfig { mode: VoteMode::Paper, ..config.clone() })?.0;
        let (online, mut vote) = run(&set, config.clone())?;
        let refined = vote.refine(options.passes).into_iter().map(|v| (v.landmark.clone(), v)).collect();
        let best = SETS.iter().find(|(set, _)| *set == name).map_or("".to_owned(), |(_, best)| format!("{best:.1}"));
        let mut row = String::new();
        writeln!(
            row,
            "| {name} | {:.2} | {best} | {:.2} | {:.2} | {:.2} |",
            majority(&set),
            accuracy(&set, &paper),
            accuracy(&set, &online),
            accuracy(&set, &refined)
        )?;
        print!("{row}");
        table.push_str(&row);
    }
    if let Some(path) = &options.table {
        write_table(path, &table)?;
    }
    Ok(())
}
