//! The snapshot of a cell that browsers get: everything the page shows, as one JSON object.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ecod::names::{LandmarkId, NodeName};
use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, NodeState, NodeStatus, Reputations, Role, Verdicts};
use serde::Serialize;

use super::live_state::{LatestReport, MAX_SHOWN, ReportedStatus};
use super::node_sources::NodeSources;
use crate::messages::leadership::{Leadership, Position};
use crate::messages::newest::Received;
use crate::observe::readiness::Readiness;
use crate::telemetry::counters::CounterSnapshot;
use crate::transport::gossip::Member;
use crate::transport::mqtt::{BrokerAddress, LinkState};

/// How the link to each broker is.
pub(crate) type Links = BTreeMap<BrokerAddress, LinkState>;

/// Version of [`Snapshot`] and of the other answers of the API.
pub(crate) const API_VERSION: u32 = 1;

/// What the node knows of its cell at one moment. Times are Unix microseconds by the node's clock unless they come from
/// a message.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Snapshot {
    /// [`API_VERSION`].
    pub schema: u32,
    /// When it was made.
    pub now_us: Timestamp,
    /// This node.
    pub node: NodeFacts,
    /// Whether the node does what it is there for.
    pub readiness: Readiness,
    /// Who leads.
    pub leadership: LeadershipFacts,
    /// The newest map accepted.
    pub map: Option<Stamped<GlobalMap>>,
    /// The newest verdicts accepted.
    pub verdicts: Option<Stamped<Verdicts>>,
    /// The newest reputations accepted.
    pub reputations: Option<Stamped<Reputations>>,
    /// The latest report of each vehicle.
    pub vehicles: Vec<LatestReport>,
    /// This node and the others.
    pub nodes: Vec<NodeEntry>,
    /// State of the link to each broker: `up`, `stalled`, `down` or `refused`.
    pub links: BTreeMap<String, &'static str>,
    /// What went wrong or was left out, by reason.
    pub counters: CounterSnapshot,
}

/// A message and when it came.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Stamped<T> {
    /// When it came.
    pub received_at_us: Timestamp,
    /// The message as it is on the wire.
    pub message: Arc<T>,
}

/// What does not change while a node runs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NodeFacts {
    /// Its name.
    pub name: NodeName,
    /// The name of its cell.
    pub cell: NodeName,
    /// Its role.
    pub role: Role,
    /// Version of the software.
    pub version: &'static str,
    /// When it started.
    pub started_at_us: Timestamp,
    /// Longest time between two rounds of a living aggregator, in seconds.
    pub round_period_s: f64,
}

/// Who leads, for a browser.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(crate) struct LeadershipFacts {
    /// What this node has to do with it.
    pub position: Position,
    /// Who leads; absent while the node seeks.
    pub leader: Option<NodeName>,
    /// The highest term known.
    pub epoch: Option<u64>,
    /// Who leads next.
    pub standby: Option<NodeName>,
    /// When this node took the leader for it.
    pub since_us: Option<Timestamp>,
    /// How often the leader changed since the node started.
    pub failovers: u64,
}

/// A node of the cell.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct NodeEntry {
    /// Its name.
    pub name: NodeName,
    /// Its role.
    pub role: Role,
    /// Whether it answers; of a node that never has, whether a broker to which there is a link says that it is there.
    pub alive: bool,
    /// What it said it does.
    pub state: Option<NodeState>,
    /// Whether it said it could lead.
    pub fit: Option<bool>,
    /// Its software, as it said.
    pub version: Option<String>,
}

/// A known location.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LandmarkFacts {
    /// Its name.
    pub id: LandmarkId,
    /// East in metres.
    pub x_m: f64,
    /// North in metres.
    pub y_m: f64,
    /// Direction that it faces in radians, counter-clockwise from east.
    pub facing_rad: Option<f64>,
}

impl<T> From<Received<T>> for Stamped<T> {
    fn from(received: Received<T>) -> Self {
        Self { received_at_us: received.received_at, message: received.message }
    }
}

impl LeadershipFacts {
    pub(crate) fn new(leadership: &Leadership, since_us: Option<Timestamp>, failovers: u64) -> Self {
        Self {
            position: leadership.position,
            leader: leadership.leader().cloned(),
            epoch: leadership.epoch.as_ref().map(|epoch| epoch.term),
            standby: leadership.standby.clone(),
            since_us: since_us.filter(|_| leadership.leader().is_some()),
            failovers,
        }
    }
}

/// A value as JSON; cut short if it cannot be written, which is logged.
pub(crate) fn json(value: &impl Serialize) -> Vec<u8> {
    let mut text = Vec::new();
    if let Err(error) = serde_json::to_writer(&mut text, value) {
        tracing::warn!(%error, "answer for browsers cut short");
    }
    text
}

/// This node, those that answer, and those that only brokers tell of; `met` are names of nodes that have answered at
/// some time, `links` how the links are, if the gateway tells.
pub(crate) fn nodes(sources: &NodeSources, met: &BTreeSet<NodeName>, links: Option<&Links>) -> Vec<NodeEntry> {
    let own = &sources.node;
    let leading = sources.vitals.leadership.borrow().is_leading();
    let me = NodeEntry {
        name: own.name.clone(),
        role: own.role,
        alive: true,
        state: Some(if leading { NodeState::Aggregating } else { NodeState::Following }),
        fit: None,
        version: Some(own.version.to_owned()),
    };
    let mut nodes = others(&sources.members.borrow(), sources.live_state.statuses(), met, links);
    nodes.retain(|node| node.name != own.name);
    nodes.push(me);
    nodes.sort_by(|a, b| a.name.cmp(&b.name));
    nodes
}

/// A node that has answered is there while it does; of one that never has, a broker's word counts while it is heard.
fn others(
    members: &[Member],
    mut statuses: BTreeMap<NodeName, ReportedStatus>,
    met: &BTreeSet<NodeName>,
    links: Option<&Links>,
) -> Vec<NodeEntry> {
    let entry = |name: &NodeName, role, alive, status: Option<&NodeStatus>| NodeEntry {
        name: name.clone(),
        role,
        alive,
        state: status.map(|status| status.state),
        fit: status.and_then(|status| status.fit),
        version: status.map(|status| status.version.clone()),
    };
    let (shown, further) = members.split_at(members.len().min(MAX_SHOWN));
    let mut nodes = Vec::new();
    for Member { name, role, .. } in shown {
        let told = statuses.remove(name);
        nodes.push(entry(name, *role, true, told.as_ref().map(|told| &*told.status)));
    }
    let is_heard = |broker: &BrokerAddress| {
        links.is_none_or(|links| matches!(links.get(broker), Some(LinkState::Up | LinkState::Stalled)))
    };
    for ReportedStatus { status, via, .. } in statuses.values() {
        let name = &status.node;
        let is_told = status.state != NodeState::Offline && !met.contains(name) && via.iter().any(is_heard);
        let alive = is_told || further.iter().any(|member| member.name == *name);
        nodes.push(entry(name, status.role, alive, Some(status)));
    }
    nodes
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::observe::dashboard::LiveState;
    use crate::transport::mqtt::Incoming;

    #[test]
    fn who_no_longer_answers_or_is_only_known_from_a_lost_broker_is_gone() {
        let name = NodeName::from_static;
        let (edge, euclid): (BrokerAddress, BrokerAddress) =
            ("10.0.0.2:1883".parse().unwrap(), "10.0.0.3:1883".parse().unwrap());
        let member = Member {
            name: name("euclid"),
            run: 0,
            gossip: "10.0.0.3:17884".parse().unwrap(),
            broker: None,
            role: Role::Auto,
        };
        let live_state = LiveState::default();
        let say = |node, via: &BrokerAddress| {
            let status = NodeStatus::starting(name(node), Uuid::nil(), Role::Cav, "0.1.0");
            live_state.note(&Incoming::Status { status: Arc::new(status), via: via.clone() }, Timestamp(1));
        };
        for node in ["edge", "euclid", "plain"] {
            say(node, &edge);
        }
        say("both", &edge);
        say("both", &euclid);
        let alive = |members: &[Member], links: &Links| {
            let met = [name("edge"), name("euclid")].into();
            let nodes = others(members, live_state.statuses(), &met, Some(links));
            nodes.into_iter().filter(|node| node.alive).map(|node| node.name.to_string()).collect::<Vec<_>>()
        };
        let up = [(edge.clone(), LinkState::Up), (euclid.clone(), LinkState::Up)].into();
        assert_eq!(alive(std::slice::from_ref(&member), &up), ["euclid", "both", "plain"], "the edge does not answer");
        let left = [(euclid.clone(), LinkState::Up)].into();
        assert_eq!(alive(std::slice::from_ref(&member), &left), ["euclid", "both"], "the link was given up");
        live_state.note(&Incoming::Link { broker: edge, state: LinkState::Refused }, Timestamp(2));
        assert_eq!(
            alive(&[member], &up),
            ["euclid", "both"],
            "what a broker said before it was lost is not its word now"
        );
        assert_eq!(alive(&[], &up), ["both"]);
    }
}
