//! The command line of `ecod-node`.

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
pub use run::RunArguments;

use logging::LogFormat;

/// Camera vehicles that see together: run a node of a cell, or one of the commands.
#[derive(Debug, Parser)]
#[command(name = "ecod-node", version, args_conflicts_with_subcommands = true, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    run: RunArguments,
    /// Form of the log; RUST_LOG sets what is in it
    #[arg(long, global = true, value_enum, value_name = "FORM", default_value_t)]
    log_format: LogFormat,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a whole cell on this machine, as separate processes, and print what it saw
    #[cfg(feature = "camera")]
    Demo(demo::DemoArguments),
    /// Run recorded scenes in virtual time: parking lots are rendered and detected, intersections were
    #[cfg(feature = "camera")]
    Testbed(testbed::TestbedArguments),
    /// Measure a live cell under simulated vehicles: latency beside the bare broker, capacity, costs
    Bench(bench::BenchArguments),
    /// Look whether a node can run here: camera, broker, ports, key, clock, disk; say what to fix
    Doctor(doctor::DoctorArguments),
    /// Join a cell as an observer and show it in this terminal
    Top(top::TopArguments),
    /// Join a cell as an observer and record what all of it says (MCAP)
    Record(record::RecordArguments),
    /// Run recorded reports again, in virtual time: the same input gives the same output
    Replay(replay::ReplayArguments),
    /// Write one page about a log: leadership, latency, gaps, reputations, coverage, drops
    Report(report::ReportArguments),
    /// Judge the output of a replay by what is true
    Eval(eval::EvalArguments),
    /// Calibrate a camera from photographs of a chessboard
    #[cfg(feature = "camera")]
    Calibrate(calibrate::CalibrateArguments),
    /// Make a cell's certificates: its CA, one for each node, and the list of those that are revoked
    #[command(subcommand)]
    Pki(pki::PkiCommand),
    /// Print the JSON Schemas of every payload
    Schema,
    /// Print what a shell needs to complete these commands
    Completions(shell::CompletionsArguments),
    /// Write manual pages
    Man(shell::ManArguments),
}

/// A command that failed, and how the process says so.
#[derive(Debug)]
struct Failure {
    error: anyhow::Error,
    code: u8,
}

/// Exit code of a configuration or argument that cannot be used.
const USAGE: u8 = 2;

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let level = match &cli.command {
        None | Some(Command::Record(_)) => "info,rmqtt=warn,rmqtt_net=warn",
        Some(Command::Top(_)) => "off",
        Some(_) => "warn",
    };
    let runs_on = matches!(&cli.command, None | Some(Command::Record(_)));
    let _export = logging::start(cli.log_format, runs_on, level);
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

/// Writes to standard output. A reader that has seen enough, such as `head`, is no failure.
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

/// Writes JSON for programs.
fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
