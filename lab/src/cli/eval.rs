//! `ecod-lab eval`: how right the output of a replay is.

mod tracks;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::perception::landmark::LandmarkIndex;
use ecod::replay::{FusedLine, ReplayConfig, read_report};
use ecod::wire::GlobalMap;
use ecod_actors::cli::lines::{self, LineRead, read_line};
use ecod_actors::cli::{Failure, cell};
use serde::Deserialize;

use super::columns::columns;
use super::write_json;
use crate::eval::tracks::TrackTruth;
use crate::eval::{EvalResult, Evaluation, Scores, Truth};
use crate::report::tracks::percent;

/// Flags of `eval`.
#[derive(Debug, Args)]
pub(super) struct EvalArguments {
    /// Truth: the object at each location (JSON, or CSV with the columns item,truth), or the places of all objects (JSON)
    #[arg(long, value_name = "FILE")]
    truth: PathBuf,
    /// Output of `replay`, or the map log of a node; `-` for standard input
    #[arg(long, value_name = "FILE")]
    input: PathBuf,
    /// The reports that were replayed, for majority vote and every vehicle alone
    #[arg(long, value_name = "FILE")]
    reports: Option<PathBuf>,
    /// Configuration of the cell (TOML), to place reported objects that name no location and for synonyms
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write the results to this file (JSON)
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Longest line of output in bytes: the last of several passes is one line.
const MAX_LINE_BYTES: usize = 1 << 28;

/// Confusions that are printed; the file has all.
const MAX_CONFUSIONS: usize = 12;

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
        let reports = arguments.reports.iter();
        let inputs: Vec<_> = [path, &arguments.input].into_iter().chain(reports).collect();
        lines::check_apart(out, &inputs).map_err(Failure::usage)?;
    }
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()));
    let text = text.map_err(Failure::usage)?;
    if TrackTruth::is_in(&text) {
        return tracks::run(arguments, &text);
    }
    let config = cell(arguments.config.as_deref())?;
    let truth = Truth::parse(&text).with_context(|| format!("truth {}", path.display()));
    let synonyms = config.fusion.vote.synonyms.clone();
    let mut evaluation = Evaluation::new(truth.map_err(Failure::usage)?).with_synonyms(synonyms);
    if !config.landmarks.is_empty() {
        let gate = config.fusion.pace.gate();
        evaluation = evaluation.with_landmarks(LandmarkIndex::new(config.landmarks.clone(), gate.radius_m), gate);
    }
    read_output(&arguments.input, |line| evaluation.fused(&line))?;
    if let Some(reports) = &arguments.reports {
        read_reports(&mut evaluation, reports, &config)?;
    }
    let result = evaluation.result();
    print!("{}", table(&result));
    if let Some(out) = &arguments.out {
        write_json(out, &result)?;
    }
    Ok(())
}

fn read_output(path: &Path, mut take: impl FnMut(FusedLine)) -> Result<(), Failure> {
    let (mut read, mut unreadable) = (0u64, 0u64);
    each_line(path, MAX_LINE_BYTES, |line| {
        match line.map(serde_json::from_slice) {
            Some(Ok(InputLine::Fused(line))) => take(line),
            Some(Ok(InputLine::Received { map })) => take(FusedLine::Map(map)),
            _ => return unreadable += 1,
        }
        read += 1;
    })?;
    if unreadable > 0 {
        eprintln!("{}: {unreadable} lines are neither maps nor verdicts", path.display());
    }
    if read == 0 { Err(anyhow!("there is no map and no verdict in {}", path.display()).into()) } else { Ok(()) }
}

fn read_reports(evaluation: &mut Evaluation, path: &Path, config: &ReplayConfig) -> Result<(), Failure> {
    let mut unreadable = 0u64;
    each_line(path, config.limits.payload_bytes, |line| match line.map(|line| read_report(line, &config.limits)) {
        Some(Ok((kind, report))) => evaluation.report(kind, &report),
        _ => unreadable += 1,
    })?;
    if unreadable > 0 {
        eprintln!("{}: {unreadable} lines are not reports", path.display());
    }
    Ok(())
}

/// Gives every line that is not blank to `take`, `None` for one that is too large.
fn each_line(path: &Path, limit: usize, mut take: impl FnMut(Option<&[u8]>)) -> Result<(), Failure> {
    let mut source = lines::open(path).map_err(Failure::usage)?;
    let mut line = Vec::new();
    loop {
        match read_line(&mut source, limit, &mut line).with_context(|| format!("cannot read {}", path.display()))? {
            LineRead::End => return Ok(()),
            LineRead::TooLarge => take(None),
            LineRead::Whole if line.trim_ascii().is_empty() => {}
            LineRead::Whole => take(Some(&line)),
        }
    }
}

fn table(result: &EvalResult) -> String {
    let algorithms = [("PACE", &result.pace), ("VOTE", &result.vote)];
    let judged = algorithms.iter().filter_map(|(name, scores)| Some((*name, scores.as_ref()?)));
    let mut rows =
        vec![header(&["", "lines", "items", "accuracy %", "coverage %", "labelled %", "all lines %", "majority %"])];
    rows.extend(judged.clone().map(|(name, scores)| summary(name, scores)));
    let mut text = columns(&rows);
    for (name, scores) in judged {
        if !scores.vehicles.is_empty() {
            let mut rows = vec![header(&["alone", "votes", "right %", "coverage %", "accuracy %"])];
            rows.extend(scores.vehicles.iter().map(|(node, alone)| {
                let shares = [alone.vote_accuracy_pct, alone.coverage_pct, alone.accuracy_pct].map(percent);
                [vec![node.to_string(), alone.votes.to_string()], shares.to_vec()].concat()
            }));
            text += &format!("\n{name}, every vehicle\n{}", columns(&rows));
        }
        text += &confusion(name, scores);
    }
    text
}

fn header(cells: &[&str]) -> Vec<String> {
    cells.iter().map(|cell| (*cell).to_owned()).collect()
}

fn summary(name: &str, scores: &Scores) -> Vec<String> {
    let counts = vec![name.to_owned(), scores.lines.to_string(), scores.items.to_string()];
    [counts, scores.shares_pct().map(percent).to_vec()].concat()
}

fn confusion(name: &str, scores: &Scores) -> String {
    let mut cells: Vec<_> = scores.confusion.iter().collect();
    cells.sort_by_key(|cell| std::cmp::Reverse(cell.count));
    let name_of = |label: &Option<ecod::model::names::Label>| label.as_deref().unwrap_or("-").to_owned();
    let mut rows = vec![header(&["truth", "said", "items"])];
    rows.extend(
        cells.iter().take(MAX_CONFUSIONS).map(|c| vec![name_of(&c.truth), name_of(&c.said), c.count.to_string()]),
    );
    let more = cells.len().saturating_sub(MAX_CONFUSIONS);
    let rest = if more > 0 { format!("and {more} more\n") } else { String::new() };
    format!("\n{name}, truth and what was said\n{}{rest}", columns(&rows))
}
