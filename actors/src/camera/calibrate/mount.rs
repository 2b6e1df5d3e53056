//! The mount of a camera from points at given places on the ground.

use ecod::model::geometry::Pose;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::projection::MountEstimate;
use ecod::perception::view::PosedCamera;
use nalgebra::{Matrix3, Point2, SMatrix, SVector, Vector3};
use opencv::calib3d::{self, SolvePnPMethod};
use opencv::core::{Mat, MatTraitConstManual, Matx33d, Point2d, Point3d, Vector};
use serde::Serialize;

use crate::camera::corner_pose::camera_matrix;

/// A point on the ground, and where it is in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GroundPoint {
    /// Its pixel, without distortion.
    pub pixel: Point2<f64>,
    /// Its place on the ground in metres.
    pub place: Point2<f64>,
}

/// A camera over the ground.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundFit {
    /// Pose of the camera in the frame of the points.
    pub pose: Pose,
    /// Height, pitch and roll of the camera, with standard deviations.
    pub estimate: MountEstimate,
    /// Fit of each point, in their order.
    pub points: Vec<PointFit>,
}

/// Fit of one point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PointFit {
    /// Distance in the image in pixels; infinite behind the camera.
    pub error_px: f64,
    /// Distance on the ground in metres; `None` where the pixel shows no ground.
    pub error_m: Option<f64>,
    /// True if the point contradicts the others and was left out.
    #[serde(rename = "outlier")]
    pub is_outlier: bool,
}

/// Error of a fit to points on the ground.
#[derive(Debug, thiserror::Error)]
pub enum GroundFitError {
    /// Fewer than [`MIN_POINTS`] points; the value is their number.
    #[error("{0} points, need {MIN_POINTS}: measure more, spread over the image")]
    TooFewPoints(usize),
    /// No pose of a camera agrees with [`MIN_POINTS`] of the points.
    #[error(
        "no camera sees {MIN_POINTS} of the points where they are: check the numbers, their order and signs, and \
         `camera.optics`; of more points the wrong ones are named"
    )]
    NoCamera,
    /// The camera is below the ground.
    #[error(
        "the points fit a camera below the ground only: check that left and north are positive, and rows count downwards"
    )]
    BelowGround,
    /// The points do not determine the mount well enough.
    #[error(
        "the points determine the pitch only to ±{0:.1}°: spread them over the image, not on one line, and measure again"
    )]
    Undetermined(f64),
    /// OpenCV could not solve the equations of the points.
    #[error("opencv cannot solve the points: spread them over the image, not on one line")]
    OpenCv(#[from] opencv::Error),
}

/// Minimum number of points.
pub const MIN_POINTS: usize = 4;
/// Distance in the image beyond which a point is an outlier, as a share of the image's width.
const OUTLIER_SHARE: f64 = 0.008;
/// Least standard deviation of a measured pixel.
const MIN_SIGMA_PX: f64 = 0.3;
const RANSAC_ROUNDS: i32 = 2000;
const RANSAC_CONFIDENCE: f64 = 0.999;
/// Maximum standard deviation in degrees of a pitch that is worth reporting.
const MAX_PITCH_SIGMA_DEG: f64 = 5.0;

/// Fits a camera to points: P3P within RANSAC (Fischler, Bolles 1981), then the pose of a plane
/// (Collins, Bartoli 2014) from the inliers, refined by Levenberg and Marquardt. Places are in any
/// frame on the ground, x to y counter-clockwise from above.
///
/// # Errors
/// Returns a [`GroundFitError`] if no camera fits, or several do.
pub fn fit_ground_points(
    points: &[GroundPoint],
    intrinsics: &Intrinsics,
) -> Result<GroundFit, GroundFitError> {
    if points.len() < MIN_POINTS {
        return Err(GroundFitError::TooFewPoints(points.len()));
    }
    let threshold_px = OUTLIER_SHARE * f64::from(intrinsics.width);
    let (pose, mount, inliers) =
        solve(points, intrinsics, threshold_px)?.ok_or(GroundFitError::NoCamera)?;
    let height_m = mount.height_m.unwrap_or(0.0);
    if height_m <= 0.0 {
        return Err(GroundFitError::BelowGround);
    }
    let camera = PosedCamera::new(pose, &mount, *intrinsics);
    let fit = |(index, point): (usize, &GroundPoint)| PointFit {
        error_px: camera
            .pixel(&point.place)
            .map_or(f64::INFINITY, |pixel| (pixel - point.pixel).norm()),
        error_m: mount
            .ground_at(&point.pixel, intrinsics)
            .map(|ground| (pose.transform(ground.x, ground.y) - point.place).norm()),
        is_outlier: !inliers.contains(&index),
    };
    let fits: Vec<PointFit> = points.iter().enumerate().map(fit).collect();
    let used: Vec<GroundPoint> = inliers.iter().map(|&index| points[index]).collect();
    let squares = fits
        .iter()
        .filter(|fit| !fit.is_outlier)
        .map(|fit| fit.error_px * fit.error_px)
        .sum::<f64>();
    let freedom = (2 * used.len() - PARAMETERS) as f64;
    let sigma_px = (squares / freedom).sqrt().max(MIN_SIGMA_PX);
    let sigmas =
        sigmas(&used, &pose, &mount, intrinsics).ok_or(GroundFitError::NoCamera)? * sigma_px;
    let estimate = MountEstimate {
        mount,
        height_sigma_m: sigmas[0],
        pitch_sigma_rad: sigmas[1],
        roll_sigma_rad: sigmas[2],
    };
    if sigmas[1].to_degrees() <= MAX_PITCH_SIGMA_DEG {
        Ok(GroundFit {
            pose,
            estimate,
            points: fits,
        })
    } else {
        Err(GroundFitError::Undetermined(sigmas[1].to_degrees()))
    }
}

type Solution = (Pose, Mount, Vec<usize>);

fn solve(
    points: &[GroundPoint],
    intrinsics: &Intrinsics,
    threshold_px: f64,
) -> Result<Option<Solution>, opencv::Error> {
    let place = |point: &GroundPoint| Point3d::new(point.place.x, point.place.y, 0.0);
    let pixel = |point: &GroundPoint| Point2d::new(point.pixel.x, point.pixel.y);
    let places: Vector<Point3d> = points.iter().map(place).collect();
    let pixels: Vector<Point2d> = points.iter().map(pixel).collect();
    let camera = camera_matrix(intrinsics);
    let undistorted = Mat::default();
    let mut rotation = Mat::default();
    let mut translation = Mat::default();
    let mut inlier_indices = Vector::<i32>::new();
    let is_solved = calib3d::solve_pnp_ransac(
        &places,
        &pixels,
        &camera,
        &undistorted,
        &mut rotation,
        &mut translation,
        false,
        RANSAC_ROUNDS,
        threshold_px as f32,
        RANSAC_CONFIDENCE,
        &mut inlier_indices,
        SolvePnPMethod::SOLVEPNP_AP3P as i32,
    )?;
    let inliers: Vec<usize> = inlier_indices
        .iter()
        .filter_map(|index| usize::try_from(index).ok())
        .collect();
    if !is_solved || inliers.len() < MIN_POINTS {
        return Ok(None);
    }
    let (places, pixels): (Vector<Point3d>, Vector<Point2d>) = inliers
        .iter()
        .map(|&index| (place(&points[index]), pixel(&points[index])))
        .unzip();
    let planar = SolvePnPMethod::SOLVEPNP_IPPE as i32;
    calib3d::solve_pnp(
        &places,
        &pixels,
        &camera,
        &undistorted,
        &mut rotation,
        &mut translation,
        false,
        planar,
    )?;
    calib3d::solve_pnp_refine_lm_def(
        &places,
        &pixels,
        &camera,
        &undistorted,
        &mut rotation,
        &mut translation,
    )?;
    let mut matrix = Matx33d::default();
    calib3d::rodrigues_def(&rotation, &mut matrix)?;
    let from_ground = Matrix3::from_row_slice(&matrix.val);
    let translation = Vector3::from_column_slice(translation.data_typed::<f64>()?);
    let (pose, mount) = from_extrinsics(&from_ground, &translation);
    Ok(Some((pose, mount, inliers)))
}

/// Pose and mount from the rotation from the ground to the camera and the ground's origin in the
/// camera.
fn from_extrinsics(from_ground: &Matrix3<f64>, origin: &Vector3<f64>) -> (Pose, Mount) {
    let to_ground = from_ground.transpose();
    let position = -(to_ground * origin);
    // The last row of `Mount::to_level` is free of the heading.
    let right_up = to_ground[(2, 0)];
    let down_up = to_ground[(2, 1)];
    let ahead_up = to_ground[(2, 2)];
    let mount = Mount {
        height_m: Some(position.z),
        pitch_rad: (-ahead_up).clamp(-1.0, 1.0).asin(),
        roll_rad: (-right_up).atan2(-down_up),
        ..Mount::default()
    };
    let heading_rad = to_ground[(1, 2)].atan2(to_ground[(0, 2)]);
    (Pose::new(position.x, position.y, heading_rad), mount)
}

/// Of height, pitch, roll, heading and position.
const PARAMETERS: usize = 6;

/// Standard deviations of height (m), pitch and roll (rad) for pixels of deviation 1.
fn sigmas(
    points: &[GroundPoint],
    pose: &Pose,
    mount: &Mount,
    intrinsics: &Intrinsics,
) -> Option<Vector3<f64>> {
    const STEP: f64 = 1e-6;
    let pixels = |change: SVector<f64, PARAMETERS>| {
        let mount = Mount {
            height_m: mount.height_m.map(|height_m| height_m + change[0]),
            pitch_rad: mount.pitch_rad + change[1],
            roll_rad: mount.roll_rad + change[2],
            ..*mount
        };
        let x_m = change[3];
        let y_m = change[4];
        let turn_rad = change[5];
        let pose = Pose::new(
            pose.position.x + x_m,
            pose.position.y + y_m,
            pose.heading_rad + turn_rad,
        );
        let camera = PosedCamera::new(pose, &mount, *intrinsics);
        points
            .iter()
            .map(|point| camera.pixel(&point.place))
            .collect::<Option<Vec<_>>>()
    };
    let here = pixels(SVector::zeros())?;
    let mut columns = Vec::new();
    for axis in 0..PARAMETERS {
        let moved = pixels(SVector::from_fn(
            |row, _| if row == axis { STEP } else { 0.0 },
        ))?;
        columns.push(
            moved
                .iter()
                .zip(&here)
                .map(|(moved, here)| (moved - here) / STEP)
                .collect::<Vec<_>>(),
        );
    }
    let information = SMatrix::<f64, PARAMETERS, PARAMETERS>::from_fn(|row, column| {
        columns[row]
            .iter()
            .zip(&columns[column])
            .map(|(a, b)| a.dot(b))
            .sum()
    });
    let covariance = information.try_inverse()?;
    Some(Vector3::from_fn(|index, _| {
        covariance[(index, index)].sqrt()
    }))
}

#[cfg(test)]
mod tests;
