//! Which files a log consists of, and whose they are.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::names::NodeName;

use super::Failure;
use crate::observe::recorder::{LogError, LogReader};

/// Chooses among logs that lie together.
#[derive(Debug, Args)]
pub(super) struct NodeArguments {
    /// Whose log it is, where those of several nodes are given
    #[arg(long, value_name = "NAME")]
    pub(super) node: Option<NodeName>,
}

/// The files of one node's log, in order.
pub(super) struct Logs {
    pub(super) files: Vec<PathBuf>,
    /// Why a file does not say under which configuration it was written.
    pub(super) unusable: Option<LogError>,
}

/// A file, and what its beginning says.
struct LogInput {
    path: PathBuf,
    node: Option<NodeName>,
    unusable: Option<LogError>,
}

impl Logs {
    /// Looks into files that are logs, and directories of logs, for those of one node.
    pub(super) fn find(inputs: &[PathBuf], NodeArguments { node }: &NodeArguments) -> Result<Self, Failure> {
        let mut logs = Vec::new();
        for input in inputs {
            if input.is_dir() {
                let found =
                    crate::observe::recorder::files(input).with_context(|| format!("cannot read {}", input.display()));
                for path in found.map_err(Failure::usage)? {
                    logs.push(LogInput::look_into(path)?);
                }
            } else if LogReader::recognises(input).map_err(Failure::usage)? {
                logs.push(LogInput::look_into(input.clone())?);
            } else {
                return Err(Failure::usage(anyhow!("{} is not a log", input.display())));
            }
        }
        if logs.is_empty() {
            return Err(Failure::usage(anyhow!("there is no log in the directory {}", inputs[0].display())));
        }
        let logs = one_node(logs, node.as_ref())?;
        let (mut files, mut unusable) = (Vec::new(), None);
        for log in logs {
            files.push(log.path);
            unusable = unusable.or(log.unusable);
        }
        Ok(Self { files, unusable })
    }
}

impl LogInput {
    fn look_into(path: PathBuf) -> Result<Self, Failure> {
        let mut log = LogReader::open(&path).map_err(Failure::usage)?;
        let unusable = match log.next() {
            Some(Err(error @ (LogError::Newer { .. } | LogError::Identity { .. }))) => Some(error),
            _ => None,
        };
        let node = log.node().cloned();
        Ok(Self { path, node, unusable })
    }
}

/// Those of the node that is asked for; files that do not say whose they are go with the only one.
fn one_node(mut logs: Vec<LogInput>, node: Option<&NodeName>) -> Result<Vec<LogInput>, Failure> {
    let nodes: BTreeSet<_> = logs.iter().filter_map(|log| log.node.clone()).collect();
    let names = || nodes.iter().map(NodeName::as_str).collect::<Vec<_>>().join(", ");
    match node {
        Some(node) if !nodes.contains(node) => {
            let others = if nodes.is_empty() { "nobody".into() } else { names() };
            Err(Failure::usage(anyhow!("there is no log of {node} here, but of {others}")))
        }
        Some(node) => {
            logs.retain(|log| log.node.as_ref() == Some(node));
            Ok(logs)
        }
        None if nodes.len() > 1 => {
            Err(Failure::usage(anyhow!("these are logs of several nodes, {}: choose one by --node", names())))
        }
        None => Ok(logs),
    }
}
