//! Visibility of a landmark from a vehicle.

use std::f64::consts::{LN_2, TAU};

use super::config::{PaperConfig, WeightedConfig};

/// The paper's visibility k(ρ,v) = p_d (1 − d/d_max) + (1 − p_d) θ/360°. As printed it *grows*
/// off-axis.
///
/// `angle_rad` is the deviation θ from the camera's axis; its sign is ignored.
pub fn paper(config: &PaperConfig, distance_m: f64, angle_rad: f64) -> f64 {
    let p = config.distance_weight;
    p * (1.0 - distance_m / config.max_range_m) + (1.0 - p) * (angle_rad.abs() / TAU)
}

/// Visibility in 0 to 1 that falls with the squared distance and, as a Gaussian, with the angle off
/// the axis.
pub fn weighted(config: &WeightedConfig, distance_m: f64, angle_rad: f64) -> f64 {
    let distance = (distance_m / config.max_range_m).clamp(0.0, 1.0);
    let angle = angle_rad / config.half_visibility_rad;
    (1.0 - (1.0 - config.visibility_at_max_range) * distance * distance)
        * (-LN_2 * angle * angle).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paper_visibility_matches_formula() {
        let config = PaperConfig::default();
        let k = paper(&config, 1.27, -90f64.to_radians());
        assert!((k - (0.7 * 0.5 + 0.3 * 0.25)).abs() < 1e-12);
    }

    #[test]
    fn visibility_falls_with_angle_and_distance() {
        let config = WeightedConfig {
            max_range_m: 2.0,
            ..WeightedConfig::default()
        };
        assert_eq!(weighted(&config, 0.0, 0.0), 1.0);
        assert!((weighted(&config, 0.0, 0.8) - 0.5).abs() < 1e-12);
        assert!((weighted(&config, 2.0, 0.0) - 0.3).abs() < 1e-12);
        assert!(weighted(&config, 1.0, 0.3) < weighted(&config, 0.5, 0.3));
        assert_eq!(weighted(&config, 1.0, 0.3), weighted(&config, 1.0, -0.3));
    }
}
