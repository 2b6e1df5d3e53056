//! Evaluation of moving objects by their true positions.

use std::collections::BTreeSet;
use std::io::BufRead;
use std::ops::RangeInclusive;
use std::path::Path;

use anyhow::{Context, anyhow};
use ecod::replay::FusedLine;
use ecod_actors::cli::{Failure, lines};
use serde::Serialize;

use super::{EvalArguments, Evaluated, columns, read_output, write_json};
use crate::cli::files;
use crate::eval::formats::{FileContext, FileFormat, check_lengths, sequence_at, time_of};
use crate::eval::tracks::{TrackEvaluation, TrackScores, TrackTruth};
use crate::report::tracks::{tables, without_map};

/// Contents of the file of `--output`.
#[derive(Serialize)]
struct Judged<'a> {
    tracks: &'a TrackScores,
}

/// Evaluates maps by a truth of places.
pub(super) fn evaluate(
    arguments: &EvalArguments,
    text: &str,
    input: &Path,
) -> Result<Evaluated, Failure> {
    let path = &arguments.truth;
    let truth = TrackTruth::parse(text)
        .with_context(|| format!("truth {}", path.display()))
        .map_err(Failure::usage)?;
    judge_maps(arguments, input, TrackEvaluation::new(truth), None)
}

/// Evaluates maps, or files in a benchmark's form, by the truth in files of that benchmark.
pub(super) fn evaluate_files(
    arguments: &EvalArguments,
    format: FileFormat,
    input: &Path,
) -> Result<Evaluated, Failure> {
    let EvalArguments {
        truth: path,
        frame_rate,
        config,
        ..
    } = arguments;
    let camera = files::camera(config.as_deref())?;
    let categories = format.categories(path).map_err(Failure::usage)?;
    let context = FileContext {
        camera: camera.as_ref(),
        categories: categories.as_ref(),
    };
    let read = |path: &Path| files::read(format, path, context);
    let mut truth = read(path)?;
    let said = if is_of_maps(input)? {
        None
    } else {
        Some(read(input)?)
    };
    if let Some(said) = said
        .as_ref()
        .filter(|said| said.len() > 1 || truth.len() > 1)
    {
        // Part of the sequences may be evaluated.
        truth.retain(|sequence| said.iter().any(|other| other.name == sequence.name));
        if let Some(other) = said
            .iter()
            .find(|other| truth.iter().all(|sequence| sequence.name != other.name))
        {
            let what = format!(
                "{} has no truth of the sequence {}",
                path.display(),
                other.name
            );
            return Err(Failure::usage(anyhow!(what)));
        }
    }
    let sequences = match &truth[..] {
        // One may be of any length.
        [one] => 1..=sequence_at(time_of(0, one.last(), *frame_rate)) + 1,
        several => {
            check_lengths(several, *frame_rate).map_err(Failure::usage)?;
            several.len()..=several.len()
        }
    };
    let truth = TrackTruth::from_sequences(&truth, *frame_rate)
        .with_context(|| format!("truth {}", path.display()))
        .map_err(Failure::usage)?;
    let mut evaluation = TrackEvaluation::new(truth);
    match said {
        None => judge_maps(arguments, input, evaluation, Some(sequences)),
        Some(said) => {
            evaluation.sequences(&said, *frame_rate);
            result(arguments, input, evaluation)
        }
    }
}

/// True for output of a replay and for a map log: they begin with a JSON object.
fn is_of_maps(input: &Path) -> Result<bool, Failure> {
    if input == Path::new("-") {
        return Ok(true);
    }
    if input.is_dir() {
        return Ok(false);
    }
    let mut source = lines::open(input).map_err(Failure::usage)?;
    let begin = source
        .fill_buf()
        .with_context(|| format!("cannot read {}", input.display()))?;
    Ok(begin.trim_ascii_start().starts_with(b"{"))
}

/// Evaluates maps. Maps of `sequences` are assigned to their sequence by number only, so the
/// numbers of sequences must be equal.
fn judge_maps(
    arguments: &EvalArguments,
    input: &Path,
    mut evaluation: TrackEvaluation,
    sequences: Option<RangeInclusive<usize>>,
) -> Result<Evaluated, Failure> {
    let mut mapped = BTreeSet::new();
    read_output(input, |line| {
        if let FusedLine::Map(map) = line {
            evaluation.map(&map);
            mapped.insert(sequence_at(map.fused_at_us));
        }
    })?;
    let truth = arguments.truth.display();
    if mapped.is_empty() {
        return Err(anyhow!("there is no map in {}", input.display()).into());
    }
    if let Some(sequences) = sequences.filter(|sequences| !sequences.contains(&mapped.len())) {
        let sequences = sequences.end();
        let mapped = mapped.len();
        let what = format!(
            "{truth} has {sequences} sequences, and {} maps of {mapped}: give truth of just these",
            input.display()
        );
        return Err(Failure::usage(anyhow!(what)));
    }
    result(arguments, input, evaluation)
}

/// The figures, with warnings about input that can hardly be meant.
fn result(
    arguments: &EvalArguments,
    input: &Path,
    evaluation: TrackEvaluation,
) -> Result<Evaluated, Failure> {
    if arguments.reports.is_some() || (arguments.config.is_some() && arguments.format.is_none()) {
        return Err(Failure::usage(anyhow!(
            "--reports and --config are for a truth of locations"
        )));
    }
    if let Some((said, truth)) = evaluation.labels_without_match() {
        eprintln!(
            "no object of {} has a class of {}: {said} there, {truth} in the truth; classes count by their exact names",
            input.display(),
            arguments.truth.display()
        );
    }
    let scores = evaluation.result();
    if scores.frames_with_map == 0 {
        let what = format!(
            "no map of {} is at the time of any frame of {}",
            input.display(),
            arguments.truth.display()
        );
        return Err(anyhow!(what).into());
    }
    if let Some(warning) = without_map(&scores) {
        eprintln!("{warning}");
    }
    Ok(Evaluated::Tracks(Box::new(scores)))
}

/// Prints the tables of one file, and writes its figures.
pub(super) fn print_scores(scores: &TrackScores, out: Option<&Path>) -> Result<(), Failure> {
    print!(
        "{}",
        tables(scores)
            .iter()
            .map(|rows| columns(rows))
            .collect::<Vec<_>>()
            .join("\n")
    );
    if let Some(out) = out {
        write_json(out, &Judged { tracks: scores })?;
    }
    Ok(())
}
