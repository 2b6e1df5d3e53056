//! Messages to the detector.

use tokio::sync::OwnedSemaphorePermit;

use crate::camera::frame::Frame;

/// Requests to the detector.
#[derive(Debug)]
pub enum DetectorMessage {
    /// Find the objects in a frame.
    Detect {
        /// The frame.
        frame: Frame,
        /// Admits the next frame when dropped.
        permit: OwnedSemaphorePermit,
    },
}
