//! Consistency of a camera's mount with its images: a camera that turns moves the horizon.

use std::collections::VecDeque;
use std::time::Duration;

use super::error_sources::Source;
use super::estimate::CONFLICT_SIGMAS;
use super::ground::HalfDepth;
use super::{Cut, Projection, Ranging, box_height};
use crate::model::detection::Detection;
use crate::model::time::Timestamp;

/// Time for which a box counts.
const WINDOW: Duration = Duration::from_secs(60);
/// Time between two frames that count: the same objects are in the frames between.
const SAMPLE_PERIOD: Duration = Duration::from_millis(500);
/// Maximum number of boxes of a frame that are used: more boxes of a crowd add little information.
const MAX_OF_FRAME: usize = 4;
/// Least number of boxes that are compared.
const MIN_BOXES: usize = 30;
/// Least time between the first and the last of them.
const MIN_TIME: Duration = Duration::from_secs(10);
/// Labels of COCO that stand on the ground. Labels with a configured size count as well; other
/// objects may hang or lie on something.
const STANDING: [&str; 6] = ["person", "bicycle", "car", "motorcycle", "bus", "truck"];
/// Least ratio of near feet's slopes to far ones', of which a tenth each are beyond. At one
/// distance, a camera that has turned looks like objects that do not stand on the ground.
const MIN_SLOPE_RATIO: f64 = 1.25;
/// Least share of the boxes that agree about the angle within two standard deviations.
const MIN_AGREEMENT: f64 = 2.0 / 3.0;

/// The angle between where the foot of an object is and where the mount expects it.
#[derive(Debug, Clone, Copy)]
struct FootOffset {
    captured_at: Timestamp,
    /// Tangent of the angle below the horizon that the object's size makes one expect.
    expected_slope: f64,
    /// Positive below the expected line of sight.
    angle_rad: f64,
    sigma_rad: f64,
}

/// Recent boxes of upright objects of configured size on the ground.
#[derive(Debug, Clone, Default)]
pub struct MountCheck {
    offsets: VecDeque<FootOffset>,
    sampled_at: Option<Timestamp>,
}

impl MountCheck {
    /// Adds the boxes of a frame, without distortion, with the edges that cut them.
    ///
    /// Returns the angle in radians by which the camera points higher than its mount states, at
    /// most twice a second. Returns `None` if the stated errors explain the angle, or if objects at
    /// several distances do not agree.
    pub fn add<'a>(
        &mut self,
        boxes: impl IntoIterator<Item = (&'a Detection, Cut)>,
        captured_at: Timestamp,
        projection: &Projection,
    ) -> Option<f64> {
        if self
            .sampled_at
            .is_some_and(|last| captured_at.since(last) < SAMPLE_PERIOD)
        {
            return None;
        }
        self.sampled_at = Some(captured_at);
        self.offsets
            .retain(|offset| captured_at.since(offset.captured_at) < WINDOW);
        let offset = |(detection, cut)| projection.foot_offset(detection, cut, captured_at);
        let mut offsets: Vec<_> = boxes.into_iter().filter_map(offset).collect();
        // Near ones and far ones.
        offsets.sort_by(|a, b| a.expected_slope.total_cmp(&b.expected_slope));
        let step = offsets.len().div_ceil(MAX_OF_FRAME).max(1);
        self.offsets.extend(offsets.into_iter().step_by(step));
        self.off_rad()
    }

    fn off_rad(&self) -> Option<f64> {
        let sorted = |value: fn(&FootOffset) -> f64| {
            let mut values: Vec<f64> = self.offsets.iter().map(value).collect();
            values.sort_by(f64::total_cmp);
            values
        };
        let slopes = sorted(|offset| offset.expected_slope);
        let count = slopes.len();
        let tenth = slopes.len() / 10;
        let time = self
            .offsets
            .back()?
            .captured_at
            .since(self.offsets.front()?.captured_at);
        if count < MIN_BOXES
            || time < MIN_TIME
            || slopes[count - 1 - tenth] < MIN_SLOPE_RATIO * slopes[tenth]
        {
            return None;
        }
        let sigmas = sorted(|offset| offset.angle_rad / offset.sigma_rad)[count / 2];
        let angle_rad = sorted(|offset| offset.angle_rad)[count / 2];
        let agrees =
            |offset: &&FootOffset| (offset.angle_rad - angle_rad).abs() < 2.0 * offset.sigma_rad;
        let agreeing = self.offsets.iter().filter(agrees).count();
        (sigmas.abs() > CONFLICT_SIGMAS && agreeing as f64 >= MIN_AGREEMENT * count as f64)
            .then_some(angle_rad)
    }
}

impl Projection {
    /// The angle between the foot of a box and the direction expected from its height. Returns
    /// `None` if they cannot be compared: the image cuts the box, the box shows a target, the
    /// ranging does not use the ground, the camera's height is not configured, or the object does
    /// not stand.
    fn foot_offset(
        &self,
        detection: &Detection,
        cut: Cut,
        captured_at: Timestamp,
    ) -> Option<FootOffset> {
        let bounds = &detection.bounding_box;
        let label = detection.label.as_str();
        let stands = STANDING.contains(&label) || self.config.sizes.labels.contains_key(label);
        let is_grounded = matches!(self.config.ranging, Ranging::Auto | Ranging::Ground)
            && detection.corners.is_none();
        if !stands || !is_grounded || !bounds.is_valid() || cut.upper || cut.lower {
            return None;
        }
        let camera_m = self.mount.height_m?;
        let size = self.config.sizes.of(&detection.label)?;
        let (foot, head) = box_height::foot_and_head(bounds, self);
        let half = HalfDepth::of_size(size);
        let upright = box_height::upright(&foot, &head, size, half)?;
        let near_m = upright.distance_m - half.mean_m * foot.depth_factor;
        if near_m <= 0.0 {
            return None;
        }
        let expected_slope = camera_m / near_m;
        let mut errors = foot.errors + upright.errors * (expected_slope / near_m);
        errors[Source::Depth as usize] -=
            half.sigma_m * foot.depth_factor * expected_slope / near_m;
        errors[Source::CameraHeight as usize] -= self.config.height_sigma_m / near_m;
        Some(FootOffset {
            captured_at,
            expected_slope,
            angle_rad: foot.slope.atan() - expected_slope.atan(),
            sigma_rad: errors.norm() / (1.0 + foot.slope * foot.slope),
        })
    }
}
