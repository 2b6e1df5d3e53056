//! `ecod-node pki`: the certificates of a cell.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::anyhow;
use clap::{Args, Subcommand};
use ecod::names::NodeName;
use ecod::wire::Role;

use super::{Failure, print};
use crate::platform::clock;
use crate::transport::pki::{Authority, DEFAULT_DAYS};

/// What `pki` can do.
#[derive(Debug, Subcommand)]
pub(super) enum PkiCommand {
    /// Make the cell's CA and an empty revocation list
    Init(InitArguments),
    /// Make a key and a certificate for a node
    Issue(IssueArguments),
    /// Revoke all certificates of a node
    Revoke(RevokeArguments),
}

/// Flags of `pki init`.
#[derive(Debug, Args)]
pub(super) struct InitArguments {
    #[command(flatten)]
    place: AuthorityDir,
    /// Name of the cell
    #[arg(long)]
    cell: NodeName,
}

/// Flags of `pki issue`.
#[derive(Debug, Args)]
pub(super) struct IssueArguments {
    #[command(flatten)]
    place: AuthorityDir,
    /// Name of the node
    node: NodeName,
    /// What the node is meant to do: with `cav` it cannot have a broker, and so never lead
    #[arg(long, default_value = "auto", value_parser = ["auto", "cav", "edge"])]
    role: String,
    /// Days for which the certificate is valid
    #[arg(long, default_value_t = DEFAULT_DAYS, value_parser = clap::value_parser!(u32).range(1..=3650))]
    days: u32,
}

/// Flags of `pki revoke`.
#[derive(Debug, Args)]
pub(super) struct RevokeArguments {
    #[command(flatten)]
    place: AuthorityDir,
    /// Name of the node
    node: NodeName,
}

#[derive(Debug, Args)]
struct AuthorityDir {
    /// Directory of the CA; whoever can read its `ca.key` can make certificates
    #[arg(long, value_name = "DIR", default_value = "pki")]
    dir: PathBuf,
}

/// Does it, and says which files are for whom.
pub(super) fn run(command: &PkiCommand) -> Result<(), Failure> {
    let now = clock::now();
    let told = match command {
        PkiCommand::Init(InitArguments { place, cell }) => {
            let authority = Authority::init(&place.dir, cell, now).map_err(failure)?;
            format!("made a CA for {cell}; its certificate, for every node: {}\n", shown(&authority.ca()))
        }
        PkiCommand::Issue(IssueArguments { place, node, role, days }) => {
            let mut authority = Authority::open(&place.dir).map_err(failure)?;
            let role = match role.as_str() {
                "cav" => Role::Cav,
                "edge" => Role::Edge,
                _ => Role::Auto,
            };
            let valid = Duration::from_secs(u64::from(*days) * 86_400);
            authority.issue(node, role, valid, now).map_err(failure)?;
            configuration(&authority, node)
        }
        PkiCommand::Revoke(RevokeArguments { place, node }) => {
            let mut authority = Authority::open(&place.dir).map_err(failure)?;
            let count = authority.revoke(node, now).map_err(failure)?;
            let list = shown(&authority.revocation_list());
            format!("revoked {count} of {node}; copy the list to every node, which need not be restarted: {list}\n")
        }
    };
    Ok(print(&told)?)
}

/// What belongs into the node's configuration once these files are on it.
fn configuration(authority: &Authority, node: &NodeName) -> String {
    let (certificate, key) = authority.files_of(node);
    let (ca, certificate) = (shown(&authority.ca()), shown(&certificate));
    let (key, list) = (shown(&key), shown(&authority.revocation_list()));
    format!("[tls]\nca = \"{ca}\"\ncertificate = \"{certificate}\"\nkey = \"{key}\"\nrevocation_list = \"{list}\"\n")
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

fn failure(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    anyhow!(error).into()
}
