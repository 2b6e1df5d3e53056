//! Command line of `ecod-region`.

mod account;
mod export;
mod serve;

use std::process::ExitCode;

use anyhow::Context;
use clap::{Parser, Subcommand};
use ecod_actors::cli::{Failure, LogArguments, arguments, exit, start_log};
use tokio::runtime::Runtime;
use tokio::signal::unix::{SignalKind, signal};

/// Many cells of ECOD in one view, through the broker of their region
#[derive(Debug, Parser)]
#[command(name = "ecod-region", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    log: LogArguments,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Serve a page of the whole town, and metrics for Prometheus
    Serve(serve::ServeArguments),
    /// Read the maps of a region for some seconds, and write them as GeoJSON or MCAP
    Export(export::ExportArguments),
    /// Print the account of a cell for the region's broker: its write and read permissions
    CellAccount(account::AccountArguments),
}

/// Runs the program with the process's arguments.
pub fn main() -> ExitCode {
    let cli = arguments::<Cli>();
    let is_service = matches!(cli.command, Command::Serve(_));
    let _export = start_log(
        cli.log.log_format,
        is_service,
        if is_service { "info" } else { "warn" },
    );
    let outcome = match cli.command {
        Command::Serve(arguments) => serve::run(&arguments),
        Command::Export(arguments) => export::run(&arguments),
        Command::CellAccount(arguments) => account::run(&arguments),
    };
    exit("ecod-region", outcome)
}

/// Runs a future until it ends, or the process is terminated.
fn run_until_stopped<T>(
    future: impl Future<Output = anyhow::Result<T>>,
) -> Result<Option<T>, Failure> {
    let runtime = Runtime::new().context("cannot start threads")?;
    let outcome = runtime.block_on(async {
        let mut interrupted = signal(SignalKind::interrupt())?;
        let mut terminated = signal(SignalKind::terminate())?;
        tokio::select! {
            outcome = future => outcome.map(Some),
            _ = interrupted.recv() => Ok(None),
            _ = terminated.recv() => Ok(None),
        }
    });
    runtime.shutdown_background();
    Ok(outcome?)
}
