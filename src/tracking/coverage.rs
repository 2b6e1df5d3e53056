//! Coverage of a vehicle's sensor: where the sensor detects objects, and with which probability.

use std::f64::consts::PI;

use nalgebra::Vector2;

use super::existence::{DetectionRates, ObservationState};
use crate::wire::{FieldOfView, ObjectReport, PerceivedObject};

/// Estimated field of view and detection rates of one vehicle.
#[derive(Debug, Clone)]
pub(super) struct Coverage {
    /// Position of the vehicle, metres, and unit vector of its heading.
    pose: Option<(Vector2<f64>, Vector2<f64>)>,
    stated: Option<FieldOfView>,
    /// Position of the pose, or the median of the detections.
    centre: Option<Vector2<f64>>,
    /// Fading numbers of detections by direction from the heading.
    directions: [f32; Self::DIRECTIONS],
    /// Number of detections above which a direction is in view.
    min_detections: f32,
    /// Detection rates by distance from the centre.
    rates: [DetectionRates; Self::BINS],
    farthest_m: f64,
}

impl Default for Coverage {
    fn default() -> Self {
        Self {
            pose: None,
            stated: None,
            centre: None,
            directions: [0.0; Self::DIRECTIONS],
            min_detections: 0.0,
            rates: [DetectionRates::object(); Self::BINS],
            farthest_m: 0.0,
        }
    }
}

impl Coverage {
    /// Bins of distance, each twice as wide as the one before, and the end of the first in metres.
    const BINS: usize = 6;
    const FIRST_BIN_M: f64 = 5.0;
    const DIRECTIONS: usize = 24;

    /// Maximum range, metres.
    const MAX_RANGE_M: f64 = 160.0;

    /// Distance in metres that is too large for any vehicle between two reports.
    const JUMP_M: f64 = 500.0;

    /// Updates the field of view from a report; true if the vehicle has jumped to another place.
    pub(super) fn observe(&mut self, report: &ObjectReport) -> bool {
        self.pose = report.pose.map(|pose| {
            let (sin, cos) = pose.heading_rad.sin_cos();
            (Vector2::new(pose.x_m, pose.y_m), Vector2::new(cos, sin))
        });
        // A stated view is relative to the pose.
        self.stated = report.view.filter(|_| report.pose.is_some());
        let Some(here) = self.position().or_else(|| median(report)).or(self.centre) else {
            return false;
        };
        let has_jumped = self
            .centre
            .is_some_and(|before| (here - before).norm() > Self::JUMP_M);
        if has_jumped {
            self.farthest_m = 0.0;
            self.directions = [0.0; Self::DIRECTIONS];
        }
        let centre = match self.centre {
            Some(before) if self.pose.is_none() && !has_jumped => before + (here - before) * 0.2,
            _ => here,
        };
        self.centre = Some(centre);
        self.farthest_m *= 0.995;
        self.directions.iter_mut().for_each(|count| *count *= 0.99);
        for object in &report.objects {
            let offset = Vector2::new(object.x_m, object.y_m) - centre;
            if offset.norm() > Self::MAX_RANGE_M {
                continue;
            }
            self.farthest_m = self.farthest_m.max(offset.norm());
            self.directions[self.direction(&offset)] += 1.0;
        }
        self.min_detections = 0.1 * self.directions.iter().sum::<f32>() / Self::DIRECTIONS as f32;
        has_jumped
    }

    /// Reported position of the vehicle, metres.
    pub(super) fn position(&self) -> Option<Vector2<f64>> {
        self.pose.map(|(position, _)| position)
    }

    /// Reported position, or else the median of the detections, metres.
    pub(super) fn centre(&self) -> Option<Vector2<f64>> {
        self.centre
    }

    /// Range around the centre, metres.
    pub(super) fn range_m(&self) -> f64 {
        self.stated
            .map_or(self.farthest_m, |view| view.range_m)
            .min(Self::MAX_RANGE_M)
    }

    /// Detection rates at a reported position without occlusion; `None` outside the field of view.
    pub(super) fn rates_at(&self, reported: &Vector2<f64>) -> Option<&DetectionRates> {
        let offset = reported - self.centre?;
        let distance_m = offset.norm();
        if distance_m > self.range_m() || !self.faces(&offset, distance_m) {
            return None;
        }
        Some(&self.rates[Self::bin(distance_m)])
    }

    /// Updates the rates with an observation of an object that exists with a probability; `state` is the state before
    /// the observation.
    pub(super) fn learn(
        &mut self,
        reported: &Vector2<f64>,
        state: ObservationState,
        is_hit: bool,
        probability: f64,
    ) {
        let Some(centre) = self.centre else { return };
        self.rates[Self::bin((reported - centre).norm())].learn(state, is_hit, probability);
    }

    fn faces(&self, offset: &Vector2<f64>, distance_m: f64) -> bool {
        let Some((_, heading)) = self.pose else {
            return true;
        };
        if let Some(view) = self.stated {
            return offset.dot(&heading)
                >= distance_m * (view.angle_rad / 2.0).min(PI).cos() - 1e-9;
        }
        self.directions[self.direction(offset)] > self.min_detections
    }

    fn direction(&self, offset: &Vector2<f64>) -> usize {
        let heading = self.pose.map_or(Vector2::x(), |(_, heading)| heading);
        let from_heading = Vector2::new(heading.dot(offset), heading.perp(offset));
        (turn(&from_heading) * Self::DIRECTIONS as f64) as usize % Self::DIRECTIONS
    }

    fn bin(distance_m: f64) -> usize {
        let mut end_m = Self::FIRST_BIN_M;
        for bin in 0..Self::BINS - 1 {
            if distance_m <= end_m {
                return bin;
            }
            end_m *= 2.0;
        }
        Self::BINS - 1
    }
}

/// Direction of an offset as a fraction of a turn, counter-clockwise from east, 0 to 1.
///
/// Within a quarter it follows the share of the coordinates instead of the angle. Equal fractions differ in angle by a
/// factor of at most two, and need no trigonometry.
pub(super) fn turn(offset: &Vector2<f64>) -> f64 {
    let share = offset.y / (offset.x.abs() + offset.y.abs()).max(f64::MIN_POSITIVE) / 4.0;
    if offset.x < 0.0 {
        0.5 - share
    } else if share < 0.0 {
        1.0 + share
    } else {
        share
    }
}

/// The median of the detections in each direction, which is robust against outliers.
fn median(report: &ObjectReport) -> Option<Vector2<f64>> {
    let median = |coordinate: fn(&PerceivedObject) -> f64| {
        let mut values: Vec<f64> = report.objects.iter().map(coordinate).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        Some((values[last / 2] + values[last.div_ceil(2)]) / 2.0)
    };
    Some(Vector2::new(
        median(|object| object.x_m)?,
        median(|object| object.y_m)?,
    ))
}
