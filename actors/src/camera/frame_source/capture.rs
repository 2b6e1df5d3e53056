//! Runs a source on its own threads: the latest frame wins, and a source that fails or stalls is
//! reopened.
//!
//! ```text
//! reader thread (one per opening) --frames, errors--> capture thread --latest frame--> slot --> detector
//! ```
//!
//! A driver or a file system may block forever. The capture thread then abandons the reader, which
//! ends when that returns, and reopens the source on a new one.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender};
use std::sync::{Arc, LazyLock};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use ecod::config::{ConfigError, check_range};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::{FrameError, FrameSource, TimeSource};
use crate::camera::frame::CameraFrame;
use crate::platform::latest_slot::LatestSlot;

/// Stall timeout and retries of a source.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CaptureConfig {
    /// Seconds without a frame after which a source is reopened. Default 5. Must exceed the start
    /// time of the camera.
    pub stall_timeout_s: f64,
    /// Seconds before the first retry. Default 0.5. Doubles with each failure in a row.
    pub retry_min_s: f64,
    /// Maximum seconds between two attempts. Default 30.
    pub retry_max_s: f64,
}

impl Default for CaptureConfig {
    fn default() -> Self {
        Self {
            stall_timeout_s: 5.0,
            retry_min_s: 0.5,
            retry_max_s: 30.0,
        }
    }
}

impl CaptureConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("stall_timeout_s", self.stall_timeout_s, 0.01, 3600.0)?;
        check_range("retry_min_s", self.retry_min_s, 0.001, 3600.0)?;
        check_range("retry_max_s", self.retry_max_s, self.retry_min_s, 3600.0)
    }

    /// Wait after this many failures in a row, from 1.
    fn retry_after(&self, failures: u32) -> Duration {
        let doubled = self.retry_min_s * 2f64.powi(failures.saturating_sub(1).min(60) as i32);
        Duration::from_secs_f64(doubled.min(self.retry_max_s))
    }
}

/// State of a source.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub enum CaptureStatus {
    /// The source is being opened, or has delivered no frame yet.
    #[default]
    Opening,
    /// The last frame arrived in time.
    Running,
    /// The source failed and will be reopened.
    Failed {
        /// Error of the last attempt.
        error: FrameError,
        /// Failures in a row.
        failures: u32,
        /// Time to the next attempt.
        retry_after: Duration,
    },
    /// A file or sequence ended, and is not repeated.
    Ended,
}

/// Opens a source, for the first time or again.
pub type Opener = Arc<dyn Fn() -> Result<Box<dyn FrameSource>, FrameError> + Send + Sync>;

/// A running capture; stops when dropped.
#[derive(Debug)]
pub struct Capture {
    slot: Arc<LatestSlot<CameraFrame>>,
    status: watch::Receiver<CaptureStatus>,
    time_source: watch::Receiver<Option<TimeSource>>,
    events: SyncSender<CaptureEvent>,
    unusable: Arc<AtomicU64>,
    failures: Arc<AtomicU64>,
    readers: Readers,
}

impl Capture {
    /// Starts to capture. `open` is called on threads of the capture.
    ///
    /// # Errors
    /// Returns an error if the operating system gives no thread.
    pub fn start(open: Opener, config: CaptureConfig) -> std::io::Result<Self> {
        let slot = Arc::new(LatestSlot::default());
        let (status_sender, status) = watch::channel(CaptureStatus::default());
        let (time_source_sender, time_source) = watch::channel(None);
        let (events, inbox) = mpsc::sync_channel(1);
        let capture = CaptureLoop {
            open,
            config,
            slot: Arc::clone(&slot),
            status: status_sender,
            time_source: time_source_sender,
            events: events.clone(),
            inbox,
            opening: Arc::default(),
            abandoned: Vec::new(),
            captured: 0,
            unusable: Arc::default(),
            failures: Arc::default(),
            readers: Readers::default(),
        };
        let readers = capture.readers.clone();
        let unusable = Arc::clone(&capture.unusable);
        let failures = Arc::clone(&capture.failures);
        thread::Builder::new()
            .name("capture".into())
            .spawn(move || capture.run())?;
        Ok(Self {
            slot,
            status,
            time_source,
            events,
            unusable,
            failures,
            readers,
        })
    }

    /// Waits for the latest frame; `None` once the source ended. Numbers continue when the source
    /// is reopened.
    pub async fn next_frame(&self) -> Option<CameraFrame> {
        self.slot.take().await
    }

    /// Number of frames replaced by a later one before the detector took them.
    pub fn skipped(&self) -> u64 {
        self.slot.skipped()
    }

    /// Number of frames of a recording that are not images.
    pub fn unusable(&self) -> u64 {
        self.unusable.load(Ordering::Relaxed)
    }

    /// How the capture time of the latest frame was determined; `None` before the first frame.
    pub fn time_source(&self) -> Option<TimeSource> {
        *self.time_source.borrow()
    }

    /// Number of failures and stalls.
    pub fn failures(&self) -> u64 {
        self.failures.load(Ordering::Relaxed)
    }

    /// The readers of this capture.
    pub fn readers(&self) -> Readers {
        self.readers.clone()
    }

    /// State of the source as it changes.
    pub fn status(&self) -> watch::Receiver<CaptureStatus> {
        self.status.clone()
    }
}

impl Drop for Capture {
    fn drop(&mut self) {
        // The capture thread is gone if the source has ended.
        let _ = self.events.send(CaptureEvent::Stop);
    }
}

/// Number of running readers. They may be inside OpenCV, which must not be in use while the process
/// ends.
#[derive(Debug, Clone, Default)]
pub struct Readers(Arc<AtomicUsize>);

impl Readers {
    /// The readers of all captures in this process.
    pub fn of_process() -> &'static Self {
        static ALL: LazyLock<Readers> = LazyLock::new(Readers::default);
        &ALL
    }

    /// Waits at most `timeout` until all readers have ended.
    pub fn wait_for_end(&self, timeout: Duration) {
        let until = Instant::now() + timeout;
        while self.0.load(Ordering::SeqCst) > 0 && Instant::now() < until {
            thread::sleep(Duration::from_millis(2));
        }
    }
}

/// Counts a reader of a capture while it runs.
struct ReaderGuard(Readers);

impl ReaderGuard {
    fn new(readers: Readers) -> Self {
        for count in [&readers, Readers::of_process()] {
            count.0.fetch_add(1, Ordering::SeqCst);
        }
        Self(readers)
    }
}

impl Drop for ReaderGuard {
    fn drop(&mut self) {
        for count in [&self.0, Readers::of_process()] {
            count.0.fetch_sub(1, Ordering::SeqCst);
        }
    }
}

/// Maximum number of blocked readers.
const MAX_ABANDONED: usize = 4;

enum CaptureEvent {
    /// A result of the reader with this number.
    Read(u64, Result<CameraFrame, FrameError>),
    Stop,
}

/// Reason for the end of a reader.
enum Outcome {
    Failed(FrameError),
    Stopped,
}

struct CaptureLoop {
    open: Opener,
    config: CaptureConfig,
    slot: Arc<LatestSlot<CameraFrame>>,
    status: watch::Sender<CaptureStatus>,
    time_source: watch::Sender<Option<TimeSource>>,
    events: SyncSender<CaptureEvent>,
    inbox: Receiver<CaptureEvent>,
    /// Number of the current opening and its reader.
    opening: Arc<AtomicU64>,
    abandoned: Vec<JoinHandle<()>>,
    captured: u64,
    unusable: Arc<AtomicU64>,
    failures: Arc<AtomicU64>,
    readers: Readers,
}

impl CaptureLoop {
    fn run(mut self) {
        let mut failures = 0;
        loop {
            let before = self.captured;
            let outcome = self.read_until_failure();
            self.opening.fetch_add(1, Ordering::SeqCst);
            let error = match outcome {
                Outcome::Stopped => break,
                Outcome::Failed(FrameError::Ended { origin }) => {
                    tracing::info!(origin, "frame source ended");
                    self.status.send_replace(CaptureStatus::Ended);
                    break;
                }
                Outcome::Failed(error) => error,
            };
            failures = if self.captured > before {
                1
            } else {
                failures + 1
            };
            let retry_after = self.config.retry_after(failures);
            self.failures.fetch_add(1, Ordering::Relaxed);
            let retry_after_s = retry_after.as_secs_f64();
            tracing::info!(%error, failures, retry_after_s, "frame source failed");
            self.status.send_replace(CaptureStatus::Failed {
                error,
                failures,
                retry_after,
            });
            if self.is_stopped_within(retry_after) {
                break;
            }
        }
        self.opening.fetch_add(1, Ordering::SeqCst);
        self.slot.close();
    }

    /// Opens the source and passes on its frames.
    fn read_until_failure(&mut self) -> Outcome {
        let stall_timeout = Duration::from_secs_f64(self.config.stall_timeout_s);
        self.abandoned.retain(|reader| !reader.is_finished());
        if self.abandoned.len() >= MAX_ABANDONED {
            return Outcome::Failed(FrameError::Stalled(stall_timeout));
        }
        let opening = self.opening.load(Ordering::SeqCst);
        let reader = Reader {
            opening,
            current: Arc::clone(&self.opening),
            events: self.events.clone(),
            time_source: self.time_source.clone(),
        };
        let open = Arc::clone(&self.open);
        let running = ReaderGuard::new(self.readers.clone());
        let read = move || {
            let _running = running;
            reader.run(&open);
        };
        match thread::Builder::new().name("camera".into()).spawn(read) {
            Ok(reader) => self.abandoned.push(reader),
            Err(e) => {
                return Outcome::Failed(FrameError::Open {
                    origin: "a thread".into(),
                    reason: e.to_string(),
                });
            }
        }
        let mut deadline = Instant::now() + stall_timeout;
        let mut last_unusable = None;
        loop {
            match self
                .inbox
                .recv_timeout(deadline.saturating_duration_since(Instant::now()))
            {
                Ok(CaptureEvent::Stop) | Err(RecvTimeoutError::Disconnected) => {
                    return Outcome::Stopped;
                }
                Err(RecvTimeoutError::Timeout) => {
                    return Outcome::Failed(
                        last_unusable.unwrap_or(FrameError::Stalled(stall_timeout)),
                    );
                }
                Ok(CaptureEvent::Read(from, _)) if from != opening => {}
                Ok(CaptureEvent::Read(_, Err(FrameError::NotDue))) => {
                    deadline = Instant::now() + stall_timeout;
                }
                Ok(CaptureEvent::Read(_, Err(error @ FrameError::Unusable { .. }))) => {
                    if last_unusable.is_none() {
                        tracing::warn!(%error, "frame skipped; others until the next whole one are only counted");
                    }
                    last_unusable = Some(error);
                    self.unusable.fetch_add(1, Ordering::Relaxed);
                }
                Ok(CaptureEvent::Read(_, Err(error))) => return Outcome::Failed(error),
                Ok(CaptureEvent::Read(_, Ok(frame))) => {
                    deadline = Instant::now() + stall_timeout;
                    last_unusable = None;
                    if matches!(*self.status.borrow(), CaptureStatus::Failed { .. }) {
                        tracing::info!("frame source runs again");
                    }
                    self.status.send_if_modified(|status| {
                        std::mem::replace(status, CaptureStatus::Running) != CaptureStatus::Running
                    });
                    self.slot.put(CameraFrame {
                        seq: self.captured,
                        ..frame
                    });
                    self.captured += 1;
                }
            }
        }
    }

    fn is_stopped_within(&self, time: Duration) -> bool {
        let deadline = Instant::now() + time;
        loop {
            match self
                .inbox
                .recv_timeout(deadline.saturating_duration_since(Instant::now()))
            {
                Ok(CaptureEvent::Read(..)) => {}
                Err(RecvTimeoutError::Timeout) => return false,
                Ok(CaptureEvent::Stop) | Err(RecvTimeoutError::Disconnected) => return true,
            }
        }
    }
}

/// Reads one opening of the source until it fails or is abandoned.
struct Reader {
    opening: u64,
    current: Arc<AtomicU64>,
    events: SyncSender<CaptureEvent>,
    time_source: watch::Sender<Option<TimeSource>>,
}

impl Reader {
    fn run(self, open: &Opener) {
        let mut source = match open() {
            Ok(source) => source,
            Err(error) => return self.send(Err(error)),
        };
        while self.current.load(Ordering::SeqCst) == self.opening {
            let read = source.next_frame();
            if read.is_ok() {
                self.record_time_source(source.time_source());
            }
            let failed = read.as_ref().is_err_and(|error| !error.is_passing());
            self.send(read);
            if failed {
                return;
            }
        }
    }

    fn record_time_source(&self, present: TimeSource) {
        let is_new = self
            .time_source
            .send_if_modified(|last| last.replace(present) != Some(present));
        if is_new {
            tracing::info!(by = %present, "frames are dated");
        }
    }

    fn send(&self, read: Result<CameraFrame, FrameError>) {
        // The receiver is gone once the capture has ended.
        let _ = self.events.send(CaptureEvent::Read(self.opening, read));
    }
}

#[cfg(test)]
mod tests;
