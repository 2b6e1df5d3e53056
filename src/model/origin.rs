//! The place of a cell's frame on Earth.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_range};

/// Geographic origin of the east-north frame, in WGS 84.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeographicOrigin {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
    /// Height above the ellipsoid in metres. Default 0.
    #[serde(default)]
    pub height_m: f64,
    /// Direction of the x axis in degrees, counter-clockwise from true east. Default 0.
    #[serde(default)]
    pub rotation_deg: f64,
}

impl GeographicOrigin {
    /// Checks all values.
    ///
    /// # Errors
    /// [`ConfigError`] naming the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("latitude_deg", self.latitude_deg, -90.0, 90.0)?;
        check_range("longitude_deg", self.longitude_deg, -180.0, 180.0)?;
        check_range("height_m", self.height_m, -1e4, 1e5)?;
        check_range("rotation_deg", self.rotation_deg, -360.0, 360.0)
    }
}
