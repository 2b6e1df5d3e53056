//! The program `ecod-video`: opens a source by OpenCV's `VideoCapture`, and writes its frames to
//! standard output.

use std::fs::File;
use std::io::{self, BufRead, Write};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::Context;
use ecod::model::time::Timestamp;
use opencv::core::{self, Mat, Size, Vector};
use opencv::imgproc;
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};
use rustix::process::{Signal, getpid, kill_process};

use super::motion_jpeg::MotionJpeg;
use super::protocol::{self, ImageHeader, VideoMessage, VideoRequest};
use crate::camera::frame::CameraFrame;
use crate::camera::frame_source::capture_clock::{CaptureClock, FrameStamp};
use crate::camera::frame_source::{FrameError, FrameSource, SourceConfig, TimeSource};
use crate::camera::image_codec::{self, ImageError};
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
        .context("ecod-node starts this program and sends the source to open on standard input")?;
    thread::spawn(end_with_input);
    let mut video = match open(&source, timeout) {
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
            Ok(frame) => write_frame(&mut output, &frame, video.time_source())?,
            Err(error) if error.is_passing() => {
                protocol::write_line(&mut output, &VideoMessage::Failed(error))?;
            }
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
    // An input that cannot be read ends the process like a closed input.
    let _ = io::copy(&mut io::stdin().lock(), &mut io::sink());
    // A process may always send itself a signal.
    let _ = kill_process(getpid(), Signal::KILL);
}

fn write_frame(
    output: &mut File,
    frame: &CameraFrame,
    time_source: TimeSource,
) -> anyhow::Result<()> {
    let CameraFrame {
        image, captured_at, ..
    } = frame;
    let since_boot = clock::since_boot().saturating_sub(clock::now().since(*captured_at));
    let header = ImageHeader {
        rows: image.rows(),
        columns: image.cols(),
        kind: image.typ(),
        since_boot,
        time_source,
    };
    protocol::write_line(output, &VideoMessage::Frame(header))?;
    Ok(output.write_all(image.data_bytes()?)?)
}

/// Frames per second of video files.
const PLAUSIBLE_FPS: RangeInclusive<f64> = 0.01..=1000.0;

/// Rate of a video file without a plausible one.
const FALLBACK_FPS: f64 = 25.0;

/// Maximum time without a message while the next frame of a file is not due.
const MAX_SILENCE: Duration = Duration::from_secs(1);

/// Opens a source: motion JPEG over HTTP without OpenCV, which hides the time of a picture.
fn open(source: &SourceConfig, timeout: Duration) -> Result<Box<dyn FrameSource>, FrameError> {
    if let Some(stream) = MotionJpeg::open(source, timeout)? {
        return Ok(Box::new(stream));
    }
    Ok(Box::new(Video::open(source, timeout)?))
}

struct Video {
    origin: String,
    pictures: Pictures,
    playback: Option<Playback>,
    /// Capture times of a live source.
    clock: CaptureClock,
    seq: u64,
}

/// Playback of a file.
struct Playback {
    path: PathBuf,
    pacer: StampPacer,
    /// The file once more where its pictures are read undecoded: they have no stamps.
    stamps: Option<VideoCapture>,
    looping: bool,
    /// The next frame, until it is due.
    next: Option<Picture>,
    /// Time between two messages while the next frame is not due.
    patience: Duration,
}

/// Delays the frames of a file to the times that the file states.
struct StampPacer {
    /// Time between two frames without usable stamps.
    period: Duration,
    /// The latest frame's stamp.
    stamp_ms: f64,
    due: Option<Instant>,
}

impl StampPacer {
    /// Schedules the frame with this stamp. Without a later stamp than the frame before, as after
    /// a restart, the frame is one period later.
    fn schedule(&mut self, stamp_ms: f64) {
        let step_ms = stamp_ms - self.stamp_ms;
        let stated_step = Duration::try_from_secs_f64(step_ms / 1e3).unwrap_or_default();
        let step = if stated_step.is_zero() {
            self.period
        } else {
            stated_step
        };
        self.stamp_ms = stamp_ms;
        let now = Instant::now();
        self.due = Some(self.due.map_or(now, |due| (due + step).max(now)));
    }

    /// Sleeps until the scheduled frame is due, but not longer than `most`; true if it is due.
    fn wait(&self, most: Duration) -> bool {
        let remaining = self
            .due
            .map(|due| due.saturating_duration_since(Instant::now()))
            .unwrap_or_default();
        thread::sleep(remaining.min(most));
        remaining <= most
    }
}

/// How a player shows the decoded frames.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Presentation {
    /// OpenCV's code of the rotation.
    rotation: Option<i32>,
    /// Width of a pixel divided by its height.
    pixel_aspect: f64,
}

/// Plausible ratios of a pixel's width to its height; the largest of anamorphic formats is 2.
const PIXEL_ASPECTS: RangeInclusive<f64> = 0.2..=5.0;

impl Presentation {
    /// Reads the presentation that a source states, and switches off OpenCV's own rotation.
    fn of(capture: &mut VideoCapture) -> opencv::Result<Self> {
        let mut rotation_deg = 0.0;
        if capture.set(videoio::CAP_PROP_ORIENTATION_AUTO, 0.0)? {
            rotation_deg = capture.get(videoio::CAP_PROP_ORIENTATION_META)?;
        }
        // OpenCV 4.6 states, and would apply, the opposite angle: opencv/opencv#22088.
        if (core::get_version_major(), core::get_version_minor()) == (4, 6) {
            rotation_deg = -rotation_deg;
        }
        let ratio =
            capture.get(videoio::CAP_PROP_SAR_NUM)? / capture.get(videoio::CAP_PROP_SAR_DEN)?;
        let is_plausible = PIXEL_ASPECTS.contains(&ratio);
        Ok(Self {
            rotation: match rotation_deg.rem_euclid(360.0).round() as i32 {
                90 => Some(core::ROTATE_90_CLOCKWISE),
                180 => Some(core::ROTATE_180),
                270 => Some(core::ROTATE_90_COUNTERCLOCKWISE),
                _ => None,
            },
            pixel_aspect: if is_plausible { ratio } else { 1.0 },
        })
    }

    /// The image with square pixels and upright.
    fn apply(self, mut image: Mat) -> opencv::Result<Mat> {
        let width = f64::from(image.cols());
        let height = f64::from(image.rows());
        // The shorter side of the pixels is enlarged, so that no detail is lost.
        let size = Size::new(
            (width * self.pixel_aspect.max(1.0)).round() as i32,
            (height / self.pixel_aspect.min(1.0)).round() as i32,
        );
        if size != image.size()? {
            let mut square = Mat::default();
            imgproc::resize(&image, &mut square, size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
            image = square;
        }
        if let Some(code) = self.rotation {
            let mut upright = Mat::default();
            core::rotate(&image, &mut upright, code)?;
            image = upright;
        }
        Ok(image)
    }
}

/// The pictures of an open source, and how they are shown.
struct Pictures {
    capture: VideoCapture,
    presentation: Presentation,
    /// True if `capture` returns pictures undecoded. FFmpeg takes damaged ones for whole, or for
    /// the end.
    are_jpeg: bool,
    /// True if the source states presentation times. FFmpeg counts pictures at an assumed rate for
    /// streams without, as motion JPEG over HTTP.
    has_positions: bool,
}

/// A picture with the time that its source states.
struct Picture {
    image: Mat,
    stamp: Option<FrameStamp>,
    arrived_at: Timestamp,
}

/// Codecs of motion JPEG, by their names in containers and by FFmpeg's.
const MOTION_JPEG: [&[u8; 4]; 4] = [b"MJPG", b"mjpg", b"jpeg", b"mjpe"];

impl Pictures {
    fn of(mut capture: VideoCapture) -> opencv::Result<Self> {
        let presentation = Presentation::of(&mut capture)?;
        let codec = (capture.get(videoio::CAP_PROP_FOURCC)? as u32).to_le_bytes();
        let are_jpeg = MOTION_JPEG.contains(&&codec)
            && capture.get(videoio::CAP_PROP_BACKEND)? == f64::from(videoio::CAP_FFMPEG)
            && capture.set(videoio::CAP_PROP_FORMAT, -1.0)?;
        Ok(Self {
            capture,
            presentation,
            are_jpeg,
            has_positions: true,
        })
    }

    /// A second capture of a file for the stamps of its pictures, which undecoded pictures lack.
    fn stamps_of(&self, path: &Path) -> opencv::Result<Option<VideoCapture>> {
        self.are_jpeg.then(|| open_file(path)).transpose()
    }

    /// The next picture, if there is one.
    fn next(&mut self) -> opencv::Result<Option<Result<Picture, ImageError>>> {
        let mut read = Mat::default();
        if !self.capture.read(&mut read)? || read.empty() {
            return Ok(None);
        }
        let arrived_at = clock::now();
        // Zero without a presentation time, as of undecoded pictures.
        let position_ms = self.capture.get(videoio::CAP_PROP_POS_MSEC)?;
        let position = Duration::try_from_secs_f64(position_ms / 1e3)
            .ok()
            .filter(|position| self.has_positions && !position.is_zero());
        if self.are_jpeg {
            match image_codec::decode_motion_jpeg(read.data_bytes()?) {
                Ok(decoded) => read = decoded,
                Err(damage) => return Ok(Some(Err(damage))),
            }
        }
        Ok(Some(Ok(Picture {
            image: self.presentation.apply(read)?,
            stamp: position.map(FrameStamp::Position),
            arrived_at,
        })))
    }
}

fn open_file(path: &Path) -> opencv::Result<VideoCapture> {
    VideoCapture::from_file(path, videoio::CAP_ANY)
}

impl Video {
    fn open(source: &SourceConfig, timeout: Duration) -> Result<Self, FrameError> {
        let origin = source.origin();
        let video = match source {
            SourceConfig::Gstreamer { pipeline, .. } => Self::pipeline(pipeline, origin)?,
            SourceConfig::Url { url, .. } => Self::url(url, origin, timeout)?,
            SourceConfig::Video { path, looping } => Self::file(path, origin, *looping, timeout)?,
            SourceConfig::V4l2 { .. } | SourceConfig::Images { .. } => {
                return Err(FrameError::Open {
                    origin,
                    reason: "the node reads it itself".into(),
                });
            }
        };
        Ok(Self {
            clock: CaptureClock::new(source.latency_s()),
            ..video
        })
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
        let mut video = Self::live(origin, || {
            VideoCapture::from_file_with_params(
                url,
                videoio::CAP_FFMPEG,
                &Vector::from_slice(&timeouts),
            )
        })?;
        video.pictures.has_positions = url.to_ascii_lowercase().starts_with("rtsp");
        Ok(video)
    }

    fn file(
        path: &Path,
        origin: String,
        looping: bool,
        timeout: Duration,
    ) -> Result<Self, FrameError> {
        readable(path, &origin)?;
        // In a relative path, FFmpeg takes `-` for a pipe and the text before `:` for a protocol.
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let mut video = Self::live(origin, || open_file(&path))?;
        let fps = video
            .pictures
            .capture
            .get(videoio::CAP_PROP_FPS)
            .ok()
            .filter(|fps| PLAUSIBLE_FPS.contains(fps));
        let stamps = video.pictures.stamps_of(&path).map_err(|e| video.lost(e))?;
        video.playback = Some(Playback {
            path,
            stamps,
            pacer: StampPacer {
                period: Duration::from_secs_f64(1.0 / fps.unwrap_or(FALLBACK_FPS)),
                stamp_ms: 0.0,
                due: None,
            },
            looping,
            next: None,
            patience: MAX_SILENCE.min(timeout / 2),
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
        let pictures = Pictures::of(capture).map_err(|e| failed(e.message))?;
        Ok(Self {
            origin,
            pictures,
            playback: None,
            clock: CaptureClock::new(None),
            seq: 0,
        })
    }

    /// The next picture, if there is one.
    fn read(&mut self) -> Result<Option<Picture>, FrameError> {
        let read = self.pictures.next();
        if let Some(stamps) = self.playback.as_mut().and_then(|p| p.stamps.as_mut()) {
            // False for a picture that FFmpeg cannot decode.
            stamps.grab().map_err(|e| self.lost(e))?;
        }
        let picture = read.map_err(|e| self.lost(e))?.transpose();
        picture.map_err(|damage| FrameError::Unusable {
            origin: self.origin.clone(),
            reason: damage.to_string(),
        })
    }

    /// The next picture of a file, from its beginning again if it loops.
    fn read_file(&mut self) -> Result<Option<Picture>, FrameError> {
        let picture = self.read()?;
        let again = self
            .playback
            .as_ref()
            .filter(|playback| picture.is_none() && playback.looping && self.seq > 0);
        let Some(Playback { path, .. }) = again else {
            return Ok(picture);
        };
        let pictures = open_file(path).and_then(Pictures::of);
        let pictures = pictures.map_err(|e| self.lost(e))?;
        let stamps = pictures.stamps_of(path).map_err(|e| self.lost(e))?;
        if let Some(playback) = &mut self.playback {
            playback.stamps = stamps;
        }
        self.pictures = pictures;
        self.read()
    }

    fn lost(&self, error: opencv::Error) -> FrameError {
        FrameError::Lost {
            origin: self.origin.clone(),
            reason: error.message,
        }
    }
}

impl FrameSource for Video {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        let waiting = self.playback.as_mut().and_then(|p| p.next.take());
        let is_waiting = waiting.is_some();
        let next = match waiting {
            Some(picture) => Some(picture),
            None => self.read_file()?,
        };
        let origin = || self.origin.clone();
        let picture = next.ok_or_else(|| match self.playback {
            Some(_) => FrameError::Ended { origin: origin() },
            None => FrameError::Lost {
                origin: origin(),
                reason: "no further frame".into(),
            },
        })?;
        let captured_at = if let Some(playback) = &mut self.playback {
            if !is_waiting {
                let stamps = playback.stamps.as_ref().unwrap_or(&self.pictures.capture);
                let stamp_ms = stamps.get(videoio::CAP_PROP_POS_MSEC);
                playback.pacer.schedule(stamp_ms.unwrap_or_default());
            }
            if !playback.pacer.wait(playback.patience) {
                playback.next = Some(picture);
                return Err(FrameError::NotDue);
            }
            clock::now()
        } else {
            self.clock.time(picture.stamp, picture.arrived_at)
        };
        let frame = CameraFrame {
            image: picture.image,
            captured_at,
            seq: self.seq,
        };
        self.seq += 1;
        Ok(frame)
    }

    fn time_source(&self) -> TimeSource {
        match self.playback {
            Some(_) => TimeSource::Playback,
            None => self.clock.source(),
        }
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
            "it is a directory: for images use kind `images`",
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pipeline_elements_are_recognised() {
        let pipeline = "libcamerasrc camera-name=x ! video/x-raw,width=640 ! videoconvert ! tee name=t ! appsink drop=true";
        assert_eq!(
            elements(pipeline).collect::<Vec<_>>(),
            ["libcamerasrc", "videoconvert", "tee", "appsink"]
        );
    }
}
