//! Pose of a vehicle: constant, or received while it moves.

use std::net::SocketAddr;

use ecod::config::{ConfigError, check_range};
use ecod::model::geometry::Pose;
use ecod::model::time::Timestamp;
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
    /// UDP address that receives poses from the vehicle's localisation. It replaces the keys above, and a frame without
    /// a pose near its time is not reported. Default none: the vehicle stands still.
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

/// A received pose; unknown fields are ignored.
#[derive(Debug, Deserialize)]
struct PoseFix {
    x_m: f64,
    y_m: f64,
    heading_rad: f64,
    /// Unix time by this machine's clock. Default the time of receipt.
    captured_at_us: Option<Timestamp>,
}

/// Maximum distance from the origin in metres, along each axis.
const WORLD_M: f64 = 1e8;

/// Reads a pose from JSON, and its time by the node's steady clock, than which the wall clock is `wall_offset_us` more:
///
/// ```json
/// {"x_m": 4.2, "y_m": -1.0, "heading_rad": 1.57, "captured_at_us": 1732154400000000}
/// ```
///
/// # Errors
/// The problem as text.
pub fn read_pose(datagram: &[u8], now: Timestamp, wall_offset_us: i64) -> Result<(Timestamp, Pose), String> {
    let fix: PoseFix = serde_json::from_slice(datagram).map_err(|error| error.to_string())?;
    let within = |value: f64, most: f64| value.abs() <= most;
    if !within(fix.x_m, WORLD_M) || !within(fix.y_m, WORLD_M) || !within(fix.heading_rad, 1e3) {
        return Err(format!("{fix:?} is not in this world"));
    }
    let captured_at = fix.captured_at_us.map(|wall| wall.shifted(wall_offset_us.saturating_neg()));
    Ok((captured_at.unwrap_or(now), Pose::new(fix.x_m, fix.y_m, fix.heading_rad)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_has_its_own_time_or_that_of_its_receipt() {
        let now = Timestamp(7);
        let told =
            read_pose(br#"{"x_m":1,"y_m":-2.5,"heading_rad":3.1,"captured_at_us":5,"speed_mps":4}"#, now, 2).unwrap();
        assert_eq!(told, (Timestamp(3), Pose::new(1.0, -2.5, 3.1)));
        assert_eq!(read_pose(br#"{"x_m":1,"y_m":2,"heading_rad":0}"#, now, 2).unwrap().0, now);
    }

    #[test]
    fn what_is_no_pose_is_refused_with_a_reason() {
        for (datagram, reason) in [
            (&b"{\"x_m\":1,\"y_m\":2}"[..], "heading_rad"),
            (b"{\"x_m\":1e12,\"y_m\":2,\"heading_rad\":0}", "world"),
            (b"{\"x_m\":1,\"y_m\":2,\"heading_rad\":0,\"captured_at_us\":-1}", "invalid value"),
            (b"\xff\xfe", "line 1"),
        ] {
            let error = read_pose(datagram, Timestamp(0), 0).unwrap_err();
            assert!(error.contains(reason), "{error}");
        }
    }
}
