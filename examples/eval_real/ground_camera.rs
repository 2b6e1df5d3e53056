//! A pinhole camera from its homography to the ground.

use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use nalgebra::{Complex, Matrix3, Vector3};

/// Image size in pixels.
const IMAGE: [u32; 2] = [1920, 1080];

/// A calibrated camera over the ground.
pub(super) struct GroundCamera {
    pub(super) intrinsics: Intrinsics,
    pub(super) pose: Pose,
    pub(super) mount: Mount,
}

impl GroundCamera {
    /// The camera of square pixels with this homography from the ground in centimetres: H = K (r₁ r₂ t). `None` if
    /// there is no such camera.
    ///
    /// With u the vertical and s the sine of the axis over the horizon, M = h₁h₁ᵀ + h₂h₂ᵀ = K (I - u uᵀ) Kᵀ. Columns and rows
    /// as complex numbers leave a quadratic equation for K u, whose other root puts the principal point far off.
    pub(super) fn new(homography: &Matrix3<f64>) -> Option<Self> {
        let [h1, h2, h3] = [0, 1, 2].map(|column| homography.column(column).into_owned());
        let moments = h1 * h1.transpose() + h2 * h2.transpose();
        let middle = Complex::new(moments.m13, moments.m23);
        let cos_square = moments.m33;
        let sin = -(1.0 - cos_square).sqrt();
        let difference = Complex::new(moments.m11 - moments.m22, 2.0 * moments.m12);
        let root = (middle * middle - difference * cos_square).sqrt();
        let verticals = [root, -root].map(|root| (middle * sin + root) / cos_square);
        let principal = |vertical: &Complex<f64>| middle + vertical * sin;
        let [columns, rows] = IMAGE.map(f64::from);
        let off = |vertical: &Complex<f64>| {
            (principal(vertical) - Complex::new(columns, rows) / 2.0).norm()
        };
        let vertical = verticals
            .into_iter()
            .min_by(|a, b| off(a).total_cmp(&off(b)))?;
        let Complex { re: cx, im: cy } = principal(&vertical);
        let [width, height] = IMAGE;
        let focal = (moments.m11 - cx * cx + vertical.re * vertical.re).sqrt();
        let intrinsics = Intrinsics {
            width,
            height,
            fx: focal,
            fy: focal,
            cx,
            cy,
        };
        let [r1, r2, t] = [h1, h2, h3]
            .map(|h| Vector3::new((h.x - cx * h.z) / focal, (h.y - cy * h.z) / focal, h.z));
        let to_world = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]).transpose();
        let position = -to_world * t / 100.0;
        let right = to_world.column(0);
        let down = to_world.column(1);
        let axis = to_world.column(2);
        let mount = Mount {
            height_m: Some(position.z),
            pitch_rad: (-axis.z).asin(),
            roll_rad: (-right.z).atan2(-down.z),
            ..Mount::default()
        };
        let pose = Pose::new(position.x, position.y, axis.y.atan2(axis.x));
        let is_camera = [focal, position.z, mount.pitch_rad]
            .into_iter()
            .all(|value| value.is_finite() && value > 0.0);
        is_camera.then_some(Self {
            intrinsics,
            pose,
            mount,
        })
    }
}
