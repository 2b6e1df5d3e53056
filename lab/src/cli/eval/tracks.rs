//! Objects that move, judged by where they were.

use anyhow::{Context, anyhow};
use ecod::replay::FusedLine;
use ecod_actors::cli::Failure;
use serde::Serialize;

use super::{EvalArguments, columns, read_output, write_json};
use crate::eval::tracks::{TrackEvaluation, TrackScores, TrackTruth};
use crate::report::tracks::{tables, without_map};

/// Contents of the file of `--out`.
#[derive(Serialize)]
struct Judged {
    tracks: TrackScores,
}

pub(super) fn run(arguments: &EvalArguments, text: &str) -> Result<(), Failure> {
    if arguments.reports.is_some() || arguments.config.is_some() {
        return Err(Failure::usage(anyhow!("--reports and --config are for a truth of locations")));
    }
    let path = &arguments.truth;
    let truth = TrackTruth::parse(text).with_context(|| format!("truth {}", path.display())).map_err(Failure::usage)?;
    let mut evaluation = TrackEvaluation::new(truth);
    let mut maps = 0u64;
    read_output(&arguments.input, |line| {
        if let FusedLine::Map(map) = line {
            evaluation.map(&map);
            maps += 1;
        }
    })?;
    if maps == 0 {
        return Err(anyhow!("there is no map in {}", arguments.input.display()).into());
    }
    let scores = evaluation.result();
    if let Some(warning) = without_map(&scores) {
        eprintln!("{warning}");
    }
    print!("{}", tables(&scores).map(|rows| columns(&rows)).join("\n"));
    if let Some(out) = &arguments.out {
        write_json(out, &Judged { tracks: scores })?;
    }
    Ok(())
}
