//! Views of cards, by the geometry: cards stand upright and the axis of the camera is at the height
//! of their codes, so that one column of the image hits each card at one depth.

use ecod::model::geometry::{Pose, wrap_angle};
use nalgebra::Vector2;

use super::{Card, Testbed};

/// Nearest depth in metres at which a card is drawn or counts.
pub(super) const NEAR_M: f64 = 1e-3;
/// Columns by which the shown part of a code is measured.
const PROBES: u32 = 41;
/// Minimum width in pixels of a legible code in the image: slightly more than a pixel for each of
/// the 21 modules of the smallest code. With fewer pixels the modules cannot be distinguished.
const LEGIBLE_PX: f64 = 25.0;
/// Part of a code that must be shown: error correction level M restores 15 % of the code words, but
/// a finder pattern that is cut is not restored.
const CLEAR: f64 = 0.9;

/// Intersection of a line of sight with the plane of a card.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance along the axis of the camera in metres.
    pub depth_m: f64,
    /// Metres from the middle of the card to the right, as seen from its front.
    pub right_m: f64,
    /// True if the front of the card is towards the camera.
    pub front: bool,
}

impl Card {
    /// Intersection of the line of sight through one column with the card's plane; `slope` is the
    /// tangent of its bearing, left positive. `None` behind the camera and along the plane.
    pub fn hit(&self, camera: &Pose, slope: f64) -> Option<Hit> {
        let (sin, cos) = camera.heading_rad.sin_cos();
        let sight = Vector2::new(cos - sin * slope, sin + cos * slope);
        let facing = Vector2::new(self.facing_rad.cos(), self.facing_rad.sin());
        let approach = sight.dot(&facing);
        let depth_m = (self.position - camera.position).dot(&facing) / approach;
        let at = camera.position + sight * depth_m - self.position;
        let right_m = facing.x * at.y - facing.y * at.x;
        (depth_m >= NEAR_M && right_m.is_finite()).then_some(Hit {
            depth_m,
            right_m,
            front: approach < 0.0,
        })
    }

    /// The slope of the line of sight to a point of the card, `right_m` from its middle; `None`
    /// behind the camera.
    fn slope(&self, camera: &Pose, right_m: f64) -> Option<f64> {
        let (sin, cos) = self.facing_rad.sin_cos();
        let point = self.position + Vector2::new(-sin, cos) * right_m;
        let (range_m, bearing_rad) = camera.range_bearing(&point);
        (range_m * bearing_rad.cos() >= NEAR_M).then(|| bearing_rad.tan())
    }
}

/// View of a card's code by a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sighting {
    /// Distance of the card in metres.
    pub range_m: f64,
    /// Angle between the direction that the card faces and the line to the camera, 0 to π/2
    /// radians.
    pub yaw_rad: f64,
    /// Width of the code in the image, in pixels.
    pub width_px: f64,
    /// Part of the code's width that no other card hides, 0 to 1.
    pub shown: f64,
}

impl Sighting {
    /// View of `card` among `cards` by the camera at `camera`; `None` unless the code lies fully
    /// inside the image and shows its front.
    pub fn of(card: &Card, cards: &[Card], camera: &Pose, testbed: &Testbed) -> Option<Self> {
        let intrinsics = &testbed.camera.intrinsics;
        let placard = &testbed.placard;
        let half_m = placard.qr_width_m / 2.0;
        let left = card.slope(camera, -half_m)?;
        let right = card.slope(camera, half_m)?;
        let left_px = intrinsics.cx - intrinsics.fx * left;
        let right_px = intrinsics.cx - intrinsics.fx * right;
        if right_px <= left_px || left_px < 0.0 || right_px > f64::from(intrinsics.width) {
            return None;
        }
        let nearest_m = card
            .hit(camera, left)?
            .depth_m
            .min(card.hit(camera, right)?.depth_m);
        if half_m * intrinsics.fy > intrinsics.cy * nearest_m {
            return None;
        }
        let is_shown = |probe: &u32| {
            let slope = left + (right - left) * (f64::from(*probe) + 0.5) / f64::from(PROBES);
            let Some(own) = card.hit(camera, slope) else {
                return false;
            };
            let hides = |other: &Card| {
                other.hit(camera, slope).is_some_and(|hit| {
                    hit.right_m.abs() <= placard.card_width_m / 2.0
                        && hit.depth_m < own.depth_m - NEAR_M
                })
            };
            !cards.iter().any(hides)
        };
        let shown = (0..PROBES).filter(is_shown).count() as f64 / f64::from(PROBES);
        let to_camera = camera.position - card.position;
        let yaw_rad = wrap_angle(to_camera.y.atan2(to_camera.x) - card.facing_rad).abs();
        Some(Self {
            range_m: to_camera.norm(),
            yaw_rad,
            width_px: right_px - left_px,
            shown,
        })
    }

    /// True if the code is large enough, and little enough of it hidden, to be read.
    pub fn is_legible(&self) -> bool {
        self.shown >= CLEAR && self.width_px >= LEGIBLE_PX
    }
}
