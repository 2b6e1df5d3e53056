//! Videos, network cameras and pipelines: frames of the program `ecod-video`, the only program that
//! is linked to OpenCV's `videoio`.
//!
//! In Debian `videoio` loads some 200 libraries, 80 MB. In a process of its own it is loaded only
//! if a source needs it, and crashes or hangs in it do not affect the node.
//!
//! ```text
//! node --VideoRequest, a line of JSON----------------------------> ecod-video
//! node <--VideoMessage, a line of JSON; a frame's pixels after it-- ecod-video
//! ```
//!
//! The program ends when its standard input closes, which also happens when the node is killed. Its
//! standard error, including output of its libraries, becomes debug lines of the node's log.

mod motion_jpeg;
pub mod program;
mod protocol;

use std::io::{self, BufRead, BufReader, Read};
use std::process::{Child, ChildStderr, ChildStdout, Command, Stdio};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, LazyLock, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use ecod::logins::without_logins;
use opencv::core::{Mat, Scalar};
use opencv::prelude::*;
use regex_lite::Regex;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use self::protocol::{ImageHeader, VideoMessage, VideoRequest};
use super::{FrameError, FrameSource, SourceConfig, TimeSource};
use crate::camera::frame::CameraFrame;
use crate::platform::{clock, installed};

/// Name of the program.
const PROGRAM: &str = "ecod-video";

/// Minimum time for opening a source: GStreamer may first look through all of its plugins, once on
/// a machine.
const MIN_OPEN_TIME: Duration = Duration::from_secs(30);

/// Maximum number of pixels of a frame: 8K.
const MAX_PIXELS: i64 = 7680 * 4320;

/// Maximum length of a message in bytes, without a frame's pixels.
const MAX_LINE: u64 = 64 * 1024;

/// Time for a program that has ended to deliver its last lines.
const LAST_WORDS_TIME: Duration = Duration::from_millis(200);

/// A running `ecod-video` and the frames that it writes.
pub(super) struct VideoProcess {
    origin: String,
    source: SourceConfig,
    child: ProgramGuard,
    output: BufReader<DeadlineReader>,
    last_words: LastWords,
    frame_time: Duration,
    time_source: TimeSource,
    seq: u64,
}

impl VideoProcess {
    /// Starts the program and waits until it has opened the source. The program gives up on a
    /// network camera after `timeout`; here, twice that time without a frame is an error.
    pub(super) fn open(source: &SourceConfig, timeout: Duration) -> Result<Self, FrameError> {
        let origin = source.origin();
        let failed = |reason: String| FrameError::Open {
            origin: source.origin(),
            reason,
        };
        let program = installed::program(PROGRAM).ok_or_else(|| {
            let remedy = "install the package ecod-node, or build it by `cargo build --bin ecod-video` and keep it beside this program";
            failed(format!("the program {PROGRAM}, which reads such sources, is missing: {remedy}"))
        })?;
        let mut command = Command::new(&program);
        let started = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn();
        let child =
            started.map_err(|e| failed(format!("cannot start {}: {e}", program.display())))?;
        let mut child = ProgramGuard(child);
        let pipes = (
            &mut child.0.stdin,
            child.0.stdout.take(),
            child.0.stderr.take(),
        );
        let (Some(stdin), Some(stdout), Some(stderr)) = pipes else {
            return Err(failed(format!("no pipes to {PROGRAM}")));
        };
        // If the program has already ended, its exit status gives the reason.
        let _ = protocol::write_line(
            stdin,
            &VideoRequest {
                source: source.clone(),
                timeout,
            },
        );
        let last_words = LastWords::collect(source, stderr).map_err(|e| failed(e.to_string()))?;
        let frame_time = 2 * timeout;
        let output = BufReader::new(DeadlineReader {
            stdout,
            deadline: Instant::now(),
        });
        let mut process = Self {
            origin,
            source: source.clone(),
            child,
            output,
            last_words,
            frame_time,
            time_source: TimeSource::Arrival,
            seq: 0,
        };
        match process.receive(MIN_OPEN_TIME.max(frame_time)) {
            Ok(VideoMessage::Opened) => Ok(process),
            Ok(VideoMessage::Failed(error)) => Err(error.redacted(source)),
            Ok(VideoMessage::Frame(_)) => Err(failed(format!("{PROGRAM} is of another version"))),
            Err(FrameError::Lost { reason, .. }) => Err(failed(reason)),
            Err(error) => Err(failed(error.to_string())),
        }
    }

    /// The program's next message; a frame's pixels are still to be read.
    fn receive(&mut self, time: Duration) -> Result<VideoMessage, FrameError> {
        self.output.get_mut().deadline = Instant::now() + time;
        let mut line = String::new();
        match (&mut self.output).take(MAX_LINE).read_line(&mut line) {
            Ok(0) => Err(self.end()),
            Ok(_) => serde_json::from_str(&line)
                .map_err(|e| self.lost(format!("{PROGRAM} is of another version: {e}"))),
            Err(error) => Err(self.broken(&error, time)),
        }
    }

    fn receive_pixels(&mut self, header: &ImageHeader) -> Result<CameraFrame, FrameError> {
        let ImageHeader {
            rows,
            columns,
            kind,
            since_boot,
            time_source,
        } = *header;
        if i64::from(rows) * i64::from(columns) > MAX_PIXELS {
            return Err(self.lost(format!("{columns} by {rows} pixels are too many")));
        }
        let mut image = Mat::new_rows_cols_with_default(rows, columns, kind, Scalar::all(0.0))
            .map_err(|e| self.lost(e.message))?;
        let pixels = image.data_bytes_mut().map_err(|e| self.lost(e.message))?;
        self.output
            .read_exact(pixels)
            .map_err(|e| self.broken(&e, self.frame_time))?;
        self.time_source = time_source;
        let frame = CameraFrame {
            image,
            captured_at: clock::at(since_boot),
            seq: self.seq,
        };
        self.seq += 1;
        Ok(frame)
    }

    fn broken(&mut self, error: &io::Error, time: Duration) -> FrameError {
        match error.kind() {
            io::ErrorKind::TimedOut => FrameError::Stalled(time),
            io::ErrorKind::UnexpectedEof => self.end(),
            _ => self.lost(error.to_string()),
        }
    }

    /// The error for the end of the program, with its status and last lines.
    fn end(&mut self) -> FrameError {
        // The program may have closed its output and continue to run; if it has ended, the status
        // is unaffected.
        let _ = self.child.0.kill();
        let status = self
            .child
            .0
            .wait()
            .map_or_else(|error| error.to_string(), |status| status.to_string());
        let last_words = self.last_words.wait();
        let words = if last_words.is_empty() {
            last_words
        } else {
            format!(": {last_words}")
        };
        self.lost(format!("{PROGRAM} ended, {status}{words}"))
    }

    fn lost(&self, reason: String) -> FrameError {
        FrameError::Lost {
            origin: self.origin.clone(),
            reason,
        }
    }
}

impl FrameSource for VideoProcess {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        match self.receive(self.frame_time)? {
            VideoMessage::Frame(header) => self.receive_pixels(&header),
            VideoMessage::Failed(error) => Err(error.redacted(&self.source)),
            VideoMessage::Opened => Err(self.lost(format!("{PROGRAM} is of another version"))),
        }
    }

    fn time_source(&self) -> TimeSource {
        self.time_source
    }
}

/// The running program, which is killed when this is dropped.
struct ProgramGuard(Child);

impl Drop for ProgramGuard {
    fn drop(&mut self) {
        if let Err(error) = self.0.kill().and_then(|()| self.0.wait()) {
            tracing::warn!(%error, "cannot end {PROGRAM}");
        }
    }
}

/// Standard output of the program; each read has a deadline.
struct DeadlineReader {
    stdout: ChildStdout,
    deadline: Instant,
}

impl Read for DeadlineReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = Timespec::try_from(self.deadline.saturating_duration_since(Instant::now()))
            .map_err(io::Error::other)?;
        match poll(&mut [PollFd::new(&self.stdout, PollFlags::IN)], Some(&left))? {
            0 => Err(io::ErrorKind::TimedOut.into()),
            _ => self.stdout.read(buffer),
        }
    }
}

/// Standard error of the program: logged line by line, with the last line kept.
struct LastWords {
    line: Arc<Mutex<String>>,
    ended: Receiver<()>,
}

impl LastWords {
    fn collect(source: &SourceConfig, stderr: ChildStderr) -> io::Result<Self> {
        let line = Arc::<Mutex<String>>::default();
        let (until, ended) = mpsc::channel();
        let source = source.clone();
        let last = Arc::clone(&line);
        thread::Builder::new()
            .name("video-log".into())
            .spawn(move || log(&source, stderr, &last, &until))?;
        Ok(Self { line, ended })
    }

    /// The last line, after the end of the output or the timeout.
    fn wait(&self) -> String {
        // Returns when the reader ends, because no message is sent.
        let _ = self.ended.recv_timeout(LAST_WORDS_TIME);
        self.line
            .lock()
            .map(|line| line.clone())
            .unwrap_or_default()
    }
}

fn log(source: &SourceConfig, stderr: ChildStderr, last: &Mutex<String>, _until: &Sender<()>) {
    let camera = source.origin();
    for line in BufReader::new(stderr).split(b'\n').map_while(Result::ok) {
        let line = source.redacted(String::from_utf8_lossy(&line).trim_end());
        tracing::debug!(camera, "{line}");
        if let Ok(mut last) = last.lock() {
            *last = line;
        }
    }
}

/// A text that may be logged: addresses without login and query, and without values of properties
/// such as `user-pw`.
pub(super) fn without_credentials(text: &str) -> String {
    #[expect(clippy::expect_used, reason = "the expression is constant")]
    static PROPERTY: LazyLock<Regex> = LazyLock::new(|| {
        let value = r#"(?:\([^)]*\))?(?:"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|(?:\\.|[^\s"'])+)"#;
        let property =
            format!(r"(?i)((?:pw|pass|passwd|password|passphrase|secret|token|key)\s*=\s*){value}");
        Regex::new(&property).expect("a valid expression")
    });
    without_logins(&PROPERTY.replace_all(text, "${1}…"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_secrets_are_hidden() {
        assert_eq!(
            without_credentials("rtsp://user:p@ss@camera:554/1"),
            "rtsp://camera:554/1"
        );
        assert_eq!(
            without_credentials("rtsp://user:p?ss@camera/1"),
            "rtsp://***"
        );
        assert_eq!(
            without_credentials("rtsp://camera/user=admin_password=hush_channel=1"),
            "rtsp://camera/user=admin_password=…"
        );
        assert_eq!(
            without_credentials("http://camera/video?user=admin&pwd=hush"),
            "http://camera/video"
        );
        assert_eq!(
            without_credentials(
                "rtspsrc location=rtsp://camera user-id=me user-pw=\"hu sh\" ! x264enc key-int-max=30 ! appsink"
            ),
            "rtspsrc location=rtsp://camera user-id=me user-pw=… ! x264enc key-int-max=30 ! appsink"
        );
        for secret in [
            r"!hush",
            r"Winter!hush",
            r#""hu\"hush hush""#,
            r"hu\ hush",
            r#"(string)"hu hush""#,
            "'hu hush'",
        ] {
            let shown = without_credentials(&format!("rtspsrc user-pw={secret} ! appsink"));
            assert_eq!(shown, "rtspsrc user-pw=… ! appsink", "{secret}");
        }
        assert_eq!(
            without_credentials(
                "rtspsrc location=\"rtsp://user:secret@camera\" ! tee name=a@b ! udpsink uri=udp://x@host"
            ),
            "rtspsrc location=\"rtsp://camera\" ! tee name=a@b ! udpsink uri=udp://host"
        );
    }
}
