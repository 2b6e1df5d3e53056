//! Lens distortion by the model of Brown and Conrady, with OpenCV's coefficients, and its removal.

use nalgebra::Point2;

use super::camera::Intrinsics;
use crate::model::detection::{BoundingBox, Detection};

/// OpenCV's k1, k2, p1, p2, k3, k4, k5, k6; the last three are 0 unless the model is rational.
pub type Distortion = [f64; 8];

/// The coefficients of a lens from the first ones, in OpenCV's order; `None` if all are 0, as those of
/// a lens without distortion.
pub fn from_first(stated: &[f64]) -> Option<Distortion> {
    let mut distortion = Distortion::default();
    for (coefficient, stated) in distortion.iter_mut().zip(stated) {
        *coefficient = *stated;
    }
    distortion.iter().any(|k| *k != 0.0).then_some(distortion)
}

/// Maximum number of steps of the iteration. The distortion of common lenses needs at most 20.
const MAX_STEPS: usize = 100;

/// Change of a step, in focal lengths, that ends the iteration: a millionth of a pixel and less.
const PRECISION: f64 = 1e-10;

/// Undistorts the box and the corners of a detection. A box is undistorted at the midpoints of its
/// edges.
pub fn undistort(detection: &mut Detection, intrinsics: &Intrinsics, distortion: &Distortion) {
    let straight = |x, y| undistorted(&Point2::new(x, y), intrinsics, distortion);
    let bounds = detection.bounding_box;
    let middle = detection.bounding_box.center();
    detection.bounding_box = BoundingBox {
        x_min: straight(bounds.x_min, middle.y).x,
        y_min: straight(middle.x, bounds.y_min).y,
        x_max: straight(bounds.x_max, middle.y).x,
        y_max: straight(middle.x, bounds.y_max).y,
    };
    for corner in detection.corners.iter_mut().flatten() {
        *corner = straight(corner.x, corner.y);
    }
}

/// The pixel at which an ideal lens would show what this lens shows at `pixel`.
///
/// The model leads from ideal to distorted pixels. Its inverse is the fixed point of x ← (x' −
/// tangential(x)) / radial(x), with x' the distorted point, as in OpenCV's `undistortPoints`.
/// Pixels beyond the range of the model, where it has no inverse, stay where they are.
pub fn undistorted(
    pixel: &Point2<f64>,
    intrinsics: &Intrinsics,
    distortion: &Distortion,
) -> Point2<f64> {
    let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
    let [k1, k2, p1, p2, k3, k4, k5, k6] = *distortion;
    let bent = Point2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
    let mut ideal = bent;
    for _ in 0..MAX_STEPS {
        let x = ideal.x;
        let y = ideal.y;
        let r2 = x * x + y * y;
        let polynomial = |a, b, c| 1.0 + r2 * (a + r2 * (b + r2 * c));
        let radial = polynomial(k1, k2, k3) / polynomial(k4, k5, k6);
        if !(radial.is_finite() && radial > 0.0) {
            break;
        }
        let next = Point2::new(
            (bent.x - 2.0 * p1 * x * y - p2 * (r2 + 2.0 * x * x)) / radial,
            (bent.y - p1 * (r2 + 2.0 * y * y) - 2.0 * p2 * x * y) / radial,
        );
        if (next - ideal).amax() < PRECISION {
            return Point2::new(cx + fx * next.x, cy + fy * next.y);
        }
        ideal = next;
    }
    *pixel
}
