//! The actor that detects objects in frames.
//!
//! ```text
//! capture threads ── latest frame ──> pump task ── Detect ──> Detector ── Report ──> Projector
//!                                         ▲                       │
//!                                         └── permit, when done ──┘
//! ```
//!
//! The pump takes the latest frame only when the detector is done with the previous one, so frames
//! do not queue.

use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ecod::diagnostics::TroubleKind;
use ecod::model::detection::Detection;
use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::{Semaphore, watch};
use tokio::task::{JoinSet, spawn_blocking};
use tokio::time::timeout;

use crate::camera::detect::{Detect, DetectError};
use crate::camera::frame::CameraFrame;
use crate::camera::frame_source::TimeSource;
use crate::camera::frame_source::capture::{
    Capture, CaptureConfig, CaptureStatus, Opener, Readers,
};
use crate::camera::image_size::{ImageSize, SizeMismatch};
use crate::camera::lens::Lens;
use crate::messages::actor_slot::ActorSlot;
use crate::messages::detector::DetectorMessage;
use crate::messages::projector::ProjectorMessage;
use crate::observe::dashboard::CameraFeed;
use crate::observe::recorder::ImageRecorder;
use crate::telemetry::camera_troubles::CameraTroubles;
use crate::telemetry::counters::{Counters, Event};
use crate::telemetry::spans::Spans;

/// Arguments of a detector's start.
pub struct DetectorArguments {
    /// Opens the frame source.
    pub open: Opener,
    /// Stall timeout and retries of the source.
    pub capture: CaptureConfig,
    /// The detection algorithm, which runs outside the async threads.
    pub detect: Box<dyn Detect>,
    /// The camera's lens. Detections are scaled to the image size of this lens.
    pub lens: Lens,
    /// Receiver of the detections.
    pub projector: ActorSlot<ProjectorMessage>,
    /// Records some of the frames.
    pub images: Option<ImageRecorder>,
    /// Shows some of the frames, if the page shows the camera.
    pub camera_feed: Option<Arc<CameraFeed>>,
    /// Troubles of the camera.
    pub troubles: CameraTroubles,
    /// Counters of the node.
    pub counters: Arc<Counters>,
    /// Spans of the node in the vehicle's current cell.
    pub spans: watch::Receiver<Spans>,
    /// Age from which a report is refused.
    pub max_age: Duration,
}

/// Runs the detection algorithm repeatedly on the latest frame.
#[derive(Debug, Default)]
pub struct Detector;

/// The detector between frames.
pub struct DetectorState {
    /// Absent only while a frame is being processed.
    detect: Option<Box<dyn Detect>>,
    lens: Lens,
    /// The size mismatch of the last frame.
    mismatch: Option<SizeMismatch>,
    /// True if the detector failed on the last frame.
    failing: bool,
    max_age: Duration,
    /// Successive frames that took longer, and the frames skipped before them.
    slow_frames: u32,
    skipped_before: u64,
    projector: ActorSlot<ProjectorMessage>,
    images: Option<ImageRecorder>,
    camera_feed: Option<Arc<CameraFeed>>,
    troubles: CameraTroubles,
    counters: Arc<Counters>,
    pump: JoinSet<()>,
    readers: Readers,
}

/// A frame after the detection, with what the detection thread borrowed from the state.
struct DetectedFrame {
    detect: Box<dyn Detect>,
    images: Option<ImageRecorder>,
    frame: CameraFrame,
    outcome: Result<Vec<Detection>, DetectError>,
    took: Duration,
}

/// Successive frames that take too long, from which a detector is reported as slow.
const SLOW_FRAMES: u32 = 3;

/// Duration of one frame from which a detector is reported as slow before the frame is done.
const SLOW_AFTER: Duration = Duration::from_secs(5);
const SLOW_DETECTOR: &str = "the detector has been busy with one frame for more than 5 s: use smaller frames or another model";

/// Successive frames with wrong stamps, from which the camera's clock is reported as wrong: the first
/// frames of a stream may be old.
const WRONG_STAMPS: u32 = 10;
const WRONG_CLOCK: &str = "the camera states capture times after the arrival of its frames or more than 1 s before it: they count as captured on arrival";

/// Maximum time for the camera to end.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);

impl Actor for Detector {
    type Msg = DetectorMessage;
    type State = DetectorState;
    type Arguments = DetectorArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let DetectorArguments {
            open,
            capture,
            detect,
            lens,
            projector,
            images,
            camera_feed,
            troubles,
            counters,
            spans,
            max_age,
        } = arguments;
        let capture = Capture::start(open, capture)?;
        let readers = capture.readers();
        let skipped_before = counters.events(Event::FrameSkipped);
        let mut pumping = JoinSet::new();
        pumping.spawn(pump(
            capture,
            myself,
            troubles.clone(),
            Arc::clone(&counters),
            spans,
        ));
        let detect = Some(detect);
        Ok(DetectorState {
            detect,
            lens,
            mismatch: None,
            failing: false,
            max_age,
            slow_frames: 0,
            skipped_before,
            projector,
            images,
            camera_feed,
            troubles,
            counters,
            pump: pumping,
            readers,
        })
    }

    async fn post_stop(
        &self,
        _myself: ActorRef<Self::Msg>,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        state.pump.abort_all();
        let readers = state.readers.clone();
        spawn_blocking(move || readers.wait_for_end(STOP_TIMEOUT)).await?;
        Ok(())
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let DetectorMessage::Detect { frame, permit } = message;
        let Some(mut detect) = state.detect.take() else {
            return Err("the detector was lost".into());
        };
        let captured_at = frame.captured_at;
        let size = ImageSize::of(&frame.image);
        let mut images = state.images.take();
        let lens = state.lens;
        let span = tracing::info_span!("detect");
        let detected = spawn_blocking(move || {
            let begun = Instant::now();
            let outcome = span.in_scope(|| detect.detect(&frame));
            let took = begun.elapsed();
            drop(span);
            if let Some(images) = &mut images {
                images.offer(&frame, &lens, outcome.as_deref().unwrap_or_default());
            }
            DetectedFrame {
                detect,
                images,
                frame,
                outcome,
                took,
            }
        })
        .await?;
        state.detect = Some(detected.detect);
        state.images = detected.images;
        state.record_duration(detected.took);
        match detected.outcome {
            Ok(mut detections) => {
                if std::mem::take(&mut state.failing) {
                    state.troubles.settle(TroubleKind::Camera);
                }
                if let Some(lens) = state.scale(size, &mut detections) {
                    state.counters.count(Event::FrameDetected);
                    let shown = state
                        .camera_feed
                        .as_ref()
                        .is_some_and(|feed| feed.takes(captured_at))
                        .then_some(detected.frame);
                    state.projector.send(ProjectorMessage::Report {
                        detections,
                        lens,
                        captured_at,
                        shown,
                    });
                } else {
                    state.counters.count(Event::FrameFailed);
                }
            }
            Err(error) => {
                state.counters.count(Event::FrameFailed);
                state
                    .troubles
                    .record(TroubleKind::Camera, &error.to_string());
                state.failing = true;
            }
        }
        drop(permit);
        Ok(())
    }
}

impl DetectorState {
    /// Records whether the detector is too slow, by the measured time of a frame.
    fn record_duration(&mut self, took: Duration) {
        if took < self.max_age {
            self.slow_frames = 0;
            self.skipped_before = self.counters.events(Event::FrameSkipped);
            return self.troubles.settle(TroubleKind::DetectorSlow);
        }
        self.slow_frames += 1;
        if self.slow_frames >= SLOW_FRAMES {
            let skipped = self.counters.events(Event::FrameSkipped) - self.skipped_before;
            let cause = format!(
                "the detector takes {:.1} s for a frame and has skipped {skipped}: reports older than {:.1} s are not used",
                took.as_secs_f64(),
                self.max_age.as_secs_f64()
            );
            self.troubles.record(TroubleKind::DetectorSlow, &cause);
        }
    }

    /// Scales detections to the image size of the lens. Returns the lens; `None` for a frame of a
    /// shape that the lens does not accept.
    fn scale(&mut self, frame: ImageSize, detections: &mut [Detection]) -> Option<Lens> {
        let scaled = self.lens.fitted(frame, detections);
        let mismatch = scaled.as_ref().err().copied();
        match &mismatch {
            Some(error) => self
                .troubles
                .record(TroubleKind::Camera, &error.to_string()),
            None if self.mismatch.is_some() => self.troubles.settle(TroubleKind::Camera),
            None => {}
        }
        self.mismatch = mismatch;
        scaled.ok()
    }
}

/// Sends the latest frame whenever the detector is ready, until the source or the detector ends.
async fn pump(
    capture: Capture,
    detector: ActorRef<DetectorMessage>,
    troubles: CameraTroubles,
    counters: Arc<Counters>,
    spans: watch::Receiver<Spans>,
) {
    let permits = Arc::new(Semaphore::new(1));
    let mut status = capture.status();
    let mut skipped = 0;
    let mut unusable = 0;
    let mut failures = 0;
    let mut wrong_stamps = 0;
    loop {
        let mut ready = pin!(Arc::clone(&permits).acquire_owned());
        let permit = loop {
            match timeout(SLOW_AFTER, &mut ready).await {
                Ok(Ok(permit)) => break permit,
                Ok(Err(_)) => return,
                Err(_) => troubles.record(TroubleKind::DetectorSlow, SLOW_DETECTOR),
            }
        };
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
            match &*status.borrow() {
                CaptureStatus::Failed { error, .. } => {
                    troubles.record(
                        TroubleKind::Camera,
                        &format!("the camera gives no frames: {error}"),
                    );
                }
                CaptureStatus::Ended => {}
                _ => troubles.settle(TroubleKind::Camera),
            }
        };
        let Some(frame) = frame else {
            troubles.record(
                TroubleKind::Camera,
                "the camera's frames have ended: set `looping` of its source, or another source",
            );
            return;
        };
        wrong_stamps = match capture.time_source() {
            Some(TimeSource::WrongStamp) => wrong_stamps + 1,
            _ => 0,
        };
        if wrong_stamps >= WRONG_STAMPS {
            troubles.record(TroubleKind::CameraClock, WRONG_CLOCK);
        }
        let span = spans.borrow().frame(frame.captured_at);
        if span.in_scope(|| {
            detector
                .cast(DetectorMessage::Detect { frame, permit })
                .is_err()
        }) {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::sync::mpsc::{Receiver, channel};

    use ecod::model::names::NodeName;
    use ecod::perception::camera::Intrinsics;
    use opencv::core::{CV_8UC3, Mat, Scalar};

    use super::*;
    use crate::camera::config::CameraConfig;
    use crate::camera::frame_source::{FrameError, FrameSource};
    use crate::platform::clock;

    /// A camera whose clock is wrong.
    struct WrongClock;

    impl FrameSource for WrongClock {
        fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
            std::thread::sleep(Duration::from_millis(10));
            Ok(CameraFrame {
                image: Mat::new_rows_cols_with_default(48, 64, CV_8UC3, Scalar::all(0.0)).unwrap(),
                captured_at: clock::now(),
                seq: 0,
            })
        }

        fn time_source(&self) -> TimeSource {
            TimeSource::WrongStamp
        }
    }

    /// A model that is too large for its machine: each frame takes until the test releases it.
    struct Slow(Receiver<()>);

    impl Detect for Slow {
        fn detect(&mut self, _: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
            self.0.recv().ok();
            Ok(Vec::new())
        }
    }

    /// A model whose frames take the same time, which the test changes.
    struct Steady(Arc<AtomicU64>);

    impl Detect for Steady {
        fn detect(&mut self, _: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
            std::thread::sleep(Duration::from_millis(self.0.load(Ordering::Relaxed)));
            Ok(Vec::new())
        }
    }

    /// Arguments of a detector that gets ten frames a second, with reports that are used for 0.2 s.
    fn arguments(detect: impl Detect + 'static, counters: &Arc<Counters>) -> DetectorArguments {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/photos");
        let camera: CameraConfig = toml::from_str(&format!(
            "source = {{ kind = \"images\", path = {path:?}, looping = true }}\n\
             detector.kind = \"placard\""
        ))
        .unwrap();
        DetectorArguments {
            open: camera.opener(Duration::from_secs(5)),
            capture: CaptureConfig::default(),
            detect: Box::new(detect),
            lens: Lens {
                is_any_shape: true,
                ..Lens::ideal(Intrinsics::with_square_pixels(640, 480, 1.0))
            },
            projector: ActorSlot::default(),
            images: None,
            camera_feed: None,
            troubles: CameraTroubles::new(Arc::clone(counters), None),
            counters: Arc::clone(counters),
            spans: watch::channel(Spans::new(
                NodeName::from_static("cell"),
                NodeName::from_static("euclid"),
            ))
            .1,
            max_age: Duration::from_millis(200),
        }
    }

    #[tokio::test]
    async fn late_reports_mark_detector_slow() {
        let counters = Arc::<Counters>::default();
        let frame_ms = Arc::new(AtomicU64::new(300));
        let detector = arguments(Steady(Arc::clone(&frame_ms)), &counters);
        let (detector, ended) = Actor::spawn(None, Detector, detector).await.unwrap();
        let cause = || {
            let mut troubles = counters.troubles().present().into_iter();
            troubles.find_map(|it| (it.kind == "detector_slow").then_some(it.cause))
        };
        let until = async |is_slow: bool| {
            while cause().is_some() != is_slow {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        timeout(Duration::from_secs(60), until(true)).await.unwrap();
        let text = cause().unwrap();
        assert!(
            text.starts_with("the detector takes 0.3 s for a frame"),
            "{text}"
        );
        assert!(counters.events(Event::FrameSkipped) > 0);
        frame_ms.store(0, Ordering::Relaxed);
        timeout(Duration::from_secs(60), until(false))
            .await
            .unwrap();
        detector.stop(None);
        ended.await.unwrap();
    }

    #[tokio::test]
    async fn wrong_camera_clock_is_trouble() {
        let counters = Arc::<Counters>::default();
        let arguments = DetectorArguments {
            open: Arc::new(|| Ok(Box::new(WrongClock))),
            ..arguments(Steady(Arc::default()), &counters)
        };
        let (detector, ended) = Actor::spawn(None, Detector, arguments).await.unwrap();
        let reported = async {
            loop {
                if let Some(trouble) = counters.troubles().present().pop() {
                    return trouble;
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        let trouble = timeout(Duration::from_secs(60), reported).await.unwrap();
        assert_eq!(
            (&*trouble.kind, &*trouble.cause),
            ("camera_clock", WRONG_CLOCK)
        );
        assert!(trouble.remedy.contains("`camera.source.latency_s`"));
        detector.stop(None);
        ended.await.unwrap();
    }

    #[tokio::test]
    async fn unfinished_frame_is_trouble() {
        let (done, waits) = channel();
        let counters = Arc::<Counters>::default();
        let detector = arguments(Slow(waits), &counters);
        let (detector, ended) = Actor::spawn(None, Detector, detector).await.unwrap();
        let until = async |is_slow: bool| {
            let is_reported = || {
                counters
                    .troubles()
                    .present()
                    .iter()
                    .any(|trouble| trouble.cause == SLOW_DETECTOR)
            };
            while is_reported() != is_slow {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        timeout(Duration::from_secs(60), until(true))
            .await
            .expect("no trouble was reported");
        drop(done);
        timeout(Duration::from_secs(60), until(false))
            .await
            .expect("it is over");
        detector.stop(None);
        ended.await.unwrap();
    }
}
