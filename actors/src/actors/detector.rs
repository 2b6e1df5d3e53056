//! The actor that looks at frames.
//!
//! ```text
//! capture threads ── latest frame ──> pump task ── Look ──> Detector ── Report ──> Projector
//!                                         ▲                     │
//!                                         └── done with the last one
//! ```
//!
//! The pump takes the latest frame only when the detector is done with the one before, so frames never queue up.

use std::sync::Arc;

use ecod::detection::Detection;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::Semaphore;
use tokio::task::{JoinHandle, spawn_blocking};

use crate::camera::detect::Detect;
use crate::camera::frame_source::capture::{Capture, CaptureConfig, Opener};
use crate::camera::image_size::{ImageSize, SizeMismatch};
use crate::messages::actor_slot::ActorSlot;
use crate::messages::detector::DetectorMessage;
use crate::messages::projector::ProjectorMessage;
use crate::observe::recorder::ImageRecorder;
use crate::telemetry::counters::{Counters, Event};
use crate::telemetry::spans::Spans;

/// What a detector needs at its start.
pub struct DetectorArguments {
    /// Opens the frame source.
    pub open: Opener,
    /// When the source counts as stalled.
    pub capture: CaptureConfig,
    /// Finds the objects.
    pub detect: Box<dyn Detect>,
    /// The image that the camera's optics describe; detections are handed on as of this size.
    pub optics: ImageSize,
    /// Gets the detections.
    pub projector: ActorSlot<ProjectorMessage>,
    /// Gets the frames that were looked at, to record some.
    pub pictures: Option<ImageRecorder>,
    /// The node's counters.
    pub counters: Arc<Counters>,
    /// The node's spans.
    pub spans: Spans,
}

/// Looks at the latest frame, again and again.
#[derive(Debug, Default)]
pub struct Detector;

/// The detector between frames.
pub struct DetectorState {
    /// Away only while a frame is being looked at.
    detect: Option<Box<dyn Detect>>,
    optics: ImageSize,
    /// The last mismatch, told of once.
    mismatch: Option<SizeMismatch>,
    /// Whether the last frame could not be looked at: the first in a row is told of.
    failing: bool,
    projector: ActorSlot<ProjectorMessage>,
    pictures: Option<ImageRecorder>,
    counters: Arc<Counters>,
    pump: JoinHandle<()>,
}

impl Actor for Detector {
    type Msg = DetectorMessage;
    type State = DetectorState;
    type Arguments = DetectorArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let DetectorArguments { open, capture, detect, optics, projector, pictures, counters, spans } = arguments;
        let capture = Capture::start(open, capture)?;
        let pump = tokio::spawn(pump(capture, myself, Arc::clone(&counters), spans));
        let detect = Some(detect);
        Ok(DetectorState { detect, optics, mismatch: None, failing: false, projector, pictures, counters, pump })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let DetectorMessage::Look { frame, turn } = message;
        let Some(mut detect) = state.detect.take() else { return Err("the detector was lost".into()) };
        let (captured_at, size) = (frame.captured_at, ImageSize::of(&frame.image));
        let mut pictures = state.pictures.take();
        let span = tracing::info_span!("detect");
        let (detect, pictures, outcome) = spawn_blocking(move || {
            let outcome = span.in_scope(|| detect.detect(&frame));
            drop(span);
            if let Some(pictures) = &mut pictures {
                pictures.offer(&frame);
            }
            (detect, pictures, outcome)
        })
        .await?;
        (state.detect, state.pictures) = (Some(detect), pictures);
        match outcome {
            Ok(mut detections) => {
                state.failing = false;
                if state.fits(size, &mut detections) {
                    state.counters.count(Event::FrameDetected);
                    state.projector.send(ProjectorMessage::Report { detections, captured_at });
                } else {
                    state.counters.count(Event::FrameFailed);
                }
            }
            Err(error) => {
                state.counters.count(Event::FrameFailed);
                if !std::mem::replace(&mut state.failing, true) {
                    tracing::warn!(%error, "frame not used, the first in a row");
                }
            }
        }
        drop(turn);
        Ok(())
    }
}

impl DetectorState {
    /// Reads the detections in the size that the optics describe; false, and told of once, when that cannot be.
    fn fits(&mut self, frame: ImageSize, detections: &mut [Detection]) -> bool {
        let mismatch = self.optics.fit(frame, detections).err();
        if let Some(error) = mismatch
            && self.mismatch != mismatch
        {
            tracing::error!(%error, "frames not used");
        }
        self.mismatch = mismatch;
        mismatch.is_none()
    }
}

impl Drop for DetectorState {
    fn drop(&mut self) {
        self.pump.abort();
    }
}

/// Hands over the latest frame whenever the detector is ready, until the source or the detector ends.
async fn pump(capture: Capture, detector: ActorRef<DetectorMessage>, counters: Arc<Counters>, spans: Spans) {
    let turns = Arc::new(Semaphore::new(1));
    let mut status = capture.status();
    let (mut skipped, mut unusable, mut failures) = (0, 0, 0);
    while let Ok(turn) = Arc::clone(&turns).acquire_owned().await {
        let frame = loop {
            let frame = tokio::select! {
                frame = capture.next_frame() => Some(frame),
                Ok(()) = status.changed() => None,
            };
            for (event, total, counted) in [
                (Event::FrameSkipped, capture.skipped(), &mut skipped),
                (Event::FrameFailed, capture.unusable(), &mut unusable),
                (Event::SourceFailed, capture.failures(), &mut failures),
            ] {
                counters.add(event, total - std::mem::replace(counted, total));
            }
            if let Some(frame) = frame {
                break frame;
            }
        };
        let Some(frame) = frame else { return };
        let span = spans.frame(frame.captured_at);
        if span.in_scope(|| detector.cast(DetectorMessage::Look { frame, turn })).is_err() {
            return;
        }
    }
}
