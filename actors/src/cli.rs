//! Command line of `ecod-node`, including the parts that `ecod-lab` shares.

#[cfg(feature = "camera")]
mod calibrate;
mod cell;
mod doctor;
mod installation;
mod join;
pub mod lines;
mod logging;
mod logs;
mod pki;
mod record;
mod replay;
mod report;
mod reset;
mod run;
mod schema;
mod shell;
mod status;
mod top;
#[cfg(feature = "camera")]
mod try_command;

use std::fmt;
use std::io::{ErrorKind, Write};
use std::process::ExitCode;

use anyhow::{Context, anyhow};
use clap::error::{ContextKind, ContextValue};
use clap::{CommandFactory, Parser, Subcommand};
use ecod::logins::without_logins;

pub use logging::{LogArguments, start as start_log};
pub use replay::cell;
#[cfg(fuzzing)]
pub use replay::rounds_of_log;
pub use report::{PageArguments, page};

use run::RunArguments;

/// Cooperative perception of camera vehicles: run a node of a cell, or one of the commands
#[derive(Debug, Parser)]
#[command(
    name = "ecod-node",
    version,
    args_conflicts_with_subcommands = true,
    arg_required_else_help = true,
    after_long_help = format!("{HELP}\n\n{}", logging::HELP)
)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    run: RunArguments,
    #[command(flatten)]
    log: LogArguments,
}

/// Examples, files and exit codes, printed by `ecod-node --help` and in the manual page.
const HELP: &str = "\
Examples:
  ecod-node try                                   see it work with rendered cameras
  sudo ecod-node init lot-1 edge --role edge      make a cell and its first node, which runs as a service
  sudo ecod-node invite --role auto euclid        let the machine euclid join
  ecod-node status                                state of this machine's node
  ecod-node --role edge --name edge --cell lot-1  run a node without files

Files:
  /etc/ecod/node.toml  configuration of this machine's node; commands read it without --config
  ecod/node.toml       the same for a node made without the rights of root
  /etc/ecod/pki        CA of the cell, on the machine where `init` made it
  /var/lib/ecod        state of the service

Exit codes:
  0  success, or ended by SIGINT or SIGTERM
  1  could not start, gave up, or the command failed
  2  unusable arguments or configuration
  3  replay: unusable input
  4  another running node of the cell has this node's name
  5  status: the node is not ready
  6  status: no node answers";

#[derive(Debug, Subcommand)]
enum Command {
    /// Try it on your own video, images or camera: starts a cell with a page, without a
    /// configuration
    #[command(after_long_help = "\
Examples:
  ecod-node try                       a rendered street
  ecod-node try drive.mp4             your own video
  ecod-node try 0 frames --height 2.5 a camera of this machine and a directory of images")]
    #[cfg(feature = "camera")]
    Try(try_command::TryArguments),
    /// Check whether a node can run here: camera, broker, ports, key, clock, disk; suggest fixes
    #[command(after_long_help = "\
Examples:
  ecod-node doctor                      check this machine for its node
  ecod-node doctor --json | jq .        the same for a program")]
    Doctor(doctor::DoctorArguments),
    /// Print the state of this machine's node: readiness, leader, nodes and troubles. Ends with 0 if
    /// it is ready, 5 if not, 6 if no node answers
    #[command(after_long_help = "\
Examples:
  ecod-node status                       state of this machine's node
  ecod-node status --json | jq .nodes    its nodes for a script
  ecod-node status --watch               print the state at every change")]
    Status(status::StatusArguments),
    /// Join a cell as an observer and show it in the terminal
    #[command(after_long_help = "\
Examples:
  ecod-node top                                           the cell of this machine's node
  ecod-node top --cell lot-1 --seed 192.168.1.10:17884    another cell without a key")]
    Top(top::TopArguments),
    /// Join a cell as an observer and record all its messages (MCAP)
    #[command(after_long_help = "\
Examples:
  ecod-node record --dir log    record the cell of this machine's node until Ctrl-C")]
    Record(record::RecordArguments),
    /// Recompute maps and verdicts of a recording; equal input gives equal output
    #[command(after_long_help = "\
Examples:
  ecod-node replay --input log/ --output rounds.jsonl
  ecod-node replay --config cell.toml --input reports.jsonl --output -")]
    Replay(replay::ReplayArguments),
    /// Write an HTML report about a log: leadership, latency, gaps, reputations, coverage, losses
    #[command(after_long_help = "\
Examples:
  ecod-node report log/ --output report.html")]
    Report(report::ReportArguments),
    /// Calibrate a camera from photographs of a chessboard
    #[command(after_long_help = "\
Examples:
  ecod-node calibrate --columns 9 --rows 6 --square-mm 25 --output calibration.toml photographs/")]
    #[cfg(feature = "camera")]
    Calibrate(calibrate::CalibrateArguments),
    /// Make a cell and its first node on this machine: CA, key, certificate, configuration
    #[command(after_long_help = "\
Examples:
  sudo ecod-node init lot-1 edge --role edge")]
    Init(join::InitArguments),
    /// Let other machines join the cell: prints a token for each, and waits for them
    #[command(after_long_help = "\
Examples:
  sudo ecod-node invite --role auto euclid    a node that may take over the lead
  sudo ecod-node invite gauss riemann         two vehicles")]
    Invite(join::InviteArguments),
    /// Join a cell with a token of `ecod-node invite`, as this machine's node
    #[command(after_long_help = "\
Examples:
  sudo ecod-node join TOKEN")]
    Join(join::JoinArguments),
    /// Make the certificates of a cell by hand: its CA, one per node, and the revocation list
    #[command(after_long_help = "\
Examples:
  ecod-node pki issue viewer --role cav    a certificate for a program on another machine
  ecod-node pki revoke gauss               the certificates of a stolen node")]
    #[command(subcommand)]
    Pki(pki::PkiCommand),
    /// The settings that all nodes of a cell share: set, show, compare; dismiss a missing node
    #[command(after_long_help = "\
Examples:
  ecod-node cell set cell.toml     give the cell a description
  ecod-node cell show              which node uses which version
  ecod-node cell dismiss gauss     stop missing a node that is gone for good")]
    #[command(subcommand)]
    Cell(cell::CellCommand),
    /// Drop the evidence, the highest term or the cell's description of a stopped node
    #[command(after_long_help = "\
Examples:
  ecod-node reset --reputations    while the node is stopped")]
    Reset(reset::ResetArguments),
    /// Print the JSON Schemas of every message
    Schema,
    /// Print a completion script for a shell
    Completions(shell::CompletionsArguments),
    /// Write manual pages
    Man(shell::ManArguments),
}

/// Commands of other programs, which are not installed on vehicles.
const ELSEWHERE: [(&str, &str); 5] = [
    ("bench", "ecod-lab bench"),
    ("demo", "ecod-lab demo"),
    ("eval", "ecod-lab eval"),
    ("region", "ecod-region"),
    ("testbed", "ecod-lab testbed"),
];

/// A failed command and the exit code of the process.
#[derive(Debug)]
pub struct Failure {
    error: anyhow::Error,
    code: u8,
}

/// Exit code for an unusable configuration or argument.
const USAGE: u8 = 2;

/// Exit code of a node whose name is already in use.
const NAME_TAKEN: u8 = 4;

/// Exit code for input that is unusable or almost unusable.
const REJECTED: u8 = 3;

/// Exit code of `status` for a node that is not ready.
const NOT_READY: u8 = 5;

/// Exit code of `status` if no node answers.
const NO_NODE: u8 = 6;

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    exit("ecod-node", parse().and_then(run_command))
}

/// The exit code of `program`; a failure is printed on standard error.
pub fn exit(program: &str, outcome: Result<(), Failure>) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("{program}: {failure}");
            ExitCode::from(failure.code)
        }
    }
}

/// The process's arguments; ends the process if they cannot be used.
pub fn arguments<T: Parser>() -> T {
    T::try_parse().unwrap_or_else(|error| refuse(&error))
}

/// Ends the process because of its arguments, and shows the error without logins.
fn refuse(error: &clap::Error) -> ! {
    let text = error.render().to_string();
    let shown = without_logins(&text);
    if shown == text {
        error.exit();
    }
    eprint!("{shown}");
    std::process::exit(error.exit_code())
}

/// The process's arguments; ends the process if they are invalid for every program of the project.
fn parse() -> Result<Cli, Failure> {
    Cli::try_parse().map_err(|error| {
        let command = match error.get(ContextKind::InvalidSubcommand) {
            Some(ContextValue::String(command)) => command.as_str(),
            _ => refuse(&error),
        };
        let other = ELSEWHERE.into_iter().find(|(name, _)| *name == command);
        other.map_or_else(|| refuse(&error), |(_, instead)| elsewhere(instead))
    })
}

/// Names the command of another program, and how to install that program.
fn elsewhere(instead: &str) -> Failure {
    let program = instead.split(' ').next().unwrap_or_default();
    let build =
        format!("build that program from the sources by `cargo build --release --bin {program}`");
    Failure::usage(anyhow!("run `{instead}` instead; {build}"))
}

fn run_command(cli: Cli) -> Result<(), Failure> {
    let is_service = match &cli.command {
        None | Some(Command::Record(_)) => true,
        Some(Command::Init(arguments)) => arguments.runs_node(),
        Some(Command::Join(arguments)) => arguments.runs_node(),
        Some(_) => false,
    };
    let level = match &cli.command {
        _ if is_service => "info,rmqtt=warn,rmqtt_net=warn",
        Some(Command::Top(_)) => "off",
        // `try` keeps no state.
        #[cfg(feature = "camera")]
        Some(Command::Try(_)) => "warn,ecod_actors::actors::reputation_keeper=error",
        // The command reports refusals itself.
        Some(Command::Cell(_)) => "warn,rumqttc=off",
        _ => "warn",
    };
    let _export = logging::start(cli.log.log_format, is_service, level);
    match cli.command {
        None => run::run(&cli.run),
        #[cfg(feature = "camera")]
        Some(Command::Calibrate(arguments)) => calibrate::run(&arguments),
        #[cfg(feature = "camera")]
        Some(Command::Try(arguments)) => try_command::run(&arguments),
        Some(Command::Doctor(arguments)) => doctor::run(&arguments),
        Some(Command::Status(arguments)) => status::run(&arguments),
        Some(Command::Top(arguments)) => top::run(&arguments),
        Some(Command::Record(arguments)) => record::run(&arguments),
        Some(Command::Replay(arguments)) => replay::run(&arguments),
        Some(Command::Report(arguments)) => report::run(&arguments),
        Some(Command::Init(arguments)) => join::init(&arguments),
        Some(Command::Invite(arguments)) => join::invite(&arguments),
        Some(Command::Join(arguments)) => join::join(&arguments),
        Some(Command::Pki(command)) => pki::run(&command),
        Some(Command::Cell(command)) => cell::run(&command),
        Some(Command::Reset(arguments)) => reset::run(&arguments),
        Some(Command::Schema) => schema::run(),
        Some(Command::Completions(arguments)) => shell::completions(&arguments, Cli::command()),
        Some(Command::Man(arguments)) => shell::man(&arguments, Cli::command()),
    }
}

/// Writes to standard output. A reader that closes it early, such as `head`, is not a failure.
///
/// # Errors
/// Returns an error if standard output cannot be written.
pub fn print(text: &str) -> anyhow::Result<()> {
    let mut output = std::io::stdout().lock();
    match output
        .write_all(text.as_bytes())
        .and_then(|()| output.flush())
    {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.context("cannot write to standard output"),
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&without_logins(&format!("{:#}", self.error)))
    }
}

impl From<anyhow::Error> for Failure {
    fn from(error: anyhow::Error) -> Self {
        Self { error, code: 1 }
    }
}

impl Failure {
    /// A node whose name is already in use.
    fn name_taken(error: anyhow::Error) -> Self {
        Self {
            error,
            code: NAME_TAKEN,
        }
    }

    /// A configuration or argument that cannot be used.
    pub fn usage(error: impl Into<anyhow::Error>) -> Self {
        Self {
            error: error.into(),
            code: USAGE,
        }
    }

    /// A node that is not ready.
    fn not_ready(error: anyhow::Error) -> Self {
        Self {
            error,
            code: NOT_READY,
        }
    }

    /// A node that does not answer.
    fn no_node(error: anyhow::Error) -> Self {
        Self {
            error,
            code: NO_NODE,
        }
    }

    /// Input that is unusable or almost unusable.
    fn rejected(error: anyhow::Error) -> Self {
        Self {
            error,
            code: REJECTED,
        }
    }
}
