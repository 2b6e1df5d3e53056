//! Camera images in the log, a few a second.

use std::time::Duration;

use ecod::model::detection::Detection;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use tokio::sync::watch;

use super::{CapturedPicture, LogItem, LogSender, RecordConfig};
use crate::camera::config::CameraConfig;
use crate::camera::frame::CameraFrame;
use crate::camera::image_codec;
use crate::camera::image_size::ImageSize;
use crate::camera::lens::Lens;

/// Quality of recorded pictures, from which detectors are judged later: 1 to 100.
const JPEG_QUALITY: u8 = 95;

/// Records frames as JPEG at a fixed rate.
#[derive(Debug, Clone)]
pub struct ImageRecorder {
    /// The log of the vehicle's present node.
    log: watch::Receiver<LogSender>,
    camera: Option<String>,
    reporter: NodeName,
    period: Duration,
    due: Timestamp,
}

impl ImageRecorder {
    /// As configured, for a camera of a vehicle; `None` without a log, or without images in it.
    pub fn new(
        config: Option<&RecordConfig>,
        vehicle: &NodeName,
        camera: &CameraConfig,
        log: watch::Receiver<LogSender>,
    ) -> Option<Self> {
        let hz = config.map(|record| record.camera_hz).filter(|hz| *hz > 0.0)?;
        let (camera, reporter) = (camera.name.clone(), camera.reporter(vehicle));
        Some(Self { log, camera, reporter, period: Duration::from_secs_f64(1.0 / hz), due: Timestamp::default() })
    }

    /// Records the frame with its detections if one is due, which takes some milliseconds.
    pub fn offer(&mut self, frame: &CameraFrame, lens: &Lens, detections: &[Detection]) {
        if frame.captured_at < self.due {
            return;
        }
        self.due = frame.captured_at + self.period;
        match image_codec::encode_jpeg(&frame.image, JPEG_QUALITY) {
            Ok(jpeg) => {
                let size = ImageSize::of(&frame.image);
                let picture = CapturedPicture {
                    camera: self.camera.clone(),
                    reporter: self.reporter.clone(),
                    jpeg,
                    height: size.height,
                    optics: lens.in_pixels_of(size).ok().map(|lens| (lens.intrinsics, lens.distortion)),
                    detections: detections.to_vec(),
                };
                self.log.borrow().send(frame.captured_at, LogItem::Picture(Box::new(picture)));
            }
            Err(error) => tracing::debug!(%error, "cannot encode frame as JPEG"),
        }
    }
}
