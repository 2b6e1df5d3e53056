//! Frames through OpenCV's `VideoCapture`: devices, pipelines, network cameras and video files.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use opencv::core::{Mat, Vector};
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};

use super::{FrameError, FramePacer, FrameSource};
use crate::camera::frame::CameraFrame;
use crate::platform::clock;

/// Rate of a video file without one.
const FALLBACK_FPS: f64 = 25.0;

/// An open capture.
pub(super) struct Video {
    origin: String,
    capture: VideoCapture,
    playback: Option<Playback>,
    seq: u64,
}

/// Playback of a file.
struct Playback {
    pace: FramePacer,
    looping: bool,
}

impl Video {
    pub(super) fn device(
        device: &Path,
        width: Option<u32>,
        height: Option<u32>,
        fps: Option<f64>,
    ) -> Result<Self, FrameError> {
        let origin = device.display().to_string();
        readable(device, &origin)?;
        let wishes = [
            (videoio::CAP_PROP_FRAME_WIDTH, width.map(f64::from)),
            (videoio::CAP_PROP_FRAME_HEIGHT, height.map(f64::from)),
            (videoio::CAP_PROP_FPS, fps),
            (videoio::CAP_PROP_BUFFERSIZE, Some(1.0)),
        ];
        let mut video = Self::live(origin, || VideoCapture::from_file(device, videoio::CAP_V4L2))?;
        for (property, wish) in wishes {
            if let Some(value) = wish
                && !video.capture.set(property, value).unwrap_or(false)
            {
                tracing::debug!(camera = video.origin, property, value, "camera rejects a setting");
            }
        }
        Ok(video)
    }

    pub(super) fn pipeline(pipeline: &str) -> Result<Self, FrameError> {
        if let Some(element) = elements(pipeline).find(|element| is_missing(element)) {
            let reason = format!("GStreamer has no element `{element}` here: install the package that has it");
            return Err(FrameError::Open { origin: pipeline.into(), reason });
        }
        let opened = Self::live(pipeline.into(), || VideoCapture::from_file(pipeline, videoio::CAP_GSTREAMER));
        opened.map_err(|error| match error {
            FrameError::Open { origin, reason } if Command::new(INSPECTOR).arg("--version").output().is_err() => {
                let remedy = "install gstreamer1.0-tools, so that a missing element is named";
                FrameError::Open { origin, reason: format!("{reason}; {remedy}") }
            }
            error => error,
        })
    }

    /// A network camera with a timeout for opening it and for each frame.
    pub(super) fn url(url: &str, timeout: Duration) -> Result<Self, FrameError> {
        let timeout_ms = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
        let properties = [videoio::CAP_PROP_OPEN_TIMEOUT_MSEC, videoio::CAP_PROP_READ_TIMEOUT_MSEC];
        let timeouts: Vec<i32> = properties.into_iter().flat_map(|property| [property, timeout_ms]).collect();
        Self::live(without_credentials(url), || {
            VideoCapture::from_file_with_params(url, videoio::CAP_FFMPEG, &Vector::from_slice(&timeouts))
        })
    }

    pub(super) fn file(path: &Path, looping: bool) -> Result<Self, FrameError> {
        let origin = path.display().to_string();
        readable(path, &origin)?;
        let mut video = Self::live(origin, || VideoCapture::from_file(path, videoio::CAP_ANY))?;
        let fps = video.capture.get(videoio::CAP_PROP_FPS).ok().filter(|fps| fps.is_finite() && *fps > 0.0);
        video.playback = Some(Playback { pace: FramePacer::new(fps.unwrap_or(FALLBACK_FPS)), looping });
        Ok(video)
    }

    fn live(origin: String, open: impl FnOnce() -> opencv::Result<VideoCapture>) -> Result<Self, FrameError> {
        let failed = |reason: String| FrameError::Open { origin: origin.clone(), reason };
        let capture = open().map_err(|e| failed(e.message))?;
        if !capture.is_opened().map_err(|e| failed(e.message))? {
            return Err(failed("opencv finds no video there: see whether a player shows it".into()));
        }
        Ok(Self { origin, capture, playback: None, seq: 0 })
    }

    /// The next image, if there is one.
    fn read(&mut self) -> Result<Option<Mat>, FrameError> {
        let mut image = Mat::default();
        let read = self.capture.read(&mut image);
        let read = read.map_err(|e| FrameError::Lost { origin: self.origin.clone(), reason: e.message })?;
        Ok((read && !image.empty()).then_some(image))
    }
}

impl FrameSource for Video {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        if let Some(playback) = &mut self.playback {
            playback.pace.wait();
        }
        let mut image = self.read()?;
        if image.is_none() && self.playback.as_ref().is_some_and(|p| p.looping) && self.seq > 0 {
            let reopened = VideoCapture::from_file(&self.origin, videoio::CAP_ANY);
            self.capture = reopened.map_err(|e| FrameError::Lost { origin: self.origin.clone(), reason: e.message })?;
            image = self.read()?;
        }
        let origin = || self.origin.clone();
        let image = image.ok_or_else(|| match self.playback {
            Some(_) => FrameError::Ended { origin: origin() },
            None => FrameError::Lost { origin: origin(), reason: "no further frame".into() },
        })?;
        let frame = CameraFrame { image, captured_at: clock::now(), seq: self.seq };
        self.seq += 1;
        Ok(frame)
    }
}

/// An address that may be logged: `rtsp://user:secret@camera/1` without user and secret.
pub(super) fn without_credentials(url: &str) -> String {
    match url.split_once("://") {
        Some((scheme, rest)) => {
            let (login_and_host, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
            let host = login_and_host.rsplit('@').next().unwrap_or_default();
            format!("{scheme}://{host}{path}")
        }
        None => url.rsplit('@').next().unwrap_or_default().to_owned(),
    }
}

/// Names of the elements of a GStreamer pipeline; caps, references and properties are none.
fn elements(pipeline: &str) -> impl Iterator<Item = &str> {
    pipeline
        .split('!')
        .filter_map(|part| part.split_whitespace().next())
        .filter(|word| word.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-'))
}

/// GStreamer's program that knows its elements.
const INSPECTOR: &str = "gst-inspect-1.0";

/// True if GStreamer says that it does not know an element; OpenCV only waits for frames then.
fn is_missing(element: &str) -> bool {
    let answer = Command::new(INSPECTOR).args(["--exists", element]).output();
    answer.is_ok_and(|answer| answer.status.code() == Some(1))
}

/// The operating system's error for a missing or forbidden file, since OpenCV reports none.
fn readable(path: &Path, origin: &str) -> Result<(), FrameError> {
    let failed = |e: std::io::Error| FrameError::Open { origin: origin.to_owned(), reason: e.to_string() };
    let file = File::open(path).map_err(failed)?;
    if file.metadata().map_err(failed)?.is_dir() {
        return Err(failed(std::io::Error::other("it is a directory: for images use kind `images`, or `--images`")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_of_an_address_are_not_shown() {
        assert_eq!(without_credentials("rtsp://user:p@ss@camera:554/1"), "rtsp://camera:554/1");
        assert_eq!(without_credentials("http://camera/a@b"), "http://camera/a@b");
    }

    #[test]
    fn the_elements_of_a_pipeline_are_told_from_caps_and_properties() {
        let pipeline =
            "libcamerasrc camera-name=x ! video/x-raw,width=640 ! videoconvert ! tee name=t ! appsink drop=true";
        assert_eq!(elements(pipeline).collect::<Vec<_>>(), ["libcamerasrc", "videoconvert", "tee", "appsink"]);
    }
}
