//! Camera images in the log, a few a second.

use std::time::Duration;

use ecod::model::time::Timestamp;
use opencv::core::Vector;
use opencv::imgcodecs;

use super::{LogItem, LogSender, RecordConfig};
use crate::camera::frame::CameraFrame;

/// Records frames as JPEG at a fixed rate.
#[derive(Debug, Clone)]
pub struct ImageRecorder {
    log: LogSender,
    topic: String,
    period: Duration,
    due: Timestamp,
}

impl ImageRecorder {
    /// As configured, for a camera by its name; `None` without a log, or without images in it.
    pub fn new(config: Option<&RecordConfig>, camera: Option<&str>, log: LogSender) -> Option<Self> {
        let hz = config.map(|record| record.camera_hz).filter(|hz| *hz > 0.0)?;
        let topic = camera.map_or_else(|| "camera".to_owned(), |name| format!("camera/{name}"));
        Some(Self { log, topic, period: Duration::from_secs_f64(1.0 / hz), due: Timestamp::default() })
    }

    /// Records the frame if one is due, which takes some milliseconds.
    pub fn offer(&mut self, frame: &CameraFrame) {
        if frame.captured_at < self.due {
            return;
        }
        self.due = frame.captured_at + self.period;
        let mut jpeg = Vector::<u8>::new();
        match imgcodecs::imencode_def(".jpg", &frame.image, &mut jpeg) {
            Ok(true) => self.log.send(frame.captured_at, LogItem::Image(self.topic.clone(), jpeg.into())),
            encoded => tracing::debug!(?encoded, "cannot encode frame as JPEG"),
        }
    }
}
