//! The actor that takes part in the election and has the node do what comes of it.
//!
//! ```text
//! Membership ── who is there, messages ──┐                    ┌── Lead, StopPublishing ──> Fuser
//! Gateway ───── links, statuses ─────────┤                    ├── SetBrokers, PublishStatus ──> Gateway
//! Follower ──── rounds accepted ─────────┼─> LeaderElection ──┼── SendSnapshot ──> ReputationKeeper
//! Broker ┐                               │         │          ├── Send ──> Membership
//! Fuser  ┴───── health ──────────────────┘         │          └── term ──> disk
//!                                                  └──> watch of the leadership
//! ```
//!
//! [`ecod::election::Election`] decides; the actor carries out its effects in their order, a term being on disk before
//! the node leads in it. What is a state rather than an event (links, status, watch) is not carried out effect by
//! effect but compared with what the election says now.

use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::leadership::Leadership;
use crate::transport::mqtt::DataPlane;

mod driver;
mod health;
mod routes;
mod terms;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::election::ElectionConfig;
use ecod::wire::NodeStatus;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

pub use driver::ElectionDriver;

pub use terms::saved_term;

use crate::messages::actor_slot::ActorSlot;
use crate::messages::broker::BrokerMessage;
use crate::messages::fuser::FuserMessage;
use crate::messages::gateway::GatewayMessage;
use crate::messages::membership::MembershipMessage;
use crate::messages::reputation_keeper::ReputationKeeperMessage;
use crate::platform::state_file::StateFile;
use crate::telemetry::counters::Counters;
use crate::transport::gossip::Member;
use crate::transport::mqtt::Incoming;

/// Where the parts that the election commands or asks are reached.
#[derive(Debug, Clone, Default)]
pub struct Parts {
    /// Sends messages to other nodes.
    pub membership: ActorSlot<MembershipMessage>,
    /// Keeps the links.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Makes maps and verdicts.
    pub fuser: ActorSlot<FuserMessage>,
    /// Holds the reputations.
    pub keeper: ActorSlot<ReputationKeeperMessage>,
    /// The node's own broker.
    pub broker: ActorSlot<BrokerMessage>,
}

/// What an election needs at its start.
pub struct LeaderElectionArguments {
    /// Timings, role and priority.
    pub config: ElectionConfig,
    /// Where the term is kept, if anywhere.
    pub term_file: Option<StateFile>,
    /// Longest time between two rounds.
    pub round_period: Duration,
    /// Which brokers carry the data.
    pub plane: DataPlane,
    /// What the node says about itself; state, epoch and aggregator follow the election.
    pub status: NodeStatus,
    /// Where the node's own broker listens.
    pub own_broker: watch::Receiver<Option<SocketAddr>>,
    /// The other nodes.
    pub members: watch::Receiver<Vec<Member>>,
    /// The parts it commands.
    pub parts: Parts,
    /// Gets the leadership whenever it changes.
    pub leadership: watch::Sender<Leadership>,
    /// Gets the highest term known whenever it changes.
    pub term: watch::Sender<u64>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Drives an [`Election`](ecod::election::Election).
#[derive(Debug, Default)]
pub struct LeaderElection;

/// How often the parts are looked at.
const HEALTH_PERIOD: Duration = Duration::from_millis(250);

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
        myself.send_interval(HEALTH_PERIOD, || LeaderElectionMessage::CheckHealth);
        let mut driver = ElectionDriver::new(arguments, myself);
        driver.check_health().await?;
        driver.reflect();
        Ok(driver)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        driver: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            LeaderElectionMessage::Membership { event } => driver.take_event(event).await?,
            LeaderElectionMessage::LinkChanged { broker, state } => driver.take_link(&broker, state).await?,
            LeaderElectionMessage::TakeStatus { delivery } => {
                if let Incoming::Status { status, .. } = &delivery.message {
                    driver.take_status(status).await?;
                }
            }
            LeaderElectionMessage::NoteRound { epoch, round } => driver.note_round(epoch, round).await?,
            LeaderElectionMessage::NoteState { from } => driver.note_state(&from),
            LeaderElectionMessage::NoteFuserRestart => driver.note_fuser_restart().await?,
            LeaderElectionMessage::NoteGatewayRestart => driver.note_gateway_restart().await?,
            LeaderElectionMessage::NoteHealth { sample } => driver.note_health(sample).await?,
            LeaderElectionMessage::CheckHealth => driver.check_health().await?,
            LeaderElectionMessage::CheckPrepared => driver.check_prepared().await?,
            LeaderElectionMessage::Wake => driver.wake().await?,
        }
        driver.reflect();
        Ok(())
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        driver: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        driver.leave().await
    }
}
