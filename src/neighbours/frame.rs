//! From a neighbour's frame into this cell's, through the place on Earth.

use nalgebra::{Point2, Rotation2, Vector2};

use super::COVER_M;
use crate::model::geometry::{Covariance, wrap_angle};
use crate::model::origin::{GeographicOrigin, GeographicPosition};
use crate::model::quadkey::Quadkey;
use crate::wire::FusedObject;

/// Metres in a degree of latitude.
const DEGREE_M: f64 = 111_195.0;

/// The change from a neighbour's frame to this cell's, and the area of which the neighbour may tell.
#[derive(Debug, Clone)]
pub(super) struct FrameChange {
    own: GeographicOrigin,
    /// Angle of the neighbour's axes in this cell's frame.
    rotation: Rotation2<f64>,
    /// The middle of the area: latitude and longitude in degrees.
    middle_deg: [f64; 2],
    /// Half its sides in degrees.
    half_deg: [f64; 2],
}

impl FrameChange {
    pub(super) fn new(from: &GeographicOrigin, own: &GeographicOrigin) -> Self {
        // The angle is the same for all of the frame to 1 µrad within a kilometre.
        let place = |x_m| own.to_map(&from.to_wgs84(x_m, 0.0, 0.0)).xy();
        let east = place(100.0) - place(0.0);
        let [[north_deg, west_deg], [south_deg, east_deg]] = Quadkey::of_cell(from).corners_deg();
        let middle_deg = [(north_deg + south_deg) / 2.0, (west_deg + east_deg) / 2.0];
        let cover_deg = COVER_M / DEGREE_M;
        let half_deg = [
            (north_deg - south_deg) / 2.0 + cover_deg,
            (east_deg - west_deg) / 2.0 + cover_deg / middle_deg[0].to_radians().cos(),
        ];
        Self { own: *own, rotation: Rotation2::new(east.y.atan2(east.x)), middle_deg, half_deg }
    }

    /// True if the neighbour may tell of a place.
    pub(super) fn is_covered(&self, place: &GeographicPosition) -> bool {
        let north_deg = place.latitude_deg - self.middle_deg[0];
        let east_deg = (place.longitude_deg - self.middle_deg[1] + 180.0).rem_euclid(360.0) - 180.0;
        north_deg.abs() <= self.half_deg[0] && east_deg.abs() <= self.half_deg[1]
    }

    /// Puts an object of the neighbour, which is at `place`, into this cell's frame.
    pub(super) fn apply(&self, place: &GeographicPosition, object: &mut FusedObject) {
        let position: Point2<f64> = self.own.to_map(place).xy();
        (object.x_m, object.y_m) = (position.x, position.y);
        object.velocity_mps = object.velocity_mps.map(|velocity| (self.rotation * Vector2::from(velocity)).into());
        object.heading_rad = object.heading_rad.map(|heading_rad| wrap_angle(heading_rad + self.rotation.angle()));
        let turned = self.rotation * object.covariance().matrix() * self.rotation.inverse();
        object.covariance_m2 = Covariance { xx: turned.m11, xy: turned.m12, yy: turned.m22 }.into();
    }
}
