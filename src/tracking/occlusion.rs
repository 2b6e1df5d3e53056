//! Occlusion map of one frame: the directions in which a detection hides objects behind it.

use nalgebra::Vector2;

use super::coverage::turn;
use crate::wire::PerceivedObject;

/// Distance of the nearest detection in each direction from the vehicle.
#[derive(Debug)]
pub(super) struct OcclusionMap {
    /// Position of the vehicle; without a position, no place is hidden.
    origin: Option<Vector2<f64>>,
    /// Line of sight by direction, metres.
    sight_m: [f32; Self::RAYS],
}

impl OcclusionMap {
    const RAYS: usize = 360;

    /// Half the width of an occluder, metres.
    const HALF_WIDTH_M: f64 = 0.6;

    /// Minimum distance in metres of a hidden object behind its occluder; a nearer object may be the occluder itself.
    const MIN_BEHIND_M: f64 = 3.0;

    /// A frame without detections, seen from `origin`.
    pub(super) fn new(origin: Option<Vector2<f64>>) -> Self {
        Self {
            origin,
            sight_m: [f32::INFINITY; Self::RAYS],
        }
    }

    /// Adds a detection as an occluder, unless its distance is below `min_m`, because it is then a part of the vehicle
    /// itself.
    pub(super) fn add(&mut self, object: &PerceivedObject, min_m: f64) {
        let Some(origin) = self.origin else { return };
        let offset = Vector2::new(object.x_m, object.y_m) - origin;
        let distance_m = offset.norm();
        if distance_m <= min_m.max(2.0 * Self::HALF_WIDTH_M) {
            return;
        }
        let aside = Vector2::new(-offset.y, offset.x) * (Self::HALF_WIDTH_M / distance_m);
        let first = Self::ray(&(offset - aside));
        let last = Self::ray(&(offset + aside));
        let count = (last + Self::RAYS - first) % Self::RAYS + 1;
        for ray in (first..first + count).map(|ray| ray % Self::RAYS) {
            self.sight_m[ray] = self.sight_m[ray].min(distance_m as f32);
        }
    }

    /// Whether a reported position is hidden from the vehicle.
    pub(super) fn hides(&self, reported: &Vector2<f64>) -> bool {
        self.origin.is_some_and(|origin| {
            let offset = reported - origin;
            offset.norm() > f64::from(self.sight_m[Self::ray(&offset)]) + Self::MIN_BEHIND_M
        })
    }

    fn ray(offset: &Vector2<f64>) -> usize {
        (turn(offset) * Self::RAYS as f64 + 0.5) as usize % Self::RAYS
    }
}
