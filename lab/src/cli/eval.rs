//! `ecod-lab eval`: accuracy of the output of a replay, or of several methods beside each other.

mod comparison;
mod tracks;

use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::model::names::Label;
use ecod::perception::landmark::LandmarkIndex;
use ecod::replay::{FusedLine, ReplayConfig, read_report};
use ecod::wire::{GlobalMap, RejectReason, Verdicts};
use ecod_actors::cli::lines::{self, LineRead, read_line};
use ecod_actors::cli::{Failure, cell};
use ecod_actors::platform::bounded_file;
use serde::Deserialize;
use serde_json::Value;

use super::columns::columns;
use super::files::frame_rate;
use super::write_json;
use crate::eval::formats::FileFormat;
use crate::eval::tracks::{TrackScores, TrackTruth};
use crate::eval::{ClassRecall, EvalResult, Evaluation, Scores, Truth};
use crate::report::tracks::percent;

/// Flags of `eval`.
#[derive(Debug, Args)]
pub(super) struct EvalArguments {
    /// Truth: the object at each location (JSON, or CSV with the columns item,truth), the places of
    /// all objects (JSON), or a file of --format
    #[arg(long, value_name = "FILE")]
    truth: PathBuf,
    /// Output of `replay`, or the map log of a node, `-` for standard input; with --format also a
    /// file of that form. Several are compared in one table, in a row for each NAME; files of one
    /// NAME are runs of one method, with other seeds for example
    #[arg(long = "input", value_name = "[NAME=]FILE", required = true)]
    inputs: Vec<MethodFile>,
    /// The reports that were replayed, for majority vote and every vehicle alone
    #[arg(long, value_name = "FILE")]
    reports: Option<PathBuf>,
    /// Configuration of the cell (TOML), to place reported objects that name no location and for
    /// synonyms; with --format, of the vehicle whose camera took the images, to place boxes
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Form of a benchmark's files, or of all files in a directory
    #[arg(long, value_enum, value_name = "FORM")]
    format: Option<FileFormat>,
    /// Frames a second in files of --format
    #[arg(long, value_name = "HZ", default_value_t = 10.0, value_parser = frame_rate, requires = "format")]
    frame_rate: f64,
    /// Write the results to this file (JSON); of several inputs also as CSV or LaTeX, if the file
    /// ends in .csv or .tex
    #[arg(short, long = "output", alias = "out", value_name = "FILE")]
    out: Option<PathBuf>,
}

/// A file to evaluate, and the name of the method that made it.
#[derive(Debug, Clone)]
struct MethodFile {
    method: Option<String>,
    path: PathBuf,
}

impl From<&str> for MethodFile {
    /// Reads `NAME=FILE` or `FILE`; a file whose path has a `=` is a file if it exists.
    fn from(text: &str) -> Self {
        match text.split_once('=') {
            Some((method, path)) if !method.is_empty() && !Path::new(text).exists() => Self {
                method: Some(method.to_owned()),
                path: path.into(),
            },
            _ => Self {
                method: None,
                path: text.into(),
            },
        }
    }
}

impl MethodFile {
    /// The given name of the method, or the file's name.
    fn method(&self) -> String {
        let of_file = || self.path.file_stem().unwrap_or(self.path.as_os_str());
        self.method
            .clone()
            .unwrap_or_else(|| of_file().to_string_lossy().into_owned())
    }
}

/// The result of one file.
enum Evaluated {
    Locations(Box<EvalResult>),
    Tracks(Box<TrackScores>),
}

/// Longest line of output in bytes: the last of several passes is one line.
const MAX_LINE_BYTES: usize = 1 << 28;

/// Classes and confusions that are printed; the file has all.
const MAX_ROWS: usize = 12;

/// A line of a replay's output or of a node's map log.
#[derive(Deserialize)]
#[serde(untagged)]
enum InputLine {
    Fused(FusedLine),
    Received { map: GlobalMap },
}

pub(super) fn run(arguments: &EvalArguments) -> Result<(), Failure> {
    let path = &arguments.truth;
    if let Some(out) = &arguments.out {
        let judged = || {
            [path]
                .into_iter()
                .chain(arguments.inputs.iter().map(|input| &input.path))
        };
        let mut inputs: Vec<_> = judged().chain(&arguments.reports).cloned().collect();
        for directory in judged().filter(|input| input.is_dir()) {
            let files = arguments
                .format
                .map(|format| format.files(directory))
                .transpose()
                .map_err(Failure::usage)?;
            inputs.extend(files.unwrap_or_default());
        }
        lines::check_apart(out, &inputs).map_err(Failure::usage)?;
    }
    if let [MethodFile { method: None, path }] = &arguments.inputs[..] {
        return print_one(arguments, &evaluate(arguments, path)?);
    }
    let mut runs = Vec::new();
    for input in &arguments.inputs {
        runs.extend(comparison::runs(input, &evaluate(arguments, &input.path)?));
    }
    comparison::print(&runs, arguments.out.as_deref())
}

/// Prints the tables of one file, and writes its result.
fn print_one(arguments: &EvalArguments, evaluated: &Evaluated) -> Result<(), Failure> {
    match evaluated {
        Evaluated::Locations(result) => {
            print!("{}", table(result));
            if let Some(out) = &arguments.out {
                write_json(out, result)?;
            }
        }
        Evaluated::Tracks(scores) => tracks::print_scores(scores, arguments.out.as_deref())?,
    }
    Ok(())
}

/// Evaluates one file by the truth.
fn evaluate(arguments: &EvalArguments, input: &Path) -> Result<Evaluated, Failure> {
    let path = &arguments.truth;
    if let Some(format) = arguments.format {
        return tracks::evaluate_files(arguments, format, input);
    }
    let text = bounded_file::read_text(path)
        .with_context(|| format!("cannot read {}", path.display()))
        .map_err(Failure::usage)?;
    if TrackTruth::is_in(&text) {
        return tracks::evaluate(arguments, &text, input);
    }
    let config = cell(arguments.config.as_deref())?;
    let truth = Truth::parse(&text).with_context(|| format!("truth {}", path.display()));
    let synonyms = config.fusion.vote.synonyms.clone();
    let mut evaluation = Evaluation::new(truth.map_err(Failure::usage)?).with_synonyms(synonyms);
    if !config.landmarks.is_empty() {
        let gate = config.fusion.pace.gate();
        evaluation = evaluation.with_landmarks(
            LandmarkIndex::new(config.landmarks.clone(), gate.radius_m),
            gate,
        );
    }
    read_output(input, |line| evaluation.fused(&line))?;
    if !evaluation.matches_truth() {
        eprintln!(
            "no location of {} is in {} at the time of a line; locations count by their exact ids",
            input.display(),
            path.display()
        );
    }
    if let Some(reports) = &arguments.reports {
        read_reports(&mut evaluation, reports, &config)?;
    }
    Ok(Evaluated::Locations(Box::new(evaluation.result())))
}

fn read_output(path: &Path, mut take: impl FnMut(FusedLine)) -> Result<(), Failure> {
    let mut read = 0u64;
    let mut unreadable = UnreadableLines::default();
    each_line(path, MAX_LINE_BYTES, |number, line| {
        let line = match line.map(serde_json::from_slice) {
            Some(Ok(InputLine::Fused(line))) => line,
            Some(Ok(InputLine::Received { map })) => FusedLine::Map(map),
            _ => return unreadable.add(number, fault_of(line)),
        };
        if let FusedLine::Map(GlobalMap { objects, .. }) = &line
            && let Some((place, reason)) = objects
                .iter()
                .enumerate()
                .find_map(|(n, o)| Some((n, o.validate().err()?)))
        {
            return unreadable.add(number, format!("objects[{place}]: {reason}"));
        }
        if let FusedLine::Map(GlobalMap { objects, .. }) = &line {
            let mut ids = BTreeSet::new();
            if let Some(place) = objects.iter().position(|object| !ids.insert(object.id)) {
                let fault = format!("objects[{place}].id: is in this map already");
                return unreadable.add(number, fault);
            }
        }
        take(line);
        read += 1;
    })?;
    unreadable.print(path);
    if read == 0 {
        Err(anyhow!("there is no map and no verdict in {}", path.display()).into())
    } else {
        Ok(())
    }
}

/// The fault of a line that cannot be used; `None` stands for a line that is too long.
fn fault_of(line: Option<&[u8]>) -> String {
    let Some(line) = line else {
        return format!("it is longer than {MAX_LINE_BYTES} bytes");
    };
    let value: Value = match serde_json::from_slice(line) {
        Ok(value) => value,
        Err(error) => return format!("it is not JSON: {error}"),
    };
    // The map log of a node has the map beside its time of receipt.
    let map = value.get("map").unwrap_or(&value);
    let fault = if value.get("verdicts").is_some() {
        serde_path_to_error::deserialize::<_, Verdicts>(&value).err()
    } else {
        serde_path_to_error::deserialize::<_, GlobalMap>(map).err()
    };
    fault.map_or_else(
        || "it is neither a map nor verdicts".to_owned(),
        |error| format!("it is neither a map nor verdicts: {error}"),
    )
}

fn read_reports(
    evaluation: &mut Evaluation,
    path: &Path,
    config: &ReplayConfig,
) -> Result<(), Failure> {
    let mut unreadable = UnreadableLines::default();
    each_line(path, config.limits.payload_bytes, |number, line| match line
        .map(|line| read_report(line, &config.limits))
    {
        Some(Ok((kind, report))) => evaluation.report(kind, &report),
        Some(Err(flaw)) => unreadable.add(number, flaw),
        None => unreadable.add(number, RejectReason::TooLarge),
    })?;
    unreadable.print(path);
    Ok(())
}

/// Lines that cannot be used; the first is kept.
#[derive(Default)]
struct UnreadableLines {
    lines: u64,
    first: String,
}

impl UnreadableLines {
    fn add(&mut self, number: u64, why: impl Display) {
        if self.lines == 0 {
            self.first = format!("line {number}: {why}");
        }
        self.lines += 1;
    }

    fn print(&self, path: &Path) {
        if self.lines > 0 {
            eprintln!(
                "{}: {} lines cannot be used, the first is {}",
                path.display(),
                self.lines,
                self.first
            );
        }
    }
}

/// Passes every line that is not blank to `take`, with its number from 1; `None` for a line that is
/// too large.
fn each_line(
    path: &Path,
    limit: usize,
    mut take: impl FnMut(u64, Option<&[u8]>),
) -> Result<(), Failure> {
    let mut source = lines::open(path).map_err(Failure::usage)?;
    let mut line = Vec::new();
    for number in 1.. {
        match read_line(&mut source, limit, &mut line)
            .with_context(|| format!("cannot read {}", path.display()))?
        {
            LineRead::End => break,
            LineRead::TooLarge => take(number, None),
            LineRead::Whole if line.trim_ascii().is_empty() => {}
            LineRead::Whole => take(number, Some(&line)),
        }
    }
    Ok(())
}

fn table(result: &EvalResult) -> String {
    let algorithms = [("PACE", &result.pace), ("VOTE", &result.vote)];
    let judged = algorithms
        .iter()
        .filter_map(|(name, scores)| Some((*name, scores.as_ref()?)));
    let mut rows = vec![header(&[
        "",
        "lines",
        "items",
        "accuracy %",
        "coverage %",
        "labelled %",
        "all lines %",
        "majority %",
    ])];
    rows.extend(judged.clone().map(|(name, scores)| summary(name, scores)));
    let mut text = columns(&rows);
    for (name, scores) in judged {
        if !scores.vehicles.is_empty() {
            let mut rows = vec![header(&[
                "alone",
                "votes",
                "right %",
                "coverage %",
                "accuracy %",
            ])];
            rows.extend(scores.vehicles.iter().map(|(node, alone)| {
                let shares = [
                    alone.vote_accuracy_pct,
                    alone.coverage_pct,
                    alone.accuracy_pct,
                ]
                .map(percent);
                [
                    vec![node.to_string(), alone.votes.to_string()],
                    shares.to_vec(),
                ]
                .concat()
            }));
            text += &format!("\n{name}, every vehicle\n{}", columns(&rows));
        }
        text += &recall(name, scores);
        text += &confusion(name, scores);
    }
    text
}

fn recall(name: &str, scores: &Scores) -> String {
    let mut classes: Vec<_> = scores.recall.iter().collect();
    classes.sort_by_key(|class| std::cmp::Reverse(class.items));
    let row = |class: &&ClassRecall| {
        vec![
            name_of(&class.truth),
            class.items.to_string(),
            percent(class.recall_pct),
        ]
    };
    let mut rows = vec![header(&["truth", "items", "recall %"])];
    rows.extend(classes.iter().take(MAX_ROWS).map(row));
    rows.push(vec![
        "mean".into(),
        String::new(),
        percent(scores.mean_recall_pct),
    ]);
    format!(
        "\n{name}, every class\n{}{}",
        columns(&rows),
        rest(classes.len())
    )
}

fn name_of(label: &Option<Label>) -> String {
    label.as_deref().unwrap_or("-").to_owned()
}

/// The note after a table of which [`MAX_ROWS`] rows are printed.
fn rest(rows: usize) -> String {
    let more = rows.saturating_sub(MAX_ROWS);
    if more > 0 {
        format!("and {more} more\n")
    } else {
        String::new()
    }
}

fn header(cells: &[&str]) -> Vec<String> {
    cells.iter().map(|cell| (*cell).to_owned()).collect()
}

fn summary(name: &str, scores: &Scores) -> Vec<String> {
    let counts = vec![
        name.to_owned(),
        scores.lines.to_string(),
        scores.items.to_string(),
    ];
    [counts, scores.shares_pct().map(percent).to_vec()].concat()
}

fn confusion(name: &str, scores: &Scores) -> String {
    let mut cells: Vec<_> = scores.confusion.iter().collect();
    cells.sort_by_key(|cell| std::cmp::Reverse(cell.count));
    let mut rows = vec![header(&["truth", "reported", "items"])];
    rows.extend(
        cells
            .iter()
            .take(MAX_ROWS)
            .map(|c| vec![name_of(&c.truth), name_of(&c.said), c.count.to_string()]),
    );
    format!(
        "\n{name}, truth and reported labels\n{}{}",
        columns(&rows),
        rest(cells.len())
    )
}
