//! Position of a square target relative to the camera, from its four corners.

use ecod::perception::camera::Intrinsics;
use nalgebra::{Point2, Point3};
use opencv::calib3d::{self, SolvePnPMethod};
use opencv::core::{Mat, MatTraitConstManual, Matx33d, Point2d, Point3d, Vector};

/// Error of locating a target.
#[derive(Debug, thiserror::Error)]
pub enum CornerPoseError {
    /// No square facing the camera fits the corners.
    #[error("no square target that faces the camera fits the corners")]
    NoSolution,
    /// OpenCV refused the corners.
    #[error("opencv cannot solve the corners")]
    OpenCv(#[from] opencv::Error),
}

/// Centre of a square target in the camera frame, in metres: x right, y down, z along the axis.
///
/// `corners` are undistorted pixels in the order of [`ecod::model::detection::Detection::corners`];
/// `side_m` is the length of a side. Infinitesimal plane-based pose estimation finds two poses
/// (Collins and Bartoli 2014, OpenCV's `SOLVEPNP_IPPE_SQUARE`). The result is the pose that faces
/// the camera with the smaller reprojection error.
///
/// # Errors
/// Returns a [`CornerPoseError`] if no such pose exists.
pub fn locate_target(
    corners: &[Point2<f64>; 4],
    side_m: f64,
    intrinsics: &Intrinsics,
) -> Result<Point3<f64>, CornerPoseError> {
    match solve(corners, side_m, intrinsics) {
        Err(CornerPoseError::NoSolution) => solve(&perturbed(corners), side_m, intrinsics),
        outcome => outcome,
    }
}

/// Corners with one moved by a thousandth of a pixel. OpenCV finds no finite pose for many
/// symmetric squares, which whole-pixel corners often form.
fn perturbed(corners: &[Point2<f64>; 4]) -> [Point2<f64>; 4] {
    let [first, second, third, fourth] = *corners;
    [
        Point2::new(first.x + 1e-3, first.y + 2e-3),
        second,
        third,
        fourth,
    ]
}

/// The intrinsics as OpenCV's 3×3 camera matrix.
pub(crate) fn camera_matrix(intrinsics: &Intrinsics) -> Matx33d {
    let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
    Matx33d::from_array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
}

fn solve(
    corners: &[Point2<f64>; 4],
    side_m: f64,
    intrinsics: &Intrinsics,
) -> Result<Point3<f64>, CornerPoseError> {
    let half = side_m / 2.0;
    // The target's frame: x right, y up, z out of its front.
    let target: Vector<Point3d> = [(-half, half), (half, half), (half, -half), (-half, -half)]
        .map(|(x, y)| Point3d::new(x, y, 0.0))
        .into_iter()
        .collect();
    let image: Vector<Point2d> = corners
        .iter()
        .map(|corner| Point2d::new(corner.x, corner.y))
        .collect();
    let mut rotations = Vector::<Mat>::new();
    let mut translations = Vector::<Mat>::new();
    calib3d::solve_pnp_generic(
        &target,
        &image,
        &camera_matrix(intrinsics),
        &Mat::default(),
        &mut rotations,
        &mut translations,
        false,
        SolvePnPMethod::SOLVEPNP_IPPE_SQUARE,
        &Mat::default(),
        &Mat::default(),
        &mut Mat::default(),
    )?;
    // OpenCV lists the solutions by rising reprojection error.
    for (rotation, translation) in rotations.iter().zip(&translations) {
        let mut matrix = Matx33d::default();
        calib3d::rodrigues_def(&rotation, &mut matrix)?;
        let &[x, y, z] = translation.data_typed::<f64>()? else {
            continue;
        };
        let towards_camera = -(matrix.val[2] * x + matrix.val[5] * y + matrix.val[8] * z);
        if z > 0.0 && towards_camera > 0.0 && [x, y, z].iter().all(|c| c.is_finite()) {
            return Ok(Point3::new(x, y, z));
        }
    }
    Err(CornerPoseError::NoSolution)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;

    fn camera() -> Intrinsics {
        Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians())
    }

    fn corners(middle: Point3<f64>, side_m: f64, yaw_rad: f64, pitch_rad: f64) -> [Point2<f64>; 4] {
        let half = side_m / 2.0;
        let turn = Rotation3::from_euler_angles(pitch_rad, yaw_rad, 0.0);
        [(-half, -half), (half, -half), (half, half), (-half, half)].map(|(right, down)| {
            camera()
                .project(&(middle + turn * Vector3::new(right, down, 0.0)))
                .expect("before the camera")
        })
    }

    #[test]
    fn target_is_placed_at_any_yaw() {
        for yaw_deg in [-60.0, -30.0, 0.0, 15.0, 45.0] {
            for middle in [
                Point3::new(0.0, 0.0, 0.5),
                Point3::new(-0.2, 0.05, 0.6),
                Point3::new(0.15, -0.1, 0.3),
            ] {
                let seen = corners(middle, 0.05, f64::to_radians(yaw_deg), 0.1);
                let found = locate_target(&seen, 0.05, &camera()).unwrap();
                assert!(
                    (found - middle).norm() < 1e-4,
                    "{yaw_deg}° {middle} {found}"
                );
            }
        }
    }

    #[test]
    fn half_pixel_noise_is_tolerated() {
        let middle = Point3::new(0.05, 0.0, 0.4);
        let mut seen = corners(middle, 0.05, 0.4, 0.0);
        seen[0].x += 0.5;
        seen[2].y -= 0.5;
        let found = locate_target(&seen, 0.05, &camera()).unwrap();
        assert!((found.z - middle.z).abs() < 0.01, "{found}");
    }

    #[test]
    fn mirrored_corners_give_position() {
        for square in [
            [
                (154.0, 210.0),
                (216.0, 210.0),
                (216.0, 270.0),
                (154.0, 270.0),
            ],
            [
                (326.0, 210.0),
                (380.0, 211.0),
                (380.0, 269.0),
                (326.0, 270.0),
            ],
        ] {
            let found =
                locate_target(&square.map(|(x, y)| Point2::new(x, y)), 0.05, &camera()).unwrap();
            assert!((0.4..0.5).contains(&found.z), "{found}");
        }
    }

    #[test]
    fn corners_need_square() {
        let at = Point2::new(300.0, 200.0);
        assert!(
            locate_target(&[at; 4], 0.05, &camera()).is_err(),
            "a single point"
        );
        let mirrored = corners(Point3::new(0.0, 0.0, 0.5), 0.05, 0.2, 0.0);
        let mirrored = [mirrored[1], mirrored[0], mirrored[3], mirrored[2]];
        assert!(
            locate_target(&mirrored, 0.05, &camera()).is_err(),
            "seen from behind"
        );
        assert!(
            locate_target(&[Point2::new(f64::NAN, 0.0); 4], 0.05, &camera()).is_err(),
            "not a number"
        );
    }
}
