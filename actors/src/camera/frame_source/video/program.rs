//! The program `ecod-video`: opens a source by OpenCV's `VideoCapture`, and writes its frames to
//! standard output.

use std::fs::File;
use std::io::{self, BufRead, Write};
use std::ops::RangeInclusive;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::thread;
use std::time::Duration;

use anyhow::Context;
use opencv::core::{Mat, Vector};
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};
use rustix::process::{Signal, getpid, kill_process};

use super::protocol::{self, ImageHeader, VideoMessage, VideoRequest};
use crate::camera::frame::CameraFrame;
use crate::camera::frame_source::{FrameError, FramePacer, FrameSource, SourceConfig};
use crate::platform::clock;

/// Maximum number of bytes in a pipe, as far as the kernel allows: with fewer bytes, both sides
/// wait more often.
const PIPE_BYTES: usize = 1 << 20;

/// Runs until the source or standard input ends.
pub fn main() -> ExitCode {
    match serve() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error:#}");
            ExitCode::FAILURE
        }
    }
}

fn serve() -> anyhow::Result<()> {
    let mut output = frames_output().context("standard output cannot be used")?;
    let mut request = String::new();
    io::stdin().lock().read_line(&mut request)?;
    let VideoRequest { source, timeout } = serde_json::from_str(&request)
        .context("ecod-node starts this program, and tells it on standard input what to open")?;
    thread::spawn(end_with_input);
    let mut video = match Video::open(&source, timeout) {
        Ok(video) => video,
        Err(error) => {
            return Ok(protocol::write_line(
                &mut output,
                &VideoMessage::Failed(error),
            )?);
        }
    };
    protocol::write_line(&mut output, &VideoMessage::Opened)?;
    loop {
        match video.next_frame() {
            Ok(frame) => write_frame(&mut output, &frame)?,
            Err(error) => {
                return Ok(protocol::write_line(
                    &mut output,
                    &VideoMessage::Failed(error),
                )?);
            }
        }
    }
}

/// Standard output, reserved for frames: output of libraries is redirected to standard error.
fn frames_output() -> io::Result<File> {
    let output = rustix::io::fcntl_dupfd_cloexec(io::stdout(), 3)?;
    rustix::stdio::dup2_stdout(io::stderr())?;
    // The output is not a pipe when a person runs the program by hand.
    let _ = rustix::pipe::fcntl_setpipe_size(&output, PIPE_BYTES);
    Ok(output.into())
}

/// Ends this process when its standard input closes, in every state: a library may block forever,
/// even while a process exits.
fn end_with_input() {
    let _ = io::copy(&mut io::stdin().lock(), &mut io::sink());
    let _ = kill_process(getpid(), Signal::KILL);
}

fn write_frame(output: &mut File, frame: &CameraFrame) -> anyhow::Result<()> {
    let CameraFrame {
        image, captured_at, ..
    } = frame;
    let since_boot = clock::since_boot().saturating_sub(clock::now().since(*captured_at));
    let header = ImageHeader {
        rows: image.rows(),
        columns: image.cols(),
        kind: image.typ(),
        since_boot,
    };
    protocol::write_line(output, &VideoMessage::Frame(header))?;
    Ok(output.write_all(image.data_bytes()?)?)
}

/// Frames per second of video files.
const PLAUSIBLE_FPS: RangeInclusive<f64> = 0.01..=1000.0;

/// Rate of a video file without a plausible one.
const FALLBACK_FPS: f64 = 25.0;

/// An open capture.
struct Video {
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
    fn open(source: &SourceConfig, timeout: Duration) -> Result<Self, FrameError> {
        let origin = source.origin();
        match source {
            SourceConfig::Gstreamer { pipeline } => Self::pipeline(pipeline, origin),
            SourceConfig::Url { url } => Self::url(url, origin, timeout),
            SourceConfig::Video { path, looping } => Self::file(path, origin, *looping),
            SourceConfig::V4l2 { .. } | SourceConfig::Images { .. } => Err(FrameError::Open {
                origin,
                reason: "the node reads it itself".into(),
            }),
        }
    }

    fn pipeline(pipeline: &str, origin: String) -> Result<Self, FrameError> {
        if let Some(element) = elements(pipeline).find(|element| is_missing(element)) {
            let reason = format!(
                "GStreamer has no element `{element}` here: install the package that has it"
            );
            return Err(FrameError::Open { origin, reason });
        }
        let opened = Self::live(origin, || {
            VideoCapture::from_file(pipeline, videoio::CAP_GSTREAMER)
        });
        opened.map_err(|error| match error {
            FrameError::Open { origin, reason }
                if Command::new(INSPECTOR).arg("--version").output().is_err() =>
            {
                let remedy = "install gstreamer1.0-tools, so that a missing element is named";
                FrameError::Open {
                    origin,
                    reason: format!("{reason}; {remedy}"),
                }
            }
            error => error,
        })
    }

    /// A network camera with a timeout for opening it and for each frame.
    fn url(url: &str, origin: String, timeout: Duration) -> Result<Self, FrameError> {
        let timeout_ms = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
        let properties = [
            videoio::CAP_PROP_OPEN_TIMEOUT_MSEC,
            videoio::CAP_PROP_READ_TIMEOUT_MSEC,
        ];
        let timeouts: Vec<i32> = properties
            .into_iter()
            .flat_map(|property| [property, timeout_ms])
            .collect();
        Self::live(origin, || {
            VideoCapture::from_file_with_params(
                url,
                videoio::CAP_FFMPEG,
                &Vector::from_slice(&timeouts),
            )
        })
    }

    fn file(path: &Path, origin: String, looping: bool) -> Result<Self, FrameError> {
        readable(path, &origin)?;
        let mut video = Self::live(origin, || VideoCapture::from_file(path, videoio::CAP_ANY))?;
        let fps = video
            .capture
            .get(videoio::CAP_PROP_FPS)
            .ok()
            .filter(|fps| PLAUSIBLE_FPS.contains(fps));
        video.playback = Some(Playback {
            pace: FramePacer::new(fps.unwrap_or(FALLBACK_FPS)),
            looping,
        });
        Ok(video)
    }

    fn live(
        origin: String,
        open: impl FnOnce() -> opencv::Result<VideoCapture>,
    ) -> Result<Self, FrameError> {
        let failed = |reason: String| FrameError::Open {
            origin: origin.clone(),
            reason,
        };
        let capture = open().map_err(|e| failed(e.message))?;
        if !capture.is_opened().map_err(|e| failed(e.message))? {
            return Err(failed(
                "opencv finds no video there: see whether a player shows it".into(),
            ));
        }
        Ok(Self {
            origin,
            capture,
            playback: None,
            seq: 0,
        })
    }

    /// The next image, if there is one.
    fn read(&mut self) -> Result<Option<Mat>, FrameError> {
        let mut image = Mat::default();
        let read = self.capture.read(&mut image);
        let read = read.map_err(|e| FrameError::Lost {
            origin: self.origin.clone(),
            reason: e.message,
        })?;
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
            self.capture = reopened.map_err(|e| FrameError::Lost {
                origin: self.origin.clone(),
                reason: e.message,
            })?;
            image = self.read()?;
        }
        let origin = || self.origin.clone();
        let image = image.ok_or_else(|| match self.playback {
            Some(_) => FrameError::Ended { origin: origin() },
            None => FrameError::Lost {
                origin: origin(),
                reason: "no further frame".into(),
            },
        })?;
        let frame = CameraFrame {
            image,
            captured_at: clock::now(),
            seq: self.seq,
        };
        self.seq += 1;
        Ok(frame)
    }
}

/// Names of the elements of a GStreamer pipeline; caps, references and properties are skipped.
fn elements(pipeline: &str) -> impl Iterator<Item = &str> {
    pipeline
        .split('!')
        .filter_map(|part| part.split_whitespace().next())
        .filter(|word| {
            word.bytes()
                .all(|byte| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-')
        })
}

/// GStreamer's program that lists its elements.
const INSPECTOR: &str = "gst-inspect-1.0";

/// True if GStreamer reports that an element does not exist; OpenCV would only wait for frames in
/// this case.
fn is_missing(element: &str) -> bool {
    let answer = Command::new(INSPECTOR).args(["--exists", element]).output();
    answer.is_ok_and(|answer| answer.status.code() == Some(1))
}

/// The operating system's error for a missing or forbidden file, because OpenCV does not report
/// one.
fn readable(path: &Path, origin: &str) -> Result<(), FrameError> {
    let failed = |e: std::io::Error| FrameError::Open {
        origin: origin.to_owned(),
        reason: e.to_string(),
    };
    let file = File::open(path).map_err(failed)?;
    if file.metadata().map_err(failed)?.is_dir() {
        return Err(failed(std::io::Error::other(
            "it is a directory: for images use kind `images`, or `--images`",
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_elements_of_a_pipeline_are_told_from_caps_and_properties() {
        let pipeline = "libcamerasrc camera-name=x ! video/x-raw,width=640 ! videoconvert ! tee name=t ! appsink drop=true";
        assert_eq!(
            elements(pipeline).collect::<Vec<_>>(),
            ["libcamerasrc", "videoconvert", "tee", "appsink"]
        );
    }
}
