//! Selection of log files by node.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::model::names::NodeName;

use super::Failure;
use crate::observe::recorder::{LogError, LogReader};

/// Choice among logs of several nodes.
#[derive(Debug, Args)]
pub(super) struct NodeArguments {
    /// Node whose log to use, among logs of several nodes
    #[arg(long, value_name = "NAME")]
    pub(super) node: Option<NodeName>,
}

/// Files of one node's log, in order.
pub(super) struct Logs {
    pub(super) files: Vec<PathBuf>,
    /// Error of the first file whose configuration is unknown.
    pub(super) unusable: Option<LogError>,
}

/// A file and the identity at its beginning.
struct LogInput {
    path: PathBuf,
    node: Option<NodeName>,
    unusable: Option<LogError>,
}

impl Logs {
    /// Finds the log files of one node among files and directories.
    pub(super) fn find(inputs: &[PathBuf], NodeArguments { node }: &NodeArguments) -> Result<Self, Failure> {
        let mut logs = Vec::new();
        for input in inputs {
            if input.is_dir() {
                let found =
                    crate::observe::recorder::files(input).with_context(|| format!("cannot read {}", input.display()));
                for path in found.map_err(Failure::usage)? {
                    logs.push(LogInput::open(path)?);
                }
            } else if LogReader::recognises(input).map_err(Failure::usage)? {
                logs.push(LogInput::open(input.clone())?);
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
    fn open(path: PathBuf) -> Result<Self, Failure> {
        let mut log = LogReader::open(&path).map_err(Failure::usage)?;
        let unusable = match log.next() {
            Some(Err(error @ (LogError::Newer { .. } | LogError::Identity { .. }))) => Some(error),
            _ => None,
        };
        let node = log.node().cloned();
        Ok(Self { path, node, unusable })
    }
}

/// Files of the wanted node. Files without a node's name belong to the only node.
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
