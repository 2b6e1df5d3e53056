//! `ecod-node report`: an HTML report about a log.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;

use super::logs::{Logs, LogsNodeArguments};
use super::{Failure, elsewhere};
use crate::cli::lines;
use crate::observe::report::Report;

/// Input logs of a page, and its output file.
#[derive(Debug, Args)]
pub struct PageArguments {
    /// Log files of one node (MCAP) in order, or their directory
    #[arg(value_name = "LOG", required = true)]
    logs: Vec<PathBuf>,
    #[command(flatten)]
    node: LogsNodeArguments,
    /// Report to write (HTML)
    #[arg(short, long, value_name = "FILE", default_value = "report.html")]
    output: PathBuf,
}

/// Flags of `report`.
#[derive(Debug, Args)]
pub(super) struct ReportArguments {
    #[command(flatten)]
    page: PageArguments,
    /// `ecod-lab report` has this flag
    #[arg(long, value_name = "FILE", hide = true)]
    truth: Option<PathBuf>,
}

pub(super) fn run(arguments: &ReportArguments) -> Result<(), Failure> {
    if arguments.truth.is_some() {
        return Err(elsewhere("ecod-lab report --truth"));
    }
    page(&arguments.page, Report::default(), None, "ecod-node")
}

/// Gathers the log into `report` and writes its page. The page must not be the file `read`, which
/// the caller has read. Problems are printed under the name `program`.
///
/// # Errors
/// Returns an error if there is no log of one node, or the page cannot be written.
pub fn page(
    arguments: &PageArguments,
    mut report: Report,
    read: Option<&Path>,
    program: &str,
) -> Result<(), Failure> {
    let PageArguments { logs, node, output } = arguments;
    let files = Logs::find(logs, node)?.files;
    let inputs: Vec<&Path> = files.iter().map(PathBuf::as_path).chain(read).collect();
    lines::check_apart(output, &inputs).map_err(Failure::usage)?;
    for file in files {
        report.file(&file).map_err(|error| anyhow!(error))?;
    }
    for problem in report.problems() {
        eprintln!("{program}: {problem}");
    }
    if report.is_empty() {
        return Err(anyhow!("the log is empty").into());
    }
    Ok(fs::write(output, report.page())
        .with_context(|| format!("cannot write {}", output.display()))?)
}
