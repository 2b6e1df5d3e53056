//! The place of a cell's frame on Earth, and positions and poses in WGS 84.
//!
//! The frame is the tangent plane: it touches Earth's curve at the origin, x and y lie in it, and z
//! is the height above it. Within 5 km of the origin x and y are distances along the ground to 1
//! mm, and the ground is s²/2R below the plane: 2 m at s = 5 km.

use map_3d::{Ellipsoid, enu2geodetic, enu2uvw, geodetic2enu, uvw2enu};
use minicbor::{Decode, Encode};
use nalgebra::{Point2, Point3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_range};
use crate::model::geometry::{Pose, wrap_angle};

/// Maximum distance of a pose from the origin in metres. At larger distances x and y deviate from
/// distances on the ground: by 4 m at this distance.
const MAX_DISTANCE_M: f64 = 1e5;

/// Geographic origin of the east-north frame, in WGS 84.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Encode, Decode, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GeographicOrigin {
    /// Latitude in degrees, north positive.
    #[n(0)]
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    #[n(1)]
    pub longitude_deg: f64,
    /// Height above the ellipsoid in metres. Default 0.
    #[serde(default)]
    #[n(2)]
    pub height_m: f64,
    /// Direction of the x axis in degrees, counter-clockwise from true east. Default 0.
    #[serde(default)]
    #[n(3)]
    pub rotation_deg: f64,
}

/// A position on Earth, in WGS 84.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GeographicPosition {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
    /// Height above the ellipsoid in metres.
    pub height_m: f64,
}

/// A vehicle's position and heading on Earth, in WGS 84.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct GeographicPose {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
    /// Height above the ellipsoid in metres; if absent, the height of the cell's origin. At 5 km
    /// from the origin, an error of 10 m moves the vehicle by 8 mm.
    pub height_m: Option<f64>,
    /// Heading in degrees, clockwise from true north.
    pub azimuth_deg: f64,
}

impl GeographicPose {
    /// Checks all values.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("latitude_deg", self.latitude_deg, -90.0, 90.0)?;
        check_range("longitude_deg", self.longitude_deg, -180.0, 180.0)?;
        check_range("height_m", self.height_m.unwrap_or(0.0), -1e4, 1e5)?;
        check_range("azimuth_deg", self.azimuth_deg, -360.0, 360.0)
    }
}

/// A vehicle's pose as configuration or a program states it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StatedPose {
    /// In the cell's frame.
    InMap(Pose),
    /// At a position in the cell's frame in metres, with a heading in degrees clockwise from true
    /// north. Without an origin, the y axis is north.
    ByCompass(Point2<f64>, f64),
    /// In latitude and longitude; the cell needs an origin to convert it.
    OnEarth(GeographicPose),
}

/// A pose on Earth that has no place in the cell's frame.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// The place of the frame is unknown.
    #[error(
        "the pose is in latitude and longitude, and the cell has no origin: set `[origin]` in the cell's description \
         (`ecod-node cell set`), or state the pose in metres"
    )]
    NoOrigin,
    /// The heading is no compass heading.
    #[error(
        "`azimuth_deg`: {azimuth_deg} is not allowed, must be from -360 to 360, in degrees clockwise from north"
    )]
    Azimuth {
        /// The value.
        azimuth_deg: f64,
    },
    /// The frame is flat, and Earth is not.
    #[error(
        "the pose is {} km from the cell's origin, at most {} are allowed: check its latitude and longitude, and those of \
         `[origin]`",
        (distance_m / 1000.0).round(),
        MAX_DISTANCE_M / 1000.0
    )]
    TooFar {
        /// Distance from the origin in metres.
        distance_m: f64,
    },
}

impl StatedPose {
    /// The pose in a frame with this origin.
    ///
    /// # Errors
    /// Returns a [`PoseError`] for a pose on Earth without an origin, or far from it.
    pub fn in_map(&self, origin: Option<&GeographicOrigin>) -> Result<Pose, PoseError> {
        match self {
            Self::InMap(pose) => Ok(*pose),
            Self::ByCompass(position, azimuth_deg) => {
                let rotation_deg = origin.map_or(0.0, |origin| origin.rotation_deg);
                let heading_deg = 90.0 - azimuth_deg - rotation_deg;
                Ok(Pose {
                    position: *position,
                    heading_rad: wrap_angle(heading_deg.to_radians()),
                })
            }
            Self::OnEarth(pose) => origin.ok_or(PoseError::NoOrigin)?.pose_to_map(pose),
        }
    }
}

/// Checks a heading in degrees clockwise from north.
///
/// # Errors
/// Returns [`PoseError::Azimuth`] beyond ±360°, also for NaN.
pub fn check_azimuth(azimuth_deg: f64) -> Result<(), PoseError> {
    if azimuth_deg.abs() <= 360.0 {
        Ok(())
    } else {
        Err(PoseError::Azimuth { azimuth_deg })
    }
}

impl GeographicOrigin {
    /// Checks all values.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("latitude_deg", self.latitude_deg, -90.0, 90.0)?;
        check_range("longitude_deg", self.longitude_deg, -180.0, 180.0)?;
        check_range("height_m", self.height_m, -1e4, 1e5)?;
        check_range("rotation_deg", self.rotation_deg, -360.0, 360.0)
    }

    /// The position on Earth of a position in the frame, `z_m` above the tangent plane.
    pub fn to_wgs84(&self, x_m: f64, y_m: f64, z_m: f64) -> GeographicPosition {
        let (sin, cos) = self.rotation_deg.to_radians().sin_cos();
        let east = x_m * cos - y_m * sin;
        let north = x_m * sin + y_m * cos;
        let (latitude, longitude) = self.radians();
        let (latitude, longitude, height_m) = enu2geodetic(
            east,
            north,
            z_m,
            latitude,
            longitude,
            self.height_m,
            Ellipsoid::WGS84,
        );
        GeographicPosition {
            latitude_deg: latitude.to_degrees(),
            longitude_deg: longitude.to_degrees(),
            height_m,
        }
    }

    /// The position in the frame, and its height above the tangent plane, of a position on Earth.
    pub fn to_map(&self, position: &GeographicPosition) -> Point3<f64> {
        let (latitude, longitude) = self.radians();
        let (east, north, up) = geodetic2enu(
            position.latitude_deg.to_radians(),
            position.longitude_deg.to_radians(),
            position.height_m,
            latitude,
            longitude,
            self.height_m,
            Ellipsoid::WGS84,
        );
        let (sin, cos) = self.rotation_deg.to_radians().sin_cos();
        Point3::new(east * cos + north * sin, north * cos - east * sin, up)
    }

    /// The pose in the frame of a pose on Earth. North there and north at the origin are different
    /// directions, except on one meridian.
    ///
    /// # Errors
    /// Returns [`PoseError::TooFar`] at more than 100 km from the origin, and
    /// [`PoseError::Azimuth`] for a heading beyond ±360°.
    pub fn pose_to_map(&self, pose: &GeographicPose) -> Result<Pose, PoseError> {
        let GeographicPose {
            latitude_deg,
            longitude_deg,
            height_m,
            azimuth_deg,
        } = *pose;
        check_azimuth(azimuth_deg)?;
        let height_m = height_m.unwrap_or(self.height_m);
        let position = self.to_map(&GeographicPosition {
            latitude_deg,
            longitude_deg,
            height_m,
        });
        let distance_m = position.coords.norm();
        if distance_m > MAX_DISTANCE_M {
            return Err(PoseError::TooFar { distance_m });
        }
        let (sin, cos) = azimuth_deg.to_radians().sin_cos();
        let (u, v, w) = enu2uvw(
            sin,
            cos,
            0.0,
            latitude_deg.to_radians(),
            longitude_deg.to_radians(),
        );
        let (latitude, longitude) = self.radians();
        let (east, north, _) = uvw2enu(u, v, w, latitude, longitude);
        let heading_rad = wrap_angle(north.atan2(east) - self.rotation_deg.to_radians());
        Ok(Pose {
            position: position.xy(),
            heading_rad,
        })
    }

    /// Latitude and longitude in radians.
    fn radians(&self) -> (f64, f64) {
        (
            self.latitude_deg.to_radians(),
            self.longitude_deg.to_radians(),
        )
    }
}

#[cfg(test)]
mod tests;
