//! Inputs and effects of the election.

use crate::aggregator::round::FirstRound;
use crate::leadership::election::message::ElectionMessage;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;

/// Something that happened around the node.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum ElectionInput {
    /// An authenticated message arrived.
    Receive {
        /// The message.
        message: ElectionMessage,
    },
    /// The membership found a node: it can be spoken to.
    PeerAlive {
        /// The node.
        peer: NodeName,
    },
    /// The membership doubts a node: its leadership, if any, is checked at once.
    PeerSuspected {
        /// The node.
        peer: NodeName,
    },
    /// The membership gave a node up. The leader's own beats weigh more, see [`crate::leadership::election`].
    PeerDown {
        /// The node.
        peer: NodeName,
    },
    /// A node's process is gone for certain: its connection broke and its broker's port refuses a new one.
    PeerGone {
        /// The node.
        peer: NodeName,
    },
    /// The node's own parts changed, or its load did. Until first told, a node is not fit to lead.
    Health {
        /// The state of the parts.
        health: Health,
    },
    /// A round was published by this node, or accepted by its round filter.
    Round {
        /// The epoch it was published in.
        epoch: Epoch,
        /// The round's number.
        round: u64,
    },
    /// The candidates at whose brokers this node cannot log in, although it should, have changed.
    NoLogin {
        /// All of them, at most [`MAX_NO_LOGIN`](crate::leadership::election::MAX_NO_LOGIN).
        at: Vec<NodeName>,
    },
    /// The preparation that [`ElectionEffect::Prepare`] asked for is complete.
    Prepared,
    /// Others are to hear of this node at once: all of them from a node that may lead, from others the leader.
    Greet,
    /// The node is about to stop: a leader resigns, a follower tells its leader that it is no candidate any more.
    Leave,
}

/// State of the parts that a leader needs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Health {
    /// Clients can connect to the broker.
    pub broker: bool,
    /// The fuser closes rounds.
    pub fuser: bool,
    /// The gateway can publish and receive.
    pub gateway: bool,
    /// Vehicles' reports are usable: not nearly all of them are rejected for their time.
    pub reports: bool,
    /// The node uses the cell's description, or nobody leads.
    pub settings: bool,
    /// Processor load of the machine, 0 to 100 %.
    pub load_percent: u8,
}

impl Health {
    /// All parts work.
    pub fn is_fit(&self) -> bool {
        self.broker && self.fuser && self.gateway && self.reports && self.settings
    }
}

/// Something to be done, in the order given.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum ElectionEffect {
    /// Hand a term to the disk; it may be lower than the last one. An [`ElectionEffect::Lead`] in it waits for the answer.
    PersistTerm {
        /// To be given to [`crate::leadership::election::Election::new`] after a restart.
        term: u64,
    },
    /// Send a message once, without waiting.
    Send {
        /// The addressee.
        to: NodeName,
        /// The message.
        message: ElectionMessage,
    },
    /// Publish from now on in this epoch. Comes again, with a new epoch, when a leader has to renew its own.
    Lead {
        /// The node's leadership.
        epoch: Epoch,
        /// The number of the next round.
        first_round: u64,
        /// Time at which it is due.
        first: FirstRound,
    },
    /// Let the present round last its whole length: the next one is the other's unless it stays away for a whole period.
    HoldRound,
    /// Publish nothing more in this epoch.
    StopPublishing {
        /// The leadership that ended.
        epoch: Epoch,
    },
    /// Get ready to lead: serve the broker, take the leader's state, warm the fuser; then tell [`ElectionInput::Prepared`].
    Prepare {
        /// The leader that hands over.
        leader: NodeName,
    },
    /// Count a message of this node with a term, round or sequence number beyond what can have been reached. The number
    /// has changed nothing.
    CountImplausible {
        /// The sender.
        from: NodeName,
    },
    /// Share all evidence about vehicles with a node: the next leader, or the one that remains when two sides heal.
    SendSnapshot {
        /// The addressee.
        to: NodeName,
    },
}
