//! Detectors: from an image to labels with places in the image. One trait, one file each.

pub mod coco;
mod config;
pub mod placard;
pub mod recorded;

use ecod::model::detection::Detection;

pub use config::{CustomDetector, DetectorConfig};

use crate::camera::frame::Frame;

/// Finds objects in images.
///
/// A detector may keep buffers and what it learned from earlier frames, and may take tens of milliseconds: call it off
/// the async threads.
pub trait Detect: Send {
    /// What is in the frame, in no particular order; pixels are those of `frame.image`.
    ///
    /// # Errors
    /// [`DetectError`] when the image cannot be used or a library fails; the next frame may well succeed.
    fn detect(&mut self, frame: &Frame) -> Result<Vec<Detection>, DetectError>;
}

/// A frame that could not be looked at; the detector stays usable.
#[derive(Debug, thiserror::Error)]
pub enum DetectError {
    /// The image is empty or not 8-bit gray or BGR.
    #[error("frame {seq} has {found}, need 8-bit gray or bgr pixels")]
    UnusableImage {
        /// The frame's sequence number.
        seq: u64,
        /// What it holds instead.
        found: String,
    },
    /// OpenCV refused an operation.
    #[error("opencv failed in {step}")]
    OpenCv {
        /// What was being done.
        step: &'static str,
        /// OpenCV's own words.
        #[source]
        source: opencv::Error,
    },
    /// The decoder refused the image.
    #[error("placard decoder failed: {0}")]
    Decoder(String),
}
