//! The actor that places detections in the world and reports them.
//!
//! ```text
//! Detector ── Report ──> Projector ── PublishReport ──> Gateway
//! ```

use std::sync::Arc;

use ecod::detection::Detection;
use ecod::time::Timestamp;
use ractor::{Actor, ActorProcessingErr, ActorRef};

use crate::counters::{Counters, Event};
use crate::gateway::{GatewayMessage, ReportKind};
use crate::perception::Perception;
use crate::seat::Seat;

/// What the projector is asked to do.
#[derive(Debug)]
pub enum ProjectorMessage {
    /// Place the detections of one frame and publish them.
    Report {
        /// What the detector found, in pixels.
        detections: Vec<Detection>,
        /// When the frame was captured.
        captured_at: Timestamp,
    },
}

/// What a projector needs at its start.
pub struct ProjectorArguments {
    /// Camera, pose and known locations.
    pub perception: Perception,
    /// Where reports are published.
    pub gateway: Seat<GatewayMessage>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Turns each frame's detections into a report.
#[derive(Debug, Default)]
pub struct Projector;

impl Actor for Projector {
    type Msg = ProjectorMessage;
    type State = ProjectorArguments;
    type Arguments = ProjectorArguments;

    async fn pre_start(
        &self,
        _myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        Ok(arguments)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let ProjectorMessage::Report { detections, captured_at } = message;
        let found = detections.len();
        let report = Arc::new(state.perception.report(detections, captured_at));
        state.counters.add(Event::DetectionUnplaced, (found - report.objects.len()) as u64);
        state.gateway.send(GatewayMessage::PublishReport { kind: ReportKind::Detections, report });
        Ok(())
    }
}
