//! Files of this machine's node, which commands use if they are given no file.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;
use serde_json::json;

use super::Failure;
use crate::node::config::NodeConfig;
use crate::node::config::guidance::SERVICE_DIRECTORY;
use crate::platform::owner::is_root;

/// Flag that names the configuration of a node of this machine.
#[derive(Debug, Args)]
pub(super) struct ConfigurationArguments {
    /// Configuration of the node (TOML); `ECOD_…` variables apply as they do to the node [default:
    /// /etc/ecod/node.toml or ecod/node.toml, if it exists]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

impl ConfigurationArguments {
    /// The configuration and its file.
    pub(super) fn load(&self) -> Result<(NodeConfig, PathBuf), Failure> {
        let file = configuration(self.config.as_deref()).ok_or_else(|| {
            let remedy = "name it by --config FILE, or make one by `ecod-node init` or `ecod-node join`";
            Failure::usage(anyhow!(
                "neither {SERVICE_DIRECTORY}/node.toml nor {USER_DIRECTORY}/node.toml exists: {remedy}"
            ))
        })?;
        let config = NodeConfig::load(Some(&file), &json!({})).map_err(Failure::usage)?;
        Ok((config, file))
    }
}

/// Directory of a node that a user has made without the rights of root.
const USER_DIRECTORY: &str = "ecod";

/// Directory of a CA that was made by hand.
pub(super) const AUTHORITY_DIRECTORY: &str = "pki";

/// Directory in which `init` and `join` make a node.
pub(super) fn directory() -> &'static Path {
    Path::new(if is_root() {
        SERVICE_DIRECTORY
    } else {
        USER_DIRECTORY
    })
}

/// The configuration for a command: the given file, or else the file of this machine's node, if there
/// is one. A file that was not given is named on standard error.
pub(super) fn configuration(given: Option<&Path>) -> Option<PathBuf> {
    given
        .map(Path::to_owned)
        .or_else(|| installed("node.toml").inspect(|path| name(path)))
}

/// Directory of the cell's CA: the given one, or else `pki` in the working directory, or else the
/// CA that `init` has made on this machine. The last is named on standard error.
pub(super) fn authority(given: Option<&Path>) -> PathBuf {
    let by_hand = Path::new(AUTHORITY_DIRECTORY);
    if let Some(given) = given.or_else(|| by_hand.exists().then_some(by_hand)) {
        return given.to_owned();
    }
    installed(AUTHORITY_DIRECTORY)
        .inspect(|path| name(path))
        .unwrap_or_else(|| by_hand.to_owned())
}

/// A file of this machine's node: in the user's own directory of nodes, or else in the other one.
fn installed(file: &str) -> Option<PathBuf> {
    let others = [SERVICE_DIRECTORY, USER_DIRECTORY].map(Path::new);
    let directories = [directory()].into_iter().chain(others);
    directories
        .map(|directory| directory.join(file))
        .find(|path| path.exists())
}

fn name(path: &Path) {
    eprintln!("using {}", path.display());
}
