//! Presence of a node in its cell, and the parts that move along when a vehicle changes to another
//! cell.
//!
//! A moving vehicle temporarily has two nodes: the present node, and a second node in preparation for
//! the next cell. Cameras, poses, counters and addresses belong to the vehicle, and both nodes
//! share them. Detectors keep running; the next node's projectors replace the projectors of the
//! present node. A frame is therefore reported in one cell only.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;

use ecod::model::names::NodeName;
use ecod::model::origin::StatedPose;
use ecod::model::time::Timestamp;
use ractor::{ActorCell, ActorProcessingErr, ActorStatus};
use tokio::sync::watch;

#[cfg(feature = "camera")]
use super::camera;
use super::config::NodeConfig;
use super::slots::{ActorKind, ActorSlots};
use super::{NodeError, SupervisorState};
use crate::messages::actor_slot::ActorSlot;
#[cfg(feature = "camera")]
use crate::messages::detector::DetectorMessage;
use crate::messages::pose_receiver::PoseReceiverMessage;
#[cfg(feature = "camera")]
use crate::messages::projector::ProjectorMessage;
use crate::observe::dashboard::ShownCamera;
use crate::observe::recorder::LogSender;
use crate::telemetry::counters::Counters;
use crate::telemetry::spans::Spans;

/// How far a node has entered its cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Presence {
    /// The node follows the leader, while another node of the vehicle is present in another cell.
    Preparing,
    /// It reports, too.
    Reporting,
    /// The node also has page, local broker and log.
    Active,
}

/// Parts and addresses of which a vehicle has one, independent of its cell.
#[derive(Clone)]
pub(super) struct VehicleParts {
    /// The cell in which it is present.
    pub(super) present_cell: watch::Sender<NodeName>,
    pub(super) counters: Arc<Counters>,
    /// The present node's log and spans.
    pub(super) log: watch::Sender<LogSender>,
    pub(super) spans: watch::Sender<Spans>,
    /// The vehicle's most recent poses, the newest last.
    pub(super) poses: watch::Sender<VecDeque<(Timestamp, StatedPose)>>,
    pub(super) pose_receiver: ActorSlot<PoseReceiverMessage>,
    #[cfg(feature = "camera")]
    pub(super) projectors: Vec<ActorSlot<ProjectorMessage>>,
    #[cfg(feature = "camera")]
    pub(super) detectors: Vec<ActorSlot<DetectorMessage>>,
    /// The cameras, if the page shows their pictures.
    pub(super) shown_cameras: Vec<ShownCamera>,
    /// Cameras of other nodes of this process whose pictures the page shows, too.
    pub(super) further_cameras: watch::Sender<Vec<ShownCamera>>,
    /// Address of the broker, for any use.
    pub(super) listens_at: watch::Sender<Option<SocketAddr>>,
    pub(super) dashboard_address: watch::Sender<Option<SocketAddr>>,
}

impl VehicleParts {
    /// The parts of a vehicle with this configuration.
    pub(super) fn new(config: &NodeConfig) -> Self {
        #[cfg(feature = "camera")]
        let (projectors, detectors) = config.all_cameras().map(|_| Default::default()).unzip();
        #[cfg(feature = "camera")]
        let shown_cameras = camera::shown(config);
        #[cfg(not(feature = "camera"))]
        let shown_cameras = Vec::new();
        let counters = Arc::<Counters>::default();
        let name = config.name.clone().unwrap_or(NodeName::from_static("node"));
        Self {
            present_cell: watch::Sender::new(config.cell.clone()),
            log: watch::Sender::new(LogSender::new(Arc::clone(&counters))),
            spans: watch::Sender::new(Spans::new(config.cell.clone(), name)),
            counters,
            poses: watch::Sender::default(),
            pose_receiver: ActorSlot::default(),
            #[cfg(feature = "camera")]
            projectors,
            #[cfg(feature = "camera")]
            detectors,
            shown_cameras,
            further_cameras: watch::Sender::default(),
            listens_at: watch::Sender::new(None),
            dashboard_address: watch::Sender::new(None),
        }
    }

    /// Slots of a node of the vehicle.
    pub(super) fn slots(&self) -> ActorSlots {
        ActorSlots {
            pose_receiver: self.pose_receiver.clone(),
            #[cfg(feature = "camera")]
            projectors: self.projectors.clone(),
            #[cfg(feature = "camera")]
            detectors: self.detectors.clone(),
            ..ActorSlots::default()
        }
    }

    /// Running parts that move along with the vehicle.
    fn running(&self) -> Vec<(ActorKind, ActorCell)> {
        let poses = self
            .pose_receiver
            .get()
            .map(|actor| (ActorKind::PoseReceiver, actor.get_cell()));
        #[cfg_attr(
            not(feature = "camera"),
            expect(unused_mut, reason = "there is no more without cameras")
        )]
        let mut running = Vec::from_iter(poses);
        #[cfg(feature = "camera")]
        for (camera, detector) in self.detectors.iter().enumerate() {
            running.extend(
                detector
                    .get()
                    .map(|actor| (ActorKind::Detector(camera), actor.get_cell())),
            );
        }
        running
    }
}

/// A step of a vehicle's change to another cell, for one of its two nodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MoveStep {
    /// Stop the local broker, so that another node of the vehicle can use its address.
    CloseDoor,
    /// Release the vehicle's running parts. The projectors run until the next node's projectors
    /// replace them.
    HandOver,
    /// Take over the vehicle's running parts, and report from now on.
    TakeOver,
    /// Start page, local broker and log again.
    Activate,
}

impl SupervisorState {
    /// Carries out a step of the vehicle's change to another cell.
    pub(super) async fn apply_step(
        &mut self,
        step: MoveStep,
        supervisor: &ActorCell,
    ) -> Result<(), ActorProcessingErr> {
        let started = match step {
            MoveStep::CloseDoor => {
                self.close_door().await;
                Ok(())
            }
            MoveStep::HandOver => {
                self.hand_over(supervisor);
                Ok(())
            }
            MoveStep::TakeOver => self.take_over(supervisor).await,
            MoveStep::Activate => self.advance(Presence::Active, supervisor).await,
        };
        started.inspect_err(|error| self.builder.give_up(NodeError::Failed(error.to_string())))
    }

    /// Continues to this presence: starts the parts that it adds.
    async fn advance(
        &mut self,
        presence: Presence,
        supervisor: &ActorCell,
    ) -> Result<(), ActorProcessingErr> {
        self.builder.set_presence(presence);
        self.start_missing(supervisor).await
    }

    /// Starts the parts that the node should have now and that are not running.
    pub(super) async fn start_missing(
        &mut self,
        supervisor: &ActorCell,
    ) -> Result<(), ActorProcessingErr> {
        for part in self.builder.parts() {
            if !self.running.values().any(|running| *running == part) {
                self.start(part, supervisor).await?;
            }
        }
        Ok(())
    }

    /// Leaves the cell: camera and pose receiver continue without this node, until the vehicle's
    /// node in another cell takes them over.
    fn hand_over(&mut self, supervisor: &ActorCell) {
        self.builder.set_presence(Presence::Preparing);
        self.running.retain(|_, part| !part.is_of_vehicle());
        for (_, part) in self.builder.vehicle().running() {
            part.unlink(supervisor.clone());
        }
        self.manager = None;
        self.builder.counters().troubles().leave_cell();
    }

    /// Takes over camera and pose receiver from the vehicle's node in the previous cell, and
    /// reports in this cell from now on. A part that has just ended is started again.
    async fn take_over(&mut self, supervisor: &ActorCell) -> Result<(), ActorProcessingErr> {
        for (kind, part) in self.builder.vehicle().running() {
            part.link(supervisor.clone());
            // A part that has just ended is restarted.
            if part.get_status() <= ActorStatus::Upgrading {
                self.running.insert(part.get_id(), kind);
            }
        }
        self.builder.take_frames();
        self.advance(Presence::Reporting, supervisor).await
    }

    async fn close_door(&mut self) {
        self.builder.set_presence(Presence::Reporting);
        self.running.retain(|_, part| *part != ActorKind::Broker);
        self.builder.stop_broker().await;
    }
}
