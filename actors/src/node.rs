//! The supervisor of a node.
//!
//! ```text
//! Node
//! ├─ Recorder          writes the log                     if configured
//! ├─ Broker            embedded MQTT broker               unless switched off where it is only a door
//! ├─ Membership        who is there, datagrams            always
//! ├─ DescriptionKeeper newest settings of the cell        always
//! ├─ Gateway           the only owner of MQTT clients     always
//! ├─ Follower          takes maps, verdicts, reputations  always
//! ├─ ReputationKeeper  publishes and keeps reputations    may lead, in a cell that votes or tracks
//! ├─ Fuser             closes rounds: maps and verdicts   may lead; publishes only while leading
//! ├─ Uplink            cells around, a region's broker    may lead, if configured; connected only while leading
//! ├─ LeaderElection    who leads, and what follows        always
//! ├─ Dashboard         page, metrics and health           unless switched off
//! ├─ Projector         detections -> report               with a camera
//! ├─ Detector          frames -> detections               with a camera
//! └─ PoseReceiver      where the vehicle is               if it moves
//! ```
//!
//! A part that ends is restarted while the other parts continue: they address each other through
//! slots. A node whose parts end more often than [`MAX_RESTARTS`] times in [`RESTART_SPAN`] gives
//! up, so that the service manager starts it afresh.

mod builder;
#[cfg(feature = "camera")]
pub mod camera;
pub mod config;
pub(crate) mod description;
pub(crate) mod health_log;
mod presence;
mod restarts;
pub mod roaming;
pub mod running;
pub mod service;
mod slots;

use std::collections::HashMap;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use ecod::diagnostics::in_words;
use ecod::leadership::Leadership;
use ecod::leadership::readiness::Readiness;
use ecod::model::names::NodeName;
use ecod::wire::{CellDescription, Reputations, Trouble, Verdicts};
use ractor::{
    Actor, ActorCell, ActorId, ActorProcessingErr, ActorRef, RpcReplyPort, SupervisionEvent,
};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;

pub use restarts::{MAX_RESTARTS, RESTART_SPAN};
pub use slots::{ActorKind, ActorSlots};

use crate::messages::newest::{Newest, Received, ReceivedMap};
use crate::node::config::NodeConfig;
use crate::node::service::ServiceManager;
use crate::observe::dashboard::{LiveState, ShownCamera};
use crate::observe::readiness::{SharedFacts, Vitals};
use crate::platform::clock;
use crate::telemetry::counters::Counters;
use crate::transport::gossip::{FrameCounters, Member};
use builder::{NodeBuilder, cause};
use description::HeldDescription;
use health_log::HealthLog;
pub use presence::MoveStep;
use presence::{Presence, VehicleParts};
use restarts::Restarts;

/// Messages to the supervisor; it stops by [`NodeHandle::stop`].
#[derive(Debug)]
pub enum NodeMessage {
    /// Log the state of the node.
    LogHealth,
    /// Report the state of the node to the service manager from now on.
    ReportTo {
        /// Service manager that started the node.
        manager: ServiceManager,
    },
    /// Use this description of the cell.
    Describe {
        /// The description to use from now on.
        description: Arc<CellDescription>,
    },
    /// Record the readiness of the node.
    RecordReadiness {
        /// Readiness for its task.
        readiness: Readiness,
    },
    /// Change the functions of this node for the vehicle, which moves from cell to cell.
    Move {
        /// Step by which the node enters or leaves its cell.
        step: MoveStep,
        /// Answered when the change is done.
        done: RpcReplyPort<()>,
    },
}

/// Starts and restarts the parts of a node.
#[derive(Debug, Default)]
struct Supervisor;

struct SupervisorState {
    builder: NodeBuilder,
    running: HashMap<ActorId, ActorKind>,
    restarts: Restarts,
    health: HealthLog,
    manager: Option<ServiceManager>,
}

/// A node that could not start or had to give up.
#[derive(Debug, Clone, thiserror::Error)]
pub enum NodeError {
    /// A part did not start, or the node gave up on one.
    #[error("{0}")]
    Failed(String),
    /// Another node has the name, and the cell accepts that node's messages.
    #[error(
        "another running node of the cell {cell} is called {name}: give one of them another name, or stop that one"
    )]
    NameTaken {
        /// The name of both.
        name: NodeName,
        /// Name of the cell of both.
        cell: NodeName,
    },
}

/// Handle of a running node, through which it is observed and stopped.
pub struct NodeHandle {
    supervisor: ActorRef<NodeMessage>,
    ended: JoinHandle<()>,
    failure: watch::Receiver<Option<NodeError>>,
    newest: Newest,
    broker: watch::Receiver<Option<SocketAddr>>,
    listens_at: watch::Receiver<Option<SocketAddr>>,
    gossip: watch::Receiver<Option<SocketAddr>>,
    members: watch::Receiver<Vec<Member>>,
    leadership: watch::Receiver<Leadership>,
    dashboard: watch::Receiver<Option<SocketAddr>>,
    slots: ActorSlots,
    counters: Arc<Counters>,
    frames: Arc<FrameCounters>,
    live_state: Arc<LiveState>,
    shared: watch::Receiver<SharedFacts>,
    cameras: Vec<ShownCamera>,
    further_cameras: watch::Sender<Vec<ShownCamera>>,
    name: NodeName,
}

/// Time between two log lines about a node's health.
const HEALTH_PERIOD: Duration = Duration::from_secs(30);

/// A node that starts. Boxed, so that it is compiled once and not in every program that starts a
/// node.
pub type Starting = Pin<Box<dyn Future<Output = Result<NodeHandle, NodeError>> + Send>>;

/// Starts a node; `config` is taken as valid.
///
/// # Errors
/// Returns a [`NodeError`] if a part cannot start, such as when the broker's port is busy.
pub fn start(config: NodeConfig) -> Starting {
    Box::pin(async move {
        let vehicle = VehicleParts::new(&config);
        start_with(vehicle, Presence::Active, config).await
    })
}

/// Starts a node of a vehicle up to its presence.
async fn start_with(
    vehicle: VehicleParts,
    presence: Presence,
    config: NodeConfig,
) -> Result<NodeHandle, NodeError> {
    let security = config
        .security()
        .map_err(|error| NodeError::Failed(error.to_string()))?;
    if let Some(credentials) = &security.credentials {
        let checked = credentials.check_rights(config.role, config.election.priority);
        checked.map_err(|error| NodeError::Failed(error.to_string()))?;
    }
    let cameras = vehicle.shown_cameras.clone();
    let further_cameras = vehicle.further_cameras.clone();
    let (failed, failure) = watch::channel(None);
    let held = HeldDescription::at_start(&config)?;
    let floor_plan = config
        .dashboard
        .load_floor_plan()
        .map_err(|error| NodeError::Failed(error.to_string()))?;
    let builder = NodeBuilder::new(vehicle, presence, config, security, held, failed)
        .with_floor_plan(floor_plan);
    let newest = builder.newest();
    let broker = builder.broker_address();
    let gossip = builder.gossip_address();
    let members = builder.members();
    let leadership = builder.leadership();
    let dashboard = builder.dashboard_address();
    let listens_at = builder.listens_at();
    let slots = builder.slots().clone();
    let counters = builder.counters();
    let frames = builder.frames();
    let live_state = builder.live_state();
    let shared = builder.shared();
    let name = builder.name().clone();
    let started = Actor::spawn(None, Supervisor, builder).await;
    let (supervisor, ended) =
        started.map_err(|error| NodeError::Failed(cause(error).to_string()))?;
    supervisor.send_interval(HEALTH_PERIOD, || NodeMessage::LogHealth);
    Ok(NodeHandle {
        supervisor,
        ended,
        failure,
        newest,
        broker,
        listens_at,
        gossip,
        members,
        leadership,
        dashboard,
        slots,
        counters,
        frames,
        live_state,
        shared,
        cameras,
        further_cameras,
        name,
    })
}

impl NodeHandle {
    /// The newest map of the cell, as it changes.
    pub fn newest_map(&self) -> watch::Receiver<Option<ReceivedMap>> {
        self.newest.map.subscribe()
    }

    /// The newest verdicts of the cell, as they change.
    pub fn newest_verdicts(&self) -> watch::Receiver<Option<Received<Verdicts>>> {
        self.newest.verdicts.subscribe()
    }

    /// The newest reputations of the cell, as they change.
    pub fn newest_reputations(&self) -> watch::Receiver<Option<Received<Reputations>>> {
        self.newest.reputations.subscribe()
    }

    /// Where the embedded broker listens for programs and, if it carries the cell, for nodes.
    pub fn listens_at(&self) -> Option<SocketAddr> {
        *self.listens_at.borrow()
    }

    /// Address at which the embedded broker listens for other nodes, if the node has a broker that
    /// may carry the cell's data.
    pub fn broker_address(&self) -> Option<SocketAddr> {
        *self.broker.borrow()
    }

    /// Address at which the node gossips; it may be unspecified.
    pub fn gossip_address(&self) -> Option<SocketAddr> {
        *self.gossip.borrow()
    }

    /// The other nodes of the cell, as they come and go.
    pub fn members(&self) -> watch::Receiver<Vec<Member>> {
        self.members.clone()
    }

    /// The other nodes of the cell that answer, without observers.
    pub fn other_nodes(&self) -> Vec<Member> {
        let members = self.members.borrow();
        let nodes = members.iter().filter(|member| !member.name.is_part());
        nodes.cloned().collect()
    }

    /// The cell's leadership, as it changes.
    pub fn leadership(&self) -> watch::Receiver<Leadership> {
        self.leadership.clone()
    }

    /// Where the dashboard listens, as soon as it does.
    pub fn dashboard_address(&self) -> watch::Receiver<Option<SocketAddr>> {
        self.dashboard.clone()
    }

    /// Where the node's actors are reached.
    pub fn slots(&self) -> &ActorSlots {
        &self.slots
    }

    /// Counters of the node, shared by its actors.
    pub fn counters(&self) -> &Arc<Counters> {
        &self.counters
    }

    /// The counters of the node's datagrams.
    pub fn frames(&self) -> &Arc<FrameCounters> {
        &self.frames
    }

    /// Current troubles of the cell: troubles of this node, and troubles in other nodes' statuses.
    pub fn troubles(&self) -> Vec<(Option<NodeName>, Trouble)> {
        let leader = self.leadership().borrow().leader().cloned();
        self.live_state.troubles(
            &self.name,
            leader.as_ref(),
            self.counters.troubles().present(),
        )
    }

    /// The node's cameras whose pictures its page shows.
    pub fn cameras(&self) -> &[ShownCamera] {
        &self.cameras
    }

    /// Shows the pictures of these cameras on the node's page, too. They belong to other nodes of
    /// this process, and replace those shown before.
    pub fn show_cameras(&self, further: Vec<ShownCamera>) {
        self.further_cameras.send_replace(further);
    }

    /// Makes the supervisor report the node's state to a service manager until it ends.
    pub fn report_to(&self, manager: ServiceManager) {
        // `failed` detects a supervisor that has ended.
        let _ = self.supervisor.cast(NodeMessage::ReportTo { manager });
    }

    /// Waits until the node has given up.
    ///
    /// # Errors
    /// Always returns a [`NodeError`] with the reason, because a node does not end successfully by
    /// itself.
    pub async fn failed(&mut self) -> Result<(), NodeError> {
        let why = self
            .failure
            .wait_for(Option::is_some)
            .await
            .ok()
            .and_then(|why| why.clone());
        Err(why.unwrap_or_else(|| NodeError::Failed("the supervisor ended".into())))
    }

    /// Stops all parts, the camera first and the broker last, and waits until they have ended.
    pub async fn stop(self) {
        self.supervisor.stop(None);
        if self.ended.await.is_err() {
            tracing::warn!("the supervisor did not end well");
        }
    }
}

impl Actor for Supervisor {
    type Msg = NodeMessage;
    type State = SupervisorState;
    type Arguments = NodeBuilder;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        builder: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let mut state = SupervisorState {
            builder,
            running: HashMap::new(),
            restarts: Restarts::default(),
            health: HealthLog::default(),
            manager: None,
        };
        for part in state.builder.parts() {
            state.start(part, &myself.get_cell()).await?;
        }
        Ok(state)
    }

    async fn handle(
        &self,
        myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            NodeMessage::LogHealth => state.log_health(),
            NodeMessage::ReportTo { mut manager } => {
                manager.started();
                tokio::spawn(watch_readiness(
                    state.builder.vitals(),
                    manager.period(),
                    myself,
                ));
                state.manager = Some(manager);
            }
            NodeMessage::Describe { description } => {
                state.builder.describe(&description);
                // The settings may require a part that was not needed before.
                state.start_missing(&myself.get_cell()).await?;
            }
            NodeMessage::Move { step, done } => {
                state.apply_step(step, &myself.get_cell()).await?;
                // A caller that has stopped waiting needs no answer.
                let _ = done.send(());
            }
            NodeMessage::RecordReadiness { mut readiness } => {
                // Between two cells there is no leader, and a restart would begin in the home cell.
                readiness.needs_restart &= !state.builder.moves_on();
                if let Some(manager) = &mut state.manager {
                    manager.beat(readiness);
                }
            }
        }
        Ok(())
    }

    /// Handles the end of a part: starts it again. Too many ends within [`RESTART_SPAN`], or a part
    /// that does not start, end the node.
    ///
    /// # Example
    /// The fuser panics while the node leads. Its actor is started again, the election gets
    /// `FuserRestarted` and resigns, and the standby leads.
    async fn handle_supervisor_evt(
        &self,
        myself: ActorRef<Self::Msg>,
        event: SupervisionEvent,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let (actor, why) = match event {
            SupervisionEvent::ActorTerminated(actor, last, why) => {
                // A killed part lives on in its state, such as the broker with its port; ending it
                // may take a while.
                tokio::task::spawn_blocking(|| drop(last));
                (actor, why.unwrap_or_else(|| "stopped".into()))
            }
            SupervisionEvent::ActorFailed(actor, error) => (actor, error.to_string()),
            SupervisionEvent::ActorStarted(_) | SupervisionEvent::ProcessGroupChanged(_) => {
                return Ok(());
            }
        };
        let Some(part) = state.running.remove(&actor.get_id()) else {
            return Ok(());
        };
        tracing::warn!(%part, why, "part ended, starting it anew");
        let restarted = if state.restarts.allow(clock::now()) {
            state.start(part, &myself.get_cell()).await
        } else {
            Err(format!(
                "parts ended more than {MAX_RESTARTS} times in {}, the last: {part}: {why}",
                in_words(RESTART_SPAN)
            )
            .into())
        };
        restarted.inspect_err(|error| state.builder.give_up(NodeError::Failed(error.to_string())))
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        if let Some(manager) = &mut state.manager {
            manager.stopping();
        }
        state.running.clear();
        state.builder.stop_all().await;
        Ok(())
    }
}

impl SupervisorState {
    fn log_health(&mut self) {
        let counters = self.builder.counters();
        let frames = self.builder.frames();
        self.health.log(&counters, &frames);
    }

    async fn start(
        &mut self,
        part: ActorKind,
        supervisor: &ActorCell,
    ) -> Result<(), ActorProcessingErr> {
        let actor = self.builder.start(part, supervisor.clone()).await?;
        self.running.insert(actor, part);
        Ok(())
    }
}

/// Queries the parts periodically and reports to the supervisor. If a part or the supervisor hangs,
/// the node does not count as ready. Ends with the supervisor.
async fn watch_readiness(vitals: Vitals, period: Duration, supervisor: ActorRef<NodeMessage>) {
    let mut ticks = tokio::time::interval(period);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let readiness = vitals.readiness(&vitals.probe().await);
        if supervisor
            .cast(NodeMessage::RecordReadiness { readiness })
            .is_err()
        {
            break;
        }
    }
}
