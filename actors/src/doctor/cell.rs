//! Check of the way to the cell: the node looks on for a moment, with its key and certificate.

use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod::wire::Trouble;
use tokio::time::{Instant, sleep};

use super::Finding;
use crate::node::config::NodeConfig;
use crate::node::{self, NodeHandle};

/// Time in which a leader is found, if there is one.
const PATIENCE: Duration = Duration::from_secs(4);

/// Time for which an observer that follows looks on: greetings of other cells and the cell's time come within it.
const LOOK: Duration = Duration::from_secs(1);

/// Checks that nodes of the cell answer, and compares this machine's clock with theirs. Where no other node could be
/// found, nothing is checked.
pub(super) async fn examine(config: &NodeConfig) -> Vec<Finding> {
    let membership = &config.membership;
    if membership.seeds.is_empty() && !membership.multicast.enabled {
        return Vec::new();
    }
    let observer = match config.clone().observing("doctor") {
        Ok(observer) => observer,
        Err(error) => return vec![Finding::broken("cell", error.to_string(), "shorten `name`")],
    };
    let node = match node::start(observer).await {
        Ok(node) => node,
        Err(error) => return vec![Finding::broken("cell", error.to_string(), "mend what the other checks name")],
    };
    let until = Instant::now() + PATIENCE;
    while node.leadership().borrow().leader().is_none() && Instant::now() < until {
        sleep(Duration::from_millis(50)).await;
    }
    if node.leadership().borrow().leader().is_some() {
        sleep(LOOK).await;
    }
    let findings = findings(config, &node);
    node.stop().await;
    findings
}

fn findings(config: &NodeConfig, node: &NodeHandle) -> Vec<Finding> {
    let (cell, nodes) = (&config.cell, node.members().borrow().len());
    let leader = node.leadership().borrow().leader().map(NodeName::to_string);
    let fix = "start another node, or check `membership.seeds`, the key, and that UDP 17884 passes; the first node of a \
        cell is alone";
    let found = match leader {
        Some(leader) => Finding::fine("cell", format!("{cell} is led by {leader}, nodes that answer: {nodes}")),
        None if nodes > 0 => {
            Finding::doubtful("cell", format!("{cell} has no leader, nodes that answer: {nodes}"), "start an edge")
        }
        None => Finding::doubtful("cell", format!("no node of {cell} answers"), fix),
    };
    let own = node.counters().troubles().present().into_iter();
    let own = own.filter(|trouble| !is_checked_elsewhere(trouble)).map(|Trouble { kind, about, cause, remedy }| {
        let about = about.map_or_else(String::new, |about| format!("{about}: "));
        let check = if kind == TroubleKind::ClockOff.as_str() { "cell's time" } else { "cell" };
        Finding::doubtful(check, format!("{about}{cause}"), remedy)
    });
    [found].into_iter().chain(own).collect()
}

fn is_checked_elsewhere(trouble: &Trouble) -> bool {
    trouble.kind == TroubleKind::Unresolved.as_str()
}
