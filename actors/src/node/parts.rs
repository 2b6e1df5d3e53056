//! The parts of a node, how each is started, and where it is reached.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::aggregator::Aggregator;
use ecod::epoch::Epoch;
use ecod::names::NodeName;
use ecod::vote::VoteMode;
use ecod::wire::{NodeState as NodeCondition, NodeStatus, Role, SCHEMA_VERSION};
use ractor::{Actor, ActorCell, ActorId, ActorProcessingErr, ActorRef, Message, SpawnErr};
use tokio::sync::watch;
use uuid::Uuid;

use crate::broker::{Broker, BrokerError, BrokerMessage, EmbeddedBroker};
use crate::clock;
use crate::config::NodeConfig;
use crate::counters::Counters;
use crate::follower::{Follower, FollowerArguments, FollowerMessage, Newest};
use crate::fuser::{Fuser, FuserArguments, FuserMessage};
use crate::gateway::{self, BrokerAddress, Gateway, GatewayArguments, GatewayMessage, Incoming, Subscriber};
use crate::reputation_keeper::{ReputationKeeper, ReputationKeeperArguments, ReputationKeeperMessage, SharedBook};
use crate::seat::Seat;
use crate::state_file::StateFile;
#[cfg(feature = "camera")]
use crate::{
    camera,
    detector::{Detector, DetectorMessage},
    projector::{Projector, ProjectorArguments, ProjectorMessage},
};

/// A part of a node, in the order of starting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Part {
    /// The embedded broker.
    Broker,
    /// The MQTT connections.
    Gateway,
    /// The taker of maps.
    Follower,
    /// The keeper of reputations.
    ReputationKeeper,
    /// The maker of maps and verdicts.
    Fuser,
    /// The maker of reports.
    #[cfg(feature = "camera")]
    Projector,
    /// The finder of objects in frames.
    #[cfg(feature = "camera")]
    Detector,
}

/// Where the parts of a node are reached.
#[derive(Debug, Clone, Default)]
pub struct Seats {
    /// The embedded broker's.
    pub broker: Seat<BrokerMessage>,
    /// The gateway's.
    pub gateway: Seat<GatewayMessage>,
    /// The follower's.
    pub follower: Seat<FollowerMessage>,
    /// The reputation keeper's.
    pub keeper: Seat<ReputationKeeperMessage>,
    /// The fuser's.
    pub fuser: Seat<FuserMessage>,
    /// The projector's.
    #[cfg(feature = "camera")]
    pub projector: Seat<ProjectorMessage>,
    /// The detector's.
    #[cfg(feature = "camera")]
    pub detector: Seat<DetectorMessage>,
}

/// What the parts are made from; kept to make them again.
pub(super) struct Assembly {
    config: NodeConfig,
    name: NodeName,
    run: Uuid,
    seats: Seats,
    counters: Arc<Counters>,
    newest: Newest,
    book: SharedBook,
    broker_address: watch::Sender<Option<SocketAddr>>,
    failed: watch::Sender<Option<String>>,
    last_epoch: u64,
}

/// How long a part may take to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// How often, and how far apart, a broker started anew tries to get its address back.
const REBIND_ATTEMPTS: usize = 40;
const REBIND_WAIT: Duration = Duration::from_millis(50);

impl Assembly {
    pub(super) fn new(config: NodeConfig, failed: watch::Sender<Option<String>>) -> Self {
        let by_evidence = config.fusion.vote.mode != VoteMode::Paper;
        Self {
            name: config.name.clone().unwrap_or(NodeName::from_static("node")),
            config,
            run: Uuid::now_v7(),
            seats: Seats::default(),
            counters: Arc::default(),
            newest: Newest::default(),
            book: SharedBook::new(by_evidence),
            broker_address: watch::Sender::new(None),
            failed,
            last_epoch: 0,
        }
    }

    pub(super) fn seats(&self) -> &Seats {
        &self.seats
    }

    pub(super) fn counters(&self) -> Arc<Counters> {
        Arc::clone(&self.counters)
    }

    pub(super) fn newest(&self) -> Newest {
        self.newest.clone()
    }

    pub(super) fn broker_address(&self) -> watch::Receiver<Option<SocketAddr>> {
        self.broker_address.subscribe()
    }

    pub(super) fn give_up(&self, why: String) {
        self.failed.send_replace(Some(why));
    }

    /// The parts that this node has, in the order of starting.
    pub(super) fn parts(&self) -> Vec<Part> {
        let aggregates = self.config.role == Role::Edge;
        let mut parts = Vec::new();
        parts.extend((aggregates && self.config.mqtt.broker.is_none()).then_some(Part::Broker));
        parts.extend([Part::Gateway, Part::Follower]);
        if aggregates {
            parts.extend(self.config.fusion.algorithms.vote().then_some(Part::ReputationKeeper));
            parts.push(Part::Fuser);
        }
        #[cfg(feature = "camera")]
        if self.config.camera.is_some() {
            parts.extend([Part::Projector, Part::Detector]);
        }
        parts
    }

    /// Starts one part below the supervisor and seats it.
    pub(super) async fn start(&mut self, part: Part, supervisor: ActorCell) -> Result<ActorId, ActorProcessingErr> {
        match part {
            Part::Broker => self.start_broker(supervisor).await,
            Part::Gateway => self.start_gateway(supervisor).await,
            Part::Follower => {
                let arguments = FollowerArguments {
                    newest: self.newest.clone(),
                    log: self.config.map_log.clone(),
                    status: self.status(),
                    gateway: self.seats.gateway.clone(),
                    counters: self.counters(),
                };
                seat(&self.seats.follower, Actor::spawn_linked(None, Follower, arguments, supervisor).await)
            }
            Part::ReputationKeeper => {
                let arguments = self.keeper_arguments();
                seat(&self.seats.keeper, Actor::spawn_linked(None, ReputationKeeper, arguments, supervisor).await)
            }
            Part::Fuser => {
                let arguments = self.fuser_arguments();
                let id = seat(&self.seats.fuser, Actor::spawn_linked(None, Fuser, arguments, supervisor).await)?;
                self.lead();
                Ok(id)
            }
            #[cfg(feature = "camera")]
            Part::Projector => {
                let arguments = ProjectorArguments {
                    perception: camera::perception(&self.config).map_err(in_full)?,
                    gateway: self.seats.gateway.clone(),
                    counters: self.counters(),
                };
                seat(&self.seats.projector, Actor::spawn_linked(None, Projector, arguments, supervisor).await)
            }
            #[cfg(feature = "camera")]
            Part::Detector => {
                let arguments = camera::detector(&self.config, self.seats.projector.clone(), self.counters());
                let arguments = arguments.map_err(in_full)?;
                seat(&self.seats.detector, Actor::spawn_linked(None, Detector, arguments, supervisor).await)
            }
        }
    }

    /// Stops all parts, the last started first.
    pub(super) async fn stop_all(&self) {
        #[cfg(feature = "camera")]
        {
            stop(&self.seats.detector).await;
            stop(&self.seats.projector).await;
        }
        stop(&self.seats.fuser).await;
        stop(&self.seats.keeper).await;
        stop(&self.seats.follower).await;
        stop(&self.seats.gateway).await;
        stop(&self.seats.broker).await;
    }

    /// The broker comes back at the address it had, so that the links find it; the run before may need a moment to
    /// leave it.
    async fn start_broker(&self, supervisor: ActorCell) -> Result<ActorId, ActorProcessingErr> {
        let embedded = Box::new(EmbeddedBroker::new(self.config.broker()));
        let (broker, _) = Actor::spawn_linked(None, Broker, embedded, supervisor).await.map_err(cause)?;
        let before = *self.broker_address.borrow();
        let address = before.unwrap_or(self.config.listen);
        let mut attempts = if before.is_some() { REBIND_ATTEMPTS } else { 1 };
        let bound = loop {
            attempts -= 1;
            match ractor::call!(broker, |reply| BrokerMessage::Start { address, reply })? {
                Err(BrokerError::Bind { .. }) if attempts > 0 => tokio::time::sleep(REBIND_WAIT).await,
                outcome => break outcome.map_err(|error| format!("key `listen`: {error}"))?,
            }
        };
        self.broker_address.send_replace(Some(bound));
        let id = broker.get_id();
        self.seats.broker.take(broker);
        Ok(id)
    }

    async fn start_gateway(&self, supervisor: ActorCell) -> Result<ActorId, ActorProcessingErr> {
        let part = if self.config.role == Role::Cav { gateway::Part::Follower } else { gateway::Part::Candidate };
        let arguments = GatewayArguments {
            cell: self.config.cell.clone(),
            part,
            status: self.status(),
            mqtt: self.config.mqtt.clone(),
            counters: self.counters(),
            subscriber: self.subscriber(),
            seed: self.run.as_u64_pair().1,
        };
        let (actor, _) = Actor::spawn_linked(None, Gateway, arguments, supervisor).await.map_err(cause)?;
        let embedded = *self.broker_address.borrow();
        let addresses = self.config.mqtt.broker.clone().or(embedded.map(BrokerAddress::from)).into_iter().collect();
        actor.cast(GatewayMessage::SetBrokers { addresses })?;
        let id = actor.get_id();
        self.seats.gateway.take(actor);
        Ok(id)
    }

    /// Takes what comes in to the part that deals with it.
    fn subscriber(&self) -> Subscriber {
        let Seats { fuser, follower, keeper, .. } = self.seats.clone();
        Arc::new(move |delivery| {
            match &delivery.message {
                Incoming::Report { .. } => fuser.send(FuserMessage::TakeReport { delivery }),
                Incoming::Map(_) => follower.send(FollowerMessage::TakeMap { delivery }),
                Incoming::Verdicts(_) => follower.send(FollowerMessage::TakeVerdicts { delivery }),
                Incoming::Reputations(_) => follower.send(FollowerMessage::TakeReputations { delivery }),
                Incoming::Ledger(_) => keeper.send(ReputationKeeperMessage::Merge { delivery }),
                Incoming::Status(_) | Incoming::Link { .. } => true,
            };
        })
    }

    fn keeper_arguments(&self) -> ReputationKeeperArguments {
        let directory = self.config.state_dir.as_deref();
        ReputationKeeperArguments {
            name: self.name.clone(),
            cell: self.config.cell.clone(),
            reputation: self.config.fusion.reputation.clone(),
            config: self.config.reputations.clone(),
            book: self.book.clone(),
            file: directory.map(|path| StateFile::new(path, &self.config.cell, &self.name, "reputations")),
            newest: self.newest.reputations.subscribe(),
            gateway: self.seats.gateway.clone(),
            fuser: self.seats.fuser.clone(),
            counters: self.counters(),
        }
    }

    /// A fuser starts with the evidence that the keeper has.
    fn fuser_arguments(&self) -> FuserArguments {
        let (fusion, landmarks) = (self.config.fusion.clone(), self.config.landmarks());
        let mut aggregator = Aggregator::standby(fusion, landmarks, clock::now());
        aggregator.adopt(&self.book.open().ledger);
        FuserArguments {
            aggregator,
            gateway: self.seats.gateway.clone(),
            keeper: self.seats.keeper.clone(),
            counters: self.counters(),
        }
    }

    /// Every run of a fuser leads in an epoch of its own, later than all before: the seconds of its start.
    fn lead(&mut self) {
        self.last_epoch = (clock::now().micros() / 1_000_000).max(self.last_epoch + 1);
        let epoch = Epoch::new(self.last_epoch, self.name.clone());
        self.seats.fuser.send(FuserMessage::Lead { epoch, first_round: 1, on_time: true });
    }

    /// What the node says about itself when a part starts, also anew: it follows whom it followed before.
    fn status(&self) -> NodeStatus {
        let aggregates = self.config.role == Role::Edge;
        let newest = self.newest.map.borrow();
        let followed = newest.as_ref().map(|received| received.map.aggregator.clone());
        NodeStatus {
            schema: SCHEMA_VERSION,
            node: self.name.clone(),
            id: self.run,
            role: self.config.role,
            state: if aggregates { NodeCondition::Aggregating } else { NodeCondition::Following },
            epoch: self.last_epoch.max(newest.as_ref().map_or(0, |received| received.map.epoch)),
            aggregator: if aggregates { Some(self.name.clone()) } else { followed },
            version: env!("CARGO_PKG_VERSION").into(),
        }
    }
}

fn seat<M: Message>(
    seat: &Seat<M>,
    spawned: Result<(ActorRef<M>, tokio::task::JoinHandle<()>), SpawnErr>,
) -> Result<ActorId, ActorProcessingErr> {
    let (actor, _) = spawned.map_err(cause)?;
    let id = actor.get_id();
    seat.take(actor);
    Ok(id)
}

/// Why an actor did not start, without the framework's own words around it.
pub(super) fn cause(error: SpawnErr) -> ActorProcessingErr {
    match error {
        SpawnErr::StartupFailed(cause) => cause,
        other => other.into(),
    }
}

/// An error with all its causes, which the actor framework would leave out.
#[cfg(feature = "camera")]
#[expect(clippy::needless_pass_by_value, reason = "takes what map_err gives")]
fn in_full(error: anyhow::Error) -> ActorProcessingErr {
    format!("{error:#}").into()
}

async fn stop<M: Message>(seat: &Seat<M>) {
    let Some(actor) = seat.holder() else { return };
    if let Err(error) = actor.stop_and_wait(None, Some(STOP_TIMEOUT)).await {
        tracing::debug!(%error, "part did not stop in time");
        actor.kill();
    }
}

#[cfg(test)]
mod tests {
    use ecod::time::Timestamp;
    use ecod::wire::GlobalMap;

    use super::*;

    #[test]
    fn a_part_started_anew_still_says_whom_the_node_follows() {
        let config = NodeConfig { role: Role::Cav, ..NodeConfig::default() };
        let assembly = Assembly::new(config, watch::Sender::new(None));
        assert_eq!((assembly.status().epoch, assembly.status().aggregator), (0, None));
        let map = GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: NodeName::from_static("edge"),
            epoch: 7,
            round: 1,
            fused_at_us: Timestamp(0),
            oldest_capture_us: None,
            landmarks: Vec::new(),
            objects: Vec::new(),
        };
        assembly.newest.send_replace(Some(ReceivedMap { received_at: Timestamp(0), map: Arc::new(map) }));
        assert_eq!(
            (assembly.status().epoch, assembly.status().aggregator.as_ref().map(NodeName::as_str)),
            (7, Some("edge"))
        );
    }
}
