//! `ecod-node report`: an HTML report about a log.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::eval::Truth;
use ecod::eval::tracks::TrackTruth;

use super::Failure;
use super::logs::{Logs, NodeArguments};
use crate::cli::lines;
use crate::observe::report::Report;

/// Flags of `report`.
#[derive(Debug, Args)]
pub(super) struct ReportArguments {
    /// Log files of one node (MCAP) in order, or their directory
    #[arg(value_name = "LOG", required = true)]
    logs: Vec<PathBuf>,
    #[command(flatten)]
    node: NodeArguments,
    /// Ground truth: labels by location (JSON, or CSV with the columns item,truth), or tracks of all objects (JSON)
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Report to write (HTML)
    #[arg(short, long, value_name = "FILE", default_value = "report.html")]
    output: PathBuf,
}

pub(super) fn run(arguments: &ReportArguments) -> Result<(), Failure> {
    let ReportArguments { logs, node, truth, output } = arguments;
    let files = Logs::find(logs, node)?.files;
    let inputs: Vec<_> = files.iter().chain(truth).collect();
    lines::check_apart(output, &inputs).map_err(Failure::usage)?;
    let mut report = truth.as_deref().map_or_else(|| Ok(Report::default()), judged_by).map_err(Failure::usage)?;
    for file in files {
        report.file(&file).map_err(|error| anyhow!(error))?;
    }
    for problem in report.problems() {
        eprintln!("ecod-node: {problem}");
    }
    if report.is_empty() {
        return Err(anyhow!("the log is empty").into());
    }
    Ok(fs::write(output, report.page()).with_context(|| format!("cannot write {}", output.display()))?)
}

/// A report that judges by the truth in this file.
fn judged_by(path: &Path) -> anyhow::Result<Report> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let truth = || format!("truth {}", path.display());
    Ok(if TrackTruth::is_in(&text) {
        Report::default().judged_by_tracks(TrackTruth::parse(&text).with_context(truth)?)
    } else {
        Report::default().judged_by(Truth::parse(&text).with_context(truth)?)
    })
}
