//! The nodes that a cell expects: former members, until they leave in order or are dismissed.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{MAX_DISMISSED, NodeState, NodeStatus, Role};

/// Maximum number of expected nodes; beyond it the longest absent one is dropped.
const MAX_EXPECTED: usize = 256;

/// Absence from which a missing node is a trouble. A node that is restarted returns earlier.
pub const MISSING_TIMEOUT: Duration = Duration::from_secs(10);

/// Time for which a node may still answer after its farewell. A node that answers for longer has
/// returned.
const DEPARTURE: Duration = Duration::from_secs(10);

/// An expected node that does not answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MissingNode {
    /// Name of the node that does not answer.
    pub name: NodeName,
    /// The role with which it was started.
    pub role: Role,
    /// Time of the last check at which it answered.
    pub last_seen: Timestamp,
}

/// The expected nodes, as one node of the cell has observed them.
///
/// # Example
/// The node `euclid` answers at one check and is expected from then on. It crashes: from the next
/// check on it is missing, until it answers again, or an operator dismisses it. A stop in order
/// sends a status with `euclid` in its own list of dismissed nodes, so that it is not missing.
///
/// A name with a part belongs to a program or an observer of a node. Such names are not expected, and visitors are not
/// expected either: a visitor is a vehicle that moves from cell to cell, and it dismisses itself while it is present.
#[derive(Debug, Clone, Default)]
pub struct ExpectedNodes {
    nodes: BTreeMap<NodeName, ExpectedNode>,
    /// Nodes that have left or were dismissed, while they may still answer, and since when.
    departing: BTreeMap<NodeName, Timestamp>,
    /// Present nodes that are not expected to stay.
    visitors: BTreeSet<NodeName>,
    /// Nodes that were dismissed at this node and have not answered since.
    dismissed: BTreeSet<NodeName>,
    checked_at: Timestamp,
}

#[derive(Debug, Clone, Copy)]
struct ExpectedNode {
    role: Role,
    last_seen: Timestamp,
}

impl ExpectedNodes {
    /// Processes a check of the membership: the other nodes that answer now, with their roles.
    pub fn check<'a>(
        &mut self,
        present: impl Iterator<Item = (&'a NodeName, Role)>,
        now: Timestamp,
    ) {
        let present: BTreeMap<_, _> = present.filter(|(name, _)| !name.is_part()).collect();
        self.departing
            .retain(|name, since| present.contains_key(name) && now.since(*since) < DEPARTURE);
        self.visitors.retain(|name| present.contains_key(name));
        for (name, role) in present {
            if !self.departing.contains_key(name) && !self.visitors.contains(name) {
                self.dismissed.remove(name);
                let node = ExpectedNode {
                    role,
                    last_seen: now,
                };
                self.nodes.insert(name.clone(), node);
            }
        }
        while self.nodes.len() > MAX_EXPECTED {
            let longest = self.nodes.iter().min_by_key(|(_, node)| node.last_seen);
            if let Some(name) = longest.map(|(name, _)| name.clone()) {
                self.nodes.remove(&name);
            }
        }
        self.checked_at = now;
    }

    /// Processes another node's status. A node dismisses itself when it leaves, and a visitor
    /// always; others are dismissed only by present nodes that may lead.
    pub fn receive(&mut self, status: &NodeStatus, now: Timestamp) {
        if status.state != NodeState::Offline {
            if status.dismissed.contains(&status.node) {
                self.visitors.insert(status.node.clone());
            } else {
                self.visitors.remove(&status.node);
            }
        }
        for name in &status.dismissed {
            if *name == status.node || self.may_dismiss(&status.node) && !self.answers(name) {
                self.depart(name, now);
            }
        }
    }

    /// Dismisses a node at an operator's request, for all nodes of the cell; false if the node
    /// answers, or is not expected.
    pub fn dismiss(&mut self, name: &NodeName, now: Timestamp) -> bool {
        if !self.nodes.contains_key(name) || self.answers(name) {
            return false;
        }
        self.depart(name, now);
        while self.dismissed.len() >= MAX_DISMISSED {
            self.dismissed.pop_first();
        }
        self.dismissed.insert(name.clone())
    }

    /// The nodes that were dismissed at this node, for its status.
    pub fn dismissed(&self) -> Vec<NodeName> {
        self.dismissed.iter().cloned().collect()
    }

    /// True if the node was a member and has not left or been dismissed since.
    pub fn contains(&self, name: &NodeName) -> bool {
        self.nodes.contains_key(name)
    }

    /// The expected nodes that did not answer at the last check.
    pub fn missing(&self) -> Vec<MissingNode> {
        let absent = self.nodes.iter().filter(|(name, _)| !self.answers(name));
        absent
            .map(|(name, node)| MissingNode {
                name: name.clone(),
                role: node.role,
                last_seen: node.last_seen,
            })
            .collect()
    }

    fn depart(&mut self, name: &NodeName, now: Timestamp) {
        self.nodes.remove(name);
        self.departing.insert(name.clone(), now);
    }

    /// True if the node answered at the last check.
    fn answers(&self, name: &NodeName) -> bool {
        self.nodes
            .get(name)
            .is_some_and(|node| node.last_seen == self.checked_at)
    }

    fn may_dismiss(&self, name: &NodeName) -> bool {
        self.answers(name)
            && self
                .nodes
                .get(name)
                .is_some_and(|node| node.role != Role::Cav)
    }
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;

    const EDGE: NodeName = NodeName::from_static("edge");
    const EUCLID: NodeName = NodeName::from_static("euclid");
    const GAUSS: NodeName = NodeName::from_static("gauss");

    fn at(seconds: u64) -> Timestamp {
        Timestamp(seconds * 1_000_000)
    }

    fn check(expected: &mut ExpectedNodes, present: &[(NodeName, Role)], now: Timestamp) {
        expected.check(present.iter().map(|(name, role)| (name, *role)), now);
    }

    fn missing(expected: &ExpectedNodes) -> Vec<(NodeName, Timestamp)> {
        let missing = expected.missing().into_iter();
        missing.map(|node| (node.name, node.last_seen)).collect()
    }

    fn farewell(of: NodeName) -> NodeStatus {
        NodeStatus {
            state: NodeState::Offline,
            ..dismissing(of.clone(), of)
        }
    }

    fn dismissing(by: NodeName, dismissed: NodeName) -> NodeStatus {
        NodeStatus {
            dismissed: vec![dismissed],
            ..NodeStatus::starting(by, Uuid::nil(), Role::Auto, "0.1.0")
        }
    }

    #[test]
    fn silent_member_is_missing() {
        let mut expected = ExpectedNodes::default();
        check(
            &mut expected,
            &[(EDGE, Role::Edge), (EUCLID, Role::Auto)],
            at(1),
        );
        assert_eq!(missing(&expected), []);
        check(&mut expected, &[(EDGE, Role::Edge)], at(2));
        check(&mut expected, &[(EDGE, Role::Edge)], at(9));
        assert_eq!(missing(&expected), [(EUCLID, at(1))]);
        check(
            &mut expected,
            &[(EDGE, Role::Edge), (EUCLID, Role::Auto)],
            at(10),
        );
        assert_eq!(missing(&expected), []);
    }

    #[test]
    fn an_observer_is_not_expected() {
        let top = NodeName::from_static("euclid--top-12");
        let mut expected = ExpectedNodes::default();
        check(&mut expected, &[(top, Role::Cav)], at(1));
        check(&mut expected, &[], at(2));
        assert_eq!(missing(&expected), []);
    }

    #[test]
    fn leaving_node_is_not_missing() {
        let mut expected = ExpectedNodes::default();
        check(&mut expected, &[(EUCLID, Role::Auto)], at(1));
        expected.receive(&farewell(EUCLID), at(1));
        check(&mut expected, &[(EUCLID, Role::Auto)], at(2));
        check(&mut expected, &[], at(3));
        assert_eq!(missing(&expected), []);
    }

    #[test]
    fn returning_node_is_expected_again() {
        let mut expected = ExpectedNodes::default();
        check(&mut expected, &[(EUCLID, Role::Auto)], at(1));
        expected.receive(&farewell(EUCLID), at(1));
        check(&mut expected, &[(EUCLID, Role::Auto)], at(2));
        check(&mut expected, &[(EUCLID, Role::Auto)], at(12));
        check(&mut expected, &[], at(13));
        assert_eq!(missing(&expected), [(EUCLID, at(12))]);
    }

    #[test]
    fn passing_vehicle_is_not_missing() {
        let mut expected = ExpectedNodes::default();
        check(&mut expected, &[(EUCLID, Role::Cav)], at(1));
        expected.receive(&dismissing(EUCLID, EUCLID), at(1));
        check(&mut expected, &[(EUCLID, Role::Cav)], at(20));
        check(&mut expected, &[], at(21));
        assert_eq!(missing(&expected), []);
        check(&mut expected, &[(EUCLID, Role::Cav)], at(30));
        check(&mut expected, &[], at(31));
        assert_eq!(
            missing(&expected),
            [(EUCLID, at(30))],
            "it has another configuration now"
        );
    }

    #[test]
    fn dismissal_lasts_until_return() {
        let mut here = ExpectedNodes::default();
        let mut there = ExpectedNodes::default();
        check(
            &mut here,
            &[(EUCLID, Role::Auto), (GAUSS, Role::Cav)],
            at(1),
        );
        check(&mut there, &[(EDGE, Role::Edge), (GAUSS, Role::Cav)], at(1));
        assert!(!here.dismiss(&GAUSS, at(1)), "it answers");
        assert!(!here.dismiss(&EDGE, at(1)), "it is not expected");
        check(&mut here, &[(EUCLID, Role::Auto)], at(2));
        check(&mut there, &[(EDGE, Role::Edge)], at(2));
        assert!(here.dismiss(&GAUSS, at(2)));
        there.receive(
            &NodeStatus {
                dismissed: here.dismissed(),
                ..dismissing(EDGE, GAUSS)
            },
            at(2),
        );
        assert_eq!((missing(&here), missing(&there)), (vec![], vec![]));
        check(
            &mut here,
            &[(EUCLID, Role::Auto), (GAUSS, Role::Cav)],
            at(3),
        );
        check(
            &mut here,
            &[(EUCLID, Role::Auto), (GAUSS, Role::Cav)],
            at(13),
        );
        assert_eq!(here.dismissed(), [], "it has returned");
    }

    #[test]
    fn vehicle_hides_no_missing_node() {
        let mut expected = ExpectedNodes::default();
        let present = [(EDGE, Role::Edge), (EUCLID, Role::Auto), (GAUSS, Role::Cav)];
        check(&mut expected, &present, at(1));
        check(
            &mut expected,
            &[(EDGE, Role::Edge), (GAUSS, Role::Cav)],
            at(2),
        );
        expected.receive(&dismissing(GAUSS, EUCLID), at(2));
        assert_eq!(missing(&expected), [(EUCLID, at(1))]);
        expected.receive(&dismissing(EDGE, GAUSS), at(2));
        check(&mut expected, &[(EDGE, Role::Edge)], at(3));
        assert_eq!(missing(&expected), [(EUCLID, at(1)), (GAUSS, at(2))]);
    }
}
