//! Messages to the actor of this name.

use std::collections::BTreeMap;

use ecod::epoch::Epoch;
use ecod::names::NodeName;

use crate::transport::gossip::MembershipEvent;
use crate::transport::mqtt::{BrokerAddress, Delivery, LinkState};

/// What the election is told.
#[derive(Debug)]
pub enum LeaderElectionMessage {
    /// The membership found something out, or brought a message.
    Membership {
        /// What it was.
        event: MembershipEvent,
    },
    /// One of the gateway's links changed.
    LinkChanged {
        /// The broker at its other end.
        broker: BrokerAddress,
        /// How it is now.
        state: LinkState,
    },
    /// A broker told how another node is.
    TakeStatus {
        /// The other node's word, or its last will, and its place among what waits.
        delivery: Delivery,
    },
    /// A round was published by this node or accepted by its gate.
    NoteRound {
        /// The epoch of the round.
        epoch: Epoch,
        /// Its number.
        round: u64,
    },
    /// Evidence about vehicles came from another candidate.
    NoteState {
        /// The candidate.
        from: NodeName,
    },
    /// The fuser was started anew and has forgotten that it leads.
    NoteFuserRestart,
    /// The gateway was started anew and has no links.
    NoteGatewayRestart,
    /// The parts answered.
    NoteHealth {
        /// What they answered.
        sample: HealthSample,
    },
    /// Find out how the parts are.
    CheckHealth,
    /// See whether the node is ready to be handed the lead.
    CheckPrepared,
    /// A deadline of the election has come.
    Wake,
}

/// Answers of a node's parts to the question how they are.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct HealthSample {
    /// The broker answers as serving.
    pub broker_serves: bool,
    /// State of each link of the gateway; none without an answer.
    pub links: Option<BTreeMap<BrokerAddress, LinkState>>,
    /// The fuser closes rounds.
    pub fuser_runs: bool,
}
