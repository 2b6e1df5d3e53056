//! Sensor of one vehicle: from visible bodies to a report with errors.
//!
//! The chance of a detection depends on range, on how much of the object is hidden, on its class,
//! and on a quality of each pair of observer and object that changes within a second, so that
//! misses occur in runs. Confidences follow the same quality, so hardly visible objects have
//! confidences like false alarms. For a partly hidden object, the middle of its visible part is
//! reported.

use ecod::model::geometry::{Covariance, Pose, wrap_angle};
use ecod::wire::{FieldOfView, ObjectReport, PerceivedObject};
use nalgebra::{Point2, Vector2};

use super::config::{ReportedFields, TrafficConfig};
use super::dice::{Dice, Drift};
use super::sight::{Sight, TrafficBody};

/// Correlation times in seconds of an observer's view of an object, and of its pose error.
const GLANCE_S: f64 = 0.8;
const POSE_S: f64 = 25.0;
/// Noise across the line of sight, as a share of the noise along it.
const ACROSS: f64 = 0.6;
/// Share that must be visible for an object to be detected, and to count as seen.
const MIN_SHARE: f64 = 0.15;
/// Mean life of a ghost in seconds, and its chance to appear in a report.
const GHOST_S: f64 = 1.5;
const GHOST_CHANCE: f64 = 0.7;
/// Share of the range within which lures deceive, and their chance to.
const LURE_RANGE: f64 = 0.6;
const LURE_CHANCE: f64 = 0.35;
/// Share of people and bicycles that are taken for the other.
const CONFUSED: f64 = 0.05;

#[derive(Debug, Clone)]
pub(super) struct SimulatedSensor {
    offset: [Drift; 2],
    turn: Drift,
    /// Index: number of the body.
    glances: Vec<Glance>,
    ghosts: Vec<Ghost>,
    last_s: f64,
}

/// Quality of an observer's view of one body.
#[derive(Debug, Clone, Copy)]
struct Glance {
    quality: Drift,
    bias: [Drift; 2],
    at_s: f64,
}

/// A false alarm that lasts for a while.
#[derive(Debug, Clone, Copy)]
struct Ghost {
    position: Point2<f64>,
    label: &'static str,
    until_s: f64,
}

/// Detection, true or false.
#[derive(Debug, Clone, Copy)]
struct Found {
    position: Point2<f64>,
    label: &'static str,
    confidence: f64,
    /// Its place among the bodies, if it is one.
    body: Option<usize>,
}

/// Surroundings of an observer.
pub(super) struct Surroundings<'a> {
    pub(super) pose: Pose,
    pub(super) bodies: &'a [TrafficBody],
    pub(super) sights: &'a [Sight],
    /// Places that look like an object, in view.
    pub(super) lures: &'a [Point2<f64>],
    pub(super) at_s: f64,
}

impl Surroundings<'_> {
    /// A class, as often as there are such.
    fn label(&self, dice: &mut Dice<'_>) -> &'static str {
        self.bodies[dice.below(self.bodies.len())].label
    }
}

/// Confidence of a detector and its chance of a detection, as log odds.
fn share_of(log_odds: f64) -> f64 {
    1.0 / (1.0 + (-log_odds).exp())
}

impl SimulatedSensor {
    pub(super) fn new(bodies: usize, dice: &mut Dice<'_>) -> Self {
        let mut drift = || Drift::new(dice);
        Self {
            offset: [drift(), drift()],
            turn: drift(),
            glances: (0..bodies)
                .map(|_| Glance {
                    quality: drift(),
                    bias: [drift(), drift()],
                    at_s: 0.0,
                })
                .collect(),
            ghosts: Vec::new(),
            last_s: 0.0,
        }
    }

    /// True if something counts as seen.
    pub(super) fn sees(config: &TrafficConfig, pose: &Pose, sight: &Sight) -> bool {
        let aside_rad = wrap_angle(sight.bearing_rad - pose.heading_rad).abs();
        sight.share >= MIN_SHARE && aside_rad <= config.sensor.angle_rad / 2.0
    }

    /// Fills in a report.
    pub(super) fn observe(
        &mut self,
        config: &TrafficConfig,
        around: &Surroundings<'_>,
        report: &mut ObjectReport,
        dice: &mut Dice<'_>,
    ) {
        let sensor = &config.sensor;
        let passed_s = around.at_s - self.last_s;
        self.last_s = around.at_s;
        let mut found: Vec<Found> = Vec::new();
        for sight in around
            .sights
            .iter()
            .filter(|sight| Self::sees(config, &around.pose, sight))
        {
            found.extend(self.glance(config, around, sight, dice));
        }
        self.haunt(config, around, passed_s, dice);
        for ghost in &self.ghosts {
            if dice.chance(GHOST_CHANCE) {
                let confidence = share_of(0.6 * dice.normal() - 0.3);
                found.push(Found {
                    position: ghost.position,
                    label: ghost.label,
                    confidence,
                    body: None,
                });
            }
        }
        for lure in around.lures {
            let range_m = (lure - around.pose.position).norm();
            if range_m < LURE_RANGE * sensor.range_m && dice.chance(LURE_CHANCE) {
                let confidence = share_of(0.6 * dice.normal() - 0.2);
                found.push(Found {
                    position: *lure,
                    label: "car",
                    confidence,
                    body: None,
                });
            }
        }
        for _ in 0..dice.poisson(sensor.clutter) {
            let position = somewhere(config, &around.pose, dice);
            let label = around.label(dice);
            found.push(Found {
                position,
                label,
                confidence: share_of(0.8 * dice.normal() - 0.9),
                body: None,
            });
        }
        let drift_s = if config.fixed { 0.0 } else { passed_s };
        let error = Vector2::from(
            self.offset
                .each_mut()
                .map(|drift| drift.step(drift_s, POSE_S, dice)),
        ) * sensor.pose_m;
        let turned_rad = self.turn.step(drift_s, POSE_S, dice) * sensor.pose_rad;
        let said = Pose {
            position: around.pose.position + error,
            heading_rad: around.pose.heading_rad + turned_rad,
        };
        let is_posed = config.said.poses;
        report.pose = is_posed.then(|| {
            Pose {
                heading_rad: rounded(wrap_angle(said.heading_rad)),
                ..said
            }
            .into()
        });
        report.view = (is_posed && config.said.views).then_some(FieldOfView {
            range_m: sensor.range_m,
            angle_rad: sensor.angle_rad,
        });
        for Found {
            position,
            label,
            confidence,
            body,
        } in found
        {
            let (range_m, bearing_rad) = around.pose.range_bearing(&position);
            let along_m = sensor.noise_m + sensor.noise_per_m * range_m;
            let ahead_m = range_m + along_m * dice.normal();
            let aside_m = ACROSS * along_m * dice.normal();
            let (sin, cos) = bearing_rad.sin_cos();
            let place =
                said.transform(ahead_m * cos - aside_m * sin, ahead_m * sin + aside_m * cos);
            let covariance = Covariance::along_bearing(
                said.heading_rad + bearing_rad,
                along_m,
                ACROSS * along_m,
            );
            let mut object = PerceivedObject::new(
                label,
                rounded(confidence),
                rounded(place.x),
                rounded(place.y),
            );
            object.covariance_m2 = config.said.covariances.then_some(
                [covariance.xx, covariance.xy, covariance.yy].map(|v| (v * 1e6).round() / 1e6),
            );
            describe(
                &config.said,
                &mut object,
                body.map(|body| &around.bodies[body]),
                turned_rad,
                dice,
            );
            report.objects.push(object);
        }
    }

    /// Detection of an existing body.
    fn glance(
        &mut self,
        config: &TrafficConfig,
        around: &Surroundings<'_>,
        sight: &Sight,
        dice: &mut Dice<'_>,
    ) -> Option<Found> {
        let body = &around.bodies[sight.body];
        let glance = &mut self.glances[sight.body];
        let passed_s = around.at_s - glance.at_s;
        glance.at_s = around.at_s;
        let quality = glance.quality.step(passed_s, GLANCE_S, dice);
        let bias = Vector2::from(
            glance
                .bias
                .each_mut()
                .map(|drift| drift.step(passed_s, GLANCE_S, dice)),
        );
        let far = sight.range_m / config.sensor.range_m;
        let small = if body.label == "car" { 0.0 } else { 0.8 };
        let log_odds = 4.0 - 4.5 * far * far - 5.0 * (1.0 - sight.share) - small + quality;
        if !dice.chance(share_of(log_odds)) {
            return None;
        }
        let hidden_m = 0.25 * (1.0 - sight.share) * body.length_m;
        let (sin, cos) = sight.bearing_rad.sin_cos();
        let position =
            body.center + bias * config.sensor.bias_m - Vector2::new(cos, sin) * hidden_m;
        let label = match body.label {
            "person" if dice.chance(CONFUSED) => "bicycle",
            "bicycle" if dice.chance(CONFUSED) => "person",
            label => label,
        };
        let confidence = share_of(0.6 * log_odds - 0.6 + 0.5 * dice.normal());
        Some(Found {
            position,
            label,
            confidence,
            body: Some(sight.body),
        })
    }

    /// Ends and begins lasting false alarms.
    fn haunt(
        &mut self,
        config: &TrafficConfig,
        around: &Surroundings<'_>,
        passed_s: f64,
        dice: &mut Dice<'_>,
    ) {
        let range_m = config.sensor.range_m;
        self.ghosts.retain(|ghost| {
            ghost.until_s > around.at_s && (ghost.position - around.pose.position).norm() < range_m
        });
        for _ in 0..dice.poisson(config.sensor.ghosts_per_s * passed_s.min(1.0)) {
            self.ghosts.push(Ghost {
                position: somewhere(config, &around.pose, dice),
                label: around.label(dice),
                until_s: around.at_s + dice.exponential(GHOST_S),
            });
        }
    }
}

/// Reported motion and size of an object, in a rotated frame; a false alarm seems to stand.
fn describe(
    said: &ReportedFields,
    object: &mut PerceivedObject,
    body: Option<&TrafficBody>,
    turned_rad: f64,
    dice: &mut Dice<'_>,
) {
    let heading_rad = body.map_or(0.0, |body| body.heading_rad) + turned_rad;
    let speed_mps = body.map_or(0.0, |body| body.speed_mps);
    let size_m = body.map_or([4.5, 1.8], |body| [body.length_m, body.width_m]);
    let (sin, cos) = heading_rad.sin_cos();
    object.velocity_mps = said
        .velocities_mps
        .map(|sigma| [cos, sin].map(|part| rounded(speed_mps * part + sigma * dice.normal())));
    object.heading_rad = said
        .headings_rad
        .map(|sigma| rounded(wrap_angle(heading_rad + sigma * dice.normal())));
    object.size_m = said
        .sizes_m
        .map(|sigma| size_m.map(|side| rounded((side + sigma * dice.normal()).max(0.1))));
}

/// A place in view, all places alike.
fn somewhere(config: &TrafficConfig, pose: &Pose, dice: &mut Dice<'_>) -> Point2<f64> {
    let range_m = config.sensor.range_m * dice.between(0.0, 1.0).sqrt();
    let half_rad = config.sensor.angle_rad / 2.0;
    let (sin, cos) = dice.between(-half_rad, half_rad).sin_cos();
    pose.transform(range_m * cos, range_m * sin)
}

/// To the millimetre, or the thousandth, or the milliradian.
fn rounded(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}
