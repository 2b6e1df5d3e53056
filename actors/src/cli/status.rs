//! `ecod-node status`: the state of this machine's node, for people and scripts.

use std::io::{ErrorKind, Write};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow};
use chrono::DateTime;
use clap::Args;
use ecod::diagnostics::in_words;
use ecod::model::time::Timestamp;
use ecod::wire::Trouble;
use serde_json::json;

use super::run::ip_and_port;
use super::{Failure, installation, print};
use crate::node::config::NodeConfig;
use crate::node::running::{RunningMember, RunningNode, RunningTrouble, page_address};
use crate::platform::clock;

/// Flags of `status`.
#[derive(Debug, Args)]
pub(super) struct StatusArguments {
    /// Configuration of the node (TOML); `ECOD_…` variables apply as they do to the node [default,
    /// without --page: /etc/ecod/node.toml or ecod/node.toml, if it exists]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Address of the node's page, if it is not the configured one; the node's log names it
    #[arg(long, value_name = "IP:PORT", value_parser = ip_and_port)]
    page: Option<SocketAddr>,
    /// Print JSON for programs
    #[arg(long)]
    json: bool,
    /// Print the state again whenever it changes, until the command is interrupted
    #[arg(long)]
    watch: bool,
}

/// Time between two readings of the state.
const PERIOD: Duration = Duration::from_secs(1);

/// Prints the state of the node. Fails if no node answers, or the node is not ready.
pub(super) fn run(arguments: &StatusArguments) -> Result<(), Failure> {
    let given = arguments.config.as_deref();
    let file = if arguments.page.is_none() {
        installation::configuration(given)
    } else {
        given.map(PathBuf::from)
    };
    let config = NodeConfig::load(file.as_deref(), &json!({})).map_err(Failure::usage)?;
    let read = || {
        let page = arguments.page.unwrap_or(page_address(&config));
        let node = RunningNode::read(page, &config).map_err(|error| {
            let remedy = "start the node, or name its page by --page; the log of the node has it as `dashboard serves url=`";
            Failure::no_node(anyhow!(error).context(format!("no node at {page}; {remedy}")))
        })?;
        if file.is_some() && !node.is_of(&config) {
            let name = &node.node.name;
            let cell = &node.node.cell;
            let error = anyhow!(
                "the page at {page} is of {name} in cell {cell}: name that of this node by --page"
            );
            return Err(Failure::no_node(error));
        }
        Ok(node)
    };
    if arguments.watch {
        return watch(read, arguments.json);
    }
    let node = read()?;
    print(&if arguments.json {
        serde_json::to_string_pretty(&node).context("the state as JSON")? + "\n"
    } else {
        text(&node)
    })?;
    if node.readiness.ready {
        Ok(())
    } else {
        Err(Failure::not_ready(anyhow!(
            "not ready: {}",
            node.readiness.reason
        )))
    }
}

/// Prints the state whenever it changes, until the reader of the output ends.
fn watch(read: impl Fn() -> Result<RunningNode, Failure>, is_json: bool) -> Result<(), Failure> {
    let mut shown = None;
    let mut output = std::io::stdout();
    loop {
        let state = read().map_err(|failure| failure.to_string());
        // The time alone is no change.
        let undated = state.clone().map(|node| RunningNode {
            now_us: Timestamp::default(),
            ..node
        });
        if shown.as_ref() != Some(&undated) {
            let line = match &state {
                Ok(node) if is_json => json!(node).to_string(),
                Ok(node) => text(node),
                Err(error) if is_json => json!({ "error": error }).to_string(),
                Err(error) => error.clone(),
            };
            match writeln!(output, "{line}").and_then(|()| output.flush()) {
                Err(error) if error.kind() == ErrorKind::BrokenPipe => return Ok(()),
                written => written.context("cannot write to standard output")?,
            }
            shown = Some(undated);
        }
        std::thread::sleep(PERIOD);
    }
}

/// The state as text.
fn text(running: &RunningNode) -> String {
    let RunningNode {
        node,
        readiness,
        leadership,
        nodes,
        troubles,
        ..
    } = running;
    let ready = if readiness.ready {
        "ready"
    } else {
        "not ready"
    };
    let mut text = format!(
        "{} ({}) in cell {}: {ready}, {}\n",
        node.name, node.role, node.cell, readiness.reason
    );
    if let (Some(leader), Some(term)) = (&leadership.leader, leadership.epoch) {
        let standby = leadership
            .standby
            .as_ref()
            .map_or_else(String::new, |name| format!(", next {name}"));
        text += &format!("leader: {leader}, term {term}{standby}\n");
    }
    if let Some(ends) = node.certificate_ends_us {
        text += &format!("certificate: {}\n", validity_text(ends));
    }
    for member in nodes {
        text += &format!("node: {}\n", member_text(member));
    }
    for RunningTrouble { told_by, trouble } in troubles {
        let Trouble {
            about,
            cause,
            remedy,
            ..
        } = trouble;
        let about = about.as_deref().unwrap_or(told_by.as_str());
        text += &format!("trouble: {about}: {cause} -> {remedy}\n");
    }
    text
}

/// The end of the node's certificate. A running cell renews it before that.
fn validity_text(ends: Timestamp) -> String {
    let left = ends.since(clock::wall());
    let date = date(ends).unwrap_or_default();
    match left.as_secs() / 86_400 {
        0 if left.is_zero() => format!("ended {date}"),
        0 => format!("{} left, ends {date}", in_words(left)),
        days => format!("{days} days left, ends {date}"),
    }
}

fn member_text(member: &RunningMember) -> String {
    let last_seen = member.last_seen_us.and_then(date);
    let state = match last_seen {
        _ if member.alive => "online".to_owned(),
        Some(last_seen) => format!("gone, last seen {last_seen}"),
        None => "offline".to_owned(),
    };
    format!("{} ({}) {state}", member.name, member.role)
}

fn date(at: Timestamp) -> Option<String> {
    let at = DateTime::from_timestamp_micros(i64::try_from(at.micros()).ok()?)?;
    Some(at.format("%Y-%m-%d %H:%M:%S UTC").to_string())
}
