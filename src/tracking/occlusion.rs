//! What a vehicle cannot see in a frame, because something that it did detect stands in front of it.

use nalgebra::Vector2;

use super::sensors::turn;
use crate::wire::PerceivedObject;

/// How far the sight goes in one frame.
#[derive(Debug)]
pub(super) struct Shadows {
    /// Where the vehicle is; where that is not known, nothing is hidden.
    from: Option<Vector2<f64>>,
    /// By direction, how far the sight goes before it meets what was detected, metres.
    sight_m: [f32; Self::RAYS],
}

impl Shadows {
    const RAYS: usize = 360;

    /// Half the width in metres of what hides others.
    const HIDES_M: f64 = 0.6;

    /// Distance in metres behind a detection from which an object is hidden by it, and not the same.
    const BEHIND_M: f64 = 3.0;

    /// A frame without detections, seen from there.
    pub(super) fn new(from: Option<Vector2<f64>>) -> Self {
        Self { from, sight_m: [f32::INFINITY; Self::RAYS] }
    }

    /// A detection hides what is behind it; a vehicle's own parts, nearer than `nearest_m`, hide nothing.
    pub(super) fn cast(&mut self, object: &PerceivedObject, nearest_m: f64) {
        let Some(from) = self.from else { return };
        let offset = Vector2::new(object.x_m, object.y_m) - from;
        let distance_m = offset.norm();
        if distance_m <= nearest_m.max(2.0 * Self::HIDES_M) {
            return;
        }
        let aside = Vector2::new(-offset.y, offset.x) * (Self::HIDES_M / distance_m);
        let (first, last) = (Self::ray(&(offset - aside)), Self::ray(&(offset + aside)));
        let count = (last + Self::RAYS - first) % Self::RAYS + 1;
        for ray in (first..first + count).map(|ray| ray % Self::RAYS) {
            self.sight_m[ray] = self.sight_m[ray].min(distance_m as f32);
        }
    }

    /// Whether nothing could be seen at a reported position.
    pub(super) fn hide(&self, reported: &Vector2<f64>) -> bool {
        self.from.is_some_and(|from| {
            let offset = reported - from;
            offset.norm() > f64::from(self.sight_m[Self::ray(&offset)]) + Self::BEHIND_M
        })
    }

    fn ray(offset: &Vector2<f64>) -> usize {
        (turn(offset) * Self::RAYS as f64 + 0.5) as usize % Self::RAYS
    }
}
