//! Messages to the detector.

use tokio::sync::OwnedSemaphorePermit;

use crate::camera::frame::CameraFrame;
use crate::observe::recorder::ImageRecorder;
use crate::telemetry::spans::Spans;

/// Requests to the detector.
#[derive(Debug)]
pub enum DetectorMessage {
    /// Find the objects in a frame.
    Detect {
        /// The frame.
        frame: CameraFrame,
        /// Admits the next frame when dropped.
        permit: OwnedSemaphorePermit,
    },
    /// Go on for another node of the vehicle, in another cell.
    Move {
        /// Records some of the frames.
        images: Option<ImageRecorder>,
        /// That node's spans.
        spans: Spans,
    },
}
