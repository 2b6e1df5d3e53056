//! The view of leadership that all parts of a node work with.

use std::fmt;

use serde::Serialize;

use crate::leadership::election::Election;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;

/// The leader and its standby, as seen by one node.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct Leadership {
    /// The node's own place in its cell.
    pub position: Position,
    /// Highest epoch followed or led so far; its leader is the current one unless the node seeks.
    pub epoch: Option<Epoch>,
    /// The next leader, if the leader has named one; it may be this node.
    pub standby: Option<NodeName>,
    /// Highest term that the election has seen in use.
    pub term: u64,
    /// True if this node leads and all its followers are unable to log in at its broker. A change
    /// of only this field does not notify readers.
    pub is_deserted: bool,
    /// True if this node leads and its standby publishes the next round. A change of only this
    /// field does not notify readers.
    pub is_yielding: bool,
}

/// A node's place in its cell.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Position {
    /// The node has no leader.
    #[default]
    Seeking,
    /// It follows the epoch's leader.
    Following,
    /// It follows, and is the next leader.
    StandingBy,
    /// The node is the epoch's leader.
    Leading,
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Seeking => "seeking",
            Self::Following => "following",
            Self::StandingBy => "standing_by",
            Self::Leading => "leading",
        })
    }
}

impl Leadership {
    /// The view of the election's current state.
    pub(super) fn of(election: &Election, is_deserted: bool) -> Self {
        let standby = election.standby();
        let position = match election.leader() {
            None => Position::Seeking,
            Some(_) if election.is_leading() => Position::Leading,
            Some(_) if standby == Some(election.name()) => Position::StandingBy,
            Some(_) => Position::Following,
        };
        Self {
            position,
            epoch: election.epoch().cloned(),
            standby: standby.cloned(),
            term: election.term(),
            is_deserted,
            is_yielding: election.is_yielding(),
        }
    }

    /// The leader; `None` while the node seeks.
    pub fn leader(&self) -> Option<&NodeName> {
        self.present_epoch().map(|epoch| &epoch.leader)
    }

    /// The epoch followed or led now; `None` while the node seeks.
    pub fn present_epoch(&self) -> Option<&Epoch> {
        self.epoch
            .as_ref()
            .filter(|_| self.position != Position::Seeking)
    }

    /// True if this node leads.
    pub fn is_leading(&self) -> bool {
        self.position == Position::Leading
    }

    /// True if the election has seen a term in use. Only messages authenticated with the cell's key
    /// count.
    pub fn has_term(&self, term: u64) -> bool {
        term <= self.term
    }
}
