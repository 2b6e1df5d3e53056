//! The pinhole camera: intrinsics and the mount on the vehicle.
//!
//! Camera frame: x to the right, y downwards, z along the axis, metres. Pixels: origin at the upper
//! left corner of the image, x to the right, y downwards. Lens distortion is removed where images
//! are handled; pixels here are undistorted. Level frame: the camera as origin, forward along the
//! heading of its axis, left, up, metres.

use nalgebra::{Matrix3, Point2, Point3, Vector2, Vector3};

use crate::model::geometry::{Pose, TURN_BOUND_RAD, wrap_angle};
use crate::wire::WirePose;

/// Focal lengths and principal point of an image, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Column of the principal point in pixels.
    pub cx: f64,
    /// Row of the principal point in pixels.
    pub cy: f64,
}

impl Intrinsics {
    /// A camera without distortion whose axis goes through the middle of the image: f = (w/2) /
    /// tan(fov/2).
    pub fn from_field_of_view(
        width: u32,
        height: u32,
        horizontal_rad: f64,
        vertical_rad: f64,
    ) -> Self {
        let half_width = f64::from(width) / 2.0;
        let half_height = f64::from(height) / 2.0;
        Self {
            width,
            height,
            fx: half_width / (horizontal_rad / 2.0).tan(),
            fy: half_height / (vertical_rad / 2.0).tan(),
            cx: half_width,
            cy: half_height,
        }
    }

    /// A camera of square pixels without distortion whose axis goes through the middle of the
    /// image.
    pub fn with_square_pixels(width: u32, height: u32, horizontal_rad: f64) -> Self {
        let camera = Self::from_field_of_view(width, height, horizontal_rad, horizontal_rad);
        Self {
            fy: camera.fx,
            ..camera
        }
    }

    /// Bearing of an image column in radians off the axis, counter-clockwise (left) positive.
    pub fn bearing(&self, x_px: f64) -> f64 {
        ((self.cx - x_px) / self.fx).atan()
    }

    /// The paper's γ: the angle of a column in radians, with the field of view spread evenly over
    /// the image.
    pub fn angle_per_pixel(&self) -> f64 {
        self.horizontal_field_of_view() / f64::from(self.width)
    }

    /// Horizontal field of view in radians.
    pub fn horizontal_field_of_view(&self) -> f64 {
        self.bearing(0.0) - self.bearing(f64::from(self.width))
    }

    /// The direction of a pixel in the camera frame, not normalised: z is 1.
    pub fn ray(&self, pixel: &Point2<f64>) -> Vector3<f64> {
        Vector3::new(
            (pixel.x - self.cx) / self.fx,
            (pixel.y - self.cy) / self.fy,
            1.0,
        )
    }

    /// The pixel of a point in the camera frame; `None` behind the camera.
    pub fn project(&self, point: &Point3<f64>) -> Option<Point2<f64>> {
        (point.z > 0.0).then(|| {
            Point2::new(
                self.cx + self.fx * point.x / point.z,
                self.cy + self.fy * point.y / point.z,
            )
        })
    }
}

/// The mount of the camera on its vehicle, which stands on level ground.
///
/// Angles are right-handed about the forward, left and up axes of the vehicle (ISO 8855, ROS REP
/// 103), and turn in the order pan, pitch, roll.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Mount {
    /// Metres ahead of the vehicle's reference point.
    pub forward_m: f64,
    /// Metres to the left of the vehicle's reference point.
    pub left_m: f64,
    /// Angle of the axis from the vehicle's heading in radians, counter-clockwise.
    pub pan_rad: f64,
    /// Height above the ground in metres, if available.
    pub height_m: Option<f64>,
    /// Angle of the axis below the horizon in radians.
    pub pitch_rad: f64,
    /// Angle in radians by which the camera leans to its right.
    pub roll_rad: f64,
}

impl Mount {
    /// The camera's pose for a pose of the vehicle. Its heading is within [`TURN_BOUND_RAD`], as
    /// receivers of reports require.
    pub fn camera_pose(&self, vehicle: &Pose) -> Pose {
        let heading_rad = vehicle.heading_rad + self.pan_rad;
        Pose {
            position: vehicle.transform(self.forward_m, self.left_m),
            heading_rad: if heading_rad.abs() > TURN_BOUND_RAD {
                wrap_angle(heading_rad)
            } else {
                heading_rad
            },
        }
    }

    /// The pose of the camera as reports state it, including its height and tilt if configured. A
    /// level axis without a configured height is the default and is not stated.
    pub fn stated_pose(&self, camera: &Pose) -> WirePose {
        let known = |angle_rad| (self.height_m.is_some() || self.is_tilted()).then_some(angle_rad);
        let pitch_rad = known(self.pitch_rad);
        let roll_rad = known(self.roll_rad);
        WirePose {
            height_m: self.height_m,
            pitch_rad,
            roll_rad,
            ..(*camera).into()
        }
    }

    /// True if the axis is not level, or the camera leans.
    pub fn is_tilted(&self) -> bool {
        self.pitch_rad != 0.0 || self.roll_rad != 0.0
    }

    /// Distances in metres of the ground at the lower and the upper edge of the image's middle
    /// column; the upper one is infinite at the horizon. `None` without a height, or without ground
    /// in view.
    pub fn ground_in_view(&self, intrinsics: &Intrinsics) -> Option<[f64; 2]> {
        let distance_m = |row_px: f64| {
            let ground = self.ground_at(&Point2::new(intrinsics.cx, row_px), intrinsics);
            ground.map_or(f64::INFINITY, |ground| ground.norm())
        };
        let [near_m, far_m] = [f64::from(intrinsics.height), 0.0].map(distance_m);
        near_m.is_finite().then_some([near_m, far_m])
    }

    /// Metres ahead and to the left of the camera at which a pixel shows the ground; `None` without
    /// a height, and from the horizon on.
    pub fn ground_at(&self, pixel: &Point2<f64>, intrinsics: &Intrinsics) -> Option<Vector2<f64>> {
        let ray = self.to_level() * intrinsics.ray(pixel);
        let distance = self.height_m? / -ray.z;
        (ray.z < 0.0).then(|| ray.xy() * distance)
    }

    /// The rotation from the camera frame to the level frame.
    pub fn to_level(&self) -> Matrix3<f64> {
        let (sin_pitch, cos_pitch) = self.pitch_rad.sin_cos();
        let (sin_roll, cos_roll) = self.roll_rad.sin_cos();
        Matrix3::new(
            -sin_roll * sin_pitch,
            -cos_roll * sin_pitch,
            cos_pitch,
            -cos_roll,
            sin_roll,
            0.0,
            -sin_roll * cos_pitch,
            -cos_roll * cos_pitch,
            -sin_pitch,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_span_field_of_view() {
        let fov = 62.2f64.to_radians();
        let camera = Intrinsics::from_field_of_view(640, 480, fov, 48.8f64.to_radians());
        assert!((camera.bearing(0.0) - fov / 2.0).abs() < 1e-12);
        assert!((camera.bearing(640.0) + fov / 2.0).abs() < 1e-12);
        assert_eq!(camera.bearing(320.0), 0.0);
        let pixel = camera
            .project(&Point3::new(0.5, 0.0, 1.0))
            .expect("in front");
        assert!((camera.bearing(pixel.x) + 0.5f64.atan()).abs() < 1e-12);
    }

    #[test]
    fn camera_heading_stays_in_bounds() {
        let pan_rad = std::f64::consts::PI;
        let mount = Mount {
            pan_rad,
            ..Mount::default()
        };
        for heading_rad in [-6.2, 0.5, 6.2, 700.0] {
            let camera = mount.camera_pose(&Pose::new(0.0, 0.0, heading_rad));
            assert!(camera.heading_rad.abs() <= TURN_BOUND_RAD);
            let off_rad = wrap_angle(camera.heading_rad - heading_rad - pan_rad);
            assert!(off_rad.abs() < 1e-9, "{heading_rad}");
        }
    }

    #[test]
    fn pitch_and_roll_turn_camera() {
        let axis = Vector3::z();
        let pitched = Mount {
            pitch_rad: 0.3,
            ..Mount::default()
        }
        .to_level()
            * axis;
        assert!((pitched - Vector3::new(0.3f64.cos(), 0.0, -(0.3f64.sin()))).norm() < 1e-12);
        let right = Vector3::x();
        let rolled = Mount {
            roll_rad: 0.3,
            ..Mount::default()
        }
        .to_level()
            * right;
        assert!((rolled - Vector3::new(0.0, -(0.3f64.cos()), -(0.3f64.sin()))).norm() < 1e-12);
        assert_eq!(
            Mount::default().to_level() * Vector3::new(1.0, 2.0, 3.0),
            Vector3::new(3.0, -1.0, -2.0)
        );
    }

    #[test]
    fn tilted_camera_has_near_ground_edge() {
        let camera = Intrinsics::from_field_of_view(640, 480, 1.0, 40f64.to_radians());
        let view = |height_m, pitch_deg: f64| {
            Mount {
                height_m,
                pitch_rad: pitch_deg.to_radians(),
                ..Mount::default()
            }
            .ground_in_view(&camera)
        };
        let [near_m, far_m] = view(Some(2.0), 30.0).unwrap();
        let expected = [50f64, 10.0].map(|below_deg| 2.0 / below_deg.to_radians().tan());
        assert!(
            (near_m - expected[0]).abs() < 1e-9 && (far_m - expected[1]).abs() < 1e-9,
            "{near_m} {far_m}"
        );
        assert_eq!(
            view(Some(2.0), 10.0).map(|[_, far_m]| far_m),
            Some(f64::INFINITY)
        );
        assert_eq!((view(Some(2.0), -30.0), view(None, 30.0)), (None, None));
    }

    #[test]
    fn only_stated_mount_is_reported() {
        let camera = Pose::new(1.0, 2.0, 0.5);
        let tilt = |pitch_rad, height_m| {
            let stated = Mount {
                pitch_rad,
                height_m,
                ..Mount::default()
            }
            .stated_pose(&camera);
            assert_eq!(
                (stated.x_m, stated.y_m, stated.heading_rad),
                (1.0, 2.0, 0.5)
            );
            (stated.height_m, stated.pitch_rad, stated.roll_rad)
        };
        assert_eq!(tilt(0.0, None), (None, None, None));
        assert_eq!(tilt(0.0, Some(1.3)), (Some(1.3), Some(0.0), Some(0.0)));
        assert_eq!(tilt(0.1, None), (None, Some(0.1), Some(0.0)));
    }
}
