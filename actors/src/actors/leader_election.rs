//! The actor that carries out the effects of the node's leadership.
//!
//! ```text
//! Membership ── who is there, messages ──┐                    ┌── Lead, HoldRound, StopPublishing ──> Fuser
//! Gateway ───── links, statuses ─────────┤                    ├── SetBrokers, PublishStatus ──> Gateway
//! Follower ──── rounds accepted ─────────┼─> LeaderElection ──┼── SendSnapshot ──> ReputationKeeper
//! Broker ┐                               │         │          ├── Send ──> Membership
//! Fuser  ┴───── health ──────────────────┘         │          └── term ──> disk
//!                                                  └──> watch of the leadership
//! ```
//!
//! [`LeadershipNode`](ecod::leadership::node::LeadershipNode) makes the decisions. The actor
//! converts messages to inputs, carries out the effects in order, and wakes the machine at its
//! deadline.

mod driver;
mod life_signs;
mod probe;
mod term_writer;

use std::net::SocketAddr;
use std::sync::Arc;

use ecod::leadership::Leadership;
use ecod::leadership::node::{Input, NodeSettings};
use ecod::model::names::NodeName;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

pub use driver::ElectionDriver;
pub use term_writer::saved_term;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::description_keeper::DescriptionKeeperMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::membership::MembershipMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::messages::uplink::UplinkMessage;
use crate::observe::dashboard::LiveState;
use crate::observe::readiness::SharedFacts;
use crate::observe::recorder::LogSender;
use crate::platform::cell_clock::CellClock;
use crate::platform::state_file::StateFile;
use crate::telemetry::counters::Counters;
use crate::transport::broker::Door;
use crate::transport::gossip::Member;
use crate::transport::pki::Credentials;

/// Addresses of the parts that the election commands or queries.
#[derive(Debug, Clone)]
pub struct Parts {
    /// Sends messages to other nodes.
    pub membership: ActorSlot<MembershipMessage>,
    /// Keeps the links, and publishes the node's status on them.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Makes maps and verdicts.
    pub fuser: ActorSlot<FuserMessage>,
    /// Shares the evidence behind the reputations with other candidates.
    pub keeper: ActorSlot<ReputationKeeperMessage>,
    /// Keeps the cell's description.
    pub description: ActorSlot<DescriptionKeeperMessage>,
    /// Publishes the node's status to the region.
    pub uplink: ActorSlot<UplinkMessage>,
    /// The node's own broker.
    pub broker: ActorSlot<BrokerMessage>,
    /// Publishes the node's status to local programs.
    pub door: Door,
    /// Records the node's status in the log.
    pub recording: LogSender,
    /// Settings of the cell, and whether the node uses them.
    pub shared: watch::Receiver<SharedFacts>,
}

/// Arguments of an election's start.
pub struct LeaderElectionArguments {
    /// Settings of the node's leadership.
    pub settings: NodeSettings,
    /// File that holds the term, if any.
    pub term_file: Option<StateFile>,
    /// Address at which the node's own broker listens.
    pub own_broker: watch::Receiver<Option<SocketAddr>>,
    /// Address at which the node's page listens.
    pub page: watch::Receiver<Option<SocketAddr>>,
    /// All living nodes except this one.
    pub members: watch::Receiver<Vec<Member>>,
    /// The parts it commands.
    pub parts: Parts,
    /// Receives the leadership whenever it changes. A change of only the highest term does not
    /// notify readers.
    pub leadership: watch::Sender<Leadership>,
    /// Shows the cell's time.
    pub clock: CellClock,
    /// Name of the cell.
    pub cell: NodeName,
    /// Certificates of the node, which sign its signs of life; `None` in a cell without
    /// certificates.
    pub credentials: Option<Arc<Credentials>>,
    /// Counters of the node, shared by its actors.
    pub counters: Arc<Counters>,
    /// The expected nodes of the cell.
    pub live_state: Arc<LiveState>,
    /// True for a vehicle that moves from cell to cell and is not expected to stay.
    pub is_visitor: bool,
}

/// Actor that drives a [`LeadershipNode`](ecod::leadership::node::LeadershipNode): it passes events
/// and time to it, and carries out its effects.
#[derive(Debug, Default)]
pub struct LeaderElection;

impl Actor for LeaderElection {
    type Msg = LeaderElectionMessage;
    type State = ElectionDriver;
    type Arguments = LeaderElectionArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        // An earlier run may have left the fuser leading.
        arguments.parts.fuser.send(FuserMessage::StopPublishing);
        let mut driver = ElectionDriver::new(arguments, myself);
        driver.handle(Input::Wake).await;
        Ok(driver)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        driver: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            LeaderElectionMessage::Membership { event } => driver.on_membership_event(event).await,
            LeaderElectionMessage::HandleStatus { delivery } => {
                driver.on_status(&delivery.message).await;
            }
            LeaderElectionMessage::Record { input } => driver.handle(input).await,
        }
        Ok(())
    }

    /// Resigns if this node leads, so that the next leader does not have to detect the loss.
    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        driver: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        driver.leave().await;
        Ok(())
    }
}
