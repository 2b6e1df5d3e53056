//! `ecod-node completions` and `ecod-node man`: files that a package installs together with the
//! program.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use clap_complete::Shell;

use super::{Failure, print};

/// Flags of `completions`.
#[derive(Debug, Args)]
pub(super) struct CompletionsArguments {
    /// Shell to complete in
    shell: Shell,
}

/// Flags of `man`.
#[derive(Debug, Args)]
pub(super) struct ManArguments {
    /// Directory for the pages, created if missing
    dir: PathBuf,
}

/// Prints the completion script of a shell.
pub(super) fn completions(
    arguments: &CompletionsArguments,
    mut program: clap::Command,
) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut program, "ecod-node", &mut script);
    Ok(print(&String::from_utf8_lossy(&script))?)
}

/// Writes a page for the program and one for each of its commands.
pub(super) fn man(arguments: &ManArguments, program: clap::Command) -> Result<(), Failure> {
    let dir = &arguments.dir;
    let written = fs::create_dir_all(dir).and_then(|()| clap_mangen::generate_to(program, dir));
    Ok(written.with_context(|| format!("cannot write manual pages to {}", dir.display()))?)
}
