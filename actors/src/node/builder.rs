//! How the parts of a node are made, connected, started and stopped.

mod arguments;
#[cfg(feature = "camera")]
mod cameras;
mod describe;
mod listening;
mod uplink;

use std::fs::File;
use std::io;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ecod::leadership::Leadership;
use ecod::leadership::node::Input;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{CellDescription, ContentHash, SCHEMA_VERSION};
use ractor::{Actor, ActorCell, ActorId, ActorProcessingErr, ActorRef, Message, SpawnErr};
use tokio::sync::watch;
use uuid::Uuid;

use super::NodeError;
use super::description::{HeldDescription, rates_by_evidence, shared_facts};
use super::presence::{Presence, VehicleParts};
use super::slots::{ActorKind, ActorSlots};
use crate::actors::dashboard::Dashboard;
use crate::actors::description_keeper::DescriptionKeeper;
#[cfg(feature = "camera")]
use crate::actors::detector::Detector;
use crate::actors::follower::Follower;
use crate::actors::fuser::{Fuser, LatestReportQueue};
use crate::actors::gateway::Gateway;
use crate::actors::leader_election::LeaderElection;
use crate::actors::pose_receiver::{PoseReceiver, PoseReceiverArguments};
#[cfg(feature = "camera")]
use crate::actors::projector::Projector;
use crate::actors::recorder::Recorder;
use crate::actors::reputation_keeper::{ReputationKeeper, SharedReputations};
use crate::actors::uplink::Uplink;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::leader_election::LeaderElectionMessage;
use crate::messages::newest::Newest;
use crate::node::config::NodeConfig;
use crate::observe::dashboard::{FloorPlan, LiveState};
use crate::observe::readiness::SharedFacts;
use crate::observe::recorder::LogSender;
use crate::platform::cell_clock::CellClock;
use crate::platform::clock;
use crate::platform::state_file::StateFile;
use crate::telemetry::counters::Counters;
use crate::telemetry::spans::Spans;
use crate::transport::broker::Door;
use crate::transport::gossip::{FrameCounters, Member};
use crate::transport::mqtt::Security;

/// Arguments of the parts; kept to create them again.
pub(super) struct NodeBuilder {
    /// The node's own configuration.
    own_config: NodeConfig,
    /// The configuration including the cell's description, as in use.
    config: NodeConfig,
    presence: Presence,
    vehicle: VehicleParts,
    held: HeldDescription,
    shared: watch::Sender<SharedFacts>,
    security: Security,
    name: NodeName,
    run: Uuid,
    started_at: Timestamp,
    clock: CellClock,
    slots: ActorSlots,
    newest: Newest,
    reputations: SharedReputations,
    /// Keeps `ecod-node reset` away while the node runs.
    _state_lock: Option<File>,
    recording: LogSender,
    report_queue: LatestReportQueue,
    /// Address of the broker that other nodes may use.
    broker_address: watch::Sender<Option<SocketAddr>>,
    door: Door,
    gossip_address: watch::Sender<Option<SocketAddr>>,
    frames: Arc<FrameCounters>,
    members: watch::Sender<Vec<Member>>,
    leadership: watch::Sender<Leadership>,
    live_state: Arc<LiveState>,
    floor_plan: Option<FloorPlan>,
    failed: watch::Sender<Option<NodeError>>,
}

/// Maximum time for a part to stop.
const STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// Locks the node's state. A directory that cannot be written is reported when something is saved.
fn lock_state(directory: &Path, cell: &NodeName, name: &NodeName) -> Option<File> {
    let lock = StateFile::lock(directory, cell, name);
    if lock
        .as_ref()
        .is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
    {
        tracing::warn!(
            directory = %directory.display(),
            "another process uses the state of this node, and each overwrites the other's: stop one of them"
        );
    }
    lock.ok()
}

impl NodeBuilder {
    /// Arguments of all parts, under the settings of `held`, if the node can use them.
    pub(super) fn new(
        vehicle: VehicleParts,
        presence: Presence,
        own_config: NodeConfig,
        security: Security,
        mut held: HeldDescription,
        failed: watch::Sender<Option<NodeError>>,
    ) -> Self {
        let config = held
            .lay_over(&own_config)
            .unwrap_or_else(|| own_config.clone());
        let name = config.name.clone().unwrap_or(NodeName::from_static("node"));
        let directory = config.state_dir.as_deref();
        let report_queue = LatestReportQueue::new(config.mqtt.max_objects);
        let mut builder = Self {
            _state_lock: directory.and_then(|directory| lock_state(directory, &config.cell, &name)),
            name,
            reputations: SharedReputations::new(rates_by_evidence(&config)),
            shared: watch::Sender::new(shared_facts(&config, &held)),
            own_config,
            held,
            config,
            security,
            run: Uuid::now_v7(),
            started_at: clock::now(),
            clock: CellClock::default(),
            slots: vehicle.slots(),
            recording: LogSender::new(Arc::clone(&vehicle.counters)),
            presence,
            vehicle,
            newest: Newest::default(),
            report_queue,
            broker_address: watch::Sender::new(None),
            door: Door::default(),
            gossip_address: watch::Sender::new(None),
            frames: Arc::default(),
            members: watch::Sender::new(Vec::new()),
            leadership: watch::Sender::default(),
            live_state: Arc::default(),
            floor_plan: None,
            failed,
        };
        builder.check_units();
        if presence == Presence::Active {
            builder.take_frames();
        }
        builder.door = builder.new_door();
        builder
            .door
            .publish_description(&builder.present_description());
        builder
    }

    /// Sets the image under the map.
    pub(super) fn with_floor_plan(mut self, floor_plan: Option<FloorPlan>) -> Self {
        self.floor_plan = floor_plan;
        self
    }

    pub(super) fn slots(&self) -> &ActorSlots {
        &self.slots
    }

    pub(super) fn counters(&self) -> Arc<Counters> {
        Arc::clone(&self.vehicle.counters)
    }

    pub(super) fn vehicle(&self) -> &VehicleParts {
        &self.vehicle
    }

    /// True for a vehicle that moves from cell to cell.
    pub(super) fn moves_on(&self) -> bool {
        self.own_config.cells.is_some()
    }

    pub(super) fn set_presence(&mut self, presence: Presence) {
        self.presence = presence;
    }

    /// Longest time between two rounds.
    fn round_period(&self) -> Duration {
        Duration::from_secs_f64(self.config.fusion.round.period_s)
    }

    /// The cell's description for programs: version 0 without one.
    fn present_description(&self) -> CellDescription {
        let none = || CellDescription {
            schema: SCHEMA_VERSION,
            version: 0,
            hash: ContentHash::default(),
            set_by: self.name.clone(),
            text: String::new(),
        };
        self.held
            .description
            .as_deref()
            .cloned()
            .unwrap_or_else(none)
    }

    /// Makes running detectors record to this node's log, and trace their frames in its cell.
    pub(super) fn take_frames(&self) {
        self.vehicle.log.send_replace(self.recording.clone());
        self.vehicle.spans.send_replace(self.spans());
    }

    fn spans(&self) -> Spans {
        Spans::new(self.config.cell.clone(), self.name.clone()).dated_by(self.clock.clone())
    }

    pub(super) fn newest(&self) -> Newest {
        self.newest.clone()
    }

    pub(super) fn broker_address(&self) -> watch::Receiver<Option<SocketAddr>> {
        self.broker_address.subscribe()
    }

    pub(super) fn listens_at(&self) -> watch::Receiver<Option<SocketAddr>> {
        self.vehicle.listens_at.subscribe()
    }

    pub(super) fn gossip_address(&self) -> watch::Receiver<Option<SocketAddr>> {
        self.gossip_address.subscribe()
    }

    pub(super) fn dashboard_address(&self) -> watch::Receiver<Option<SocketAddr>> {
        self.vehicle.dashboard_address.subscribe()
    }

    pub(super) fn frames(&self) -> Arc<FrameCounters> {
        Arc::clone(&self.frames)
    }

    pub(super) fn members(&self) -> watch::Receiver<Vec<Member>> {
        self.members.subscribe()
    }

    pub(super) fn name(&self) -> &NodeName {
        &self.name
    }

    pub(super) fn live_state(&self) -> Arc<LiveState> {
        Arc::clone(&self.live_state)
    }

    pub(super) fn shared(&self) -> watch::Receiver<SharedFacts> {
        self.shared.subscribe()
    }

    pub(super) fn leadership(&self) -> watch::Receiver<Leadership> {
        self.leadership.subscribe()
    }

    pub(super) fn give_up(&self, why: NodeError) {
        self.failed.send_replace(Some(why));
    }

    /// The parts that this node has, in the order of starting.
    pub(super) fn parts(&self) -> Vec<ActorKind> {
        let leads = self.config.may_lead();
        let is_whole = self.presence == Presence::Active;
        let reports = self.presence >= Presence::Reporting;
        let has_broker = self.config.has_broker() && (is_whole || self.config.serves_nodes());
        let mut parts = Vec::new();
        parts.extend((is_whole && self.config.record.is_some()).then_some(ActorKind::Recorder));
        parts.extend(has_broker.then_some(ActorKind::Broker));
        parts.extend([
            ActorKind::Membership,
            ActorKind::DescriptionKeeper,
            ActorKind::Gateway,
            ActorKind::Follower,
        ]);
        if leads {
            let rates = self
                .config
                .fusion
                .rates_vehicles(!self.config.landmarks.is_empty());
            parts.extend(rates.then_some(ActorKind::ReputationKeeper));
            parts.push(ActorKind::Fuser);
        }
        parts.extend(self.config.has_uplink().then_some(ActorKind::Uplink));
        parts.push(ActorKind::LeaderElection);
        parts.extend((is_whole && self.config.dashboard.enabled).then_some(ActorKind::Dashboard));
        let takes_poses = reports && self.config.takes_poses();
        #[cfg(feature = "camera")]
        for camera in (0..self.config.all_cameras().count()).filter(|_| reports) {
            parts.extend([ActorKind::Projector(camera), ActorKind::Detector(camera)]);
        }
        parts.extend(takes_poses.then_some(ActorKind::PoseReceiver));
        parts
    }

    /// Starts one part below the supervisor and slots it.
    pub(super) async fn start(
        &mut self,
        part: ActorKind,
        supervisor: ActorCell,
    ) -> Result<ActorId, ActorProcessingErr> {
        match part {
            ActorKind::Recorder => self.start_recorder(supervisor).await,
            ActorKind::Broker => self.start_broker(supervisor).await,
            ActorKind::Membership => self.start_membership(supervisor).await,
            ActorKind::DescriptionKeeper => {
                let arguments = self.description_arguments(supervisor.clone());
                let started =
                    Actor::spawn_linked(None, DescriptionKeeper, arguments, supervisor).await;
                slot(&self.slots.description, started)
            }
            ActorKind::Gateway => {
                let started =
                    Actor::spawn_linked(None, Gateway, self.gateway_arguments(), supervisor).await;
                let id = slot(&self.slots.gateway, started)?;
                self.slots.election.send(LeaderElectionMessage::Record {
                    input: Input::GatewayRestarted,
                });
                Ok(id)
            }
            ActorKind::Follower => {
                let started =
                    Actor::spawn_linked(None, Follower, self.follower_arguments(), supervisor)
                        .await;
                slot(&self.slots.follower, started)
            }
            ActorKind::ReputationKeeper => {
                let arguments = self.keeper_arguments();
                let started =
                    Actor::spawn_linked(None, ReputationKeeper, arguments, supervisor).await;
                slot(&self.slots.keeper, started)
            }
            ActorKind::Fuser => {
                let started =
                    Actor::spawn_linked(None, Fuser, self.fuser_arguments(), supervisor).await;
                let id = slot(&self.slots.fuser, started)?;
                self.slots.election.send(LeaderElectionMessage::Record {
                    input: Input::FuserRestarted,
                });
                Ok(id)
            }
            ActorKind::Uplink => slot(
                &self.slots.uplink,
                Actor::spawn_linked(None, Uplink, self.uplink_arguments()?, supervisor).await,
            ),
            ActorKind::LeaderElection => {
                let started = Actor::spawn_linked(
                    None,
                    LeaderElection,
                    self.election_arguments(),
                    supervisor,
                )
                .await;
                slot(&self.slots.election, started)
            }
            ActorKind::Dashboard => {
                let arguments = self.dashboard_arguments();
                slot(
                    &self.slots.dashboard,
                    Actor::spawn_linked(None, Dashboard, arguments, supervisor).await,
                )
            }
            ActorKind::PoseReceiver => {
                let arguments = PoseReceiverArguments {
                    address: self
                        .config
                        .pose
                        .listen
                        .ok_or("no `pose.listen` is configured")?,
                    #[cfg(feature = "camera")]
                    projectors: self.slots.projectors.clone(),
                    poses: self.vehicle.poses.clone(),
                    counters: self.counters(),
                };
                slot(
                    &self.slots.pose_receiver,
                    Actor::spawn_linked(None, PoseReceiver, arguments, supervisor).await,
                )
            }
            #[cfg(feature = "camera")]
            ActorKind::Projector(camera) => {
                let arguments = self.projector_arguments(camera).map_err(in_full)?;
                let started = Actor::spawn_linked(None, Projector, arguments, supervisor).await;
                camera_slot(&self.slots.projectors, camera, started)
            }
            #[cfg(feature = "camera")]
            ActorKind::Detector(camera) => {
                let arguments = self.detector_arguments(camera).map_err(in_full)?;
                let started = Actor::spawn_linked(None, Detector, arguments, supervisor).await;
                camera_slot(&self.slots.detectors, camera, started)
            }
        }
    }

    /// Stops all parts, the last started first.
    pub(super) async fn stop_all(&self) {
        // The vehicle's parts may belong to another node.
        if self.presence >= Presence::Reporting {
            self.stop_vehicle().await;
        }
        stop(&self.slots.dashboard).await;
        stop(&self.slots.election).await;
        stop(&self.slots.uplink).await;
        stop(&self.slots.fuser).await;
        stop(&self.slots.keeper).await;
        stop(&self.slots.follower).await;
        stop(&self.slots.gateway).await;
        stop(&self.slots.description).await;
        stop(&self.slots.membership).await;
        self.stop_broker().await;
        stop(&self.slots.recorder).await;
    }

    async fn stop_vehicle(&self) {
        stop(&self.slots.pose_receiver).await;
        #[cfg(feature = "camera")]
        {
            for detector in &self.slots.detectors {
                stop(detector).await;
            }
            for projector in &self.slots.projectors {
                stop(projector).await;
            }
        }
    }

    pub(super) async fn stop_broker(&self) {
        stop(&self.slots.broker).await;
    }

    async fn start_recorder(&self, supervisor: ActorCell) -> Result<ActorId, ActorProcessingErr> {
        let Some(arguments) = self.recorder_arguments() else {
            return Err("no [record] is configured".into());
        };
        if !self.config.may_lead() && !arguments.config.reports {
            tracing::info!(
                "reports of other vehicles are not recorded, key `record.reports` is false"
            );
        }
        slot(
            &self.slots.recorder,
            Actor::spawn_linked(None, Recorder, arguments, supervisor).await,
        )
    }
}

/// Slots a part that was started.
fn slot<M: Message>(
    slot: &ActorSlot<M>,
    spawned: Result<(ActorRef<M>, tokio::task::JoinHandle<()>), SpawnErr>,
) -> Result<ActorId, ActorProcessingErr> {
    let (actor, _) = spawned.map_err(cause)?;
    let id = actor.get_id();
    slot.set(actor);
    Ok(id)
}

/// As `slot`, for a part of a camera.
#[cfg(feature = "camera")]
fn camera_slot<M: Message>(
    slots: &[ActorSlot<M>],
    camera: usize,
    spawned: Result<(ActorRef<M>, tokio::task::JoinHandle<()>), SpawnErr>,
) -> Result<ActorId, ActorProcessingErr> {
    slot(slots.get(camera).ok_or("there is no such camera")?, spawned)
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

async fn stop<M: Message>(slot: &ActorSlot<M>) {
    let Some(actor) = slot.get() else { return };
    if let Err(error) = actor.stop_and_wait(None, Some(STOP_TIMEOUT)).await {
        tracing::debug!(%error, "part did not stop in time");
        actor.kill();
    }
}
