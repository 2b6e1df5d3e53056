//! Which detector a camera has.

use ecod::config::ConfigError;
use serde::{Deserialize, Serialize};

use super::Detect;
use super::coco::{CocoConfig, CocoDetector};
use super::placard::{PlacardConfig, PlacardDetector};
use super::recorded::{RecordedConfig, RecordedDetector};

/// The detector of a camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum DetectorConfig {
    /// QR codes on placards.
    Placard(PlacardConfig),
    /// The 80 kinds of objects of COCO.
    Coco(CocoConfig),
    /// Detections from a file.
    Recorded(RecordedConfig),
}

impl DetectorConfig {
    /// Checks every value; files are checked when they are opened.
    ///
    /// # Errors
    /// [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        match self {
            Self::Placard(config) => config.validate(),
            Self::Coco(config) => config.validate(),
            Self::Recorded(_) => Ok(()),
        }
    }

    /// Loads the detector.
    ///
    /// # Errors
    /// When a file of the detector cannot be used; the error names it.
    pub fn build(&self) -> anyhow::Result<Box<dyn Detect>> {
        Ok(match self {
            Self::Placard(config) => Box::new(PlacardDetector::new(config.clone())),
            Self::Coco(config) => Box::new(CocoDetector::new(config.clone())?),
            Self::Recorded(config) => Box::new(RecordedDetector::open(config)?),
        })
    }
}
