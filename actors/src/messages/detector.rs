//! Messages to the detector.

use tokio::sync::OwnedSemaphorePermit;

use crate::camera::frame::CameraFrame;

/// Requests to the detector.
#[derive(Debug)]
pub enum DetectorMessage {
    /// Find the objects in a frame.
    Detect {
        /// The frame in which to find objects.
        frame: CameraFrame,
        /// Admits the next frame when dropped.
        permit: OwnedSemaphorePermit,
    },
}
