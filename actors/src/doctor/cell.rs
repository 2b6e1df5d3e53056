//! Check of the connection to the cell: the node observes it for a moment, with its key and
//! certificate.

use std::io::ErrorKind;
use std::net::UdpSocket;
use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod::wire::Trouble;
use tokio::time::{Instant, sleep};

use super::Finding;
use crate::node::config::NodeConfig;
use crate::node::{self, NodeHandle};
use crate::transport::gossip::Member;

/// Time in which a leader is found, if there is one.
const PATIENCE: Duration = Duration::from_secs(4);

/// Time for which an observer that follows a leader stays: greetings of other cells and the cell's
/// time arrive within it.
const CHECK_PERIOD: Duration = Duration::from_secs(1);

/// Checks that nodes of the cell answer, and compares this machine's clock with theirs. If no other
/// node was found, this check is skipped.
pub(super) async fn examine(config: &NodeConfig) -> Vec<Finding> {
    let membership = &config.membership;
    if membership.seeds.is_empty() && !membership.multicast.enabled {
        return Vec::new();
    }
    let unrecorded = NodeConfig {
        record: None,
        ..config.clone()
    };
    let observer = match unrecorded.observing("doctor") {
        Ok(observer) => observer,
        Err(error) => return vec![Finding::broken("cell", error.to_string(), "shorten `name`")],
    };
    let node = match node::start(observer).await {
        Ok(node) => node,
        Err(error) => {
            return vec![Finding::broken(
                "cell",
                error.to_string(),
                "correct what the other checks name",
            )];
        }
    };
    let until = Instant::now() + PATIENCE;
    while node.leadership().borrow().leader().is_none() && Instant::now() < until {
        sleep(Duration::from_millis(50)).await;
    }
    if node.leadership().borrow().leader().is_some() {
        sleep(CHECK_PERIOD).await;
    }
    let findings = findings(config, &node);
    node.stop().await;
    findings
}

fn findings(config: &NodeConfig, node: &NodeHandle) -> Vec<Finding> {
    let cell = &config.cell;
    let nodes = node.other_nodes().len();
    let leader = node.leadership().borrow().leader().map(NodeName::to_string);
    let fix = "start another node, or check that `cell` and the key are the same on all, `membership.seeds`, and that UDP 17884 \
        passes; the first node of a cell is alone";
    let found = match leader {
        Some(leader) => Finding::fine(
            "cell",
            format!("{cell} is led by {leader}, nodes that answer: {nodes}"),
        ),
        None if nodes > 0 => Finding::doubtful(
            "cell",
            format!("{cell} has no leader, nodes that answer: {nodes}"),
            "start an edge",
        ),
        None => Finding::doubtful("cell", format!("no node of {cell} answers"), fix),
    };
    let own = node
        .counters()
        .troubles()
        .present()
        .into_iter()
        .filter(|trouble| !is_checked_elsewhere(trouble))
        .map(
            |Trouble {
                 kind,
                 about,
                 cause,
                 remedy,
             }| {
                let about = about.map_or_else(String::new, |about| format!("{about}: "));
                let check = if kind == TroubleKind::ClockOff.as_str() {
                    "cell's time"
                } else {
                    "cell"
                };
                Finding::doubtful(check, format!("{about}{cause}"), remedy)
            },
        );
    let name = node
        .members()
        .borrow()
        .iter()
        .find_map(|member| used_elsewhere(config, member));
    [found].into_iter().chain(name).chain(own).collect()
}

/// A living node of another machine that has this node's name.
fn used_elsewhere(config: &NodeConfig, member: &Member) -> Option<Finding> {
    let has_name = config.name.as_ref() == Some(&member.name);
    let own_port = config
        .membership
        .bind
        .map(|bind| bind.port())
        .filter(|port| *port != 0);
    let is_on_other_port = own_port.is_some_and(|port| port != member.gossip.port());
    let is_elsewhere =
        || UdpSocket::bind(member.gossip).is_err_and(|e| e.kind() == ErrorKind::AddrNotAvailable);
    (has_name && (is_on_other_port || is_elsewhere())).then(|| {
        let seen = format!(
            "{} is the name of a node that runs at {}",
            member.name, member.gossip
        );
        Finding::broken(
            "name",
            seen,
            "give this node another `name`: only the first node of a name is a member",
        )
    })
}

fn is_checked_elsewhere(trouble: &Trouble) -> bool {
    let elsewhere = [
        TroubleKind::Unresolved,
        TroubleKind::ImplausibleSize,
        TroubleKind::ImplausibleUnit,
    ];
    elsewhere.iter().any(|kind| trouble.kind == kind.as_str())
}

#[cfg(test)]
mod tests {
    use ecod::wire::Role;

    use super::*;

    #[test]
    fn name_running_elsewhere_is_named() {
        let own = UdpSocket::bind("127.0.0.1:0").unwrap();
        let config = NodeConfig {
            name: Some(NodeName::from_static("euclid")),
            ..NodeConfig::default()
        };
        let member = |name, gossip| Member {
            name: NodeName::from_static(name),
            run: 1,
            gossip,
            broker: None,
            role: Role::Auto,
            certificate: None,
        };
        let here = own.local_addr().unwrap();
        let there = "192.0.2.7:17884".parse().unwrap();
        assert_eq!(
            used_elsewhere(&config, &member("euclid", here)),
            None,
            "the node itself, which runs"
        );
        assert_eq!(used_elsewhere(&config, &member("gauss", there)), None);
        let mut beside = config.clone();
        beside.membership.bind = Some("127.0.0.1:1".parse().unwrap());
        assert!(
            used_elsewhere(&beside, &member("euclid", here)).is_some(),
            "another run on this machine"
        );
        let found = used_elsewhere(&config, &member("euclid", there)).unwrap();
        assert!(
            found
                .seen
                .contains("euclid is the name of a node that runs at 192.0.2.7"),
            "{found:?}"
        );
    }
}
