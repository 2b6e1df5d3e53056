//! The actor that carries out what the node's leadership decides.
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
//! [`LeadershipNode`](ecod::leadership::node::LeadershipNode) decides. The actor turns messages into its inputs, carries
//! out its effects in their order, and wakes it at its deadline.

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
use crate::observe::readiness::SharedFacts;
use crate::observe::recorder::LogSender;
use crate::platform::cell_clock::CellClock;
use crate::platform::state_file::StateFile;
use crate::telemetry::counters::Counters;
use crate::transport::broker::Door;
use crate::transport::gossip::Member;
use crate::transport::pki::Credentials;

/// Where the parts that the election commands or asks are reached.
#[derive(Debug, Clone)]
pub struct Parts {
    /// Sends messages to other nodes.
    pub membership: ActorSlot<MembershipMessage>,
    /// Keeps the links.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Makes maps and verdicts.
    pub fuser: ActorSlot<FuserMessage>,
    /// Holds the reputations.
    pub keeper: ActorSlot<ReputationKeeperMessage>,
    /// Keeps the cell's description.
    pub description: ActorSlot<DescriptionKeeperMessage>,
    /// Tells the region of the node's status.
    pub uplink: ActorSlot<UplinkMessage>,
    /// The node's own broker.
    pub broker: ActorSlot<BrokerMessage>,
    /// Shows the node's status to programs.
    pub door: Door,
    /// Gets the node's status for the log.
    pub recording: LogSender,
    /// Settings of the cell, and whether the node uses them.
    pub shared: watch::Receiver<SharedFacts>,
}

/// Arguments of an election's start.
pub struct LeaderElectionArguments {
    /// Settings of the node's leadership.
    pub settings: NodeSettings,
    /// Where the term is kept, if anywhere.
    pub term_file: Option<StateFile>,
    /// Where the node's own broker listens.
    pub own_broker: watch::Receiver<Option<SocketAddr>>,
    /// Where the node's page listens.
    pub page: watch::Receiver<Option<SocketAddr>>,
    /// The other nodes.
    pub members: watch::Receiver<Vec<Member>>,
    /// The parts it commands.
    pub parts: Parts,
    /// Gets the leadership whenever it changes. A change of the highest known term alone wakes nobody.
    pub leadership: watch::Sender<Leadership>,
    /// Shows the cell's time.
    pub clock: CellClock,
    /// Name of the cell.
    pub cell: NodeName,
    /// The node's certificates.
    pub credentials: Option<Arc<Credentials>>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Drives a [`LeadershipNode`](ecod::leadership::node::LeadershipNode).
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
        // A run before this one may have left the fuser leading.
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
            LeaderElectionMessage::Membership { event } => driver.take_event(event).await,
            LeaderElectionMessage::TakeStatus { delivery } => {
                driver.take_status(&delivery.message).await;
            }
            LeaderElectionMessage::Note { input } => driver.handle(input).await,
        }
        Ok(())
    }

    /// Gives up the lead, if this node has it, so that the next one need not find out.
    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        driver: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        driver.leave().await;
        Ok(())
    }
}
