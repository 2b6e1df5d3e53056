//! Inputs and effects of the leadership of one node.

use std::net::SocketAddr;
use std::time::Duration;

use crate::aggregator::round::FirstRound;
use crate::leadership::address::BrokerAddress;
use crate::leadership::election::{ElectionConfig, ElectionMessage, Health};
use crate::leadership::health::HealthSample;
use crate::leadership::links::{DataPlane, LinkState, WantedLinks};
use crate::leadership::rights::Rights;
use crate::leadership::view::Leadership;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::wire::{DescriptionStatus, NodeStatus, Role, Trouble};

/// Settings of one node's leadership.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeSettings {
    /// Timings, role and priority.
    pub election: ElectionConfig,
    /// Brokers that carry the data.
    pub plane: DataPlane,
    /// Longest time between two rounds.
    pub round_period: Duration,
    /// True if the node keeps reputations, and so waits for evidence before it is handed the lead.
    pub keeps_reputations: bool,
    /// The node's own status; state, epoch, aggregator and fitness follow the election.
    pub status: NodeStatus,
}

/// Another node of the cell.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct SeenMember {
    /// Name of the node in its cell.
    pub name: NodeName,
    /// Start of its current run, in Unix microseconds by its own clock.
    pub run: u64,
    /// Its broker, if it has one.
    pub broker: Option<BrokerAddress>,
    /// True if it reaches this node's loopback address.
    pub is_on_this_machine: bool,
}

/// Something that happened at a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Input {
    /// The deadline has come.
    Wake,
    /// An authenticated message arrived.
    Receive {
        /// The sender, as the transport proved.
        from: NodeName,
        /// The sender's rights, as the transport proved.
        rights: Rights,
        /// The message as received, before it is limited to the sender's rights.
        message: ElectionMessage,
    },
    /// The membership found a node, or a new run of it.
    MemberAlive {
        /// The node with its current addresses.
        member: SeenMember,
    },
    /// A living node's addresses changed.
    MemberChanged {
        /// The node as it is now.
        member: SeenMember,
    },
    /// The membership doubts a node.
    MemberSuspected {
        /// Name of the node.
        name: NodeName,
    },
    /// The membership gave a node up.
    MemberDown {
        /// Name of the node.
        name: NodeName,
    },
    /// The node's own broker started or stopped listening.
    OwnBroker {
        /// Address at which the broker listens; `None` if it does not listen.
        address: Option<SocketAddr>,
    },
    /// A broker has shown the certificate of a node in its last handshake. It comes before the
    /// link's new state.
    BrokerProven {
        /// Address of the broker at the other end of the link.
        broker: BrokerAddress,
        /// Name of the node.
        node: NodeName,
    },
    /// The state of one of the gateway's links changed.
    LinkChanged {
        /// The broker at its other end.
        broker: BrokerAddress,
        /// State of the link from now on.
        state: LinkState,
    },
    /// A broker forwarded a node's status or its last will.
    StatusReceived {
        /// The status; its state is `offline` in a last will.
        status: NodeStatus,
    },
    /// A round was accepted by the node's
    /// [`RoundFilter`](crate::leadership::round_filter::RoundFilter).
    RoundAccepted {
        /// The epoch it was published in.
        epoch: Epoch,
        /// Number of the round in that epoch.
        round: u64,
    },
    /// Evidence about vehicles came from another candidate, and was verified.
    EvidenceReceived {
        /// Name of the candidate that shared the evidence.
        from: NodeName,
    },
    /// The answer to [`Effect::Observe`], at once.
    Observed {
        /// Number of times so far that the fuser found its round due: its timer runs.
        rounds_due: u64,
        /// Processor load of the machine, 0 to 100 %.
        load_percent: u8,
        /// All nodes that the membership has discovered.
        members: Vec<SeenMember>,
    },
    /// The answer to [`Effect::AskParts`], later.
    PartsAnswered {
        /// State of broker, gateway and fuser.
        sample: HealthSample,
    },
    /// The fuser was restarted and has lost the state of leading.
    FuserRestarted,
    /// The gateway was restarted and has no links.
    GatewayRestarted,
    /// The settings that all nodes of the cell share have changed.
    Described {
        /// The description that the node has; `None` without one.
        description: Option<DescriptionStatus>,
        /// Longest time between two rounds.
        round_period: Duration,
        /// True if the node keeps reputations.
        keeps_reputations: bool,
    },
    /// Parts of the node's published status. This input may come with every check.
    StatusParts {
        /// All current troubles of the node.
        troubles: Vec<Trouble>,
        /// Address and port of its page.
        page: Option<String>,
        /// Nodes that were dismissed here.
        dismissed: Vec<NodeName>,
    },
    /// The node is about to stop.
    Leave,
}

/// Something that the actors of a node must do, in the order given.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Effect {
    /// Hand a term to the disk, without waiting for it. It is mostly on disk long before it is
    /// needed.
    PersistTerm {
        /// To be given to [`LeadershipNode::new`](crate::leadership::node::LeadershipNode::new)
        /// after a restart.
        term: u64,
    },
    /// Send a message once, without waiting.
    Send {
        /// Node to which the message goes.
        to: NodeName,
        /// The message; the caller adds clock stamps, description and signature.
        message: ElectionMessage,
    },
    /// Publish the leadership to all other parts. It precedes the [`Effect::Lead`] that it
    /// announces, because the node's broker admits the first round only after it has received the
    /// new leader.
    PublishLeadership {
        /// The leadership as this node sees it now.
        leadership: Leadership,
    },
    /// Publish from now on in this epoch. It comes again, with a new epoch, when a leader has to
    /// renew its own.
    ///
    /// This effect and all later ones wait until the disk has answered for the epoch's term, or for
    /// [`DISK_TIMEOUT`](crate::leadership::timers::DISK_TIMEOUT). A disk that fails or hangs stops
    /// no leader: availability comes before the uniqueness of epochs.
    Lead {
        /// Epoch of the leadership: a new term, and the name of this node.
        epoch: Epoch,
        /// Number of the next round.
        first_round: u64,
        /// Time at which it is due.
        first: FirstRound,
    },
    /// Let the current round last its whole length: another node is about to lead.
    HoldRound,
    /// Stop publishing in this epoch.
    StopPublishing {
        /// The leadership that ended.
        epoch: Epoch,
    },
    /// Keep links to these brokers.
    SetLinks {
        /// All wanted links; the gateway closes links to other brokers.
        links: WantedLinks,
    },
    /// Publish this status of the node.
    PublishStatus {
        /// The complete status, which replaces the published one.
        status: NodeStatus,
    },
    /// Share all evidence about vehicles: a node needs it to lead, or to remain the leader.
    SendSnapshot {
        /// Name of the node.
        to: NodeName,
    },
    /// Check the node's own parts and pass [`Input::Observed`] at once.
    Observe,
    /// Query broker, gateway and fuser, and pass [`Input::PartsAnswered`] when they have answered.
    AskParts,
    /// Count a message of this node that states an implausibly high term or round.
    CountImplausible {
        /// Node that stated the number.
        from: NodeName,
    },
    /// Write to the log.
    Log {
        /// The event to be logged.
        notice: Notice,
    },
}

/// An event for the log that is not visible in any other effect.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Notice {
    /// All parts work again.
    Fit,
    /// A part does not work, or the members do not reach the broker.
    Unfit {
        /// State of the parts, of which at least one does not work.
        health: Health,
    },
    /// Other machines do not reach this node's broker, so that it does not lead.
    OutOfReach {
        /// Members on other machines.
        members: Vec<NodeName>,
    },
    /// A node's process is gone: its broker ended.
    ProcessGone {
        /// Name of the node.
        peer: NodeName,
        /// Address of the broker that ended.
        broker: BrokerAddress,
    },
    /// The leader's connection to the broker that all use broke.
    LeaderDisconnected {
        /// Name of the leader whose connection broke.
        peer: NodeName,
    },
    /// The node is about to be handed the lead.
    Preparing {
        /// The leader that hands over.
        leader: NodeName,
    },
    /// A node is ready to take over leadership, but this node is not logged in at its broker, or
    /// another node's broker answers at its address.
    NotServed {
        /// Name of the node.
        challenger: NodeName,
    },
    /// This node cannot log in at brokers that it should use, or it can again.
    NoLogin {
        /// All nodes at whose brokers a login is missing; empty if the node is logged in again.
        at: Vec<NodeName>,
    },
    /// This node leads, and more followers than before cannot log in at its broker.
    Deserted {
        /// Number of these followers.
        without_login: usize,
        /// Number of all followers.
        followers: usize,
    },
    /// A node declared more than its certificate allows, or claimed a lead that it may not have.
    Overreached {
        /// Name of the node.
        from: NodeName,
        /// The role that it declared.
        role: Role,
        /// The priority that it declared.
        priority: u8,
        /// Its rights by its certificate.
        rights: Rights,
    },
    /// A message in another node's name was dropped.
    Misattributed {
        /// Node that sent the message, as the transport proved.
        from: NodeName,
        /// The name in the message.
        claimed: NodeName,
    },
}

impl NodeSettings {
    /// True if the node cannot become leader.
    pub(super) fn is_vehicle_only(&self) -> bool {
        self.election.role == Role::Cav
    }
}
