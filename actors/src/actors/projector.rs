//! The actor that places detections in the world and publishes them as reports.
//!
//! ```text
//! PoseReceiver ── HandlePose ───────────────────┐
//! Detector ── Report ────────────────────────> Projector ── PublishReport ──> Gateway
//!                                                    └─ frame with boxes ─> CameraFeed, while a browser looks
//! ```

use std::collections::VecDeque;
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
use tokio::task::spawn_blocking;

use crate::camera::frame::CameraFrame;
use crate::camera::image_size::ImageSize;
use crate::camera::lens::Lens;
use crate::camera::perception::Perception;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::gateway::GatewayMessage;
use crate::messages::projector::ProjectorMessage;
use crate::observe::dashboard::{CameraFeed, PictureBox, camera_event};
use crate::platform::cell_clock::CellClock;
use crate::telemetry::camera_troubles::CameraTroubles;
use crate::telemetry::counters::{Counters, Event};

/// Arguments of a projector's start.
pub struct ProjectorArguments {
    /// Projection of the camera, and the landmarks of its cell.
    pub perception: Perception,
    /// The pose of a vehicle that stands still, if available.
    pub standing: Option<Pose>,
    /// The place of the cell's frame on Earth.
    pub origin: Option<GeographicOrigin>,
    /// True for a moving vehicle, whose poses are received.
    pub is_moving: bool,
    /// The vehicle's most recent poses.
    pub recent_poses: VecDeque<(Timestamp, StatedPose)>,
    /// True for a fixed camera.
    pub is_fixed: bool,
    /// Algorithms to report for.
    pub algorithms: Algorithms,
    /// The cell's time, in which reports state their capture.
    pub clock: CellClock,
    /// Publisher of the reports.
    pub gateway: ActorSlot<GatewayMessage>,
    /// Shows frames with their boxes, if the page shows the camera.
    pub camera_feed: Option<Arc<CameraFeed>>,
    /// Troubles of the camera.
    pub troubles: CameraTroubles,
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
    is_fixed: bool,
    /// Recent poses of a moving vehicle.
    poses: Option<PoseHistory>,
    /// True once the log contains the reason why a pose is not used.
    is_pose_problem_logged: bool,
    algorithms: Algorithms,
    clock: CellClock,
    gateway: ActorSlot<GatewayMessage>,
    camera_feed: Option<Arc<CameraFeed>>,
    troubles: CameraTroubles,
    counters: Arc<Counters>,
}

impl Actor for Projector {
    type Msg = ProjectorMessage;
    type State = ProjectorState;
    type Arguments = ProjectorArguments;

    async fn pre_start(
        &self,
        _myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let ProjectorArguments {
            perception,
            standing,
            origin,
            is_moving,
            recent_poses,
            is_fixed,
            algorithms,
            clock,
            gateway,
            camera_feed,
            troubles,
            counters,
        } = arguments;
        let mut state = ProjectorState {
            perception,
            standing,
            origin,
            is_fixed,
            poses: is_moving.then(PoseHistory::default),
            is_pose_problem_logged: false,
            algorithms,
            clock,
            gateway,
            camera_feed,
            troubles,
            counters,
        };
        for (at, pose) in recent_poses {
            state.on_pose(at, &pose);
        }
        Ok(state)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        match message {
            ProjectorMessage::Report {
                detections,
                lens,
                captured_at,
                shown,
            } => {
                let image = ImageSize::from(&lens.intrinsics);
                let boxed = if shown.is_some() { &*detections } else { &[] };
                let mut boxes: Vec<_> = boxed
                    .iter()
                    .map(|detection| PictureBox::new(detection, image))
                    .collect();
                state.report(detections, &lens, captured_at, &mut boxes);
                if let Some(frame) = shown {
                    state.show(frame, boxes);
                }
            }
            ProjectorMessage::Configure {
                perception,
                standing,
                origin,
                algorithms,
            } => {
                state.perception = perception.continuing(&state.perception);
                state.standing = standing;
                state.algorithms = algorithms;
                state.move_to(origin);
            }
            ProjectorMessage::HandlePose { at, pose } => state.on_pose(at, &pose),
        }
        Ok(())
    }
}

impl ProjectorState {
    /// Continues in a frame with this origin. Poses in another frame are dropped.
    fn move_to(&mut self, origin: Option<GeographicOrigin>) {
        if self.origin != origin {
            self.origin = origin;
            self.poses = self.poses.as_ref().map(|_| PoseHistory::default());
            self.is_pose_problem_logged = false;
        }
    }

    /// Handles a pose of a moving vehicle, stated for time `at`. A pose without a place in the
    /// cell's frame, or not later than the last one, is counted; the first reason why a pose has no
    /// place is logged.
    fn on_pose(&mut self, at: Timestamp, stated: &StatedPose) {
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

    /// Publishes the report of a frame. The boxes of its detections are linked to the resulting
    /// objects.
    fn report(
        &mut self,
        detections: Vec<Detection>,
        lens: &Lens,
        captured_at: Timestamp,
        boxes: &mut [PictureBox],
    ) {
        let pose = self
            .poses
            .as_ref()
            .map_or(self.standing, |poses| poses.at(captured_at));
        let Some(pose) = pose else {
            self.troubles.record(
                TroubleKind::NoPose,
                "no pose is available near the time of the camera's frames",
            );
            return self.counters.count(Event::FrameWithoutPose);
        };
        self.perception.set_pose(pose);
        self.perception.set_lens(lens);
        let found = detections.len();
        let span = tracing::info_span!("project");
        let mut report = span.in_scope(|| self.perception.report(detections, captured_at));
        drop(span);
        for (detection, object) in self.perception.reported().iter().zip(&report.objects) {
            if let Some(shown) = boxes.get_mut(*detection) {
                shown.object = Some(object.clone());
            }
        }
        let ClockReading {
            offset_us,
            error_us,
        } = self.clock.reading();
        report.captured_at_us = captured_at.shifted(offset_us);
        report.clock_error_us = error_us;
        report.moving = self.is_fixed.then_some(false);
        self.counters.add(
            Event::DetectionUnplaced,
            (found - report.objects.len()) as u64,
        );
        if let Some(cause) = self.perception.without_size() {
            self.troubles.record(TroubleKind::NoSize, &cause);
        }
        if let Some(cause) = self.perception.nothing_placed() {
            self.troubles.record(TroubleKind::NotPlaced, &cause);
        }
        if let Some(cause) = self.perception.mount_mismatch() {
            self.troubles.record(TroubleKind::MountMismatch, &cause);
        }
        if self.algorithms.vote() {
            self.publish(ReportKind::VoteDetections, report.votes());
        }
        if self.algorithms.pace() {
            self.publish(ReportKind::Detections, report);
        }
    }

    /// Shows the frame in browsers. The next report does not wait for that.
    fn show(&self, frame: CameraFrame, boxes: Vec<PictureBox>) {
        let Some(feed) = self.camera_feed.clone() else {
            return;
        };
        let counters = Arc::clone(&self.counters);
        spawn_blocking(move || match camera_event(&frame, &boxes) {
            Ok(event) => {
                feed.show(event);
                counters.count(Event::FrameShown);
            }
            Err(error) => tracing::debug!(%error, "cannot encode frame for browsers"),
        });
    }

    fn publish(&self, kind: ReportKind, report: ObjectReport) {
        self.gateway.send(GatewayMessage::PublishReport {
            kind,
            report: Arc::new(report),
        });
    }
}
