//! `ecod-node replay`: a recording run again in virtual time.

mod log;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use ecod::replay::{FusedLine, Rejections, Replay, ReplayConfig, Summary};

use super::Failure;
use crate::config::NodeConfig;
use crate::lines::{self, LineRead, read_line};

/// Flags of `replay`.
#[derive(Debug, Args)]
pub(super) struct ReplayArguments {
    /// Configuration of the cell, or of a node in it (TOML); without it, that of the log, or for reports alone defaults and
    /// the locations that they name
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A log (MCAP), a directory of one node's logs, or reports, one JSON object a line in the order of arrival; `-` for
    /// standard input; may be given several times for logs
    #[arg(long, value_name = "FILE", required = true)]
    input: Vec<PathBuf>,
    /// Where maps and verdicts are written, one JSON object a line; `-` for standard output
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// Go over all votes so many times and write only the verdicts of the last pass
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    passes: Option<u32>,
}

pub(super) fn run(arguments: &ReplayArguments) -> Result<(), Failure> {
    let ReplayArguments { config, input, output, passes } = arguments;
    let configured = config.is_some();
    let mut config = cell(config.as_deref())?;
    config.passes = *passes;
    if let [input] = &**input
        && !is_log(input)?
    {
        return replay_lines(config, input, output);
    }
    let files = log_files(input)?;
    let mut sink = files.iter().try_fold(None, |_, file| lines::create(output, file).map(Some));
    let sink = sink.as_mut().map_err(|error| Failure::usage(anyhow!("{error:#}")))?.as_mut();
    let sink = sink.ok_or_else(|| Failure::usage(anyhow!("there is no log to replay")))?;
    LogReplay::new(configured.then_some(&config), *passes).run(&files, sink, output)?;
    flush(sink).with_context(|| cannot_write(output))?;
    Ok(())
}

/// The cell that a configuration file describes.
pub(super) fn cell(path: Option<&Path>) -> Result<ReplayConfig, Failure> {
    let Some(path) = path else { return Ok(ReplayConfig::default()) };
    let node = NodeConfig::load_cell(path).map_err(Failure::usage)?;
    let default = ReplayConfig::default();
    Ok(ReplayConfig {
        limits: node.mqtt.limits(),
        landmarks: node.landmarks(),
        aggregator: node.name.unwrap_or(default.aggregator),
        fusion: node.fusion,
        passes: None,
    })
}

fn cannot_write(path: &Path) -> String {
    format!("cannot write {}", path.display())
}

/// False when nobody reads any more.
fn write(sink: &mut dyn Write, output: &[FusedLine]) -> io::Result<bool> {
    for line in output {
        let written = serde_json::to_writer(&mut *sink, line).map_err(io::Error::from);
        match written.and_then(|()| sink.write_all(b"\n")) {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => return Ok(false),
            other => other?,
        }
    }
    Ok(true)
}

fn flush(sink: &mut dyn Write) -> io::Result<()> {
    match sink.flush() {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

fn report(summary: &Summary) {
    let Summary { lines, rejected, late, ignored_votes, written } = summary;
    eprintln!("{lines} lines, {} used, {written} written", summary.used());
    for (reason, Rejections { lines, first_line }) in rejected {
        eprintln!("rejected {reason} {lines}, the first in line {first_line}");
    }
    if *late > 0 {
        eprintln!("used although earlier than a line before {late}");
    }
    if *ignored_votes > 0 {
        eprintln!("objects that voted for nothing {ignored_votes}");
    }
}
