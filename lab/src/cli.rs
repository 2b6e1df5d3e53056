//! The command line of `ecod-lab`.

mod bench;
mod columns;
mod convert;
mod demo;
mod eval;
mod eval_labels;
mod files;
mod report;
mod street;
mod testbed;

use std::fs;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use ecod_actors::cli::{LogArguments, arguments, exit, start_log};
use serde::Serialize;

/// Measures and shows a cell of ECOD; its nodes are the program `ecod-node`, which must be in the
/// same directory.
#[derive(Debug, Parser)]
#[command(name = "ecod-lab", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    log: LogArguments,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a whole cell on this machine, as separate processes, and print the results
    Demo(demo::DemoArguments),
    /// Write the street that `ecod-node try` shows: a video and a configuration for each camera
    /// that stays where it is
    Street(street::StreetArguments),
    /// Run recorded scenes in virtual time: parking lots are rendered and detected, intersections
    /// were
    Testbed(testbed::TestbedArguments),
    /// Measure a live cell under simulated vehicles: latency compared to the bare broker, capacity,
    /// costs
    Bench(bench::BenchArguments),
    /// Write one page about a log, as `ecod-node report`, evaluated against the truth
    Report(report::LogReportArguments),
    /// Convert detections in files of benchmarks to reports, which `ecod-node replay` fuses
    Convert(convert::ConvertArguments),
    /// Evaluate the output of a replay against the truth
    Eval(eval::EvalArguments),
    /// Evaluate VOTE and the majority on a label set: a table of many voters' answers about many
    /// items
    EvalLabels(eval_labels::EvalLabelsArguments),
}

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = arguments::<Cli>();
    start_log(cli.log.log_format, false, "warn");
    let outcome = match cli.command {
        Command::Demo(arguments) => demo::run(&arguments),
        Command::Street(arguments) => street::run(&arguments),
        Command::Testbed(arguments) => testbed::run(&arguments),
        Command::Bench(arguments) => bench::run(&arguments),
        Command::Report(arguments) => report::run(&arguments),
        Command::Convert(arguments) => convert::run(&arguments),
        Command::Eval(arguments) => eval::run(&arguments),
        Command::EvalLabels(arguments) => eval_labels::run(&arguments),
    };
    exit("ecod-lab", outcome)
}

/// Writes JSON for programs.
fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
