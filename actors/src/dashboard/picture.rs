//! The picture of a cell that browsers get: everything the page shows, as one JSON object.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::names::{LandmarkId, NodeName};
use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, NodeState, Reputations, Role, Verdicts};
use serde::Serialize;

use super::feed::{MAX_SHOWN, Sighting};
use super::sources::Sources;
use crate::counters::CounterSnapshot;
use crate::follower::Received;
use crate::leader_election::{Leadership, Position};
use crate::readiness::Readiness;

/// Version of [`Picture`] and of the other answers of the API.
pub(super) const API_VERSION: u32 = 1;

/// What the node knows of its cell at one moment. Times are Unix microseconds by the node's clock unless they come from
/// a message.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Picture {
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
    pub vehicles: Vec<Sighting>,
    /// This node and the others.
    pub nodes: Vec<NodeEntry>,
    /// State of the link to each broker: `up`, `stalled`, `down` or `refused`.
    pub links: BTreeMap<String, &'static str>,
    /// What went wrong or was left out, by reason.
    pub counters: CounterSnapshot,
}

/// A message and when it came.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Stamped<T> {
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
pub(super) struct LeadershipFacts {
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
pub(super) struct NodeEntry {
    /// Its name.
    pub name: NodeName,
    /// Its role.
    pub role: Role,
    /// Whether it answers, or a broker has not said otherwise.
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
    pub(super) fn new(leadership: &Leadership, since_us: Option<Timestamp>, failovers: u64) -> Self {
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

/// This node, those that answer, and those that only brokers tell of.
pub(super) fn nodes(sources: &Sources) -> Vec<NodeEntry> {
    let mut statuses = sources.feed.statuses();
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
    let mut nodes = vec![me];
    for member in sources.members.borrow().iter().take(MAX_SHOWN) {
        let status = statuses.remove(&member.name);
        nodes.push(NodeEntry {
            name: member.name.clone(),
            role: member.role,
            alive: true,
            state: status.as_ref().map(|status| status.state),
            fit: status.as_ref().and_then(|status| status.fit),
            version: status.map(|status| status.version.clone()),
        });
    }
    nodes.extend(statuses.into_values().filter(|status| status.node != own.name).map(|status| NodeEntry {
        name: status.node.clone(),
        role: status.role,
        alive: status.state != NodeState::Offline,
        state: Some(status.state),
        fit: status.fit,
        version: Some(status.version.clone()),
    }));
    nodes.sort_by(|a, b| a.name.cmp(&b.name));
    nodes
}
