//! Command line of `ecod-node`.

mod bench;
#[cfg(feature = "camera")]
mod calibrate;
mod columns;
#[cfg(feature = "camera")]
mod demo;
mod doctor;
mod eval;
#[cfg(feature = "camera")]
mod intersection;
mod lines;
mod logging;
mod logs;
mod pki;
mod record;
mod replay;
mod report;
mod run;
mod schema;
mod shell;
#[cfg(feature = "camera")]
mod testbed;
mod top;

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context;
use clap::{CommandFactory, Parser, Subcommand};
use serde::Serialize;

#[cfg(fuzzing)]
pub use replay::rounds_of_log;

use logging::LogFormat;
use run::RunArguments;

/// Cooperative perception of camera vehicles: run a node of a cell, or one of the commands
#[derive(Debug, Parser)]
#[command(
    name = "ecod-node",
    version,
    args_conflicts_with_subcommands = true,
    arg_required_else_help = true,
    after_long_help = logging::HELP
)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    run: RunArguments,
    /// Format of log lines: auto, text, json or journal; `ecod-node --help` explains them
    #[arg(
        long,
        global = true,
        value_enum,
        value_name = "FORM",
        default_value_t,
        help_heading = "Logging",
        hide_short_help = true,
        hide_possible_values = true
    )]
    log_format: LogFormat,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a whole cell on this machine as separate processes, and print its map
    #[cfg(feature = "camera")]
    Demo(demo::DemoArguments),
    /// Run recorded scenes in virtual time: rendered parking lots, or detections at an intersection
    #[cfg(feature = "camera")]
    Testbed(testbed::TestbedArguments),
    /// Measure a live cell with simulated vehicles: latency, capacity and cost
    Bench(bench::BenchArguments),
    /// Check whether a node can run here: camera, broker, ports, key, clock, disk; suggest fixes
    Doctor(doctor::DoctorArguments),
    /// Join a cell as an observer and show it in the terminal
    Top(top::TopArguments),
    /// Join a cell as an observer and record all its messages (MCAP)
    Record(record::RecordArguments),
    /// Fuse recorded reports again in virtual time: equal input gives equal output
    Replay(replay::ReplayArguments),
    /// Write an HTML report about a log: leadership, latency, gaps, reputations, coverage, losses
    Report(report::ReportArguments),
    /// Score the output of a replay against the ground truth
    Eval(eval::EvalArguments),
    /// Calibrate a camera from photographs of a chessboard
    #[cfg(feature = "camera")]
    Calibrate(calibrate::CalibrateArguments),
    /// Make the certificates of a cell: its CA, one per node, and the revocation list
    #[command(subcommand)]
    Pki(pki::PkiCommand),
    /// Print the JSON Schemas of every payload
    Schema,
    /// Print a completion script for a shell
    Completions(shell::CompletionsArguments),
    /// Write manual pages
    Man(shell::ManArguments),
}

/// A failed command and the exit code of the process.
#[derive(Debug)]
struct Failure {
    error: anyhow::Error,
    code: u8,
}

/// Exit code for an unusable configuration or argument.
const USAGE: u8 = 2;

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let level = match &cli.command {
        None | Some(Command::Record(_)) => "info,rmqtt=warn,rmqtt_net=warn",
        Some(Command::Top(_)) => "off",
        Some(_) => "warn",
    };
    let is_service = matches!(&cli.command, None | Some(Command::Record(_)));
    logging::start(cli.log_format, is_service, level);
    let outcome = match cli.command {
        None => run::run(&cli.run),
        #[cfg(feature = "camera")]
        Some(Command::Demo(arguments)) => demo::run(&arguments),
        #[cfg(feature = "camera")]
        Some(Command::Testbed(arguments)) => testbed::run(&arguments),
        #[cfg(feature = "camera")]
        Some(Command::Calibrate(arguments)) => calibrate::run(&arguments),
        Some(Command::Bench(arguments)) => bench::run(&arguments),
        Some(Command::Doctor(arguments)) => doctor::run(&arguments),
        Some(Command::Top(arguments)) => top::run(&arguments),
        Some(Command::Record(arguments)) => record::run(&arguments),
        Some(Command::Replay(arguments)) => replay::run(&arguments),
        Some(Command::Report(arguments)) => report::run(&arguments),
        Some(Command::Eval(arguments)) => eval::run(&arguments),
        Some(Command::Pki(command)) => pki::run(&command),
        Some(Command::Schema) => schema::run(),
        Some(Command::Completions(arguments)) => shell::completions(&arguments, Cli::command()),
        Some(Command::Man(arguments)) => shell::man(&arguments, Cli::command()),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { error, code }) => {
            eprintln!("ecod-node: {error:#}");
            ExitCode::from(code)
        }
    }
}

/// Writes to standard output. A reader that closes it early, such as `head`, is no failure.
fn print(text: &str) -> anyhow::Result<()> {
    let mut output = std::io::stdout().lock();
    match output.write_all(text.as_bytes()).and_then(|()| output.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.context("cannot write to standard output"),
    }
}

impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        Self { error, code: 1 }
    }
}

impl Failure {
    fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self { error: error.into(), code: USAGE }
    }
}

/// Writes a value as JSON for programs.
fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
