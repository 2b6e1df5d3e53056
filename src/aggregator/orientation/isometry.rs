//! Turns and mirrors of the plane.

use nalgebra::{Matrix2, Point2, Vector2};

/// A turn about a point, or a mirror at an axis through it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Isometry {
    pivot: Point2<f64>,
    linear: Matrix2<f64>,
    shift: Vector2<f64>,
}

impl Isometry {
    /// No change.
    pub(super) fn identity() -> Self {
        Self::turn(Point2::origin(), 0.0)
    }

    /// A turn by an angle in radians, counter-clockwise.
    pub(super) fn turn(pivot: Point2<f64>, angle_rad: f64) -> Self {
        let (sin, cos) = angle_rad.sin_cos();
        Self {
            pivot,
            linear: Matrix2::new(cos, -sin, sin, cos),
            shift: Vector2::zeros(),
        }
    }

    /// A mirror that takes the direction 0 to the direction `angle_rad`: its axis has half this
    /// angle.
    pub(super) fn mirror(pivot: Point2<f64>, angle_rad: f64) -> Self {
        let (sin, cos) = angle_rad.sin_cos();
        Self {
            pivot,
            linear: Matrix2::new(cos, sin, sin, -cos),
            shift: Vector2::zeros(),
        }
    }

    /// The same change, followed by a shift.
    pub(super) fn shifted(self, shift: Vector2<f64>) -> Self {
        Self {
            shift: self.shift + shift,
            ..self
        }
    }

    /// The image of a point.
    pub(super) fn apply(&self, point: &Point2<f64>) -> Point2<f64> {
        self.pivot + self.linear * (point - self.pivot) + self.shift
    }
}
