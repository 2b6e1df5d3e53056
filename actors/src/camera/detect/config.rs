//! Choice of a camera's detector.

use std::fmt;
use std::sync::Arc;

use ecod::config::ConfigError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Detect;
use super::coco::{CocoConfig, CocoDetector};
use super::onnx::{OnnxConfig, OnnxDetector};
use super::placard::{PlacardConfig, PlacardDetector};
use super::recorded::{RecordedConfig, RecordedDetector};

/// The detector of a camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum DetectorConfig {
    /// QR codes on placards.
    Placard(PlacardConfig),
    /// The 80 kinds of objects of COCO.
    Coco(CocoConfig),
    /// A neural network in a file of the ONNX format.
    Onnx(OnnxConfig),
    /// Detections from a file.
    Recorded(RecordedConfig),
    /// A detector of the embedding program; not available in files.
    #[serde(skip)]
    Custom(CustomDetector),
}

/// Factory of a detector outside this crate, called at every start of the detector's actor.
#[derive(Clone)]
pub struct CustomDetector {
    build: Arc<dyn Fn() -> anyhow::Result<Box<dyn Detect>> + Send + Sync>,
}

impl CustomDetector {
    /// A factory. If it fails, as without a file, the node fails.
    pub fn new(
        build: impl Fn() -> anyhow::Result<Box<dyn Detect>> + Send + Sync + 'static,
    ) -> Self {
        Self {
            build: Arc::new(build),
        }
    }
}

impl PartialEq for CustomDetector {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.build, &other.build)
    }
}

impl fmt::Debug for CustomDetector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("CustomDetector")
    }
}

impl DetectorConfig {
    /// Checks every value; files are checked when they are opened.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        match self {
            Self::Placard(config) => config.validate(),
            Self::Coco(config) => config.validate(),
            Self::Onnx(config) => config.validate(),
            Self::Recorded(_) | Self::Custom(_) => Ok(()),
        }
    }

    /// Loads the detector.
    ///
    /// # Errors
    /// Returns an error if a file of the detector cannot be used; the error names it.
    pub fn build(&self) -> anyhow::Result<Box<dyn Detect>> {
        Ok(match self {
            Self::Placard(config) => Box::new(PlacardDetector::new(config.clone())),
            Self::Coco(config) => Box::new(CocoDetector::new(config.clone())?),
            Self::Onnx(config) => Box::new(OnnxDetector::new(config.clone())?),
            Self::Recorded(config) => Box::new(RecordedDetector::open(config)?),
            Self::Custom(custom) => (custom.build)()?,
        })
    }
}
