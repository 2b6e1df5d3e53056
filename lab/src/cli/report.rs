//! `ecod-lab report`: a log as one page, evaluated against the truth.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use ecod_actors::cli::{Failure, PageArguments, page};
use ecod_actors::observe::report::Report;
use ecod_actors::platform::bounded_file;

use crate::eval::Truth;
use crate::eval::tracks::TrackTruth;
use crate::report::{judged_by, judged_by_tracks};

/// Flags of `report`.
#[derive(Debug, Args)]
pub(super) struct LogReportArguments {
    #[command(flatten)]
    page: PageArguments,
    /// Truth: the object at each location (JSON, or CSV with the columns item,truth), or the places
    /// of all objects (JSON)
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
}

pub(super) fn run(arguments: &LogReportArguments) -> Result<(), Failure> {
    let truth = arguments.truth.as_deref();
    let report = truth
        .map_or_else(|| Ok(Report::default()), judged)
        .map_err(Failure::usage)?;
    page(&arguments.page, report, truth, "ecod-lab")
}

/// A report that is evaluated against the truth in this file.
fn judged(path: &Path) -> anyhow::Result<Report> {
    let text =
        bounded_file::read_text(path).with_context(|| format!("cannot read {}", path.display()))?;
    let truth = || format!("truth {}", path.display());
    Ok(if TrackTruth::is_in(&text) {
        judged_by_tracks(TrackTruth::parse(&text).with_context(truth)?)
    } else {
        judged_by(Truth::parse(&text).with_context(truth)?)
    })
}
