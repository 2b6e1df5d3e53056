//! Detectors of objects in images: one trait, one file per detector.

mod candidates;
pub mod coco;
mod config;
pub mod onnx;
pub mod placard;
pub mod recorded;

use std::borrow::Cow;

use ecod::model::detection::Detection;
use opencv::core::{CV_8UC1, CV_8UC3, Mat};
use opencv::imgproc;
use opencv::prelude::*;

pub use config::{CustomDetector, DetectorConfig};

use crate::camera::frame::CameraFrame;

/// Detector of objects in images.
///
/// A detector may keep state between frames and may take tens of milliseconds: call it off the
/// async threads.
pub trait Detect: Send {
    /// Objects in the frame in any order, in pixels of `frame.image`.
    ///
    /// # Errors
    /// Returns a [`DetectError`] if the image is unusable or a library fails; the next frame may
    /// succeed.
    fn detect(&mut self, frame: &CameraFrame) -> Result<Vec<Detection>, DetectError>;
}

/// Error on one frame; the detector remains usable.
#[derive(Debug, thiserror::Error)]
pub enum DetectError {
    /// The image is empty or not 8-bit gray or BGR.
    #[error("frame {seq} has {found}, need 8-bit gray or bgr pixels")]
    UnusableImage {
        /// The frame's sequence number.
        seq: u64,
        /// Description of the pixels that the frame has.
        found: String,
    },
    /// OpenCV refused an operation.
    #[error("opencv failed in {step}")]
    OpenCv {
        /// Name of the operation that failed.
        step: &'static str,
        /// The error that OpenCV returned.
        #[source]
        source: opencv::Error,
    },
    /// The runtime failed to run the model.
    #[error("the model failed: {0}")]
    Model(String),
    /// The model found an object of a class without a label.
    #[error(
        "the model found class {class}, but there are {labels} labels: list all of its classes in `labels`"
    )]
    UnknownClass {
        /// Number of the class in the model.
        class: usize,
        /// Number of the labels that are configured.
        labels: usize,
    },
    /// The model's outputs do not match its family.
    #[error(
        "the outputs of the model contradict the family {family}: {what}; set `family` and `first_class`, or export the model as docs/cameras.md lists"
    )]
    Contradiction {
        /// The family in use.
        family: String,
        /// The contradiction as a phrase.
        what: String,
    },
    /// The decoder refused the image.
    #[error("placard decoder failed: {0}")]
    Decoder(String),
}

/// The frame's pixels, blue, green and red.
fn bgr(frame: &CameraFrame) -> Result<Cow<'_, Mat>, DetectError> {
    let image = &frame.image;
    let unusable = |found: String| DetectError::UnusableImage {
        seq: frame.seq,
        found,
    };
    match image.typ() {
        _ if image.empty() => Err(unusable("no pixels".into())),
        CV_8UC3 => Ok(Cow::Borrowed(image)),
        CV_8UC1 => {
            let mut coloured = Mat::default();
            imgproc::cvt_color_def(image, &mut coloured, imgproc::COLOR_GRAY2BGR).map_err(
                |source| DetectError::OpenCv {
                    step: "gray to colour",
                    source,
                },
            )?;
            Ok(Cow::Owned(coloured))
        }
        other => Err(unusable(format!("pixels of opencv type {other}"))),
    }
}
