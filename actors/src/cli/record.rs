//! `ecod-node record`: joins a cell to record what all of it says.

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
    /// Directory of the log; default that of `record` in the configuration
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
}

/// Whose log it is, unless the observer is given a name.
const NAME: NodeName = NodeName::from_static("recorder");

/// Records until SIGINT or SIGTERM.
pub(super) fn run(arguments: &RecordArguments) -> Result<(), Failure> {
    let mut config = arguments.observer.load(NAME.as_str())?;
    let configured = config.record.take();
    let record = match (&arguments.dir, configured) {
        (Some(dir), Some(record)) => RecordConfig { dir: dir.clone(), ..record },
        (Some(dir), None) => RecordConfig::new(dir),
        (None, Some(record)) => record,
        (None, None) => return Err(Failure::usage(anyhow!("where is recorded? give --dir, or [record] in --config"))),
    };
    // A node goes on without its log; an observer that records has nothing else to do.
    std::fs::create_dir_all(&record.dir).with_context(|| format!("cannot record in {}", record.dir.display()))?;
    // The name of the process would make every run a log of its own, that none after it deletes or goes on with.
    let name = Some(arguments.observer.name().cloned().unwrap_or(NAME));
    config.record = Some(RecordConfig { name, reports: true, ..record });
    run_node(config, false)
}
