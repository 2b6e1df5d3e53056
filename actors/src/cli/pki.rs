//! `ecod-node pki`: certificates of a cell.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::anyhow;
use clap::{Args, Subcommand};
use ecod::leadership::Rights;
use ecod::leadership::election::ElectionConfig;
use ecod::model::names::NodeName;
use ecod::wire::Role;

use super::{Failure, print};
use crate::platform::clock;
use crate::transport::pki::{Authority, DEFAULT_DAYS};

/// Commands of `pki`.
#[derive(Debug, Subcommand)]
pub(super) enum PkiCommand {
    /// Make the cell's CA and an empty revocation list
    Init {
        #[command(flatten)]
        ca: AuthorityDir,
        /// Name of the cell
        #[arg(long)]
        cell: NodeName,
    },
    /// Make a key and a certificate for a node
    Issue {
        #[command(flatten)]
        ca: AuthorityDir,
        /// Name of the node
        node: NodeName,
        /// Highest role of the node, its key `role`; with `cav` it can never lead, with `auto` not as an edge
        #[arg(long, default_value = "auto", value_parser = ["auto", "cav", "edge"])]
        role: String,
        /// Highest priority of the node in the election, its key `election.priority`
        #[arg(long, default_value_t = ElectionConfig::default().priority)]
        priority: u8,
        /// Validity of the certificate in days
        #[arg(long, default_value_t = DEFAULT_DAYS, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
    },
    /// Revoke all certificates of a node
    Revoke {
        #[command(flatten)]
        ca: AuthorityDir,
        /// Name of the node
        node: NodeName,
    },
}

#[derive(Debug, Args)]
pub(super) struct AuthorityDir {
    /// Directory of the CA; anyone who can read its `ca.key` can issue certificates
    #[arg(long, value_name = "DIR", default_value = "pki")]
    dir: PathBuf,
}

/// Runs the command and prints the files to distribute.
pub(super) fn run(command: &PkiCommand) -> Result<(), Failure> {
    let now = clock::now();
    let message = match command {
        PkiCommand::Init { ca, cell } => {
            let authority = Authority::init(&ca.dir, cell, now).map_err(failure)?;
            format!("made a CA for {cell}; copy its certificate to every node: {}\n", shown(&authority.ca()))
        }
        PkiCommand::Issue { ca, node, role, priority, days } => {
            let mut authority = Authority::open(&ca.dir).map_err(failure)?;
            let role = role_named(role);
            let valid = Duration::from_secs(u64::from(*days) * 86_400);
            authority.issue(node, Rights { role, priority: *priority }, valid, now).map_err(failure)?;
            configuration(&authority, node)
        }
        PkiCommand::Revoke { ca, node } => {
            let mut authority = Authority::open(&ca.dir).map_err(failure)?;
            let count = authority.revoke(node, now).map_err(failure)?;
            let list = shown(&authority.revocation_list());
            format!("revoked {count} of {node}; copy the list to every node (no restart needed): {list}\n")
        }
    };
    Ok(print(&message)?)
}

/// The role of a flag, whose value is one of the three.
pub(super) fn role_named(name: &str) -> Role {
    match name {
        "cav" => Role::Cav,
        "edge" => Role::Edge,
        _ => Role::Auto,
    }
}

/// Section of the node's configuration that names these files.
fn configuration(authority: &Authority, node: &NodeName) -> String {
    let (certificate, key) = authority.files_of(node);
    let [ca, certificate, key, list] =
        [authority.ca(), certificate, key, authority.revocation_list()].map(|path| shown(&path));
    format!("[tls]\nca = \"{ca}\"\ncertificate = \"{certificate}\"\nkey = \"{key}\"\nrevocation_list = \"{list}\"\n")
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

fn failure(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    anyhow!(error).into()
}
