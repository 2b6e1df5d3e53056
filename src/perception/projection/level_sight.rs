//! The line of sight of a pixel in the level frame, and how pixel and angle errors move it.

use nalgebra::{Point2, Vector3};

use super::Projection;
use super::error_sources::{Errors, Source};

/// The line of sight of a pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct LevelSight {
    /// Off the heading of the axis in radians, counter-clockwise positive.
    pub(super) bearing_rad: f64,
    /// Standard deviation of the bearing in radians, excluding the error of the heading.
    pub(super) turn_rad: f64,
    /// Tangent of the angle below the horizon.
    pub(super) slope: f64,
    /// Distance along the line of sight that an object's half depth across the image's row takes on
    /// the ground.
    pub(super) depth_factor: f64,
    /// Changes of the slope.
    pub(super) errors: Errors,
}

/// Largest [`LevelSight::depth_factor`]: beyond, the row runs almost along the line of sight.
const MAX_DEPTH_FACTOR: f64 = 2.0;

impl LevelSight {
    /// The line of sight of `pixel`, on the row of a box's edge.
    pub(super) fn of(pixel: &Point2<f64>, edge: Source, projection: &Projection) -> Self {
        let Projection {
            config,
            intrinsics,
            to_level,
            ..
        } = projection;
        let ray = to_level * intrinsics.ray(pixel);
        let square = ray.x * ray.x + ray.y * ray.y;
        let level = square.sqrt();
        // Both edges of a box have an error, which their middle halves.
        let column_px = config.pixel_sigma_px * std::f64::consts::FRAC_1_SQRT_2;
        let axis = to_level * Vector3::z();
        let turns = [
            (
                Some(edge),
                to_level * Vector3::new(0.0, config.pixel_sigma_px / intrinsics.fy, 0.0),
            ),
            (
                None,
                to_level * Vector3::new(column_px / intrinsics.fx, 0.0, 0.0),
            ),
            (
                Some(Source::Pitch),
                Vector3::y().cross(&ray) * config.tilt_sigma_rad,
            ),
            (Some(Source::Roll), axis.cross(&ray) * config.tilt_sigma_rad),
        ];
        let mut errors = Errors::zeros();
        let mut variance = 0.0;
        for (source, change) in turns {
            if let Some(source) = source {
                let outward = (ray.x * change.x + ray.y * change.y) / square;
                errors[source as usize] = (ray.z * outward - change.z) / level;
            }
            variance += ((ray.x * change.y - ray.y * change.x) / square).powi(2);
        }
        // The row's direction on the ground, up to scale.
        let along_row = to_level * Vector3::new(1.0, 0.0, 0.0);
        let forward = ray.x * along_row.z - ray.z * along_row.x;
        let left = ray.y * along_row.z - ray.z * along_row.y;
        let depth_factor = (forward.hypot(left) * level / (ray.x * left - ray.y * forward).abs())
            .min(MAX_DEPTH_FACTOR);
        Self {
            bearing_rad: ray.y.atan2(ray.x),
            turn_rad: variance.sqrt(),
            slope: -ray.z / level,
            depth_factor,
            errors,
        }
    }
}
