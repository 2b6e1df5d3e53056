//! From a neighbour's frame into this cell's, through the place on Earth.

use nalgebra::{Point2, Rotation2, Vector2};

use crate::model::geometry::{Covariance, wrap_angle};
use crate::model::origin::{GeographicOrigin, GeographicPosition};
use crate::wire::FusedObject;

/// The change from a neighbour's frame to this cell's.
#[derive(Debug, Clone)]
pub(super) struct FrameChange {
    own: GeographicOrigin,
    /// Angle of the neighbour's axes in this cell's frame.
    rotation: Rotation2<f64>,
}

impl FrameChange {
    pub(super) fn new(from: &GeographicOrigin, own: &GeographicOrigin) -> Self {
        // Within a kilometre, the angle is constant throughout the frame to 1 µrad.
        let place = |x_m| own.to_map(&from.to_wgs84(x_m, 0.0, 0.0)).xy();
        let east = place(100.0) - place(0.0);
        Self {
            own: *own,
            rotation: Rotation2::new(east.y.atan2(east.x)),
        }
    }

    /// Puts an object of the neighbour, which is at `place`, into this cell's frame.
    pub(super) fn apply(&self, place: &GeographicPosition, object: &mut FusedObject) {
        let position: Point2<f64> = self.own.to_map(place).xy();
        object.x_m = position.x;
        object.y_m = position.y;
        object.velocity_mps = object
            .velocity_mps
            .map(|velocity| (self.rotation * Vector2::from(velocity)).into());
        object.heading_rad = object
            .heading_rad
            .map(|heading_rad| wrap_angle(heading_rad + self.rotation.angle()));
        let turned = self.rotation * object.covariance().matrix() * self.rotation.inverse();
        object.covariance_m2 = Covariance {
            xx: turned.m11,
            xy: turned.m12,
            yy: turned.m22,
        }
        .into();
    }
}
