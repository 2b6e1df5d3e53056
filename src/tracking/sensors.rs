//! What is learnt about one vehicle: how noisy its positions are, where it sees, what its confidences are worth.

use std::f64::consts::PI;

use nalgebra::{Matrix2, Vector2};

use super::calibration::Calibration;
use super::config::TracksConfig;
use super::existence::Rates;
use super::registration::Alignment;
use super::trust::Standing;
use crate::geometry::Covariance;
use crate::names::NodeName;
use crate::reputation::ReputationConfig;
use crate::time::Timestamp;
use crate::wire::{FieldOfView, ObjectReport, PerceivedObject};

/// One vehicle.
#[derive(Debug, Clone)]
pub(super) struct Source {
    pub(super) node: NodeName,
    pub(super) last_report: Timestamp,
    pub(super) alignment: Alignment,
    pub(super) noise: Noise,
    pub(super) calibration: Calibration,
    pub(super) view: View,
    pub(super) standing: Standing,
}

impl Source {
    pub(super) fn new(
        node: NodeName,
        at: Timestamp,
        alignment: Alignment,
        standing: Standing,
        config: &TracksConfig,
    ) -> Self {
        Self {
            node,
            last_report: at,
            alignment,
            noise: Noise::default(),
            calibration: Calibration::new(config.even_confidence),
            view: View::default(),
            standing,
        }
    }

    /// Weight of its word, 0 to 1.
    pub(super) fn trust(&self, config: &ReputationConfig) -> f64 {
        self.standing.trust(config)
    }
}

/// How far reported positions scatter about their tracks, as a multiple of what was assumed.
#[derive(Debug, Clone)]
pub(super) struct Noise {
    scale: f64,
    weight: f64,
}

impl Default for Noise {
    fn default() -> Self {
        Self { scale: 1.0, weight: 30.0 }
    }
}

impl Noise {
    /// Weight beyond which older detections are forgotten.
    const MEMORY: f64 = 500.0;

    /// Covariance of a position, m².
    pub(super) fn covariance(&self, object: &PerceivedObject, config: &TracksConfig) -> Matrix2<f64> {
        let floor = Matrix2::identity() * (config.noise_floor_m * config.noise_floor_m);
        stated(object, config).matrix() * self.scale + floor
    }

    /// A detection was so far from a track that is well known; `expected` is the part of the squared distance that is
    /// the track's.
    pub(super) fn learn(&mut self, object: &PerceivedObject, squared: f64, expected: f64, config: &TracksConfig) {
        let stated = stated(object, config);
        let ratio = ((squared - expected) / (stated.xx + stated.yy)).clamp(0.0, 25.0);
        self.weight = (self.weight + 1.0).min(Self::MEMORY);
        self.scale += (ratio - self.scale) / self.weight;
        // A covariance that was stated is never taken for better than it says.
        let least = if object.covariance_m2.is_some() { 1.0 } else { 0.05 };
        self.scale = self.scale.max(least);
    }
}

/// The middle of what a vehicle detected: the median each way, which no stray detection moves far.
fn middle(report: &ObjectReport) -> Option<Vector2<f64>> {
    let median = |coordinate: fn(&PerceivedObject) -> f64| {
        let mut values: Vec<f64> = report.objects.iter().map(coordinate).collect();
        values.sort_by(f64::total_cmp);
        let last = values.len().checked_sub(1)?;
        Some((values[last / 2] + values[last.div_ceil(2)]) / 2.0)
    };
    Some(Vector2::new(median(|object| object.x_m)?, median(|object| object.y_m)?))
}

fn stated(object: &PerceivedObject, config: &TracksConfig) -> Covariance {
    object.covariance().unwrap_or_else(|| Covariance::isotropic(config.noise_m))
}

/// Where a vehicle sees things and how surely.
#[derive(Debug, Clone)]
pub(super) struct View {
    /// Where the vehicle is and the unit vector that it heads along.
    pose: Option<(Vector2<f64>, Vector2<f64>)>,
    stated: Option<FieldOfView>,
    /// The pose, or the middle of what it sees.
    centre: Option<Vector2<f64>>,
    /// Detections by direction from the heading, fading.
    directions: [f32; Self::DIRECTIONS],
    /// It sees that way where there are more.
    least: f32,
    /// By distance from the centre.
    rates: [Bin; Self::BINS],
    farthest_m: f64,
}

/// (Hits, looks) after a hit and after a miss.
#[derive(Debug, Clone, Copy)]
struct Bin {
    stay: (f32, f32),
    find: (f32, f32),
}

impl Default for View {
    fn default() -> Self {
        let (stay, find) = (0.9, 0.15);
        let bin = Bin { stay: (stay * 20.0, 20.0), find: (find * 20.0, 20.0) };
        Self {
            pose: None,
            stated: None,
            centre: None,
            directions: [0.0; Self::DIRECTIONS],
            least: 0.0,
            rates: [bin; Self::BINS],
            farthest_m: 0.0,
        }
    }
}

impl View {
    const BINS: usize = 16;
    const BIN_M: f64 = 10.0;
    const DIRECTIONS: usize = 24;

    /// Looks after which older ones are forgotten.
    const MEMORY: f32 = 400.0;

    /// Distance in metres that no vehicle comes from one report to the next.
    const JUMP_M: f64 = 500.0;

    /// Takes note of where a report comes from; true if the vehicle is somewhere else all at once.
    pub(super) fn observe(&mut self, report: &ObjectReport) -> bool {
        self.pose = report.pose.map(|pose| {
            let (sin, cos) = pose.heading_rad.sin_cos();
            (Vector2::new(pose.x_m, pose.y_m), Vector2::new(cos, sin))
        });
        // Of no use without the pose that it is from.
        self.stated = report.view.filter(|_| report.pose.is_some());
        let Some(here) = self.position().or_else(|| middle(report)).or(self.centre) else { return false };
        let has_jumped = self.centre.is_some_and(|before| (here - before).norm() > Self::JUMP_M);
        if has_jumped {
            (self.farthest_m, self.directions) = (0.0, [0.0; Self::DIRECTIONS]);
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
            if offset.norm() > Self::BIN_M * Self::BINS as f64 {
                continue;
            }
            self.farthest_m = self.farthest_m.max(offset.norm());
            self.directions[self.direction(&offset)] += 1.0;
        }
        self.least = 0.1 * self.directions.iter().sum::<f32>() / Self::DIRECTIONS as f32;
        has_jumped
    }

    /// Where the vehicle says it is.
    pub(super) fn position(&self) -> Option<Vector2<f64>> {
        self.pose.map(|(position, _)| position)
    }

    /// The pose, or the middle of what it sees.
    pub(super) fn centre(&self) -> Option<Vector2<f64>> {
        self.centre
    }

    /// How far it sees, metres.
    pub(super) fn reach_m(&self) -> f64 {
        self.stated.map_or(self.farthest_m, |view| view.range_m).min(Self::BIN_M * Self::BINS as f64)
    }

    /// How surely it detects what is at a reported position, if nothing hides it; `None` out of its view.
    pub(super) fn rates_at(&self, reported: &Vector2<f64>) -> Option<Rates> {
        let offset = reported - self.centre?;
        let distance_m = offset.norm();
        if distance_m > self.reach_m() || !self.faces(&offset, distance_m) {
            return None;
        }
        let bin = &self.rates[Self::bin(distance_m)];
        let rate = |(hits, looks): (f32, f32)| f64::from(hits / looks).clamp(0.02, 0.98);
        Some(Rates { stay: rate(bin.stay), find: rate(bin.find) })
    }

    /// It looked at an object that is sure to exist.
    pub(super) fn learn(&mut self, reported: &Vector2<f64>, was_hit: bool, is_hit: bool) {
        let Some(centre) = self.centre else { return };
        let bin = &mut self.rates[Self::bin((reported - centre).norm())];
        let (hits, looks) = if was_hit { &mut bin.stay } else { &mut bin.find };
        *hits += f32::from(u8::from(is_hit));
        *looks += 1.0;
        if *looks > Self::MEMORY {
            let kept = Self::MEMORY / *looks;
            *hits *= kept;
            *looks *= kept;
        }
    }

    fn faces(&self, offset: &Vector2<f64>, distance_m: f64) -> bool {
        let Some((_, heading)) = self.pose else { return true };
        if let Some(view) = self.stated {
            return offset.dot(&heading) >= distance_m * (view.angle_rad / 2.0).min(PI).cos() - 1e-9;
        }
        self.directions[self.direction(offset)] > self.least
    }

    fn direction(&self, offset: &Vector2<f64>) -> usize {
        let heading = self.pose.map_or(Vector2::x(), |(_, heading)| heading);
        let from_heading = Vector2::new(heading.dot(offset), heading.perp(offset));
        (turn(&from_heading) * Self::DIRECTIONS as f64) as usize % Self::DIRECTIONS
    }

    fn bin(distance_m: f64) -> usize {
        ((distance_m / Self::BIN_M) as usize).min(Self::BINS - 1)
    }
}

/// Direction of an offset, counterclockwise from east, as a part of a turn, 0 to 1. Within a quarter it goes by the
/// share of the coordinates instead of the angle: equal parts differ in angle by a factor of two at most, and need no
/// trigonometry.
pub(super) fn turn(offset: &Vector2<f64>) -> f64 {
    let share = offset.y / (offset.x.abs() + offset.y.abs()).max(f64::MIN_POSITIVE) / 4.0;
    match offset.x < 0.0 {
        true => 0.5 - share,
        false if share < 0.0 => 1.0 + share,
        false => share,
    }
}
