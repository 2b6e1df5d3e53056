//! One track: an object that is followed.

use std::collections::BTreeMap;
use std::time::Duration;

use nalgebra::Vector2;
use smallvec::SmallVec;
use uuid::Uuid;

use super::config::TracksConfig;
use super::detection_history::DetectionHistory;
use super::existence::{
    BaseRate, MAX_DENIAL_NATS, SensorHistory, SensorQuality, alone_nats, logistic, persistence_nats,
};
use super::grid::IndexedTrack;
use super::handles::{SensorId, TrackIndex};
use super::kinematics::{KinematicState, Measurement};
use super::neighbours::TrackNeighbours;
use crate::model::geometry::{Covariance, wrap_angle};
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::wire::{FusedObject, PerceivedObject};

/// Maximum age of another vehicle's detection that confirms a track.
const CONFIRMED_WITHIN: Duration = Duration::from_millis(500);

/// Maximum number of labels of a track; the likeliest stay.
const MAX_LABELS: usize = 8;

/// Similarity to a label that was never read.
pub(super) const MIN_LABEL_SIMILARITY: f64 = 0.02;

/// Maximum position error of a useful object, metres.
const USABLE_M: f64 = 1.5;

/// Rate at which the probability of a position error falls, in standard deviations: errors of associated detections have
/// an exponential tail.
const ERROR_RATE: f64 = 1.23;

/// Rate at which objects disappear, per second.
const DISAPPEARANCE_RATE: f64 = 0.02;

/// Time constant in seconds with which an unseen object disappears.
const UNSEEN_S: f64 = 2.0;

/// Time before its last detection within which a vehicle must have looked at an object to count as one that looks at it:
/// as long as evidence lasts. An object that all have left gets no surer by that.
const LOOKS_FOR: Duration = Duration::from_secs(3);

/// Power at which survival enters the odds of existence: tracks are kept for longer than their objects are likely there.
const SURVIVAL_POWER: f64 = 3.1;

/// State of one track.
#[derive(Debug, Clone)]
pub(super) struct Track {
    pub(super) id: Uuid,
    pub(super) state: KinematicState,
    pub(super) history: DetectionHistory,
    /// Fading weights of the labels that were read.
    labels: SmallVec<[(Label, f64); 1]>,
    /// Direction that vehicles stated.
    heading_rad: Option<f64>,
    /// Direction by another aggregator, which may be the course of then; it holds until a course is known here.
    inherited_heading_rad: Option<f64>,
    size_m: Option<[f64; 2]>,
    pub(super) first_seen: Timestamp,
    pub(super) last_seen: Timestamp,
    /// Odds that the object has disappeared since it was last seen.
    disappeared: f64,
    /// The vehicle that this track is, by its reported pose.
    pub(super) vehicle: Option<SensorId>,
    /// Number of detections.
    pub(super) hits: u32,
    /// Number of identities taken over from neighbouring cells.
    pub(super) renames: u8,
    pub(super) neighbours: TrackNeighbours,
    /// Log-odds from another aggregator, which fade, and the time at which they came.
    inherited: Option<(f64, Timestamp)>,
    /// Probability that the track never was an object, by the last estimate.
    pub(super) clutter: Option<f64>,
}

impl Track {
    /// A track with one measurement.
    pub(super) fn new(
        id: Uuid,
        at: Timestamp,
        measurement: &Measurement,
        config: &TracksConfig,
    ) -> Self {
        Self {
            id,
            state: KinematicState::new(at, measurement, config.speed_mps),
            history: DetectionHistory::default(),
            labels: SmallVec::new(),
            heading_rad: None,
            inherited_heading_rad: None,
            size_m: None,
            first_seen: at,
            last_seen: at,
            disappeared: 0.0,
            vehicle: None,
            hits: 0,
            renames: 0,
            neighbours: TrackNeighbours::default(),
            inherited: None,
            clutter: None,
        }
    }

    /// The entry of the grid at `at`.
    pub(super) fn indexed(&self, track: TrackIndex, at: Timestamp) -> IndexedTrack {
        IndexedTrack {
            position: self.state.position_at(at),
            velocity: self.state.velocity,
            track,
        }
    }

    /// Updates labels, heading and size from a detection.
    pub(super) fn update_attributes(&mut self, object: &PerceivedObject, heading_rad: Option<f64>) {
        const KEPT: f64 = 0.95;
        const SHARE: f64 = 0.3;
        self.labels
            .iter_mut()
            .for_each(|(_, weight)| *weight *= KEPT);
        let label = [(&object.label, object.confidence)];
        let scores = object.scores.iter().map(|(label, score)| (label, *score));
        let has_no_scores = object.scores.is_empty();
        for (label, score) in scores.chain(label.into_iter().filter(|_| has_no_scores)) {
            match self.labels.iter_mut().find(|(known, _)| known == label) {
                Some((_, weight)) => *weight += score,
                None => self.labels.push((label.clone(), score)),
            }
        }
        if self.labels.len() > MAX_LABELS {
            self.labels.sort_by(|a, b| b.1.total_cmp(&a.1));
            self.labels.truncate(MAX_LABELS);
        }
        if self.course_rad().is_some() {
            self.inherited_heading_rad = None;
        }
        if let Some(new) = heading_rad {
            let old = self.heading_rad.unwrap_or(new);
            self.heading_rad = Some(wrap_angle(old + SHARE * wrap_angle(new - old)));
        }
        if let Some(new) = object.size_m {
            let old = self.size_m.unwrap_or(new);
            self.size_m = Some([0, 1].map(|side| old[side] + SHARE * (new[side] - old[side])));
        }
    }

    /// Records a detection at `at`.
    pub(super) fn record_hit(&mut self, at: Timestamp) {
        self.last_seen = self.last_seen.max(at);
        self.disappeared = 0.0;
        self.hits = self.hits.saturating_add(1);
    }

    /// Records a miss at `at` by a vehicle that had detected the object and last looked `dt_s` before; `rate` is its
    /// probability of detection.
    pub(super) fn record_miss(&mut self, at: Timestamp, dt_s: f64, rate: f64) {
        if at > self.last_seen {
            // It was there when another vehicle saw it meanwhile.
            let unseen_s = dt_s.min(at.since(self.last_seen).as_secs_f64());
            self.disappeared =
                ((self.disappeared + DISAPPEARANCE_RATE * unseen_s) / (1.0 - rate)).min(1e6);
        }
    }

    /// Similarity of a detection's labels to those of the track, 0 to 1.
    pub(super) fn label_similarity(&self, object: &PerceivedObject) -> f64 {
        if self.labels.is_empty() {
            return 1.0;
        }
        let total: f64 = self.labels.iter().map(|(_, weight)| weight).sum::<f64>() + 1e-9;
        let stated: f64 = object.scores.values().sum();
        let share = |label: &Label| {
            if object.scores.is_empty() {
                f64::from(u8::from(*label == object.label))
            } else {
                object.scores.get(label).copied().unwrap_or(0.0) / stated.max(1e-9)
            }
        };
        let common: f64 = self
            .labels
            .iter()
            .map(|(label, weight)| weight / total * share(label))
            .sum();
        common.max(MIN_LABEL_SIMILARITY)
    }

    /// Estimates whether the track is of an object; returns the probability that it is still there. `base_rate` are the
    /// log-odds of any track, `quality` weighs the evidence of each vehicle.
    pub(super) fn estimate_existence(
        &mut self,
        at: Timestamp,
        base_rate: f64,
        quality: impl Fn(SensorId) -> SensorQuality,
    ) -> f64 {
        let (mut evidence, mut denied, mut detected) = (0.0, 0.0, 0.0);
        let (mut looks_hz, mut most_trusted) = (0.0, 0.0f64);
        let (mut witnesses, mut even_excess) = (0, None);
        let looking_since = self.last_seen - LOOKS_FOR;
        for history in self.history.iter() {
            let sensor = quality(history.sensor);
            let (shared, denial) = history.shared_nats(at);
            evidence += sensor.trust * shared;
            denied += sensor.trust * denial;
            if history.last_look >= looking_since {
                looks_hz += sensor.trust * sensor.looks_hz;
                most_trusted = most_trusted.max(sensor.trust);
            }
            if history.last_hit.is_some() && sensor.trust > 0.0 {
                witnesses += 1;
                detected = sensor.trust.max(detected);
                even_excess = Some(
                    even_excess
                        .unwrap_or(sensor.even_excess)
                        .min(sensor.even_excess),
                );
            }
        }
        let persistence = persistence_nats(self.last_seen.since(self.first_seen).as_secs_f64());
        let inherited = self.inherited.map_or(0.0, |(nats, since)| {
            nats * (-at.since(since).as_secs_f64()).exp()
        });
        let evidence = if witnesses < 2 {
            evidence - denied.min(MAX_DENIAL_NATS)
        } else {
            evidence
        };
        // Looks count beside each other, not less for all: those who are trusted little find an object no surer by that.
        let looks_hz = if most_trusted > 0.0 {
            looks_hz / most_trusted
        } else {
            0.0
        };
        let alone = alone_nats(looks_hz, even_excess.unwrap_or_default());
        let nats = base_rate + alone + evidence + detected * persistence + inherited;
        self.clutter = Some(logistic(-nats));
        logistic(nats + SURVIVAL_POWER * self.survival(at).ln())
    }

    /// The only vehicle that detects the object, if there is but one.
    pub(super) fn only_witness(&self) -> Option<SensorId> {
        let mut witnesses = self.witnesses();
        witnesses.next().filter(|_| witnesses.next().is_none())
    }

    fn witnesses(&self) -> impl Iterator<Item = SensorId> {
        self.history
            .iter()
            .filter(|history| history.last_hit.is_some())
            .map(|history| history.sensor)
    }

    /// Probability that an object that existed is still there.
    pub(super) fn survival(&self, now: Timestamp) -> f64 {
        let age = now.since(self.last_seen).as_secs_f64();
        (-age / UNSEEN_S).exp() / (1.0 + self.disappeared)
    }

    /// The histories of the vehicles that detected the object since `limit`.
    pub(super) fn seen_by(&self, limit: Timestamp) -> impl Iterator<Item = &SensorHistory> {
        self.history
            .iter()
            .filter(move |history| history.last_hit.is_some_and(|hit| hit >= limit))
    }

    /// Whether another vehicle than `sensor` detected the object shortly before `at`.
    pub(super) fn is_confirmed(&self, sensor: SensorId, at: Timestamp) -> bool {
        self.seen_by(at - CONFIRMED_WITHIN)
            .any(|history| history.sensor != sensor)
    }

    /// True if a vehicle detected both objects in the frame of its last detection. Detections of long ago do not count: a
    /// duplicate of then would stay for as long as the vehicle.
    pub(super) fn is_resolved_from(&self, other: &Self) -> bool {
        let since = self.last_seen.max(other.last_seen) - LOOKS_FOR;
        self.history.iter().any(|own| {
            own.last_hit.is_some_and(|hit| hit >= since)
                && other
                    .history
                    .iter()
                    .any(|theirs| theirs.sensor == own.sensor && theirs.last_hit == own.last_hit)
        })
    }

    /// Merges a later track of the same object; the identity and labels of this one stay.
    pub(super) fn merge(&mut self, other: Self) {
        self.history.merge(other.history);
        if self.last_seen < other.last_seen {
            self.state = other.state;
            self.last_seen = other.last_seen;
            self.disappeared = other.disappeared;
        }
        self.neighbours.merge(other.neighbours, self.id);
        self.hits = self.hits.saturating_add(other.hits);
        self.vehicle = self.vehicle.or(other.vehicle);
        self.heading_rad = self.heading_rad.or(other.heading_rad);
        self.inherited_heading_rad = self.inherited_heading_rad.or(other.inherited_heading_rad);
        self.size_m = self.size_m.or(other.size_m);
    }

    /// Takes existence and attributes from another aggregator's object.
    pub(super) fn inherit(&mut self, object: &FusedObject, at: Timestamp) {
        let existence = object
            .existence
            .unwrap_or(object.confidence)
            .clamp(0.01, 0.99);
        let alone = BaseRate::usual_log_odds() + alone_nats(0.0, 0.0);
        self.inherited = Some(((existence / (1.0 - existence)).ln() - alone, at));
        self.first_seen = object
            .first_seen_us
            .map_or(self.first_seen, |first| first.min(self.first_seen));
        self.labels = object
            .scores
            .iter()
            .map(|(label, score)| (label.clone(), *score))
            .collect();
        self.inherited_heading_rad = object.heading_rad;
        self.size_m = object.size_m;
    }

    /// The object of the map at `now`.
    pub(super) fn object(
        &self,
        now: Timestamp,
        config: &TracksConfig,
        existence: f64,
        name: impl Fn(SensorId) -> Option<NodeName>,
    ) -> FusedObject {
        let covariance = self.state.covariance_at(now, config.density());
        let position = self.state.position_at(now);
        let total: f64 = self.labels.iter().map(|(_, weight)| weight).sum();
        let mut scores = BTreeMap::new();
        scores.extend(
            self.labels
                .iter()
                .map(|(label, weight)| (label.clone(), weight / total.max(1e-9))),
        );
        let sigma_m = (covariance.trace() / 2.0).sqrt();
        let usable = 1.0 - (-ERROR_RATE * USABLE_M / sigma_m).exp();
        let covariance = Covariance {
            xx: covariance.m11,
            xy: covariance.m12,
            yy: covariance.m22,
        };
        let confidence = existence * usable;
        let has_velocity = self.hits > 1;
        let seen_by = self.seen_by(now - Duration::from_secs_f64(config.life_s));
        let mut contributors = Vec::with_capacity(self.history.len());
        contributors.extend(seen_by.filter_map(|history| name(history.sensor)));
        FusedObject {
            contributors,
            existence: Some(existence),
            scores,
            velocity_mps: has_velocity.then_some([self.state.velocity.x, self.state.velocity.y]),
            heading_rad: self
                .heading_rad
                .or_else(|| self.course_rad())
                .or(self.inherited_heading_rad),
            size_m: self.size_m,
            age_s: Some(now.since(self.last_seen).as_secs_f64()),
            first_seen_us: Some(self.first_seen),
            vehicle: self.vehicle.and_then(name),
            ..FusedObject::new(
                self.id,
                self.label(config),
                confidence,
                position.x,
                position.y,
                covariance,
            )
        }
    }

    /// The likeliest label; a track without labels is a vehicle that only its own pose reports.
    pub(super) fn label(&self, config: &TracksConfig) -> Label {
        let best = self
            .labels
            .iter()
            .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
        best.map_or_else(|| config.vehicle_label.clone(), |(label, _)| label.clone())
    }

    /// Direction of the velocity, radians; `None` unless the velocity is well known.
    fn course_rad(&self) -> Option<f64> {
        let velocity: Vector2<f64> = self.state.velocity;
        let sigma = (self.state.velocity_covariance().trace() / 2.0).sqrt();
        (velocity.norm() > (3.0 * sigma).max(1.0)).then(|| velocity.y.atan2(velocity.x))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_that_one_camera_has_just_detected_is_still_there_for_others_that_miss_it() {
        let config = TracksConfig::default();
        let (before, at) = (Timestamp(1_000_000), Timestamp(1_500_000));
        let independent = nalgebra::Matrix2::identity() * 0.01;
        let measurement = Measurement {
            position: Vector2::zeros(),
            independent,
            common_m: 0.0,
        };
        let mut track = Track::new(Uuid::nil(), before, &measurement, &config);
        track.record_hit(at);
        (1..=3).for_each(|ms| track.record_miss(at + Duration::from_millis(ms), 0.5, 0.9));
        assert!(track.survival(at) > 0.8, "survival {}", track.survival(at));
        (1..=3).for_each(|ms| track.record_miss(at + Duration::from_millis(500 + ms), 0.5, 0.9));
        assert!(track.survival(at) < 0.1, "survival {}", track.survival(at));
    }
}
