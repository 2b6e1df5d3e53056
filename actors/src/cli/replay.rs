//! `ecod-node replay`: a recording run again in virtual time.

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
    /// Configuration of the cell, or of a node in it (TOML); without it, defaults and the locations that reports name
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Recorded reports, one JSON object a line in the order of arrival; `-` for standard input
    #[arg(long, value_name = "FILE")]
    input: PathBuf,
    /// Where maps and verdicts are written, one JSON object a line; `-` for standard output
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// Go over all votes so many times and write only the verdicts of the last pass
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    passes: Option<u32>,
}

pub(super) fn run(arguments: &ReplayArguments) -> Result<(), Failure> {
    let ReplayArguments { config, input, output, passes } = arguments;
    let mut config = cell(config.as_deref())?;
    config.passes = *passes;
    let limit = config.limits.payload_bytes;
    let mut source = lines::open(input).map_err(Failure::usage)?;
    let mut sink = lines::create(output, input).map_err(Failure::usage)?;
    let mut replay = Replay::new(config);
    let mut line = Vec::new();
    loop {
        match read_line(&mut source, limit, &mut line).with_context(|| format!("cannot read {}", input.display()))? {
            LineRead::End => break,
            LineRead::TooLarge => replay.oversized_line(),
            LineRead::Whole => {
                if !write(&mut sink, &replay.line(&line)).with_context(|| cannot_write(output))? {
                    return Ok(());
                }
            }
        }
    }
    let (rest, summary) = replay.finish();
    if write(&mut sink, &rest).with_context(|| cannot_write(output))? {
        flush(&mut sink).with_context(|| cannot_write(output))?;
    }
    report(&summary);
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
