//! Detectors of objects in images: one trait, one file per detector.

pub mod coco;
mod config;
pub mod placard;
pub mod recorded;

use ecod::model::detection::Detection;

pub use config::{CustomDetector, DetectorConfig};

use crate::camera::frame::Frame;

/// Detector of objects in images.
///
/// A detector may keep state between frames and may take tens of milliseconds: call it off the async threads.
pub trait Detect: Send {
    /// Objects in the frame in any order, in pixels of `frame.image`.
    ///
    /// # Errors
    /// [`DetectError`] when the image is unusable or a library fails; the next frame may succeed.
    fn detect(&mut self, frame: &Frame) -> Result<Vec<Detection>, DetectError>;
}

/// Error on one frame; the detector remains usable.
#[derive(Debug, thiserror::Error)]
pub enum DetectError {
    /// The image is empty or not 8-bit gray or BGR.
    #[error("frame {seq} has {found}, need 8-bit gray or bgr pixels")]
    UnusableImage {
        /// The frame's sequence number.
        seq: u64,
        /// Its content instead.
        found: String,
    },
    /// OpenCV refused an operation.
    #[error("opencv failed in {step}")]
    OpenCv {
        /// The step.
        step: &'static str,
        /// OpenCV's error.
        #[source]
        source: opencv::Error,
    },
    /// The decoder refused the image.
    #[error("placard decoder failed: {0}")]
    Decoder(String),
}
