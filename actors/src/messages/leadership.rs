//! What the rest of a node needs to know about who leads.

use ecod::election::Election;
use ecod::epoch::Epoch;
use ecod::names::NodeName;

/// Who leads, as one node sees it.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Leadership {
    /// What this node has to do with it.
    pub position: Position,
    /// The highest epoch followed or led so far; its leader is the present one unless the node seeks.
    pub epoch: Option<Epoch>,
    /// Who leads next, if the leader has named anyone; this node, it may be.
    pub standby: Option<NodeName>,
}

/// A node's place in its cell.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Position {
    /// It knows of no leader.
    #[default]
    Seeking,
    /// It follows the epoch's leader.
    Following,
    /// It follows, and leads next.
    StandingBy,
    /// It leads.
    Leading,
}

impl Leadership {
    pub(crate) fn of(election: &Election, name: &NodeName) -> Self {
        let standby = election.standby();
        let position = match election.leader() {
            None => Position::Seeking,
            Some(_) if election.is_leading() => Position::Leading,
            Some(_) if standby == Some(name) => Position::StandingBy,
            Some(_) => Position::Following,
        };
        Self { position, epoch: election.epoch().cloned(), standby: standby.cloned() }
    }

    /// Who leads; none while the node seeks.
    pub fn leader(&self) -> Option<&NodeName> {
        self.epoch.as_ref().filter(|_| self.position != Position::Seeking).map(|epoch| &epoch.leader)
    }

    /// Whether this node leads.
    pub fn is_leading(&self) -> bool {
        self.position == Position::Leading
    }
}
