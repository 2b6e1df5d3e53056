//! Selection of log files by node.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context, anyhow, bail};
use clap::Args;
use ecod::model::names::NodeName;

use super::Failure;
use crate::observe::recorder::{LogError, LogReader};

/// Choice among logs of several nodes.
#[derive(Debug, Args)]
pub(super) struct LogsNodeArguments {
    /// Node whose log to use, among logs of several nodes
    #[arg(long, value_name = "NAME")]
    pub(super) node: Option<NodeName>,
}

/// Files of one node's log, in order.
pub(super) struct Logs {
    pub(super) files: Vec<PathBuf>,
    /// Error of the first file without a configuration.
    pub(super) unusable: Option<LogError>,
}

impl Logs {
    /// Finds the log files of one node among files and directories. Files without a node's name
    /// belong to the only node.
    pub(super) fn find(
        inputs: &[PathBuf],
        LogsNodeArguments { node }: &LogsNodeArguments,
    ) -> Result<Self, Failure> {
        let paths = log_files(inputs).map_err(Failure::usage)?;
        let mut logs = Vec::new();
        let mut nodes = BTreeSet::new();
        for path in paths {
            let mut log = LogReader::open(&path).map_err(Failure::usage)?;
            let unusable = match log.next() {
                Some(Err(error @ (LogError::Newer { .. } | LogError::Identity { .. }))) => {
                    Some(error)
                }
                _ => None,
            };
            nodes.extend(log.node().cloned());
            if node.is_none() || node.as_ref() == log.node() {
                logs.push((path, unusable));
            }
        }
        let names = nodes
            .iter()
            .map(NodeName::as_str)
            .collect::<Vec<_>>()
            .join(", ");
        match node {
            Some(node) if !nodes.contains(node) => {
                let others = if nodes.is_empty() {
                    ", nor of another node".to_owned()
                } else {
                    format!(", but of {names}")
                };
                return Err(Failure::usage(anyhow!(
                    "there is no log of {node} here{others}"
                )));
            }
            None if nodes.len() > 1 => {
                return Err(Failure::usage(anyhow!(
                    "these are logs of several nodes, {names}: choose one by --node"
                )));
            }
            _ => {}
        }
        let (files, unusable): (Vec<_>, Vec<_>) = logs.into_iter().unzip();
        Ok(Self {
            files,
            unusable: unusable.into_iter().flatten().next(),
        })
    }
}

/// Log files among files and directories.
fn log_files(inputs: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for input in inputs {
        if input.is_dir() {
            let files = crate::observe::recorder::files(input);
            found.extend(files.with_context(|| format!("cannot read {}", input.display()))?);
        } else if LogReader::recognises(input)? {
            found.push(input.clone());
        } else {
            bail!("{} is not a log", input.display());
        }
    }
    if found.is_empty() {
        bail!("there is no log in the directory {}", inputs[0].display());
    }
    Ok(found)
}
