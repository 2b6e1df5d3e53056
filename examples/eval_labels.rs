//! Accuracy of VOTE on label sets, measured with the program: one landmark per item, one vehicle per annotator, without
//! geometry.
//!
//! `make eval-labels`, or `cargo run --example eval_labels -- --program target/release/ecod-node [--sets DIR]
//! [--config FILE] [--passes N] [--seed S] [--keep FRACTION] [--work DIR] [--write-table FILE]`
//!
//! DIR contains a folder for each set, or is such a folder: `label.csv` with the columns `item,worker,label` and
//! optionally `confidence` (0 to 1, default 1), and `truth.csv` with `item,truth`. Each set is written as a recording,
//! processed by `ecod-node replay` in one pass, with passes, and in `paper` mode, and judged by the `ecod-lab eval` in
//! the folder of `ecod-node`. All files are kept in the work folder.
//!
//! A second table compares PACE, VOTE and the label on which both agree, with default settings except for the memory
//! limits: the items are assigned to [`PLACES`] landmarks in turn, and each annotator reports every item for both
//! algorithms. A tie is decided for the label that sorts first, so each figure is the mean of two runs: one with the
//! labels in the set's order, one in reverse order.
//!
//! A recording resembles a drive: the items follow one another in random order, and the annotators of an item report in
//! random order within the round in which the item is in view. `--keep` drops labels at random, to measure how the
//! accuracy depends on their number.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, bail};
use ecod::model::names::{MAX_NAME_BYTES, NodeName};
use ecod_lab::document::write_table;
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

/// Name and best published or recomputed accuracy in percent.
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

const HEADER: &str = "| set | majority | best known | `paper` | online, one pass | with passes |\n|---|---|---|---|---|---|\n";
const START_US: u64 = 1_700_000_000_000_000;
const ROUND_US: u64 = 100_000;

/// Landmarks of the comparison. The votes on an item expire before the next item is assigned to its landmark.
const PLACES: u64 = 50;
const PLACE_DISTANCE_M: f64 = 10.0;

/// Orders of the labels in the comparison.
const ORDERS: [&str; 2] = ["as-given", "reversed"];

const ANSWER_HEADER: &str = "| set | PACE alone | VOTE alone | one answer |\n|---|---|---|---|\n";

struct Options {
    program: PathBuf,
    sets: PathBuf,
    config: PathBuf,
    passes: u32,
    seed: u64,
    keep: f64,
    work: PathBuf,
    table: Option<PathBuf>,
}

fn options() -> anyhow::Result<Options> {
    let here = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
    let mut options = Options {
        program: here.join("target/release/ecod-node"),
        sets: here.join("examples/crowd_labels"),
        config: here.join("examples/labels.toml"),
        passes: 50,
        seed: 1,
        keep: 1.0,
        work: here.join("target/eval-labels"),
        table: None,
    };
    let mut args = std::env::args().skip(1);
    while let Some(key) = args.next() {
        let value = args
            .next()
            .with_context(|| format!("{key} needs a value"))?;
        match key.as_str() {
            "--program" => options.program = value.into(),
            "--sets" => options.sets = value.into(),
            "--config" => options.config = value.into(),
            "--passes" => options.passes = value.parse()?,
            "--seed" => options.seed = value.parse()?,
            "--keep" => options.keep = value.parse()?,
            "--work" => options.work = value.into(),
            "--write-table" => options.table = Some(value.into()),
            _ => bail!("unknown option {key}"),
        }
    }
    Ok(options)
}

/// Maps the names of a set to names that are allowed in a report: unchanged if possible, otherwise numbered.
struct Names {
    kind: &'static str,
    is_allowed: fn(&str) -> bool,
    known: HashMap<String, String>,
}

impl Names {
    fn new(kind: &'static str, is_allowed: fn(&str) -> bool) -> Self {
        Self {
            kind,
            is_allowed,
            known: HashMap::new(),
        }
    }

    fn of(&mut self, name: &str) -> String {
        let kind = self.kind;
        let number = self.known.len();
        let is_allowed = self.is_allowed;
        let given = || {
            if is_allowed(name) {
                name.to_owned()
            } else {
                format!("{kind}~{number}")
            }
        };
        self.known
            .entry(name.to_owned())
            .or_insert_with(given)
            .clone()
    }
}

fn is_label(text: &str) -> bool {
    (1..=MAX_NAME_BYTES).contains(&text.len()) && !text.chars().any(char::is_control)
}

/// The rows of a table, each with the values of the named columns; columns after `required` may be absent.
fn rows(path: &Path, columns: &[&str], required: usize) -> anyhow::Result<Vec<Vec<String>>> {
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_path(path)?;
    let header = reader.headers()?.clone();
    let place = |column: &&str| {
        header
            .iter()
            .position(|name| name.trim_start_matches('\u{feff}') == *column)
    };
    let places: Vec<Option<usize>> = columns.iter().map(place).collect();
    if let Some(missing) = places[..required].iter().position(Option::is_none) {
        bail!("there is no column {}", columns[missing]);
    }
    let read = |row: csv::StringRecord| {
        places
            .iter()
            .map(|place| {
                place
                    .and_then(|p| row.get(p))
                    .unwrap_or_default()
                    .to_owned()
            })
            .collect()
    };
    reader.records().map(|row| Ok(read(row?))).collect()
}

/// Writes a set as a recording and its truth.
fn convert(set: &Path, work: &Path, options: &Options) -> anyhow::Result<()> {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let mut names = Names::new("item", is_label);
    let mut labels = Names::new("label", is_label);
    let mut workers = Names::new("worker", |name| NodeName::new(format!("w{name}")).is_ok());
    let mut items: BTreeMap<String, Vec<(String, String, f64)>> = BTreeMap::new();
    let path = set.join("label.csv");
    let of_path = || path.display().to_string();
    for (number, row) in rows(&path, &["item", "worker", "label", "confidence"], 3)
        .with_context(of_path)?
        .into_iter()
        .enumerate()
    {
        if rng.random_bool(options.keep) {
            let confidence = if row[3].is_empty() {
                1.0
            } else {
                row[3].parse().unwrap_or(f64::NAN)
            };
            if !(0.0..=1.0).contains(&confidence) {
                bail!(
                    "{}, row {}: confidence {:?} is not 0 to 1",
                    of_path(),
                    number + 1,
                    row[3]
                );
            }
            let worker = format!("w{}", workers.of(&row[1]).replace('~', "-"));
            items.entry(names.of(&row[0])).or_default().push((
                worker,
                labels.of(&row[2]),
                confidence,
            ));
        }
    }
    let path = set.join("truth.csv");
    let truth: BTreeMap<String, String> = rows(&path, &["item", "truth"], 2)
        .with_context(|| path.display().to_string())?
        .into_iter()
        .map(|row| (names.of(&row[0]), labels.of(&row[1])))
        .collect();
    let mut order: Vec<_> = items.into_iter().collect();
    order.shuffle(&mut rng);
    let mut sequence: HashMap<String, u64> = HashMap::new();
    let mut reports = Vec::new();
    for (round, (item, mut votes)) in (0..).zip(order) {
        votes.shuffle(&mut rng);
        for (worker, label, confidence) in votes {
            let seq = sequence.entry(worker.clone()).or_default();
            *seq += 1;
            let object = json!({"label": label, "confidence": confidence, "x_m": 0.0, "y_m": 0.0, "landmark": item});
            let at = START_US + round * ROUND_US;
            reports.push(json!({"schema": 1, "node": worker, "seq": seq, "captured_at_us": at, "objects": [object],
                "topic": "vote_detections"}));
        }
    }
    let mut recording = BufWriter::new(File::create(work.join("reports.jsonl"))?);
    reports
        .iter()
        .try_for_each(|report| writeln!(recording, "{report}"))?;
    recording.flush()?;
    fs::write(
        work.join("truth.json"),
        json!({ "landmarks": truth }).to_string(),
    )?;
    ORDERS
        .iter()
        .try_for_each(|order| place(&reports, &truth, work, order))
}

/// Writes a set for the comparison: its items at landmarks, for both algorithms, with labels named by their order.
fn place(
    reports: &[Value],
    truth: &BTreeMap<String, String>,
    work: &Path,
    order: &str,
) -> anyhow::Result<()> {
    let reported = reports
        .iter()
        .filter_map(|report| report["objects"][0]["label"].as_str());
    let labels: BTreeSet<&str> = reported.chain(truth.values().map(String::as_str)).collect();
    let named = |label: &str| {
        let rank = labels.range(..label).count();
        format!(
            "{:04}",
            if order == ORDERS[0] {
                rank
            } else {
                labels.len() - rank
            }
        )
    };
    let mut placed = BufWriter::new(File::create(work.join(format!("placed-{order}.jsonl")))?);
    let mut spans: BTreeMap<String, Vec<Value>> = BTreeMap::new();
    let mut item_before = None;
    for report in reports {
        let object = &report["objects"][0];
        let mut report = report.clone();
        // An item without truth would be judged by the truth of the item before it.
        let Some(true_label) = object["landmark"].as_str().and_then(|item| truth.get(item)) else {
            continue;
        };
        let at = report["captured_at_us"]
            .as_u64()
            .context("a report without time")?;
        let place = (at - START_US) / ROUND_US % PLACES;
        if item_before.replace(at) != Some(at) {
            let span = json!({"from_us": at, "label": named(true_label)});
            spans
                .entry(format!("place-{place}"))
                .or_default()
                .push(span);
        }
        let label = named(object["label"].as_str().context("a report without label")?);
        report["objects"][0]["label"] = label.into();
        report["objects"][0]["landmark"] = format!("place-{place}").into();
        report["objects"][0]["x_m"] = (place as f64 * PLACE_DISTANCE_M).into();
        for topic in ["vote_detections", "detections"] {
            report["topic"] = topic.into();
            writeln!(placed, "{report}")?;
        }
    }
    placed.flush()?;
    fs::write(
        work.join(format!("placed-{order}-truth.json")),
        json!({ "landmarks": spans }).to_string(),
    )?;
    Ok(())
}

/// Runs the program and prints only the rejections in its output.
fn run(command: &mut Command) -> anyhow::Result<()> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .with_context(|| format!("cannot run {command:?}"))?;
    let said = String::from_utf8_lossy(&output.stderr);
    if !output.status.success() {
        bail!("{command:?}: {said}");
    }
    let is_news =
        |line: &&str| line.starts_with("rejected") && !line.starts_with("rejected not_fused");
    said.lines()
        .filter(is_news)
        .for_each(|line| eprintln!("{line}"));
    Ok(())
}

/// Accuracy in percent of one run and of the majority.
fn measure(
    options: &Options,
    work: &Path,
    name: &str,
    config: &Path,
    passes: u32,
) -> anyhow::Result<(f64, f64)> {
    let result = judge(
        options,
        work,
        name,
        config,
        passes,
        ["reports.jsonl", "truth.json"],
    )?;
    let figure = |key: &str| {
        result["vote"][key]
            .as_f64()
            .with_context(|| format!("{name}: eval gave no {key}"))
    };
    Ok((figure("accuracy_pct")?, figure("majority_accuracy_pct")?))
}

/// Accuracy in percent of PACE, of VOTE, and of the map with both algorithms.
fn compare(options: &Options, work: &Path) -> anyhow::Result<[f64; 3]> {
    let accuracy = |algorithms: &str, judged: &str| -> anyhow::Result<f64> {
        let config = placed_config(options, algorithms)?;
        let in_order = |order: &str| {
            let files = [
                format!("placed-{order}.jsonl"),
                format!("placed-{order}-truth.json"),
            ];
            let result = judge(
                options,
                work,
                &format!("placed-{order}-{algorithms}"),
                &config,
                0,
                files.each_ref().map(|f| &**f),
            )?;
            result[judged]["accuracy_pct"]
                .as_f64()
                .with_context(|| format!("{algorithms}: eval gave no accuracy"))
        };
        Ok((in_order(ORDERS[0])? + in_order(ORDERS[1])?) / ORDERS.len() as f64)
    };
    Ok([
        accuracy("pace", "pace")?,
        accuracy("vote", "vote")?,
        accuracy("both", "pace")?,
    ])
}

/// The configuration of the comparison.
fn placed_config(options: &Options, algorithms: &str) -> anyhow::Result<PathBuf> {
    let places = (0..PLACES)
        .map(|place| json!({"id": format!("place-{place}"), "x_m": place as f64 * PLACE_DISTANCE_M, "y_m": 0}));
    let config = json!({
        "fusion": {
            "algorithms": algorithms,
            "round": { "close": "periodic", "period_s": ROUND_US as f64 / 1e6 },
            "window": { "max_vehicles": 10_000 },
            "vote": { "max_vehicles": 10_000, "max_labels": 65_535 },
            "tracks": { "mode": "off" },
        },
        "landmarks": places.collect::<Vec<_>>(),
    });
    let path = options.work.join(format!("placed-{algorithms}.toml"));
    fs::write(&path, toml::to_string(&config)?)?;
    Ok(path)
}

/// Scores of a replay of the reports by `ecod-lab eval`.
fn judge(
    options: &Options,
    work: &Path,
    name: &str,
    config: &Path,
    passes: u32,
    [reports, truth]: [&str; 2],
) -> anyhow::Result<Value> {
    let reports = work.join(reports);
    let output = work.join(format!("{name}.jsonl"));
    let mut replay = Command::new(&options.program);
    replay
        .arg("replay")
        .arg("--config")
        .arg(config)
        .arg("--input")
        .arg(&reports)
        .arg("--output")
        .arg(&output);
    if passes > 0 {
        replay.arg("--passes").arg(passes.to_string());
    }
    run(&mut replay)?;
    let result = work.join(format!("{name}.json"));
    let mut eval = Command::new(options.program.with_file_name("ecod-lab"));
    eval.arg("eval")
        .arg("--truth")
        .arg(work.join(truth))
        .arg("--input")
        .arg(&output);
    run(eval
        .arg("--reports")
        .arg(&reports)
        .arg("--output")
        .arg(&result))?;
    Ok(serde_json::from_slice(&fs::read(&result)?)?)
}

/// The configuration with the paper's formulas and a verdict after every item.
fn paper_config(options: &Options) -> anyhow::Result<PathBuf> {
    let text = fs::read_to_string(&options.config)
        .with_context(|| options.config.display().to_string())?;
    let mut config: toml::Table = toml::from_str(&text)?;
    let table = |parent: &mut toml::Table, key: &str| -> anyhow::Result<toml::Table> {
        match parent.remove(key) {
            None => Ok(toml::Table::new()),
            Some(toml::Value::Table(table)) => Ok(table),
            Some(_) => bail!("{key} is not a table"),
        }
    };
    let mut fusion = table(&mut config, "fusion")?;
    let mut vote = table(&mut fusion, "vote")?;
    let mut paper = table(&mut vote, "paper")?;
    paper.insert("frames_per_verdict".into(), 1.into());
    vote.insert("mode".into(), "paper".into());
    vote.insert("paper".into(), paper.into());
    fusion.insert("vote".into(), vote.into());
    config.insert("fusion".into(), fusion.into());
    let path = options.work.join("paper.toml");
    fs::write(&path, toml::to_string(&config)?)?;
    Ok(path)
}

/// The folders of the sets; the sets with published accuracies come first.
fn sets(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let is_set = |path: &PathBuf| path.join("label.csv").is_file();
    if is_set(&folder.to_owned()) {
        return Ok(vec![folder.to_owned()]);
    }
    let entries =
        fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?;
    let mut sets: Vec<PathBuf> = entries
        .filter_map(Result::ok)
        .map(|entry| entry.path())
        .filter(is_set)
        .collect();
    let rank = |path: &Path| {
        SETS.iter()
            .position(|(set, _)| path.ends_with(set))
            .unwrap_or(SETS.len())
    };
    sets.sort_by_key(|path| (rank(path), path.clone()));
    if sets.is_empty() {
        bail!("there is no set in {}", folder.display())
    } else {
        Ok(sets)
    }
}

fn main() -> anyhow::Result<()> {
    let options = options()?;
    fs::create_dir_all(&options.work)?;
    let paper_config = paper_config(&options)?;
    let mut table = HEADER.to_owned();
    let mut answers = ANSWER_HEADER.to_owned();
    print!("{table}");
    for set in sets(&options.sets)? {
        let name = fs::canonicalize(&set)?
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let work = options.work.join(&name);
        fs::create_dir_all(&work)?;
        convert(&set, &work, &options)?;
        let (paper, majority) = measure(&options, &work, "paper", &paper_config, 0)?;
        let (online, _) = measure(&options, &work, "online", &options.config, 0)?;
        let (refined, _) = measure(&options, &work, "passes", &options.config, options.passes)?;
        let best = SETS
            .iter()
            .find(|(set, _)| *set == name)
            .map_or(String::new(), |(_, best)| format!("{best:.1}"));
        let mut row = String::new();
        writeln!(
            row,
            "| {name} | {majority:.2} | {best} | {paper:.2} | {online:.2} | {refined:.2} |"
        )?;
        print!("{row}");
        table.push_str(&row);
        let [pace, vote, both] = compare(&options, &work)?;
        writeln!(answers, "| {name} | {pace:.2} | {vote:.2} | {both:.2} |")?;
    }
    print!("\n{answers}");
    if let Some(path) = &options.table {
        write_table(path, "label", &table)?;
        write_table(path, "answer", &answers)?;
    }
    Ok(())
}
