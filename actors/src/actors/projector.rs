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
use ecod::diagnostics::TroubleKind;
use ecod::leadership::cell_time::ClockReading;
use ecod::model::detection::Detection;
use ecod::model::geometry::Pose;
use ecod::model::origin::{GeographicOrigin, StatedPose};
use ecod::model::time::Timestamp;
use ecod::perception::pose_history::PoseHistory;
use ecod::wire::{ObjectReport, ReportKind};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::task::JoinSet;

use crate::camera::lens::Lens;
use crate::camera::perception::Perception;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::gateway::GatewayMessage;
use crate::messages::projector::ProjectorMessage;
use crate::platform::cell_clock::CellClock;
use crate::telemetry::counters::{Counters, Event};

/// Arguments of a projector's start.
pub struct ProjectorArguments {
    /// Camera and known locations.
    pub perception: Perception,
    /// The pose of a vehicle that stands still, if it is known.
    pub standing: Option<Pose>,
    /// The place of the cell's frame on Earth.
    pub origin: Option<GeographicOrigin>,
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
    standing: Option<Pose>,
    origin: Option<GeographicOrigin>,
    /// Recent poses of a moving vehicle.
    poses: Option<PoseHistory>,
    /// True once the log has said why a pose is not used.
    is_pose_problem_logged: bool,
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
        let ProjectorArguments { perception, standing, origin, poses, algorithms, clock, gateway, counters } =
            arguments;
        let mut feed = JoinSet::new();
        if let Some(address) = poses {
            feed.spawn(pose_feed::listen(address, myself, Arc::clone(&counters)));
        }
        Ok(ProjectorState {
            perception,
            standing,
            origin,
            poses: poses.map(|_| PoseHistory::default()),
            is_pose_problem_logged: false,
            algorithms,
            clock,
            gateway,
            counters,
            _feed: feed,
        })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            ProjectorMessage::Report { detections, lens, captured_at } => state.report(detections, &lens, captured_at),
            ProjectorMessage::Configure { perception, standing, origin, algorithms } => {
                state.perception = perception.continuing(&state.perception);
                (state.standing, state.algorithms) = (standing, algorithms);
                state.move_to(origin);
            }
            ProjectorMessage::TakePose { at, pose } => state.take_pose(at, &pose),
        }
        Ok(())
    }
}

impl ProjectorState {
    /// Goes on in a frame with this origin. Poses in another one are forgotten.
    fn move_to(&mut self, origin: Option<GeographicOrigin>) {
        if self.origin != origin {
            self.origin = origin;
            self.poses = self.poses.as_ref().map(|_| PoseHistory::default());
            self.is_pose_problem_logged = false;
        }
    }

    fn take_pose(&mut self, at: Timestamp, stated: &StatedPose) {
        let Some(poses) = &mut self.poses else { return };
        let is_taken = match stated.in_map(self.origin.as_ref()) {
            Ok(pose) => poses.push(at, pose),
            Err(error) => {
                if !std::mem::replace(&mut self.is_pose_problem_logged, true) {
                    tracing::warn!(%error, "pose rejected, further ones are only counted");
                }
                false
            }
        };
        if !is_taken {
            self.counters.count(Event::PoseRejected);
        }
    }

    fn report(&mut self, detections: Vec<Detection>, lens: &Lens, captured_at: Timestamp) {
        let pose = self.poses.as_ref().map_or(self.standing, |poses| poses.at(captured_at));
        let Some(pose) = pose else {
            self.counters.troubles().note(TroubleKind::NoPose, "no pose is known near the time of the camera's frames");
            return self.counters.count(Event::FrameWithoutPose);
        };
        self.perception.set_pose(pose);
        self.perception.set_lens(lens);
        let found = detections.len();
        let span = tracing::info_span!("project");
        let mut report = span.in_scope(|| self.perception.report(detections, captured_at));
        drop(span);
        let ClockReading { offset_us, error_us } = self.clock.reading();
        (report.captured_at_us, report.clock_error_us) = (captured_at.shifted(offset_us), error_us);
        self.counters.add(Event::DetectionUnplaced, (found - report.objects.len()) as u64);
        if let Some(cause) = self.perception.without_size() {
            self.counters.troubles().note(TroubleKind::NoSize, &cause);
        }
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
pub fn votes(report: &ObjectReport) -> ObjectReport {
    let objects = report.objects.iter().filter(|object| object.landmark.is_some()).cloned().collect();
    let ObjectReport { node, seq, captured_at_us, pose, clock_error_us, .. } = report;
    let empty = ObjectReport::new(node.clone(), *seq, *captured_at_us);
    ObjectReport { pose: *pose, objects, clock_error_us: *clock_error_us, ..empty }
}
