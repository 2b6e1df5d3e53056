//! Messages to the actor of this name.

use tokio::sync::OwnedSemaphorePermit;

use crate::camera::frame::Frame;

/// What the detector is asked to do.
#[derive(Debug)]
pub enum DetectorMessage {
    /// Find the objects in a frame.
    Look {
        /// The frame.
        frame: Frame,
        /// Lets the next frame in when dropped.
        turn: OwnedSemaphorePermit,
    },
}
