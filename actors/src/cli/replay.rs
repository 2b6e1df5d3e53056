//! `ecod-node replay`: a recording run again in virtual time.

mod log;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::replay::{FusedLine, Rejections, Replay, ReplayConfig, Summary};
use ecod::wire::Limits;

#[cfg(fuzzing)]
pub use log::rounds_of_log;

use super::Failure;
use super::logs::{Logs, NodeArguments};
use crate::cli::lines::{self, LineRead, read_line};
use crate::node::config::NodeConfig;
use crate::observe::recorder::LogReader;
use log::LogReplay;

/// Flags of `replay`.
#[derive(Debug, Args)]
pub(super) struct ReplayArguments {
    /// Configuration of the cell, or of a node in it (TOML); without it, that of the log, or for reports alone defaults
    /// and the locations that they name
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A log (MCAP), a directory of logs, or reports, one JSON object a line in the order of arrival; `-`
    /// for standard input; may be given several times for logs
    #[arg(long, value_name = "FILE", required = true)]
    input: Vec<PathBuf>,
    #[command(flatten)]
    node: NodeArguments,
    /// Where maps and verdicts are written, one JSON object a line; `-` for standard output
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// Go over all votes so many times and write only the verdicts of the last pass
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    passes: Option<u32>,
}

pub(super) fn run(arguments: &ReplayArguments) -> Result<(), Failure> {
    let ReplayArguments { config, input, node, output, passes } = arguments;
    let given = config.as_deref().map(|path| cell(Some(path))).transpose()?;
    if let Some(lines) = input_of_lines(input, node)? {
        let config = ReplayConfig { passes: *passes, ..given.unwrap_or_default() };
        let mut sink = lines::create(output, input).map_err(Failure::usage)?;
        replay_lines(Replay::new(config.clone()), &config, lines, &mut sink, output)?;
        return Ok(flush(&mut sink).with_context(|| cannot_write(output))?);
    }
    let Logs { files, unusable } = Logs::find(input, node)?;
    if let (Some(unusable), None) = (unusable, &given) {
        let why = anyhow!("{:#}: say by --config how its reports are fused", anyhow!(unusable));
        return Err(Failure::usage(why));
    }
    let mut sink = lines::create(output, &files).map_err(Failure::usage)?;
    LogReplay::new(given.as_ref(), *passes).run(&files, &mut sink, output)?;
    Ok(flush(&mut sink).with_context(|| cannot_write(output))?)
}

/// The file of lines, or standard input, that is to be replayed; none if these are logs.
fn input_of_lines<'a>(inputs: &'a [PathBuf], node: &NodeArguments) -> Result<Option<&'a Path>, Failure> {
    let [input] = inputs else { return Ok(None) };
    if input != Path::new("-") && (input.is_dir() || LogReader::recognises(input).map_err(Failure::usage)?) {
        return Ok(None);
    }
    if node.node.is_some() {
        return Err(Failure::usage(anyhow!("{} is not a log: --node chooses among logs", input.display())));
    }
    Ok(Some(input))
}

fn replay_lines(
    mut replay: Replay,
    config: &ReplayConfig,
    input: &Path,
    sink: &mut dyn Write,
    output: &Path,
) -> Result<(), Failure> {
    let mut source = lines::open(input).map_err(Failure::usage)?;
    let mut line = Vec::new();
    let limit = config.limits.payload_bytes;
    loop {
        match read_line(&mut source, limit, &mut line).with_context(|| format!("cannot read {}", input.display()))? {
            LineRead::End => break,
            LineRead::TooLarge => replay.oversized_line(),
            LineRead::Whole => {
                if !write_all(sink, &replay.line(&line), output)? {
                    return Ok(());
                }
            }
        }
    }
    let (rest, summary) = replay.finish();
    write_all(sink, &rest, output)?;
    report(&summary);
    Ok(())
}

/// The cell that a configuration file describes; without a file, an open one.
///
/// # Errors
/// When the file cannot be used.
pub fn cell(path: Option<&Path>) -> Result<ReplayConfig, Failure> {
    let Some(path) = path else { return Ok(ReplayConfig::default()) };
    let node = NodeConfig::load_cell(path).map_err(Failure::usage)?;
    let default = ReplayConfig::default();
    Ok(ReplayConfig {
        // Of a line, its length alone is limited.
        limits: Limits { objects: default.limits.objects, ..node.mqtt.limits() },
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
fn write_all(sink: &mut dyn Write, output: &[FusedLine], path: &Path) -> anyhow::Result<bool> {
    write(sink, output).with_context(|| cannot_write(path))
}

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
    let Summary { lines, rejected, late, ignored_votes, overtaken, tracks, written } = summary;
    eprintln!("{lines} lines, {} used, {written} written", summary.used());
    for (reason, Rejections { lines, first_line }) in rejected {
        eprintln!("rejected {reason} {lines}, the first in line {first_line}");
    }
    for (what, number) in [
        ("used although earlier than a line before", *late),
        ("objects that voted for nothing, or whose labels had to make room", *ignored_votes),
        ("used for tracks alone, overtaken by a later report of the vehicle", *overtaken),
        ("reports too late for tracks", tracks.late),
        ("new objects refused by tracks", tracks.refused),
    ] {
        if number > 0 {
            eprintln!("{what} {number}");
        }
    }
}
