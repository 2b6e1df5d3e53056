//! The actor that places detections in the world and publishes them as reports.
//!
//! ```text
//! localisation ── UDP ──> pose feed ── TakePose ──┐
//! Detector ── Report ────────────────────────> Projector ── PublishReport ──> Gateway
//! ```

mod pose_feed;

use std::net::SocketAddr;
use std::sync::Arc;

use ecod::aggregator::Algorithms;
use ecod::leadership::cell_time::ClockReading;
use ecod::model::detection::Detection;
use ecod::model::time::Timestamp;
use ecod::perception::pose_history::PoseHistory;
use ecod::wire::{ObjectReport, ReportKind};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::task::JoinSet;

use crate::camera::perception::Perception;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::gateway::GatewayMessage;
use crate::messages::projector::ProjectorMessage;
use crate::platform::cell_clock::CellClock;
use crate::telemetry::counters::{Counters, Event};

/// Arguments of a projector's start.
pub struct ProjectorArguments {
    /// Camera, pose and known locations.
    pub perception: Perception,
    /// UDP address for the poses of a moving vehicle.
    pub poses: Option<SocketAddr>,
    /// Algorithms to report for.
    pub algorithms: Algorithms,
    /// Dates the reports.
    pub clock: CellClock,
    /// Publisher of the reports.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Counters of the node.
    pub counters: Arc<Counters>,
}

/// Turns each frame's detections into a report for each algorithm.
#[derive(Debug, Default)]
pub struct Projector;

/// Perception and motion of the vehicle.
pub struct ProjectorState {
    perception: Perception,
    /// Recent poses of a moving vehicle.
    poses: Option<PoseHistory>,
    algorithms: Algorithms,
    clock: CellClock,
    gateway: ActorSlot<GatewayMessage>,
    counters: Arc<Counters>,
    /// Ends with the actor.
    _feed: JoinSet<()>,
}

impl Actor for Projector {
    type Msg = ProjectorMessage;
    type State = ProjectorState;
    type Arguments = ProjectorArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let ProjectorArguments { perception, poses, algorithms, clock, gateway, counters } = arguments;
        let mut feed = JoinSet::new();
        if let Some(address) = poses {
            feed.spawn(pose_feed::listen(address, myself, Arc::clone(&counters)));
        }
        let history = poses.map(|_| PoseHistory::default());
        Ok(ProjectorState { perception, poses: history, algorithms, clock, gateway, counters, _feed: feed })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            ProjectorMessage::Report { detections, captured_at } => state.report(detections, captured_at),
            ProjectorMessage::Configure { perception, algorithms } => {
                state.perception = perception.continuing(&state.perception);
                state.algorithms = algorithms;
            }
            ProjectorMessage::TakePose { at, pose } => {
                if state.poses.as_mut().is_some_and(|poses| !poses.push(at, pose)) {
                    state.counters.count(Event::PoseRejected);
                }
            }
        }
        Ok(())
    }
}

impl ProjectorState {
    fn report(&mut self, detections: Vec<Detection>, captured_at: Timestamp) {
        if let Some(poses) = &self.poses {
            let Some(pose) = poses.at(captured_at) else { return self.counters.count(Event::FrameWithoutPose) };
            self.perception.set_pose(pose);
        }
        let found = detections.len();
        let span = tracing::info_span!("project");
        let mut report = span.in_scope(|| self.perception.report(detections, captured_at));
        drop(span);
        let ClockReading { offset_us, error_us } = self.clock.reading();
        (report.captured_at_us, report.clock_error_us) = (captured_at.shifted(offset_us), error_us);
        self.counters.add(Event::DetectionUnplaced, (found - report.objects.len()) as u64);
        if self.algorithms.vote() {
            self.publish(ReportKind::VoteDetections, votes(&report));
        }
        if self.algorithms.pace() {
            self.publish(ReportKind::Detections, report);
        }
    }

    fn publish(&self, kind: ReportKind, report: ObjectReport) {
        self.gateway.send(GatewayMessage::PublishReport { kind, report: Arc::new(report) });
    }
}

/// The report as VOTE needs it: objects at known locations only.
fn votes(report: &ObjectReport) -> ObjectReport {
    let objects = report.objects.iter().filter(|object| object.landmark.is_some()).cloned().collect();
    let ObjectReport { node, seq, captured_at_us, pose, clock_error_us, .. } = report;
    let empty = ObjectReport::new(node.clone(), *seq, *captured_at_us);
    ObjectReport { pose: *pose, objects, clock_error_us: *clock_error_us, ..empty }
}
