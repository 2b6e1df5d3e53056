//! `ecod-node replay`: fuses a recording again in virtual time.

mod log;

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::aggregator::Placements;
use ecod::replay::{FusedLine, Rejections, Replay, ReplayConfig, Summary};
use ecod::wire::Limits;

#[cfg(fuzzing)]
pub use log::rounds_of_log;

use super::Failure;
use super::logs::{Logs, LogsNodeArguments};
use crate::cli::lines::{self, LineRead, read_line};
use crate::node::config::NodeConfig;
use crate::observe::recorder::LogReader;
use log::LogReplay;

/// Flags of `replay`.
#[derive(Debug, Args)]
pub(super) struct ReplayArguments {
    /// Configuration of the cell or of one of its nodes (TOML). Default: the configuration in the
    /// log; for reports, the defaults and the locations that the reports name
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A log (MCAP), a directory of logs, or reports, one JSON object per line in order of arrival;
    /// `-` for standard input; may be given several times for logs
    #[arg(long, value_name = "FILE", required = true)]
    input: Vec<PathBuf>,
    #[command(flatten)]
    node: LogsNodeArguments,
    /// File for maps and verdicts, one JSON object per line; `-` for standard output
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Weigh all recorded votes together N times, and write the last verdicts only
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    passes: Option<u32>,
    /// Share of rejected reports in percent beyond which the program ends with code 3. It also does
    /// so if no report was usable, most votes were ignored, or all objects are away from the
    /// landmarks
    #[arg(long, value_name = "PERCENT", value_parser = clap::value_parser!(u64).range(0..=100), default_value_t = 10)]
    max_rejected: u64,
}

pub(super) fn run(arguments: &ReplayArguments) -> Result<(), Failure> {
    let ReplayArguments {
        config,
        input,
        node,
        output,
        passes,
        max_rejected,
    } = arguments;
    let given = config.as_deref().map(|path| cell(Some(path))).transpose()?;
    let mut read: Vec<PathBuf> = input.iter().chain(config).cloned().collect();
    if let Some(lines) = input_of_lines(input, node)? {
        let config = ReplayConfig {
            passes: *passes,
            ..given.unwrap_or_default()
        };
        let usable = replay_lines(config, lines, RoundWriter::create(output, &read)?)?;
        return usable.map_or(Ok(()), |usable| usable.check(*max_rejected));
    }
    let Logs { files, unusable } = Logs::find(input, node)?;
    if let (Some(unusable), None) = (unusable, &given) {
        let why = anyhow!(
            "{:#}: give the configuration of the fusion with --config",
            anyhow!(unusable)
        );
        return Err(Failure::usage(why));
    }
    read.extend_from_slice(&files);
    let rounds = RoundWriter::create(output, &read)?;
    let usable = LogReplay::new(given.as_ref(), *passes).run(&files, rounds)?;
    usable.map_or(Ok(()), |usable| usable.check(*max_rejected))
}

/// The input, if it is a file of lines or standard input; `None` for logs.
fn input_of_lines<'a>(
    inputs: &'a [PathBuf],
    node: &LogsNodeArguments,
) -> Result<Option<&'a Path>, Failure> {
    let [input] = inputs else { return Ok(None) };
    if input != Path::new("-")
        && (input.is_dir() || LogReader::recognises(input).map_err(Failure::usage)?)
    {
        return Ok(None);
    }
    if node.node.is_some() {
        return Err(Failure::usage(anyhow!(
            "{} is not a log: --node chooses among logs",
            input.display()
        )));
    }
    Ok(Some(input))
}

/// Replays lines; returns `None` if the reader of the output closed it.
fn replay_lines(
    config: ReplayConfig,
    input: &Path,
    mut rounds: RoundWriter,
) -> Result<Option<Usable>, Failure> {
    let mut source = lines::open(input).map_err(Failure::usage)?;
    let limit = config.limits.payload_bytes;
    let mut replay = Replay::new(config);
    let mut line = Vec::new();
    loop {
        match read_line(&mut source, limit, &mut line)
            .with_context(|| format!("cannot read {}", input.display()))?
        {
            LineRead::End => break,
            LineRead::TooLarge => replay.oversized_line(),
            LineRead::Whole => {
                if !rounds.write(&replay.line(&line))? {
                    return Ok(None);
                }
            }
        }
    }
    let (rest, summary) = replay.finish();
    rounds.write(&rest)?;
    print_summary(&summary);
    rounds.finish()?;
    Ok(Some(Usable::of(&summary, false)))
}

/// Counts of reports, to distinguish a recording from other or damaged input.
#[derive(Debug, Clone, Copy, Default)]
struct Usable {
    reports: u64,
    used: u64,
    faulty: u64,
    /// Objects for VOTE, and the number of them that were ignored.
    votes: u64,
    ignored_votes: u64,
    placed: u64,
    misplaced: u64,
}

impl Usable {
    fn of(summary: &Summary, may_repeat: bool) -> Self {
        let Summary {
            lines,
            votes,
            ignored_votes,
            placements: Placements { placed, misplaced },
            ..
        } = *summary;
        let used = summary.used();
        let faulty = summary.faulty(may_repeat);
        Self {
            reports: lines,
            used,
            faulty,
            votes,
            ignored_votes,
            placed,
            misplaced,
        }
    }

    fn plus(self, other: Self) -> Self {
        let Self {
            reports,
            used,
            faulty,
            votes,
            ignored_votes,
            placed,
            misplaced,
        } = other;
        Self {
            reports: self.reports + reports,
            used: self.used + used,
            faulty: self.faulty + faulty,
            votes: self.votes + votes,
            ignored_votes: self.ignored_votes + ignored_votes,
            placed: self.placed + placed,
            misplaced: self.misplaced + misplaced,
        }
    }

    /// Fails if no report was used, if the reports have no effect, or if more than the given share
    /// was rejected.
    fn check(self, max_rejected_pct: u64) -> Result<(), Failure> {
        let Self {
            reports,
            used,
            faulty,
            votes,
            ignored_votes,
            placed,
            misplaced,
        } = self;
        if used == 0 {
            return Err(Failure::rejected(anyhow!(
                "no report could be used: the input is no recording of reports"
            )));
        }
        if 2 * ignored_votes > votes {
            let rule = "a vote has a `landmark`, one of the configuration's if that lists any, a `confidence` above 0, and \
                a place within `fusion.vote.weighted.max_range_m` of the `pose`";
            return Err(Failure::rejected(anyhow!(
                "{ignored_votes} of {votes} votes do not count: {rule}"
            )));
        }
        if placed == 0 && misplaced > 0 {
            let rule = "positions are in metres in the frame of the configuration's `landmarks`";
            return Err(Failure::rejected(anyhow!(
                "no report has an object at a known location, or near one: {rule}"
            )));
        }
        if faulty * 100 > max_rejected_pct * reports {
            let share = format!(
                "{faulty} of {reports} reports were rejected, more than {max_rejected_pct} %"
            );
            return Err(Failure::rejected(anyhow!("{share} (--max-rejected)")));
        }
        Ok(())
    }
}

/// The cell that a configuration file describes; without a file, an open one.
///
/// # Errors
/// Returns an error if the file cannot be used.
pub fn cell(path: Option<&Path>) -> Result<ReplayConfig, Failure> {
    let Some(path) = path else {
        return Ok(ReplayConfig::default());
    };
    let node = NodeConfig::load_cell(path).map_err(Failure::usage)?;
    let default = ReplayConfig::default();
    Ok(ReplayConfig {
        // Only the length of a line is limited.
        limits: Limits {
            objects: default.limits.objects,
            ..node.mqtt.limits()
        },
        landmarks: node.landmarks(),
        aggregator: node.name.unwrap_or(default.aggregator),
        fusion: node.fusion,
        passes: None,
    })
}

/// Output of maps and verdicts.
struct RoundWriter {
    sink: Box<dyn Write>,
    path: PathBuf,
}

impl RoundWriter {
    fn create(path: &Path, inputs: &[PathBuf]) -> Result<Self, Failure> {
        let sink = lines::create(path, inputs).map_err(Failure::usage)?;
        Ok(Self {
            sink,
            path: path.into(),
        })
    }

    /// Writes rounds; false once the reader has closed the output.
    fn write(&mut self, rounds: &[FusedLine]) -> Result<bool, Failure> {
        for round in rounds {
            let mut line = round.to_json();
            line.push(b'\n');
            let written = self.sink.write_all(&line);
            if !self.is_open(written)? {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn finish(mut self) -> Result<(), Failure> {
        let flushed = self.sink.flush();
        self.is_open(flushed).map(drop)
    }

    fn is_open(&self, written: io::Result<()>) -> Result<bool, Failure> {
        match written {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
            written => Ok(written
                .map(|()| true)
                .with_context(|| format!("cannot write {}", self.path.display()))?),
        }
    }
}

fn print_summary(summary: &Summary) {
    let Summary {
        lines,
        rejected,
        unit,
        late,
        ignored_votes,
        placements,
        overtaken,
        tracks,
        written,
        ..
    } = summary;
    eprintln!("{lines} lines, {} used, {written} written", summary.used());
    for (reason, Rejections { lines, examples }) in rejected {
        eprintln!("rejected {reason} {lines}");
        for (number, flaw) in examples {
            eprintln!("  line {number}: {flaw}");
        }
    }
    if let Some(unit) = unit {
        eprintln!(
            "times look like {unit}: captured_at_us and received_at_us are microseconds since 1970"
        );
    }
    for (what, number) in [
        ("reports used although older than an earlier line", *late),
        (
            "votes ignored: no usable location, or too many labels",
            *ignored_votes,
        ),
        (
            "reports of which no object is at a known location, or near one",
            placements.misplaced,
        ),
        (
            "reports used for tracking only, since a later one of the vehicle came first",
            *overtaken,
        ),
        ("reports too late for tracking", tracks.late),
        ("new objects not tracked: too many", tracks.refused),
    ] {
        if number > 0 {
            eprintln!("{what}: {number}");
        }
    }
}
