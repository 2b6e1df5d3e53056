//! ImageRecorder of the camera, a few a second.

use std::time::Duration;

use ecod::time::Timestamp;
use opencv::core::Vector;
use opencv::imgcodecs;

use super::{LogSender, RecordConfig};
use crate::camera::frame::Frame;

/// Takes a frame now and then and records it as JPEG.
#[derive(Debug, Clone)]
pub struct ImageRecorder {
    recording: LogSender,
    period: Duration,
    due: Timestamp,
}

impl ImageRecorder {
    /// As the configuration asks for; `None` without a log, or pictures in it.
    pub fn new(config: Option<&RecordConfig>, recording: LogSender) -> Option<Self> {
        let hz = config.map(|record| record.camera_hz).filter(|hz| *hz > 0.0)?;
        Some(Self { recording, period: Duration::from_secs_f64(1.0 / hz), due: Timestamp::default() })
    }

    /// Records the frame if one is due; takes some milliseconds then.
    pub fn offer(&mut self, frame: &Frame) {
        if frame.captured_at < self.due {
            return;
        }
        self.due = frame.captured_at + self.period;
        let mut jpeg = Vector::<u8>::new();
        match imgcodecs::imencode_def(".jpg", &frame.image, &mut jpeg) {
            Ok(true) => self.recording.picture(jpeg.into(), frame.captured_at),
            encoded => tracing::debug!(?encoded, "frame is no picture"),
        }
    }
}
