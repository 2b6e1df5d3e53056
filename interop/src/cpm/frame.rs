//! The frame of a message: east and north of its reference position.

use std::f64::consts::FRAC_PI_2;

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd as cdd;
use ecod::model::geometry::{Covariance, wrap_angle};
use ecod::model::origin::{GeographicOrigin, GeographicPose, GeographicPosition};
use nalgebra::{Rotation2, Vector2};

use super::CpmError;

/// Unavailable values of latitude, longitude and altitude.
const NO_LATITUDE: i32 = 900_000_001;
const NO_LONGITUDE: i32 = 1_800_000_001;
const NO_ALTITUDE: i32 = 800_001;

/// Codes of the semi-axes of a position's error: more than 4.093 m, and unavailable.
const WIDE_AXIS: u16 = 4094;
const UNSTATED_AXIS: u16 = 4095;

/// Code of an ellipse's direction that is unavailable.
const NO_DIRECTION: u16 = 3601;

/// Standard deviations in a semi-axis of an ellipse of 95 %: the root of the quantile of
/// chi-squared with two degrees.
const ELLIPSE_SIGMAS: f64 = 2.4477;

/// Semi-axis in metres if the station states none: usual for satellite positioning without
/// corrections.
const UNSTATED_AXIS_M: f64 = 5.0;

/// A cell's frame and a message's frame.
pub(super) struct MessageFrame {
    cell: GeographicOrigin,
    reference: GeographicOrigin,
    /// Direction of the cell's x axis in the message's frame, in radians counter-clockwise from
    /// east.
    rotation_rad: f64,
}

impl MessageFrame {
    /// The frame of a message at a place in the cell's frame. Its reference position is rounded to
    /// a value that a message can state.
    pub(super) fn at(cell: &GeographicOrigin, x_m: f64, y_m: f64) -> Result<Self, CpmError> {
        let place = cell.to_wgs84(x_m, y_m, 0.0);
        Self::new(
            cell,
            GeographicPosition {
                latitude_deg: (place.latitude_deg * 1e7).round() / 1e7,
                longitude_deg: (place.longitude_deg * 1e7).round() / 1e7,
                height_m: (place.height_m * 100.0).round().clamp(-1e5, 8e5) / 100.0,
            },
        )
    }

    /// The frame of a received message.
    pub(super) fn of(
        cell: &GeographicOrigin,
        position: &cdd::ReferencePosition,
    ) -> Result<Self, CpmError> {
        let latitude = position.latitude.0;
        let longitude = position.longitude.0;
        if latitude == NO_LATITUDE || longitude == NO_LONGITUDE {
            return Err(CpmError::NoPosition);
        }
        let altitude = position.altitude.altitude_value.0;
        let height_m = if altitude == NO_ALTITUDE {
            cell.height_m
        } else {
            f64::from(altitude) / 100.0
        };
        let latitude_deg = f64::from(latitude) / 1e7;
        let longitude_deg = f64::from(longitude) / 1e7;
        Self::new(
            cell,
            GeographicPosition {
                latitude_deg,
                longitude_deg,
                height_m,
            },
        )
    }

    /// Covariance of a received reference position in the cell's frame.
    ///
    /// # Errors
    /// Returns [`CpmError::NoPosition`] for an error out of range.
    pub(super) fn position_error(
        &self,
        ellipse: &cdd::PosConfidenceEllipse,
    ) -> Result<Covariance, CpmError> {
        let major = ellipse.semi_major_confidence.0;
        let minor = ellipse.semi_minor_confidence.0;
        if major == WIDE_AXIS || minor == WIDE_AXIS {
            return Err(CpmError::NoPosition);
        }
        let is_stated = |axis: u16| (1..WIDE_AXIS).contains(&axis);
        if !is_stated(major) || !is_stated(minor) {
            return Ok(Covariance::isotropic(UNSTATED_AXIS_M / ELLIPSE_SIGMAS));
        }
        let sigma_m = |axis: u16| f64::from(axis) / 100.0 / ELLIPSE_SIGMAS;
        let direction = ellipse.semi_major_orientation.0;
        if direction >= 3600 {
            return Ok(Covariance::isotropic(sigma_m(major.max(minor))));
        }
        let bearing_rad =
            self.heading_to_cell(FRAC_PI_2 - (f64::from(direction) / 10.0).to_radians());
        Ok(Covariance::along_bearing(
            bearing_rad,
            sigma_m(major),
            sigma_m(minor),
        ))
    }

    fn new(cell: &GeographicOrigin, at: GeographicPosition) -> Result<Self, CpmError> {
        let GeographicPosition {
            latitude_deg,
            longitude_deg,
            height_m,
        } = at;
        let east_pose = GeographicPose {
            latitude_deg,
            longitude_deg,
            height_m: Some(height_m),
            azimuth_deg: 90.0,
        };
        let east = cell.pose_to_map(&east_pose).map_err(|_| CpmError::TooFar)?;
        let reference = GeographicOrigin {
            latitude_deg,
            longitude_deg,
            height_m,
            rotation_deg: 0.0,
        };
        Ok(Self {
            cell: *cell,
            reference,
            rotation_rad: -east.heading_rad,
        })
    }

    /// The reference position in a message's form. Its error is unavailable, because a node has no
    /// error estimate of its origin or pose.
    pub(super) fn reference_position(&self) -> cdd::ReferencePosition {
        let tenth_microdegrees = |degrees: f64| (degrees * 1e7).round() as i32;
        cdd::ReferencePosition {
            latitude: cdd::Latitude(tenth_microdegrees(self.reference.latitude_deg)),
            longitude: cdd::Longitude(tenth_microdegrees(self.reference.longitude_deg)),
            position_confidence_ellipse: cdd::PosConfidenceEllipse {
                semi_major_confidence: cdd::SemiAxisLength(UNSTATED_AXIS),
                semi_minor_confidence: cdd::SemiAxisLength(UNSTATED_AXIS),
                semi_major_orientation: cdd::HeadingValue(NO_DIRECTION),
            },
            altitude: cdd::Altitude {
                altitude_value: cdd::AltitudeValue((self.reference.height_m * 100.0).round() as i32),
                altitude_confidence: cdd::AltitudeConfidence::unavailable,
            },
        }
    }

    /// Metres east and north of the reference position.
    pub(super) fn to_message(&self, x_m: f64, y_m: f64) -> [f64; 2] {
        let local = self.reference.to_map(&self.cell.to_wgs84(x_m, y_m, 0.0));
        [local.x, local.y]
    }

    /// A position in the cell's frame.
    pub(super) fn to_cell(&self, [east_m, north_m]: [f64; 2]) -> [f64; 2] {
        let local = self
            .cell
            .to_map(&self.reference.to_wgs84(east_m, north_m, 0.0));
        [local.x, local.y]
    }

    /// A velocity in the message's frame.
    pub(super) fn velocity_to_message(&self, velocity: [f64; 2]) -> [f64; 2] {
        (Rotation2::new(self.rotation_rad) * Vector2::from(velocity)).into()
    }

    /// A velocity in the cell's frame.
    pub(super) fn velocity_to_cell(&self, velocity: [f64; 2]) -> [f64; 2] {
        (Rotation2::new(-self.rotation_rad) * Vector2::from(velocity)).into()
    }

    /// A direction in the message's frame.
    pub(super) fn heading_to_message(&self, heading_rad: f64) -> f64 {
        wrap_angle(heading_rad + self.rotation_rad)
    }

    /// A direction in the cell's frame.
    pub(super) fn heading_to_cell(&self, heading_rad: f64) -> f64 {
        wrap_angle(heading_rad - self.rotation_rad)
    }

    /// Variances east and north of a covariance in the cell's frame.
    pub(super) fn variances_to_message(&self, covariance_m2: [f64; 3]) -> [f64; 2] {
        let turn = Rotation2::new(self.rotation_rad);
        (turn * Covariance::from(covariance_m2).matrix() * turn.inverse())
            .diagonal()
            .into()
    }

    /// The covariance in the cell's frame of variances east and north.
    pub(super) fn variances_to_cell(&self, [east_m2, north_m2]: [f64; 2]) -> Covariance {
        Covariance::along_bearing(-self.rotation_rad, east_m2.sqrt(), north_m2.sqrt())
    }
}
