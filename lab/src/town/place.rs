//! The frame and the clock of a cell in a town.

use ecod::model::geometry::{Covariance, wrap_angle};
use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::{FusedObject, ObjectReport};
use nalgebra::{Isometry2, Point2, Vector2};

/// A cell's frame and clock relative to the town's.
#[derive(Debug, Clone)]
pub(super) struct CellFrame {
    pub(super) origin: GeographicOrigin,
    /// From the town's frame into the cell's. Within a kilometre both planes agree to a millimetre.
    into: Isometry2<f64>,
    /// The cell's clock minus the town's.
    clock_us: i64,
}

impl CellFrame {
    pub(super) fn new(town: &GeographicOrigin, origin: GeographicOrigin, clock_us: i64) -> Self {
        let place = |x_m| origin.to_map(&town.to_wgs84(x_m, 0.0, 0.0)).xy();
        let zero = place(0.0);
        let east = place(100.0);
        let angle = (east.y - zero.y).atan2(east.x - zero.x);
        Self {
            origin,
            into: Isometry2::new(zero.coords, angle),
            clock_us,
        }
    }

    pub(super) fn time(&self, town: Timestamp) -> Timestamp {
        town.shifted(self.clock_us)
    }

    pub(super) fn town_time(&self, at: Timestamp) -> Timestamp {
        at.shifted(-self.clock_us)
    }

    /// A report of the town as a vehicle sends it to the cell.
    pub(super) fn report(&self, report: &ObjectReport) -> ObjectReport {
        let mut report = report.clone();
        report.captured_at_us = self.time(report.captured_at_us);
        if let Some(pose) = &mut report.pose {
            let place = self.into * Point2::new(pose.x_m, pose.y_m);
            pose.x_m = place.x;
            pose.y_m = place.y;
            pose.heading_rad = wrap_angle(pose.heading_rad + self.into.rotation.angle());
        }
        for object in &mut report.objects {
            let place = self.into * Point2::new(object.x_m, object.y_m);
            object.x_m = place.x;
            object.y_m = place.y;
            object.velocity_mps = object
                .velocity_mps
                .map(|velocity| (self.into * Vector2::from(velocity)).into());
            object.heading_rad = object
                .heading_rad
                .map(|heading| wrap_angle(heading + self.into.rotation.angle()));
            object.covariance_m2 = object
                .covariance_m2
                .map(|covariance| turned(covariance, &self.into));
        }
        report
    }

    /// An object of the cell's map in the town's frame, moved on by `ahead_s`.
    pub(super) fn town_object(&self, object: &FusedObject, ahead_s: f64) -> FusedObject {
        let back = self.into.inverse();
        let velocity: Vector2<f64> = back * Vector2::from(object.velocity_mps.unwrap_or_default());
        let place = back * Point2::new(object.x_m, object.y_m) + velocity * ahead_s;
        let covariance_m2 = turned(object.covariance_m2, &back);
        FusedObject {
            x_m: place.x,
            y_m: place.y,
            covariance_m2,
            ..object.clone()
        }
    }
}

fn turned(covariance: [f64; 3], by: &Isometry2<f64>) -> [f64; 3] {
    let rotation = by.rotation.to_rotation_matrix();
    let turned = rotation * Covariance::from(covariance).matrix() * rotation.inverse();
    [turned.m11, turned.m12, turned.m22]
}
