//! The command line of `ecod-node`, and what that of `ecod-lab` shares with it.

#[cfg(feature = "camera")]
mod calibrate;
mod doctor;
pub mod lines;
mod logging;
mod logs;
mod pki;
mod record;
mod replay;
mod report;
mod run;
mod schema;
mod shell;
mod top;

use std::io::{ErrorKind, Write};
use std::process::ExitCode;

use anyhow::{Context, anyhow};
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, Parser, Subcommand};

pub use logging::{LogFormat, start as start_log};
pub use replay::cell;
#[cfg(fuzzing)]
pub use replay::rounds_of_log;
pub use report::{PageArguments, page};
pub use run::RunArguments;

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

/// The commands of `ecod-lab`, which is not installed on vehicles.
const LAB_COMMANDS: [&str; 4] = ["bench", "demo", "eval", "testbed"];

/// A command that failed, and how the process says so.
#[derive(Debug)]
pub struct Failure {
    error: anyhow::Error,
    code: u8,
}

/// Exit code of a configuration or argument that cannot be used.
const USAGE: u8 = 2;

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    exit("ecod-node", parse().and_then(run_command))
}

/// The exit code of `program`; a failure is told of on standard error.
pub fn exit(program: &str, outcome: Result<(), Failure>) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure { error, code }) => {
            eprintln!("{program}: {error:#}");
            ExitCode::from(code)
        }
    }
}

/// The process's arguments; ends the process on those that no program of the project has.
fn parse() -> Result<Cli, Failure> {
    Cli::try_parse().map_err(|error| match error.get(ContextKind::InvalidSubcommand) {
        Some(ContextValue::String(command)) if LAB_COMMANDS.contains(&command.as_str()) => in_lab(command),
        _ => error.exit(),
    })
}

/// Names the program that has the command, and how to get it.
fn in_lab(command: &str) -> Failure {
    let build = "build that program from the sources by `cargo build --release --bin ecod-lab`";
    Failure::usage(anyhow!("run `ecod-lab {command}` instead; {build}"))
}

fn run_command(cli: Cli) -> Result<(), Failure> {
    let level = match &cli.command {
        None | Some(Command::Record(_)) => "info,rmqtt=warn,rmqtt_net=warn",
        Some(Command::Top(_)) => "off",
        Some(_) => "warn",
    };
    let runs_on = matches!(&cli.command, None | Some(Command::Record(_)));
    let _export = logging::start(cli.log_format, runs_on, level);
    match cli.command {
        None => run::run(&cli.run),
        #[cfg(feature = "camera")]
        Some(Command::Calibrate(arguments)) => calibrate::run(&arguments),
        Some(Command::Doctor(arguments)) => doctor::run(&arguments),
        Some(Command::Top(arguments)) => top::run(&arguments),
        Some(Command::Record(arguments)) => record::run(&arguments),
        Some(Command::Replay(arguments)) => replay::run(&arguments),
        Some(Command::Report(arguments)) => report::run(&arguments),
        Some(Command::Pki(command)) => pki::run(&command),
        Some(Command::Schema) => schema::run(),
        Some(Command::Completions(arguments)) => shell::completions(&arguments, Cli::command()),
        Some(Command::Man(arguments)) => shell::man(&arguments, Cli::command()),
    }
}

/// Writes to standard output. A reader that has seen enough, such as `head`, is no failure.
///
/// # Errors
/// When it cannot be written to.
pub fn print(text: &str) -> anyhow::Result<()> {
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
    /// A configuration or argument that cannot be used.
    pub fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self { error: error.into(), code: USAGE }
    }
}
