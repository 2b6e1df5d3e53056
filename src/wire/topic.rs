//! The topics of a cell.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::model::names::NodeName;

/// Content of a topic.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Topic {
    /// A vehicle's reports for PACE.
    Detections(NodeName),
    /// A vehicle's reports for VOTE.
    VoteDetections(NodeName),
    /// Boxes in images of a program, which the node whose broker receives them projects.
    Boxes(NodeName),
    /// Maps that the leader fuses.
    GlobalDetections,
    /// Verdicts of the leader's votes.
    GlobalVerdicts,
    /// Reputations of the vehicles, retained.
    Reputations,
    /// The description of the cell, retained.
    Cell,
    /// A candidate's shares of the evidence behind the reputations.
    Ledger(NodeName),
    /// A node's status, retained.
    Nodes(NodeName),
}

/// Algorithm that a report is for, given by the topic on which it arrived.
#[derive(
    Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum ReportKind {
    /// PACE, on `detections/<node>`.
    #[default]
    Detections,
    /// VOTE, on `vote_detections/<node>`.
    VoteDetections,
}

impl ReportKind {
    /// All kinds; the index of a kind is `kind as usize`.
    pub const ALL: [Self; Self::COUNT] = [Self::Detections, Self::VoteDetections];

    /// Number of kinds; `kind as usize` is below it.
    pub const COUNT: usize = 2;

    /// The topic of a node's reports of this kind.
    pub fn topic(self, node: NodeName) -> Topic {
        match self {
            Self::Detections => Topic::Detections(node),
            Self::VoteDetections => Topic::VoteDetections(node),
        }
    }
}

/// Builds and parses the topics below `ecod/v1/<cell>`.
#[derive(Debug, Clone)]
pub struct Topics {
    root: String,
}

impl Topics {
    /// The topics of a cell.
    pub fn new(cell: &NodeName) -> Self {
        Self {
            root: format!("ecod/v1/{cell}"),
        }
    }

    /// The full topic, such as `ecod/v1/lot-1/detections/euclid`.
    pub fn path(&self, topic: &Topic) -> String {
        format!("{}/{topic}", self.root)
    }

    /// The topic on which a node's broker informs programs of refused messages.
    pub fn clients(&self, node: &NodeName) -> String {
        format!("{}/nodes/{node}/clients", self.root)
    }

    /// A topic of ETSI's collective perception messages (CPM), such as `ecod/v1/lot-1/cpm/global`.
    pub fn cpm(&self, level: &str) -> String {
        format!("{}/cpm/{level}", self.root)
    }

    /// A subscription filter for one kind of topic, such as `ecod/v1/lot-1/detections/+`.
    pub fn filter(&self, level: &str) -> String {
        format!("{}/{level}", self.root)
    }

    /// Content of a full topic; `None` for a topic of another cell.
    pub fn parse(&self, path: &str) -> Option<Topic> {
        let level = path.strip_prefix(&self.root)?.strip_prefix('/')?;
        let (kind, node) = level
            .split_once('/')
            .map_or((level, None), |(kind, node)| (kind, Some(node)));
        match (kind, node) {
            ("detections", Some(node)) => NodeName::new(node).ok().map(Topic::Detections),
            ("vote_detections", Some(node)) => NodeName::new(node).ok().map(Topic::VoteDetections),
            ("boxes", Some(node)) => NodeName::new(node).ok().map(Topic::Boxes),
            ("ledger", Some(node)) => NodeName::new(node).ok().map(Topic::Ledger),
            ("nodes", Some(node)) => NodeName::new(node).ok().map(Topic::Nodes),
            ("global_detections", None) => Some(Topic::GlobalDetections),
            ("global_verdicts", None) => Some(Topic::GlobalVerdicts),
            ("reputations", None) => Some(Topic::Reputations),
            ("cell", None) => Some(Topic::Cell),
            _ => None,
        }
    }
}

impl fmt::Display for Topic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Detections(node) => write!(f, "detections/{node}"),
            Self::VoteDetections(node) => write!(f, "vote_detections/{node}"),
            Self::Boxes(node) => write!(f, "boxes/{node}"),
            Self::GlobalDetections => f.write_str("global_detections"),
            Self::GlobalVerdicts => f.write_str("global_verdicts"),
            Self::Reputations => f.write_str("reputations"),
            Self::Cell => f.write_str("cell"),
            Self::Ledger(node) => write!(f, "ledger/{node}"),
            Self::Nodes(node) => write!(f, "nodes/{node}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_round_trip_and_others_fail() {
        let topics = Topics::new(&NodeName::new("lot-1").expect("valid name"));
        let node = NodeName::new("euclid").expect("valid name");
        for topic in [
            Topic::Detections(node.clone()),
            Topic::VoteDetections(node.clone()),
            Topic::Boxes(node.clone()),
            Topic::GlobalDetections,
            Topic::GlobalVerdicts,
            Topic::Reputations,
            Topic::Cell,
            Topic::Ledger(node.clone()),
            Topic::Nodes(node),
        ] {
            assert_eq!(topics.parse(&topics.path(&topic)), Some(topic));
        }
        for stranger in [
            "ecod/v1/lot-2/reputations",
            "ecod/v1/lot-1",
            "ecod/v1/lot-1/detections/a/b",
            "",
        ] {
            assert_eq!(topics.parse(stranger), None, "{stranger}");
        }
    }
}
