//! The mount of a configured camera: found from points that a person measured or from people who
//! walk, and written for the configuration.

pub(crate) mod people;

use ecod::model::geometry::Pose;
use ecod::perception::camera::Mount;
use ecod::perception::projection::MountEstimate;
use nalgebra::Point2;
use serde::Deserialize;

use crate::camera::calibrate::mount::{GroundFit, GroundFitError, GroundPoint, fit_ground_points};
use crate::camera::config::MountConfig;
use crate::camera::image_size::{ImageSize, SizeMismatch};
use crate::camera::lens::Lens;

/// A point on the ground as measured by a person.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeasuredPoint {
    /// Column and row in pixels of a picture.
    pub pixel: [f64; 2],
    /// Its place in metres, in the frame in which the vehicle's pose is given.
    pub position_m: [f64; 2],
}

/// The reason why measured points give no mount.
#[derive(Debug, thiserror::Error)]
pub enum MeasuredPointsError {
    /// The picture does not have the shape of the lens.
    #[error(transparent)]
    Size(#[from] SizeMismatch),
    /// The points give no camera.
    #[error(transparent)]
    Fit(#[from] GroundFitError),
}

/// Fits the whole mount of a camera to points measured in a picture. The pose of the fit is the
/// camera's pose on the vehicle; errors in the image are in pixels of the picture.
///
/// # Errors
/// Returns a [`MeasuredPointsError`].
pub fn fit_mount_to_points(
    points: &[MeasuredPoint],
    picture: ImageSize,
    lens: &Lens,
    vehicle: &Pose,
) -> Result<GroundFit, MeasuredPointsError> {
    let lens = lens.of_frames(picture)?;
    let scale = f64::from(lens.intrinsics.width) / f64::from(picture.width);
    let pixels = points
        .iter()
        .map(|point| lens.undistorted(&(Point2::from(point.pixel) * scale)));
    let places = points
        .iter()
        .map(|point| vehicle.ahead_left(&point.position_m.into()).into());
    let points: Vec<_> = pixels
        .zip(places)
        .map(|(pixel, place)| GroundPoint { pixel, place })
        .collect();
    let mut fit = fit_ground_points(&points, &lens.intrinsics)?;
    let on_vehicle = fit.pose;
    let mount = &mut fit.estimate.mount;
    mount.forward_m = on_vehicle.position.x;
    mount.left_m = on_vehicle.position.y;
    mount.pan_rad = on_vehicle.heading_rad;
    fit.points
        .iter_mut()
        .for_each(|point| point.error_px /= scale);
    Ok(fit)
}

/// The pose of the vehicle on which a camera with this mount has this pose.
pub fn vehicle_of(camera: &Pose, mount: &Mount) -> Pose {
    let vehicle = Pose {
        heading_rad: camera.heading_rad - mount.pan_rad,
        ..*camera
    };
    Pose {
        position: vehicle.transform(-mount.forward_m, -mount.left_m),
        ..vehicle
    }
}

/// A mount as a table of the configuration, `camera.mount` or the table of one of several cameras,
/// with its errors.
///
/// # Errors
/// Returns TOML's error.
pub fn mount_table(
    estimate: &MountEstimate,
    is_one_of_several: bool,
) -> Result<String, toml::ser::Error> {
    let MountEstimate {
        mount,
        pitch_sigma_rad,
        roll_sigma_rad,
        height_sigma_m,
    } = estimate;
    let keys = toml::to_string(&MountConfig::rounded(mount))?;
    let table = if is_one_of_several {
        "cameras"
    } else {
        "camera"
    };
    let [pitch_deg, roll_deg] = [pitch_sigma_rad, roll_sigma_rad].map(|sigma| sigma.to_degrees());
    Ok(format!(
        "[{table}.mount]\n{keys}# Errors: pitch ±{pitch_deg:.2}°, roll ±{roll_deg:.2}°, height ±{height_sigma_m:.3} m.\n# \
         camera.projection.tilt_sigma_rad and height_sigma_m must cover them, and how the vehicle sways.\n"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vehicle_position_follows_camera() {
        let mount = Mount {
            forward_m: -2.0,
            left_m: 0.7,
            pan_rad: 2.5,
            ..Mount::default()
        };
        let vehicle = Pose::new(12.0, -3.0, 0.8);
        let found = vehicle_of(&mount.camera_pose(&vehicle), &mount);
        let off_m = (found.position - vehicle.position).norm();
        assert!(
            off_m < 1e-9 && (found.heading_rad - vehicle.heading_rad).abs() < 1e-9,
            "{found:?}"
        );
    }
}
