//! Planar geometry in one world frame: east-north (ENU), metres, radians, counter-clockwise.

use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix2, Point2, Vector2};

/// Largest angle in radians in a message, in magnitude: a full turn, with room for its rounding to
/// four decimals or 32 bits. It is exact in 32 bits, and 16 bits round it down, so that angles
/// within it remain within it in every encoding. Larger values are degrees most of the time.
pub const TURN_BOUND_RAD: f64 = 13_176_827.0 / 2_097_152.0;

/// Position and heading of a vehicle's camera in the world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Position in the world frame in metres, east and north.
    pub position: Point2<f64>,
    /// Direction of the camera's axis in radians, counter-clockwise from +x.
    pub heading_rad: f64,
}

impl Pose {
    /// A pose from metres and radians.
    pub fn new(x_m: f64, y_m: f64, heading_rad: f64) -> Self {
        Self {
            position: Point2::new(x_m, y_m),
            heading_rad,
        }
    }

    /// The world position of a point `forward_m` ahead of and `left_m` left of this pose.
    pub fn transform(&self, forward_m: f64, left_m: f64) -> Point2<f64> {
        let (sin, cos) = self.heading_rad.sin_cos();
        self.position
            + Vector2::new(
                cos * forward_m - sin * left_m,
                sin * forward_m + cos * left_m,
            )
    }

    /// Metres ahead and to the left of this pose of a world point: the inverse of
    /// [`Self::transform`].
    pub fn ahead_left(&self, point: &Point2<f64>) -> Vector2<f64> {
        let (sin, cos) = self.heading_rad.sin_cos();
        let offset = point - self.position;
        Vector2::new(
            cos * offset.x + sin * offset.y,
            cos * offset.y - sin * offset.x,
        )
    }

    /// Range in metres and bearing in radians, wrapped to (-π, π] and relative to the heading, of a
    /// world point.
    pub fn range_bearing(&self, point: &Point2<f64>) -> (f64, f64) {
        let offset = point - self.position;
        (
            offset.norm(),
            wrap_angle(offset.y.atan2(offset.x) - self.heading_rad),
        )
    }
}

/// The same angle in (-π, π].
pub fn wrap_angle(angle_rad: f64) -> f64 {
    // Most angles are less than a turn; the remainder of these is the angle itself, and a slow division without this test.
    let remainder = if angle_rad.abs() < TAU {
        angle_rad
    } else {
        angle_rad % TAU
    };
    let wrapped = if remainder < 0.0 {
        remainder + TAU
    } else {
        remainder
    };
    if wrapped > PI { wrapped - TAU } else { wrapped }
}

/// Relative error that a product of variances may have from rounding.
const ROUNDING: f64 = 1e-12;

/// Symmetric 2×2 position covariance in m².
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Covariance {
    /// Variance of the position east in m².
    pub xx: f64,
    /// Covariance of x and y.
    pub xy: f64,
    /// Variance of the position north in m².
    pub yy: f64,
}

impl Covariance {
    /// The same variance in every direction.
    pub fn isotropic(sigma_m: f64) -> Self {
        Self {
            xx: sigma_m * sigma_m,
            xy: 0.0,
            yy: sigma_m * sigma_m,
        }
    }

    /// Independent errors along and across a line of sight whose world direction is `bearing_rad`.
    pub fn along_bearing(bearing_rad: f64, along_m: f64, across_m: f64) -> Self {
        let (sin, cos) = bearing_rad.sin_cos();
        let along = along_m * along_m;
        let across = across_m * across_m;
        Self {
            xx: cos * cos * along + sin * sin * across,
            xy: sin * cos * (along - across),
            yy: sin * sin * along + cos * cos * across,
        }
    }

    /// The covariance as a matrix.
    pub fn matrix(&self) -> Matrix2<f64> {
        Matrix2::new(self.xx, self.xy, self.xy, self.yy)
    }

    /// True if all entries are finite and the matrix is positive semi-definite up to rounding.
    pub fn is_valid(&self) -> bool {
        let product = self.xx * self.yy;
        let square = self.xy * self.xy;
        let finite = self.xx.is_finite() && self.yy.is_finite() && product.is_finite();
        finite && self.xx >= 0.0 && self.yy >= 0.0 && square <= product * (1.0 + ROUNDING)
    }

    /// Squared Mahalanobis distance of `offset`, with `floor_m` added as an isotropic standard
    /// deviation.
    pub fn mahalanobis_squared(&self, offset: &Vector2<f64>, floor_m: f64) -> f64 {
        let floor = floor_m * floor_m;
        let xx = self.xx + floor;
        let yy = self.yy + floor;
        let determinant = xx * yy - self.xy * self.xy;
        (yy * offset.x * offset.x - 2.0 * self.xy * offset.x * offset.y + xx * offset.y * offset.y)
            / determinant
    }
}

/// From `[xx, xy, yy]`.
impl From<[f64; 3]> for Covariance {
    fn from([xx, xy, yy]: [f64; 3]) -> Self {
        Self { xx, xy, yy }
    }
}

/// To `[xx, xy, yy]`.
impl From<Covariance> for [f64; 3] {
    fn from(Covariance { xx, xy, yy }: Covariance) -> Self {
        [xx, xy, yy]
    }
}

impl std::ops::Add for Covariance {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            xx: self.xx + other.xx,
            xy: self.xy + other.xy,
            yy: self.yy + other.yy,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heading_wraps_at_north() {
        assert!(
            (wrap_angle(359f64.to_radians() - 1f64.to_radians()) - (-2f64).to_radians()).abs()
                < 1e-12
        );
        assert_eq!(wrap_angle(PI), PI);
        assert_eq!(wrap_angle(-PI), PI);
    }

    #[test]
    fn sight_covariance_is_longest_along_sight() {
        let c = Covariance::along_bearing(std::f64::consts::FRAC_PI_2, 2.0, 0.5);
        assert!((c.xx - 0.25).abs() < 1e-12 && (c.yy - 4.0).abs() < 1e-12 && c.xy.abs() < 1e-12);
        assert!(c.is_valid());
    }

    #[test]
    fn rounding_keeps_covariance_valid() {
        for step in 1..1000 {
            let xx = 1e-6 * f64::from(step);
            let yy = 0.003 * f64::from(step) / 7.0;
            let of = |correlation: f64| Covariance {
                xx,
                xy: correlation * (xx * yy).sqrt(),
                yy,
            };
            assert!(of(1.0).is_valid() && of(-1.0).is_valid(), "{:?}", of(1.0));
            assert!(!of(1.0001).is_valid());
        }
        assert!(
            Covariance {
                xx: 0.0,
                xy: 0.0,
                yy: 1.0
            }
            .is_valid()
        );
        assert!(
            !Covariance {
                xx: 0.0,
                xy: 1e-9,
                yy: 1.0
            }
            .is_valid()
        );
        assert!(
            !Covariance {
                xx: 1.0,
                xy: f64::NAN,
                yy: 1.0
            }
            .is_valid()
        );
    }

    #[test]
    fn ahead_and_left_invert_pose_transform() {
        let pose = Pose::new(3.0, -1.0, 2.0);
        assert!(
            (pose.ahead_left(&pose.transform(4.0, -0.5)) - Vector2::new(4.0, -0.5)).norm() < 1e-12
        );
    }

    #[test]
    fn bearing_is_relative_to_heading() {
        let pose = Pose::new(1.0, 1.0, 3.0);
        let (range, bearing) = pose.range_bearing(&pose.transform(3.0, 4.0));
        assert!((range - 5.0).abs() < 1e-12);
        assert!((bearing - (4f64).atan2(3.0)).abs() < 1e-12);
    }
}
