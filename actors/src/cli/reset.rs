//! `ecod-node reset`: drops the evidence about vehicles, the highest term, or the description.

use anyhow::{Context, anyhow};
use clap::{ArgGroup, Args};

use super::installation::ConfigurationArguments;
use super::{Failure, print};
use crate::actors::reputation_keeper::reset_saved;
use crate::platform::clock;
use crate::platform::state_file::StateFile;

/// Flags of `reset`.
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("what").required(true).multiple(true)))]
pub(super) struct ResetArguments {
    #[command(flatten)]
    configuration: ConfigurationArguments,
    /// Drop the evidence behind the reputations. In a cell without certificates all nodes drop it
    #[arg(long, group = "what")]
    reputations: bool,
    /// Drop the highest term of leadership
    #[arg(long, group = "what")]
    term: bool,
    /// Drop the description of the cell. The node receives it again from other nodes that have it
    #[arg(long, group = "what")]
    description: bool,
}

/// Resets the files; the node must not run.
pub(super) fn run(arguments: &ResetArguments) -> Result<(), Failure> {
    let (config, _) = arguments.configuration.load()?;
    let missing = |key: &str, what: &str| Failure::usage(anyhow!("key `{key}`: {what}"));
    let directory = config
        .state_dir
        .as_deref()
        .ok_or_else(|| missing("state_dir", "not set, so nothing is saved"))?;
    let name = config
        .name
        .as_ref()
        .ok_or_else(|| missing("name", "not set, so the node's files cannot be found"))?;
    let file = |what: &str| StateFile::new(directory, &config.cell, name, what);
    let _lock = StateFile::lock(directory, &config.cell, name).with_context(|| {
        format!("{name} runs and would write its state again; stop it, and repeat the command")
    })?;
    let mut done = String::new();
    if arguments.reputations {
        if !config.may_lead() {
            return Err(Failure::usage(anyhow!(
                "{name} never leads and keeps no evidence: reset a node that may lead"
            )));
        }
        let file = file("reputations");
        reset_saved(&file, &config.cell, name, clock::now())
            .with_context(|| file.path().display().to_string())?;
        done += &format!("reset {}\n", file.path().display());
    }
    let removed = [
        (arguments.term, "term"),
        (arguments.description, "description"),
    ];
    for (_, what) in removed.into_iter().filter(|(is_asked, _)| *is_asked) {
        let file = file(what);
        file.delete()
            .with_context(|| file.path().display().to_string())?;
        done += &format!("removed {}\n", file.path().display());
    }
    Ok(print(&(done + "start the node again\n"))?)
}
