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
        /// The message, which the caller has limited to its sender's rights.
        message: ElectionMessage,
    },
    /// The membership found a node. Messages can be sent to it from now on.
    PeerAlive {
        /// Name of the node.
        peer: NodeName,
    },
    /// The membership suspects a node. If that node is the leader, the election checks it at once.
    PeerSuspected {
        /// Name of the node.
        peer: NodeName,
    },
    /// The membership gave up a node. The leader's own beats have precedence, see
    /// [`crate::leadership::election`].
    PeerDown {
        /// Name of the node.
        peer: NodeName,
    },
    /// A node's process has certainly ended: its connection broke, and its broker's port refuses
    /// new connections.
    PeerGone {
        /// Name of the node.
        peer: NodeName,
    },
    /// The state of the node's own parts or its load changed. Until the first such input the node
    /// is not fit to lead.
    Health {
        /// The state of the parts.
        health: Health,
    },
    /// This node published a round, or its round filter accepted one.
    Round {
        /// The epoch in which it was published.
        epoch: Epoch,
        /// Number of the round in that epoch.
        round: u64,
    },
    /// The set of candidates at whose brokers this node should be logged in and cannot log in has
    /// changed.
    NoLogin {
        /// All such candidates, at most
        /// [`MAX_NO_LOGIN`](crate::leadership::election::MAX_NO_LOGIN).
        at: Vec<NodeName>,
    },
    /// The preparation requested by [`ElectionEffect::Prepare`] is complete.
    Prepared,
    /// Announce this node to other nodes at once: a node that may lead announces itself to all
    /// nodes, any other node to the leader.
    Greet,
    /// The node is about to stop: a leader resigns, a follower informs its leader that it is not a
    /// candidate any more.
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
    /// Vehicles' reports are usable: the node does not reject nearly all of them because of their
    /// timestamps.
    pub reports: bool,
    /// The node uses the cell's description and its certificate does not end soon, or there is no
    /// leader.
    pub settings: bool,
    /// Processor load of the machine, 0 to 100 %.
    pub load_percent: u8,
}

impl Health {
    /// True if all parts work.
    pub fn is_fit(&self) -> bool {
        self.broker && self.fuser && self.gateway && self.reports && self.settings
    }
}

/// An action for the caller, to be carried out in the order given.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum ElectionEffect {
    /// Write a term to disk; it may be lower than the previous one. An [`ElectionEffect::Lead`] in
    /// this term waits for the disk's answer.
    PersistTerm {
        /// The term to pass to [`crate::leadership::election::Election::new`] after a restart.
        term: u64,
    },
    /// Send a message once, without blocking.
    Send {
        /// Node to which the message goes.
        to: NodeName,
        /// The message; the caller adds clock stamps, description and signature.
        message: ElectionMessage,
    },
    /// Publish in this epoch from now on. Repeated with a new epoch when a leader has to renew its
    /// term.
    Lead {
        /// Epoch of the leadership: a new term, and the name of this node.
        epoch: Epoch,
        /// The number of the next round.
        first_round: u64,
        /// Time at which the first round is due.
        first: FirstRound,
    },
    /// Let the current round last its full length: another node is about to lead. After the yield,
    /// the next round belongs to that node, unless it publishes no round for a whole period.
    HoldRound,
    /// Stop publishing in this epoch.
    StopPublishing {
        /// The leadership that ended.
        epoch: Epoch,
    },
    /// Prepare to lead: serve the broker, copy the leader's state, warm up the fuser; then send
    /// [`ElectionInput::Prepared`].
    Prepare {
        /// The leader that hands over leadership.
        leader: NodeName,
    },
    /// Count a message of this node whose term, round or sequence number is higher than could have
    /// been reached. The number was not applied.
    CountImplausible {
        /// Node that stated the number.
        from: NodeName,
    },
    /// Share all evidence about vehicles with a node: with the next leader, or with the leader that
    /// remains when a split heals.
    SendSnapshot {
        /// Node that gets the evidence.
        to: NodeName,
    },
}
