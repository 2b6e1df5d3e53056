//! Pose of a vehicle: constant, or received while it moves.

use std::net::SocketAddr;

use ecod::config::{ConfigError, check_range};
use ecod::model::geometry::{Pose, TURN_BOUND_RAD};
use ecod::model::origin::{GeographicPose, StatedPose};
use ecod::model::time::Timestamp;
use ecod::wire::use_integers;
use nalgebra::Point2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The vehicle's pose, in the cell's frame or on Earth; `[pose]` in the configuration file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PoseConfig {
    /// Position east in metres. Default 0.
    pub x_m: f64,
    /// Position north in metres. Default 0.
    pub y_m: f64,
    /// Heading in degrees, counter-clockwise from east. Default 0.
    pub heading_deg: f64,
    /// Latitude (WGS 84) in degrees, north positive. With `longitude_deg` and `azimuth_deg` it
    /// replaces the keys above; the cell then needs an `[origin]`. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latitude_deg: Option<f64>,
    /// Longitude in degrees, east positive. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub longitude_deg: Option<f64>,
    /// Height above the ellipsoid in metres. Default: the height of the cell's origin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// Heading in degrees, clockwise from true north; replaces `heading_deg`. Without an `[origin]`,
    /// the y axis of the cell's frame is north. Default: not set.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub azimuth_deg: Option<f64>,
    /// UDP address that receives poses from the vehicle's localisation. It replaces the keys above,
    /// and a frame without a pose near its time is not reported. Default: not set; the vehicle
    /// stands still.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<SocketAddr>,
    /// False for a camera at the road, which is then no object of the map. Default: true.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub moving: Option<bool>,
}

impl PoseConfig {
    /// Checks every value, and that the keys belong to one kind of pose.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the first key that is out of range, missing or of the
    /// other kind.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if self.is_fixed() && self.listen.is_some() {
            return Err(ConfigError::new(
                "moving",
                false,
                "true or absent if `listen` is set: a fixed camera receives no poses",
            ));
        }
        check_range("x_m", self.x_m, -1e8, 1e8)?;
        check_range("y_m", self.y_m, -1e8, 1e8)?;
        check_range("heading_deg", self.heading_deg, -360.0, 360.0)?;
        let stated = self.stated();
        let replaced = match stated {
            StatedPose::InMap(_) => return self.validate_in_map(),
            StatedPose::ByCompass(_, azimuth_deg) => {
                if self.heading_deg != 0.0 {
                    let allowed = "absent beside `azimuth_deg`, which is the heading, clockwise from true north";
                    return Err(ConfigError::new("heading_deg", self.heading_deg, allowed));
                }
                return check_range("azimuth_deg", azimuth_deg, -360.0, 360.0);
            }
            StatedPose::OnEarth(pose) => pose,
        };
        for (key, value) in [
            ("x_m", self.x_m),
            ("y_m", self.y_m),
            ("heading_deg", self.heading_deg),
        ] {
            if value != 0.0 {
                let allowed = "absent beside `latitude_deg` and `longitude_deg`: the heading is `azimuth_deg`, clockwise \
                               from true north";
                return Err(ConfigError::new(key, value, allowed));
            }
        }
        replaced.validate()
    }

    /// Checks that a pose on Earth is complete.
    fn validate_in_map(&self) -> Result<(), ConfigError> {
        let parts = [
            ("latitude_deg", self.latitude_deg),
            ("longitude_deg", self.longitude_deg),
            ("azimuth_deg", self.azimuth_deg),
        ];
        let missing = parts.iter().find(|(_, value)| value.is_none());
        match missing {
            Some((key, _))
                if self.height_m.is_some() || parts.iter().any(|(_, value)| value.is_some()) =>
            {
                let allowed = "a number: a pose on Earth has `latitude_deg`, `longitude_deg` and `azimuth_deg`, its \
                               heading clockwise from true north";
                Err(ConfigError::missing(*key, allowed))
            }
            _ => Ok(()),
        }
    }

    /// True for a camera at the road.
    pub fn is_fixed(&self) -> bool {
        self.moving == Some(false)
    }

    /// The configured pose, in the frame in which it is stated.
    pub fn stated(&self) -> StatedPose {
        match (self.latitude_deg, self.longitude_deg, self.azimuth_deg) {
            (Some(latitude_deg), Some(longitude_deg), Some(azimuth_deg)) => {
                StatedPose::OnEarth(GeographicPose {
                    latitude_deg,
                    longitude_deg,
                    height_m: self.height_m,
                    azimuth_deg,
                })
            }
            (None, None, Some(azimuth_deg)) if self.height_m.is_none() => {
                StatedPose::ByCompass(Point2::new(self.x_m, self.y_m), azimuth_deg)
            }
            _ => StatedPose::InMap(Pose::new(self.x_m, self.y_m, self.heading_deg.to_radians())),
        }
    }
}

/// A received pose in the cell's frame; unknown fields are ignored.
#[derive(Debug, Deserialize)]
struct PoseFix {
    x_m: f64,
    y_m: f64,
    heading_rad: Option<f64>,
    azimuth_deg: Option<f64>,
}

/// The time of a received pose.
#[derive(Debug, Deserialize)]
struct FixTime {
    /// Unix time by this machine's clock. Default the time of receipt.
    captured_at_us: Option<Timestamp>,
}

/// Time by which the stamp of a pose may be ahead of the clock, in microseconds. Until the clock
/// reaches such a stamp, all other poses are older than it.
const MAX_AHEAD_US: i64 = 100_000;

/// Maximum distance from the origin in metres, along each axis.
const WORLD_M: f64 = 1e8;

/// Reads a pose from JSON, and its time by the node's steady clock; the wall clock is
/// `wall_offset_us` ahead of it:
///
/// ```json
/// {"x_m": 4.2, "y_m": -1.0, "heading_rad": 1.57, "captured_at_us": 1732154400000000}
/// {"x_m": 4.2, "y_m": -1.0, "azimuth_deg": 0.0}
/// {"latitude_deg": 52.2296756, "longitude_deg": 21.0122287, "azimuth_deg": 90.0}
/// ```
///
/// # Errors
/// Returns the problem as text.
pub fn read_pose(
    datagram: &[u8],
    now: Timestamp,
    wall_offset_us: i64,
) -> Result<(Timestamp, StatedPose), String> {
    let mut fix: Value = serde_json::from_slice(datagram).map_err(|error| error.to_string())?;
    use_integers(&mut fix);
    let time = FixTime::deserialize(&fix).map_err(|error| error.to_string())?;
    let captured_at = time
        .captured_at_us
        .map(|wall| wall.shifted(wall_offset_us.saturating_neg()));
    let ahead_us = captured_at.map_or(0, |captured_at| captured_at.micros_from(now));
    if ahead_us > MAX_AHEAD_US {
        let ahead_s = ahead_us as f64 / 1e6;
        return Err(format!(
            "`captured_at_us` is {ahead_s:.1} s ahead of this machine's clock, must be Unix time in microseconds"
        ));
    }
    let is_on_earth = fix.get("latitude_deg").is_some();
    let pose = if is_on_earth {
        on_earth(&fix).map(StatedPose::OnEarth)
    } else {
        in_map(&fix)
    };
    Ok((captured_at.unwrap_or(now), pose?))
}

fn on_earth(fix: &Value) -> Result<GeographicPose, String> {
    let pose = GeographicPose::deserialize(fix).map_err(|error| error.to_string())?;
    pose.validate().map_err(in_words)?;
    Ok(pose)
}

fn in_map(fix: &Value) -> Result<StatedPose, String> {
    let PoseFix {
        x_m,
        y_m,
        heading_rad,
        azimuth_deg,
    } = PoseFix::deserialize(fix).map_err(|error| error.to_string())?;
    check_range("x_m", x_m, -WORLD_M, WORLD_M).map_err(in_words)?;
    check_range("y_m", y_m, -WORLD_M, WORLD_M).map_err(in_words)?;
    match (heading_rad, azimuth_deg) {
        (Some(heading_rad), None) if heading_rad.abs() <= TURN_BOUND_RAD => {
            Ok(StatedPose::InMap(Pose::new(x_m, y_m, heading_rad)))
        }
        (Some(heading_rad), None) => Err(format!(
            "`heading_rad`: {heading_rad} is beyond 2π; a heading is in radians, counter-clockwise from east: is this one \
             in degrees?"
        )),
        (None, Some(azimuth_deg)) => {
            check_range("azimuth_deg", azimuth_deg, -360.0, 360.0).map_err(in_words)?;
            Ok(StatedPose::ByCompass(Point2::new(x_m, y_m), azimuth_deg))
        }
        _ => Err("a pose has either `heading_rad` or `azimuth_deg`".to_owned()),
    }
}

/// The error of a received value, which is no key of the configuration.
fn in_words(error: ConfigError) -> String {
    let ConfigError {
        key,
        fault,
        allowed,
    } = error;
    format!("`{key}`{fault}, must be {allowed}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pose_time_defaults_to_receipt() {
        let now = Timestamp(7);
        let pose_read = read_pose(
            br#"{"x_m":1,"y_m":-2.5,"heading_rad":3.1,"captured_at_us":5,"speed_mps":4}"#,
            now,
            2,
        )
        .unwrap();
        assert_eq!(
            pose_read,
            (Timestamp(3), StatedPose::InMap(Pose::new(1.0, -2.5, 3.1)))
        );
        assert_eq!(
            read_pose(br#"{"x_m":1,"y_m":2,"heading_rad":0}"#, now, 2)
                .unwrap()
                .0,
            now
        );
    }

    #[test]
    fn earth_pose_is_in_degrees() {
        let pose_read = read_pose(
            br#"{"latitude_deg":52.2,"longitude_deg":21,"azimuth_deg":270,"captured_at_us":5}"#,
            Timestamp(7),
            0,
        );
        let pose = GeographicPose {
            latitude_deg: 52.2,
            longitude_deg: 21.0,
            height_m: None,
            azimuth_deg: 270.0,
        };
        assert_eq!(pose_read, Ok((Timestamp(5), StatedPose::OnEarth(pose))));
    }

    #[test]
    fn metric_pose_accepts_compass_heading() {
        let south = StatedPose::ByCompass(Point2::new(1.0, 6.0), 180.0);
        let pose_read = read_pose(br#"{"x_m":1,"y_m":6,"azimuth_deg":180}"#, Timestamp(7), 0);
        assert_eq!(pose_read, Ok((Timestamp(7), south)));
        let configured: PoseConfig = toml::from_str("x_m = 1\ny_m = 6\nazimuth_deg = 180").unwrap();
        assert_eq!(configured.validate(), Ok(()));
        assert_eq!(configured.stated(), south);
        let both: PoseConfig = toml::from_str("azimuth_deg = 180\nheading_deg = 90").unwrap();
        let error = both.validate().unwrap_err().to_string();
        assert!(
            error.contains("`heading_deg`: 90 is not allowed"),
            "{error}"
        );
    }

    #[test]
    fn invalid_pose_names_reason() {
        for (datagram, reason) in [
            (&b"{\"x_m\":1,\"y_m\":2}"[..], "heading_rad"),
            (b"{\"x_m\":1e12,\"y_m\":2,\"heading_rad\":0}", "`x_m`: 1e12"),
            (
                b"{\"x_m\":1,\"y_m\":2,\"heading_rad\":-90}",
                "`heading_rad`: -90 is beyond 2",
            ),
            (
                b"{\"x_m\":1,\"y_m\":2,\"heading_rad\":0,\"azimuth_deg\":90}",
                "either `heading_rad` or `azimuth_deg`",
            ),
            (
                b"{\"x_m\":1,\"y_m\":2,\"azimuth_deg\":400}",
                "`azimuth_deg`: 400",
            ),
            (
                b"{\"x_m\":1,\"y_m\":2,\"heading_rad\":0,\"captured_at_us\":-1}",
                "invalid value",
            ),
            (b"\xff\xfe", "line 1"),
            (
                b"{\"latitude_deg\":52,\"longitude_deg\":21,\"heading_rad\":0}",
                "azimuth_deg",
            ),
            (
                b"{\"latitude_deg\":152,\"longitude_deg\":21,\"azimuth_deg\":0}",
                "`latitude_deg`: 152",
            ),
        ] {
            let error = read_pose(datagram, Timestamp(0), 0).unwrap_err();
            assert!(error.contains(reason), "{error}");
        }
    }

    #[test]
    fn configured_pose_uses_one_frame() {
        let pose = |toml: &str| {
            let pose: PoseConfig = toml::from_str(toml).unwrap();
            pose.validate()
                .map(|()| pose.stated())
                .map_err(|error| error.to_string())
        };
        let on_earth = "latitude_deg = 52.2\nlongitude_deg = 21\n";
        assert_eq!(
            pose("x_m = 1\nheading_deg = 180"),
            Ok(StatedPose::InMap(Pose::new(1.0, 0.0, std::f64::consts::PI)))
        );
        let stated = pose(&format!("{on_earth}height_m = 113\nazimuth_deg = 90"));
        assert!(
            matches!(
                stated,
                Ok(StatedPose::OnEarth(GeographicPose {
                    height_m: Some(113.0),
                    ..
                }))
            ),
            "{stated:?}"
        );
        for (more, parts) in [
            ("", ["`azimuth_deg`", "missing"]),
            ("azimuth_deg = 400", ["`azimuth_deg`", "400"]),
            (
                "azimuth_deg = 90\nx_m = 2",
                ["`x_m`", "absent beside `latitude_deg`"],
            ),
            (
                "azimuth_deg = 90\nheading_deg = 2",
                ["`heading_deg`", "`azimuth_deg`, clockwise from true north"],
            ),
        ] {
            let error = pose(&format!("{on_earth}{more}")).unwrap_err();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
        assert!(
            pose("height_m = 113")
                .unwrap_err()
                .contains("`latitude_deg`")
        );
    }

    #[test]
    fn future_stamp_is_refused() {
        let now = Timestamp(1_732_154_400_000_000);
        let read = |stamp: String| {
            let text = format!(r#"{{"x_m":1,"y_m":2,"heading_rad":0,"captured_at_us":{stamp}}}"#);
            read_pose(text.as_bytes(), now, 0)
        };
        for ahead_us in [-5_000_000_i64, 0, 50_000] {
            let stamp = now.shifted(ahead_us);
            assert_eq!(read(stamp.micros().to_string()).unwrap().0, stamp);
            assert_eq!(read(format!("{}.0", stamp.micros())).unwrap().0, stamp);
        }
        for ahead_us in [1_000_000, 3_600_000_000, i64::MAX / 2] {
            let stamp = now.shifted(ahead_us).micros().to_string();
            let error = read(stamp).unwrap_err();
            assert!(error.contains("s ahead of this machine's clock"), "{error}");
        }
        let nanoseconds = format!("{}000", now.micros());
        assert!(read(nanoseconds).is_err());
    }
}
