//! All data of a cell that the page shows, as one JSON object.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};

use ecod::diagnostics::{ExpectedNodes, MissingNode};
use ecod::leadership::Position;
use ecod::leadership::readiness::Readiness;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, NodeState, NodeStatus, Reputations, Role, Trouble, Verdicts};
use serde::Serialize;

use super::live_state::{LatestReport, MAX_SHOWN, ReportedStatus};
use super::node_sources::{NodeFacts, NodeSources};
use crate::messages::newest::Received;
use crate::telemetry::counters::CounterSnapshot;
use crate::transport::gossip::Member;
use crate::transport::mqtt::{BrokerAddress, LinkState};

/// State of the link to each broker.
pub(crate) type LinkStates = BTreeMap<BrokerAddress, LinkState>;

/// Version of [`Snapshot`] and of the other answers of the API.
pub(crate) const API_VERSION: u32 = 1;

/// A node's view of its cell at one moment. Times are Unix microseconds by the node's clock, except
/// in messages.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Snapshot {
    /// [`API_VERSION`].
    pub schema: u32,
    /// Time of the snapshot.
    pub now_us: Timestamp,
    pub node: NodeFacts,
    /// Readiness of this node.
    pub readiness: Readiness,
    /// The leader, its standby and this node's position.
    pub leadership: LeadershipFacts,
    /// Newest map accepted.
    pub map: Option<Received<GlobalMap>>,
    /// Newest verdicts accepted.
    pub verdicts: Option<Received<Verdicts>>,
    /// Newest reputations accepted.
    pub reputations: Option<Received<Reputations>>,
    /// Latest report of each vehicle and kind.
    pub vehicles: Vec<LatestReport>,
    /// All nodes, this one included.
    pub nodes: Vec<NodeEntry>,
    /// State of the link to each broker: `up`, `stalled`, `down` or `refused`.
    pub links: BTreeMap<String, String>,
    /// Current troubles of the cell on this node, the node's own troubles first.
    pub troubles: Vec<TroubleEntry>,
    /// Counters of failures and losses, by reason.
    pub counters: CounterSnapshot,
}

/// A trouble, for a browser.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct TroubleEntry {
    /// The node that reports the trouble.
    pub told_by: NodeName,
    #[serde(flatten)]
    pub trouble: Trouble,
}

/// The leadership of the cell, for a browser.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct LeadershipFacts {
    pub position: Position,
    /// The leader; absent while the node seeks one.
    pub leader: Option<NodeName>,
    /// Highest term that has been seen.
    pub epoch: Option<u64>,
    /// The node that leads next.
    pub standby: Option<NodeName>,
    /// Time at which this node began to follow the leader.
    pub since_us: Option<Timestamp>,
    /// Changes of the leader since the node started.
    pub failovers: u64,
}

/// A node of the cell.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct NodeEntry {
    /// Name of the node.
    pub name: NodeName,
    pub role: Role,
    /// True if the node answers. A node that has not answered yet counts as alive while a linked
    /// broker reports its status.
    pub alive: bool,
    /// State that it reported.
    pub state: Option<NodeState>,
    /// True if the node reported that it could lead.
    pub fit: Option<bool>,
    /// Version of its software.
    pub version: Option<String>,
    /// Address and port of its page, where this node's users may reach it. Its own page is left
    /// out.
    pub page: Option<SocketAddr>,
    /// True if the node does not answer although it is expected: a former member that ended
    /// without an orderly stop and that no operator has dismissed.
    pub missing: bool,
    /// Time at which a missing node last answered this node.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub last_seen_us: Option<Timestamp>,
}

/// A value as JSON; truncated where it cannot be encoded, which is logged.
pub(crate) fn json(value: &impl Serialize) -> Vec<u8> {
    let mut text = Vec::new();
    if let Err(error) = serde_json::to_writer(&mut text, value) {
        tracing::warn!(%error, "answer to a browser truncated");
    }
    text
}

/// This node and the others by name, without observers and other parts of nodes. `links` is absent
/// if unknown.
pub(crate) fn nodes(sources: &NodeSources, links: Option<&LinkStates>) -> Vec<NodeEntry> {
    let own = &sources.node;
    let leading = sources.vitals.leadership.borrow().is_leading();
    let mut nodes = others(
        &sources.members.borrow(),
        sources.live_state.statuses(),
        &sources.live_state.expected(),
        links,
    );
    nodes.retain(|node| node.name != own.name && !node.name.is_part());
    nodes.push(NodeEntry {
        name: own.name.clone(),
        role: own.role,
        alive: true,
        state: Some(if leading {
            NodeState::Aggregating
        } else {
            NodeState::Following
        }),
        fit: None,
        version: Some(own.version.to_owned()),
        page: None,
        missing: false,
        last_seen_us: None,
    });
    nodes.sort_by(|a, b| a.name.cmp(&b.name));
    nodes
}

/// Members are alive while they answer. For nodes that have not answered yet, the status from a
/// linked broker counts.
fn others(
    members: &[Member],
    mut statuses: BTreeMap<NodeName, ReportedStatus>,
    expected: &ExpectedNodes,
    links: Option<&LinkStates>,
) -> Vec<NodeEntry> {
    let entry = |name: &NodeName, role, alive, status: Option<&NodeStatus>| NodeEntry {
        name: name.clone(),
        role,
        alive,
        state: status.map(|status| status.state),
        fit: status.and_then(|status| status.fit),
        version: status.map(|status| status.version.clone()),
        page: None,
        missing: false,
        last_seen_us: None,
    };
    let (shown, further) = members.split_at(members.len().min(MAX_SHOWN));
    let mut nodes = Vec::new();
    for Member {
        name, role, gossip, ..
    } in shown
    {
        let reported = statuses.remove(name);
        let status = reported.as_ref().map(|reported| &*reported.status);
        let page = status.and_then(|status| page(status, gossip.ip()));
        nodes.push(NodeEntry {
            page,
            ..entry(name, *role, true, status)
        });
    }
    let is_linked = |broker: &BrokerAddress| {
        links.is_none_or(|links| {
            matches!(links.get(broker), Some(LinkState::Up | LinkState::Stalled))
        })
    };
    for ReportedStatus { status, via, .. } in statuses.values() {
        let name = &status.node;
        let is_online = status.state != NodeState::Offline
            && !expected.contains(name)
            && via.iter().any(is_linked);
        let alive = is_online || further.iter().any(|member| member.name == *name);
        nodes.push(entry(name, status.role, alive, Some(status)));
    }
    for MissingNode {
        name,
        role,
        last_seen,
    } in expected.missing()
    {
        if members.iter().any(|member| member.name == name) {
            continue;
        }
        let at = nodes
            .iter()
            .position(|node| node.name == name)
            .unwrap_or_else(|| {
                nodes.push(entry(&name, role, false, None));
                nodes.len() - 1
            });
        if let Some(node) = nodes.get_mut(at) {
            node.missing = true;
            node.last_seen_us = Some(last_seen);
        }
    }
    nodes
}

/// Address of the page of a node whose datagrams come from `host`. One on loopback serves its own
/// machine only.
fn page(status: &NodeStatus, host: IpAddr) -> Option<SocketAddr> {
    let page: SocketAddr = status.page.as_ref()?.parse().ok()?;
    match page.ip() {
        ip if ip.is_unspecified() => Some(SocketAddr::new(host, page.port())),
        ip if ip.is_loopback() && !host.is_loopback() => None,
        _ => Some(page),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use uuid::Uuid;

    use super::*;
    use crate::observe::dashboard::LiveState;
    use crate::transport::mqtt::Incoming;

    #[test]
    fn silent_or_lost_nodes_are_removed() {
        let name = NodeName::from_static;
        let edge: BrokerAddress = "10.0.0.2:1883".parse().unwrap();
        let euclid: BrokerAddress = "10.0.0.3:1883".parse().unwrap();
        let member = Member {
            name: name("euclid"),
            run: 0,
            gossip: "10.0.0.3:17884".parse().unwrap(),
            broker: None,
            role: Role::Auto,
            certificate: None,
        };
        let live_state = LiveState::default();
        let say = |node, via: &BrokerAddress| {
            let status = NodeStatus::starting(name(node), Uuid::nil(), Role::Cav, "0.1.0");
            live_state.update(
                &Incoming::Status {
                    status: Arc::new(status),
                    via: via.clone(),
                },
                Timestamp(1),
            );
        };
        for node in ["edge", "euclid", "plain"] {
            say(node, &edge);
        }
        say("both", &edge);
        say("both", &euclid);
        live_state.check_members(
            &[
                member.clone(),
                Member {
                    name: name("edge"),
                    ..member.clone()
                },
            ],
            Timestamp(1),
        );
        let alive = |members: &[Member], links: &LinkStates| {
            let expected = live_state.expected();
            let nodes = others(members, live_state.statuses(), &expected, Some(links));
            nodes
                .into_iter()
                .filter(|node| node.alive)
                .map(|node| node.name.to_string())
                .collect::<Vec<_>>()
        };
        let up = [
            (edge.clone(), LinkState::Up),
            (euclid.clone(), LinkState::Up),
        ]
        .into();
        assert_eq!(
            alive(std::slice::from_ref(&member), &up),
            ["euclid", "both", "plain"],
            "the edge does not answer"
        );
        let left = [(euclid.clone(), LinkState::Up)].into();
        assert_eq!(
            alive(std::slice::from_ref(&member), &left),
            ["euclid", "both"],
            "the link was given up"
        );
        live_state.update(
            &Incoming::Link {
                broker: edge,
                state: LinkState::Refused,
            },
            Timestamp(2),
        );
        assert_eq!(
            alive(&[member], &up),
            ["euclid", "both"],
            "the state of a lost broker is unknown"
        );
        assert_eq!(alive(&[], &up), ["both"]);
    }
    #[test]
    fn reachable_page_is_linked() {
        let link = |announced: &str, host: &str| {
            let starting = NodeStatus::starting(
                NodeName::from_static("euclid"),
                Uuid::nil(),
                Role::Cav,
                "0.1.0",
            );
            let status = NodeStatus {
                page: Some(announced.into()),
                ..starting
            };
            page(&status, host.parse().unwrap()).map(|page| page.to_string())
        };
        assert_eq!(
            link("0.0.0.0:8080", "10.0.0.3").as_deref(),
            Some("10.0.0.3:8080")
        );
        assert_eq!(
            link("10.0.1.3:80", "10.0.0.3").as_deref(),
            Some("10.0.1.3:80")
        );
        assert_eq!(
            link("127.0.0.1:8081", "127.0.0.1").as_deref(),
            Some("127.0.0.1:8081")
        );
        assert_eq!(
            link("127.0.0.1:8081", "10.0.0.3"),
            None,
            "that would be this machine"
        );
    }
}
