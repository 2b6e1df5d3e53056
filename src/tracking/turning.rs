//! Reports in a turning frame, for example in a frame that is fixed to a vehicle.
//!
//! In such a frame a standing object moves in a circle, which a filter of nearly constant velocity cannot follow.
//! Tracks therefore use a frame with the same origin that does not turn: the angle between both frames is the integral
//! of the yaw rates that the reports state. A report without a yaw rate states that the frame does not turn.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use nalgebra::{Matrix2, Rotation2, Vector2};

use crate::model::geometry::wrap_angle;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{FusedObject, GlobalMap, ObjectReport, PoseCorrection};

/// Time for which a yaw rate is valid.
const HELD: Duration = Duration::from_secs(1);

/// Angle of the frame of all reports and maps against the frame of the tracks.
#[derive(Debug, Clone, Default)]
pub(super) struct TurningFrame {
    at: Timestamp,
    angle_rad: f64,
    rate_radps: f64,
    /// By vehicle, the yaw rate of its latest report, with the time and number of the report.
    stated: BTreeMap<NodeName, (Timestamp, u64, f64)>,
}

impl TurningFrame {
    /// Records the yaw rate that a report states, captured at `at`.
    pub(super) fn record(&mut self, report: &ObjectReport, at: Timestamp) {
        let latest = (at, report.seq, report.frame_yaw_rate_radps.unwrap_or(0.0));
        let known = self.stated.entry(report.node.clone()).or_insert(latest);
        if (latest.0, latest.1) > (known.0, known.1) {
            *known = latest;
        }
    }

    /// Advances to `now` with the median of the last yaw rates of trusted vehicles. For an even number, the middle rate
    /// with the smaller magnitude is used, so that a single vehicle cannot turn the frame of others.
    pub(super) fn advance(&mut self, now: Timestamp, is_trusted: impl Fn(&NodeName) -> bool) {
        self.stated.retain(|_, (at, ..)| now.since(*at) <= HELD);
        let trusted = self.stated.iter().filter(|(node, _)| is_trusted(node));
        let mut rates: Vec<f64> = trusted.map(|(_, (.., rate_radps))| *rate_radps).collect();
        rates.sort_by(f64::total_cmp);
        let middle = rates.len().saturating_sub(1) / 2..=rates.len() / 2;
        let rate_radps = rates
            .get(middle)
            .unwrap_or_default()
            .iter()
            .copied()
            .min_by(|a, b| a.abs().total_cmp(&b.abs()))
            .unwrap_or(0.0);
        let passed_s = now.since(self.at).as_secs_f64();
        if self.is_turning() {
            self.angle_rad =
                wrap_angle(self.angle_rad + (self.rate_radps + rate_radps) / 2.0 * passed_s);
        }
        self.rate_radps = rate_radps;
        self.at = self.at.max(now);
    }

    fn is_turning(&self) -> bool {
        self.angle_rad != 0.0 || self.rate_radps != 0.0
    }

    /// The turn from the frame of the reports at `at` to the frame of the tracks; `None` while both are equal.
    fn turn(&self, at: Timestamp) -> Option<Turn> {
        let passed_s = at.micros_from(self.at) as f64 * 1e-6;
        let angle_rad = self.angle_rad + self.rate_radps * passed_s;
        self.is_turning().then_some(Turn {
            angle_rad,
            rate_radps: self.rate_radps,
        })
    }

    /// A report, captured at `at`, in the frame of the tracks.
    pub(super) fn steady(&self, report: Arc<ObjectReport>, at: Timestamp) -> Arc<ObjectReport> {
        let Some(turn) = self.turn(at) else {
            return report;
        };
        let mut report = Arc::unwrap_or_clone(report);
        if let Some(pose) = &mut report.pose {
            [pose.x_m, pose.y_m] = turn.vector([pose.x_m, pose.y_m]);
            pose.heading_rad = turn.heading(pose.heading_rad);
        }
        for object in &mut report.objects {
            turn.motion(
                [&mut object.x_m, &mut object.y_m],
                &mut object.velocity_mps,
                &mut object.heading_rad,
            );
            object.covariance_m2 = object
                .covariance_m2
                .map(|covariance| turn.covariance(covariance));
        }
        Arc::new(report)
    }

    /// Another aggregator's map, received at `now`, in the frame of the tracks.
    pub(super) fn steady_map(&self, map: &GlobalMap, now: Timestamp) -> Option<GlobalMap> {
        let turn = self.turn(now)?;
        let mut map = map.clone();
        map.objects
            .iter_mut()
            .for_each(|object| turn.object(object));
        Some(map)
    }

    /// Converts the objects and corrections of a map at `now` to the frame of the reports.
    pub(super) fn restore<'a>(
        &self,
        now: Timestamp,
        objects: &mut [FusedObject],
        corrections: impl Iterator<Item = &'a mut PoseCorrection>,
    ) {
        let Some(turn) = self.turn(now).map(Turn::reversed) else {
            return;
        };
        objects.iter_mut().for_each(|object| turn.object(object));
        for correction in corrections {
            correction.about_m = turn.vector(correction.about_m);
            [correction.dx_m, correction.dy_m] = turn.vector([correction.dx_m, correction.dy_m]);
        }
    }
}

/// A change from one frame to another that turns against it.
#[derive(Debug, Clone, Copy)]
struct Turn {
    angle_rad: f64,
    rate_radps: f64,
}

impl Turn {
    fn reversed(self) -> Self {
        Self {
            angle_rad: -self.angle_rad,
            rate_radps: -self.rate_radps,
        }
    }

    fn rotation(&self) -> Rotation2<f64> {
        Rotation2::new(self.angle_rad)
    }

    fn vector(&self, vector: [f64; 2]) -> [f64; 2] {
        (self.rotation() * Vector2::from(vector)).into()
    }

    fn heading(&self, heading_rad: f64) -> f64 {
        wrap_angle(heading_rad + self.angle_rad)
    }

    fn covariance(&self, [xx, xy, yy]: [f64; 3]) -> [f64; 3] {
        let rotation = self.rotation();
        let turned = rotation * Matrix2::new(xx, xy, xy, yy) * rotation.inverse();
        [turned.m11, turned.m12, turned.m22]
    }

    fn motion(
        &self,
        [x_m, y_m]: [&mut f64; 2],
        velocity_mps: &mut Option<[f64; 2]>,
        heading_rad: &mut Option<f64>,
    ) {
        let rate = self.rate_radps;
        *velocity_mps = velocity_mps
            .map(|[east, north]| self.vector([east - rate * *y_m, north + rate * *x_m]));
        *heading_rad = heading_rad.map(|heading_rad| self.heading(heading_rad));
        [*x_m, *y_m] = self.vector([*x_m, *y_m]);
    }

    fn object(&self, object: &mut FusedObject) {
        self.motion(
            [&mut object.x_m, &mut object.y_m],
            &mut object.velocity_mps,
            &mut object.heading_rad,
        );
        object.covariance_m2 = self.covariance(object.covariance_m2);
    }
}
