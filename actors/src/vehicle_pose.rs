//! Where a vehicle is: a constant, or told while it moves.

use std::net::SocketAddr;

use ecod::config::{ConfigError, check_range};
use ecod::geometry::Pose;
use serde::{Deserialize, Serialize};

/// The vehicle's pose in the cell's east-north frame; `[pose]` in the configuration file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseConfig {
    /// East in metres. Default 0.
    pub x_m: f64,
    /// North in metres. Default 0.
    pub y_m: f64,
    /// Heading in degrees, counter-clockwise from east. Default 0.
    pub heading_deg: f64,
    /// UDP address on which the vehicle's localisation tells its poses; the keys above are then not used, and a frame
    /// without a pose near its time is not reported. Default none: the vehicle stands still.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<SocketAddr>,
}

impl PoseConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`ConfigError`] naming the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("x_m", self.x_m, -1e8, 1e8)?;
        check_range("y_m", self.y_m, -1e8, 1e8)?;
        check_range("heading_deg", self.heading_deg, -360.0, 360.0)
    }

    /// The constant pose.
    pub fn pose(&self) -> Pose {
        Pose::new(self.x_m, self.y_m, self.heading_deg.to_radians())
    }
}
