//! Sources of frames: one trait, one file per kind. [`capture`] runs a source on its own thread.

pub mod capture;
mod capture_clock;
pub(crate) mod images;
pub(super) mod masked;
mod v4l2;
pub mod video;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use ecod::config::{ConfigError, check_range};
use ecod::logins::{HIDDEN, bare_address};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use self::capture_clock::TimeSource;
use self::images::ImageSequence;
use self::v4l2::V4l2Camera;
use self::video::VideoProcess;
use crate::camera::frame::CameraFrame;

/// Source of successive frames.
pub trait FrameSource: Send {
    /// Waits for the next frame; may block as long as the camera does.
    ///
    /// # Errors
    /// Returns a [`FrameError`]. After [`FrameError::Unusable`] and [`FrameError::NotDue`] the source
    /// continues; after other errors it must be reopened.
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError>;

    /// How the capture time of the latest frame was determined.
    fn time_source(&self) -> TimeSource;
}

/// Error of a frame source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub enum FrameError {
    /// The source cannot be opened.
    #[error("cannot open {origin}: {reason}")]
    Open {
        /// Device, pipeline, address or path.
        origin: String,
        /// Description of the problem.
        reason: String,
    },
    /// One frame is not an image; the source continues.
    #[error("cannot use {origin}: {reason}")]
    Unusable {
        /// Path of the frame, or the device.
        origin: String,
        /// Description of the problem.
        reason: String,
    },
    /// The next frame of a recording is due later, as in a pause of the recording; the source
    /// continues.
    #[error("the next frame is not due yet")]
    NotDue,
    /// A live source delivers no more frames.
    #[error("lost {origin}: {reason}")]
    Lost {
        /// Device, pipeline, address or path.
        origin: String,
        /// Description of the problem.
        reason: String,
    },
    /// A live source delivered no frame within the timeout.
    #[error("no frame for {0:?}")]
    Stalled(Duration),
    /// A file or sequence ended.
    #[error("{origin} ended")]
    Ended {
        /// Path of the file or sequence.
        origin: String,
    },
}

/// Minimum length of a secret that is searched in other texts: a shorter one is part of many words.
const MIN_SECRET_BYTES: usize = 4;

impl FrameError {
    /// The error without the secrets of its source.
    fn redacted(mut self, source: &SourceConfig) -> Self {
        if let Self::Open { reason, .. }
        | Self::Unusable { reason, .. }
        | Self::Lost { reason, .. } = &mut self
        {
            *reason = source.redacted(reason);
        }
        self
    }

    /// True if the source can deliver further frames without being reopened.
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::Unusable { .. } | Self::NotDue)
    }
}

/// Maximum configured time from capture to arrival in seconds.
const MAX_LATENCY_S: f64 = 10.0;

/// Configuration of a frame source.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum SourceConfig {
    /// A Video4Linux camera, such as a USB camera.
    V4l2 {
        /// Device file. Default `/dev/video0`.
        #[serde(default = "default_device")]
        device: PathBuf,
        /// Requested image width in pixels. Default 640. The camera takes the nearest size that it
        /// has.
        #[serde(default)]
        width: Option<u32>,
        /// Requested image height in pixels. Default 480.
        #[serde(default)]
        height: Option<u32>,
        /// Requested frames per second. Default 30.
        #[serde(default)]
        fps: Option<f64>,
        /// Seconds from capture to arrival. Default: not set; then the driver's stamps count.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        latency_s: Option<f64>,
    },
    /// A GStreamer pipeline that ends in `appsink`, for example with `libcamerasrc` on a Raspberry
    /// Pi.
    Gstreamer {
        /// The pipeline as for `gst-launch-1.0`; BGR, with `appsink drop=true max-buffers=1`.
        pipeline: String,
        /// Seconds from capture to arrival. Default 0.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        latency_s: Option<f64>,
    },
    /// A network camera, which is read by its address.
    Url {
        /// Its `rtsp://` or `http://` address.
        url: String,
        /// Seconds from capture to arrival. Default: not set; then `X-Timestamp` of motion JPEG
        /// over HTTP counts, and other streams have 0.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        latency_s: Option<f64>,
    },
    /// A video file, played at the times of its frames and turned upright.
    Video {
        /// Path of the file.
        path: PathBuf,
        /// Whether to restart at the end. Default false.
        #[serde(default)]
        looping: bool,
    },
    /// Images in the order of their names.
    Images {
        /// A directory, or a pattern such as `frames/%04d.png` counting up from 0 or 1. Only the
        /// last part of the path is a pattern, and only if no directory has its name.
        path: PathBuf,
        /// Frames per second. Default 10.
        #[serde(default = "default_fps")]
        fps: f64,
        /// Whether to restart at the end. Default false.
        #[serde(default)]
        looping: bool,
    },
}

impl SourceConfig {
    /// Opens the source of whole frames, for `CameraConfig::open`, which masks them. `timeout`
    /// applies to all sources except files.
    ///
    /// # Errors
    /// Returns [`FrameError::Open`] with the source and the cause.
    pub(super) fn open(&self, timeout: Duration) -> Result<Box<dyn FrameSource>, FrameError> {
        match self {
            Self::V4l2 {
                device,
                width,
                height,
                fps,
                latency_s,
            } => Ok(Box::new(V4l2Camera::open(
                device,
                [*width, *height],
                *fps,
                *latency_s,
                timeout,
            )?)),
            Self::Images { path, fps, looping } => {
                Ok(Box::new(ImageSequence::open(path, *fps, *looping)?))
            }
            Self::Gstreamer { .. } | Self::Url { .. } | Self::Video { .. } => {
                Ok(Box::new(VideoProcess::open(self, timeout)?))
            }
        }
    }

    /// Configured seconds from capture to arrival; `None` for recordings.
    pub(crate) fn latency_s(&self) -> Option<f64> {
        match self {
            Self::V4l2 { latency_s, .. }
            | Self::Gstreamer { latency_s, .. }
            | Self::Url { latency_s, .. } => *latency_s,
            Self::Video { .. } | Self::Images { .. } => None,
        }
    }

    /// Device, pipeline, address or path in a form that may be shown: without user and password.
    pub(super) fn origin(&self) -> String {
        match self {
            Self::V4l2 { device: path, .. }
            | Self::Video { path, .. }
            | Self::Images { path, .. } => path.display().to_string(),
            Self::Gstreamer { pipeline, .. } => video::without_credentials(pipeline),
            Self::Url { url, .. } => match url.split_once("://") {
                Some((scheme, address)) => {
                    let bare = bare_address(address).unwrap_or(HIDDEN);
                    video::without_credentials(&format!("{scheme}://{bare}"))
                }
                // Without a scheme the address is refused, but its secret must not be shown with
                // the error.
                None => bare_address(url).unwrap_or(HIDDEN).to_owned(),
            },
        }
    }

    /// A text about this source without its secrets, such as an error of a library.
    fn redacted(&self, text: &str) -> String {
        let mut text = text.to_owned();
        if let Self::Url { url, .. } = self {
            text = text.replace(url, &self.origin());
            let until_host = url
                .rsplit_once('@')
                .map_or("", |(until_host, _)| until_host);
            let login = until_host
                .split_once("://")
                .map_or(until_host, |(_, login)| login);
            let password = login.split_once(':').map_or("", |(_, password)| password);
            for secret in [login, password] {
                if secret.len() >= MIN_SECRET_BYTES {
                    text = text.replace(secret, HIDDEN);
                }
            }
        }
        video::without_credentials(&text)
    }

    /// Removes user and password from an address or a pipeline; the key if there were any.
    pub(crate) fn remove_credentials(&mut self) -> Option<&'static str> {
        let bare = self.origin();
        let (key, text) = match self {
            Self::Url { url, .. } => ("url", url),
            Self::Gstreamer { pipeline, .. } => ("pipeline", pipeline),
            _ => return None,
        };
        let had = bare != *text;
        *text = bare;
        had.then_some(key)
    }

    /// Checks every value, but not whether the source exists.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if let Some(latency_s) = self.latency_s() {
            check_range("latency_s", latency_s, 0.0, MAX_LATENCY_S)?;
        }
        match self {
            Self::V4l2 {
                width, height, fps, ..
            } => {
                for (key, wish) in [("width", width), ("height", height)] {
                    wish.map_or(Ok(()), |pixels| {
                        check_range(key, f64::from(pixels), 1.0, 16_384.0)
                    })?;
                }
                fps.map_or(Ok(()), |fps| check_range("fps", fps, 0.01, 1000.0))
            }
            Self::Images { fps, .. } => check_range("fps", *fps, 0.01, 1000.0),
            Self::Gstreamer { pipeline, .. } if !pipeline.contains("appsink") => Err(
                ConfigError::new("pipeline", self.origin(), "a pipeline that ends in appsink"),
            ),
            Self::Url { url, .. } if !has_known_scheme(url) => Err(ConfigError::new(
                "url",
                self.origin(),
                "an address that begins with rtsp://, rtsps://, http:// or https://",
            )),
            _ => Ok(()),
        }
    }
}

fn default_device() -> PathBuf {
    "/dev/video0".into()
}

fn default_fps() -> f64 {
    10.0
}

/// Delays recorded frames to their own rate.
#[derive(Debug)]
struct FramePacer {
    period: Duration,
    due: Option<Instant>,
}

impl FramePacer {
    fn new(fps: f64) -> Self {
        Self {
            period: Duration::from_secs_f64(1.0 / fps),
            due: None,
        }
    }

    /// Sleeps until the next frame is due.
    fn wait(&mut self) {
        let now = Instant::now();
        let due = self.due.unwrap_or(now);
        std::thread::sleep(due.saturating_duration_since(now));
        self.due = Some(due.max(now) + self.period);
    }
}

fn has_known_scheme(url: &str) -> bool {
    let scheme = url
        .split_once("://")
        .map(|(scheme, _)| scheme.to_ascii_lowercase());
    scheme.is_some_and(|scheme| matches!(&*scheme, "rtsp" | "rtsps" | "http" | "https"))
}

#[cfg(test)]
mod tests;
