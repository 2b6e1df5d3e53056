//! `ecod-node record`: joins a cell and records all its messages.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::model::names::NodeName;

use super::Failure;
use super::run::{ObserverArguments, run_node};
use crate::observe::recorder::RecordConfig;

/// Flags of `record`.
#[derive(Debug, Args)]
pub(super) struct RecordArguments {
    #[command(flatten)]
    observer: ObserverArguments,
    /// Directory of the log; default: `record` of the configuration
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
}

/// Default name of the log.
const NAME: NodeName = NodeName::from_static("recorder");

/// Records until SIGINT or SIGTERM.
pub(super) fn run(arguments: &RecordArguments) -> Result<(), Failure> {
    let mut config = arguments.observer.load(NAME.as_str())?;
    let configured = config.record.take();
    let record = match (&arguments.dir, configured) {
        (Some(dir), Some(record)) => RecordConfig {
            dir: dir.clone(),
            ..record
        },
        (Some(dir), None) => RecordConfig::new(dir),
        (None, Some(record)) => record,
        (None, None) => {
            return Err(Failure::usage(anyhow!(
                "no directory to record to: give --dir, or [record] in --config"
            )));
        }
    };
    // A node continues without its log, but for a recorder the log is the only purpose.
    std::fs::create_dir_all(&record.dir)
        .with_context(|| format!("cannot record to {}", record.dir.display()))?;
    // A name with the process id would start a new log in every run, and no later run would
    // continue or delete it.
    let name = Some(arguments.observer.name().cloned().unwrap_or(NAME));
    config.record = Some(RecordConfig {
        name,
        reports: true,
        ..record
    });
    run_node(config, false)
}
