//! One track: the estimate of one object over time.

use std::collections::BTreeMap;
use std::time::Duration;

use nalgebra::Vector2;
use uuid::Uuid;

use super::attributes::{self, CombinedAttributes, LabelWeights};
use super::class::ObjectClass;
use super::config::TracksConfig;
use super::detection_history::DetectionHistory;
use super::existence::{Existence, SensorHistory, logistic};
use super::grid::IndexedTrack;
use super::handles::{SensorId, TrackIndex};
use super::kinematics::{KinematicState, Measurement, VELOCITY_SIGMA_MPS};
use super::population::LeavingRates;
use super::twins::Twins;
use crate::model::geometry::Covariance;
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::wire::{FusedObject, PerceivedObject};

/// Weight below which a label from another aggregator's map is dropped.
const MIN_INHERITED: f64 = 1e-3;

/// Similarity to a label without any reading.
pub(super) const MIN_LABEL_SIMILARITY: f64 = 0.02;

/// Maximum position error of a useful object, metres.
const USABLE_M: f64 = 1.5;

/// Rate at which the probability of a position error falls, in standard deviations: errors of associated detections have
/// an exponential tail.
const ERROR_RATE: f64 = 1.6;

/// Number of detections that confirm a track.
pub(super) const CONFIRMED_HITS: u32 = 5;

/// Minimum time between two detections by one vehicle that both confirm a track: the parts of a vehicle
/// may report the same object almost at once.
const CONFIRMING_INTERVAL: Duration = Duration::from_millis(20);

/// Maximum evidence for an object that only one vehicle detects while others have its place in view, nats. Two of the
/// others outweigh this evidence with at most -2.5 nats each.
const MAX_DENIED_NATS: f64 = 4.0;

/// Minimum number of vehicles whose observations count against an object that only one vehicle detects. With one
/// statement against another, it is open which vehicle is wrong.
const MIN_DENYING: usize = 2;

/// Maximum age of a detection that is evidence of a present object.
const DETECTED_WITHIN: Duration = Duration::from_secs(1);

/// State of one track.
#[derive(Debug, Clone)]
pub(super) struct Track {
    pub(super) id: Uuid,
    pub(super) state: KinematicState,
    pub(super) history: DetectionHistory,
    /// Weights of the labels that vehicles stated.
    labels: LabelWeights,
    /// Labels from another aggregator's map, which fade.
    inherited_labels: LabelWeights,
    /// Direction that vehicles stated.
    heading_rad: Option<f64>,
    /// Direction from another aggregator's map, which may be outdated; used until this aggregator has estimated a
    /// course.
    inherited_heading_rad: Option<f64>,
    size_m: Option<[f64; 2]>,
    pub(super) first_seen: Timestamp,
    pub(super) last_seen: Timestamp,
    /// Existence from all observations.
    pub(super) existence: Existence,
    /// True if a vehicle that detected the object early has stated its velocity.
    pub(super) is_velocity_stated: bool,
    /// True if the last observation of any vehicle was a detection.
    is_detected: bool,
    /// The vehicle whose detection began the track.
    pub(super) spawned_by: Option<SensorId>,
    /// True if the track has been counted as an object.
    pub(super) is_settled: bool,
    /// The vehicle that reports this track as its own pose.
    pub(super) vehicle: Option<SensorId>,
    pub(super) hits: u32,
    /// Number of identities taken over from neighbouring cells.
    pub(super) renames: u8,
    pub(super) twins: Twins,
}

impl Track {
    /// A track with one measurement.
    pub(super) fn new(
        id: Uuid,
        at: Timestamp,
        measurement: &Measurement,
        class: ObjectClass,
    ) -> Self {
        Self {
            id,
            state: KinematicState::new(at, measurement, class),
            history: DetectionHistory::default(),
            labels: LabelWeights::new(),
            inherited_labels: LabelWeights::new(),
            heading_rad: None,
            inherited_heading_rad: None,
            size_m: None,
            first_seen: at,
            last_seen: at,
            existence: Existence::new(f64::NEG_INFINITY, at),
            is_velocity_stated: false,
            is_detected: true,
            spawned_by: None,
            is_settled: false,
            vehicle: None,
            hits: 0,
            renames: 0,
            twins: Twins::default(),
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

    /// Records a vehicle's statement of label, heading and size; [`Self::combine_attributes`] applies it.
    pub(super) fn record_attributes(
        &mut self,
        sensor: SensorId,
        object: &PerceivedObject,
        heading_rad: Option<f64>,
        trust: f64,
        at: Timestamp,
    ) {
        if let Some(history) = self.history.for_hit(sensor, at) {
            history.attributes.record(object, heading_rad, trust, at);
        }
    }

    /// Updates the velocity by an accepted statement, m/s.
    pub(super) fn update_velocity(&mut self, at: Timestamp, velocity: Vector2<f64>) {
        self.is_velocity_stated = true;
        self.state.update_velocity(at, velocity, VELOCITY_SIGMA_MPS);
    }

    /// Derives label, heading and size from the recent statements of all vehicles.
    pub(super) fn combine_attributes(&mut self, at: Timestamp) {
        let stated = self.history.iter().map(|history| &history.attributes);
        let CombinedAttributes {
            mut labels,
            heading_rad,
            size_m,
        } = CombinedAttributes::of(stated.filter(|attributes| attributes.is_recent(at)));
        for (label, weight) in &mut self.inherited_labels {
            attributes::add(&mut labels, label, *weight);
            *weight *= attributes::KEPT;
        }
        self.inherited_labels
            .retain(|(_, weight)| *weight >= MIN_INHERITED);
        attributes::keep_most_likely(&mut labels);
        self.labels = labels;
        self.heading_rad = heading_rad.or(self.heading_rad);
        self.size_m = size_m.or(self.size_m);
        if self.course_rad().is_some() {
            self.inherited_heading_rad = None;
        }
    }

    /// Records a detection at `at`.
    pub(super) fn record_hit(&mut self, at: Timestamp) {
        self.last_seen = self.last_seen.max(at);
        self.hits = self.hits.saturating_add(1);
    }

    /// Records a detection by `sensors` at `at`, before their histories are updated. The detection
    /// confirms the track only if a sensor's last confirming detection is long enough ago.
    pub(super) fn record_hit_by(&mut self, sensors: impl Iterator<Item = SensorId>, at: Timestamp) {
        let mut confirms = false;
        for sensor in sensors {
            let Some(history) = self.history.get_mut(sensor) else {
                confirms = true;
                continue;
            };
            let last = history.confirmed_at;
            if last.is_none_or(|last| at.since(last) >= CONFIRMING_INTERVAL) {
                history.confirmed_at = Some(at);
                confirms = true;
            }
        }
        if confirms {
            self.record_hit(at);
        } else {
            self.last_seen = self.last_seen.max(at);
        }
    }

    /// Similarity of a detection's labels to the track's labels, 0 to 1.
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

    /// True if there are too few detections for an estimate of the velocity.
    pub(super) fn may_have_any_velocity(&self) -> bool {
        !self.is_confirmed() && self.vehicle.is_none()
    }

    /// True unless enough detections confirm the track, and a second vehicle has detected it.
    pub(super) fn is_sole(&self) -> bool {
        let mut detected = self
            .history
            .iter()
            .filter(|history| history.last_hit.is_some());
        !self.is_confirmed() || detected.nth(1).is_none()
    }

    /// True if enough detections confirm the track.
    pub(super) fn is_confirmed(&self) -> bool {
        self.hits >= CONFIRMED_HITS
    }

    /// Predicts the existence to `at`.
    pub(super) fn predict_existence(&mut self, at: Timestamp, leaving: LeavingRates) {
        self.existence.predict(at, leaving, self.is_detected);
    }

    /// Records whether any vehicle detects the object at `at`.
    pub(super) fn record_detected(&mut self, at: Timestamp) {
        self.is_detected = self
            .history
            .iter()
            .any(|history| history.state.is_hit() && at <= history.observed_at + DETECTED_WITHIN);
    }

    /// Log-odds that the object is there at `at`, from observations alone.
    fn observed_log_odds_at(&self, at: Timestamp, leaving: LeavingRates) -> f64 {
        let is_detected = self.is_detected && at.since(self.last_seen) <= DETECTED_WITHIN;
        self.existence.log_odds_at(at, leaving, is_detected)
    }

    /// Probability that the object is there at `at`, from observations alone.
    pub(super) fn presence_at(&self, at: Timestamp, leaving: LeavingRates) -> f64 {
        logistic(self.observed_log_odds_at(at, leaving))
    }

    /// Probability that the object is there at `at`, from observations and confidences; `trust` returns the trust in a
    /// vehicle, 0 to 1.
    pub(super) fn existence_at(
        &self,
        at: Timestamp,
        leaving: LeavingRates,
        trust: impl Fn(SensorId) -> f64,
    ) -> f64 {
        let observations = self.observed_log_odds_at(at, leaving);
        let mut confidences = 0.0;
        for history in self.history.iter() {
            confidences += trust(history.sensor) * history.shared_confidence_nats(at);
        }
        let Some(denied) = self.denied_nats(at, &trust) else {
            return logistic(observations + confidences);
        };
        // An object of another aggregator's map has evidence of that aggregator.
        let limit = if self.spawned_by.is_some() {
            self.history
                .iter()
                .map(|history| trust(history.sensor) * history.max_sole_nats())
                .fold(0.0, f64::max)
        } else {
            f64::INFINITY
        };
        let sole = observations.min(limit) + confidences;
        if denied < 0.0 {
            logistic(sole.min(MAX_DENIED_NATS) + denied)
        } else {
            logistic(sole)
        }
    }

    /// Evidence against an object that only one vehicle has detected, nats: the sum over all vehicles that have its
    /// place in view, if there are at least [`MIN_DENYING`]. `None` if several vehicles have detected the object.
    pub(super) fn denied_nats(
        &self,
        at: Timestamp,
        trust: impl Fn(SensorId) -> f64,
    ) -> Option<f64> {
        let mut witnesses = self
            .history
            .iter()
            .filter(|history| history.last_hit.is_some() && trust(history.sensor) > 0.0);
        let is_sole = self.vehicle.is_none() && witnesses.nth(1).is_none();
        if !is_sole {
            return None;
        }
        let mut denying = 0;
        let mut nats = 0.0;
        for history in self.history.iter() {
            let denied = trust(history.sensor) * history.denied_nats(at);
            denying += usize::from(denied < 0.0);
            nats += denied;
        }
        Some(if denying >= MIN_DENYING { nats } else { 0.0 })
    }

    /// The histories of the vehicles that detected the object since `limit`.
    pub(super) fn seen_by(&self, limit: Timestamp) -> impl Iterator<Item = &SensorHistory> {
        self.history
            .iter()
            .filter(move |history| history.last_hit.is_some_and(|hit| hit >= limit))
    }

    /// Whether a vehicle other than `sensor` has detected the object; `trust` returns a vehicle's
    /// weight, 0 to 1, and vehicles of weight 0 do not count.
    pub(super) fn is_detected_by_others(
        &self,
        sensor: SensorId,
        trust: impl Fn(SensorId) -> f64,
    ) -> bool {
        let mut others = self
            .history
            .iter()
            .filter(|history| history.sensor != sensor && history.last_hit.is_some());
        others.any(|history| trust(history.sensor) > 0.0)
    }

    /// Whether a vehicle other than `sensor` detected the object shortly before `at`.
    pub(super) fn is_seen_by_others(&self, sensor: SensorId, at: Timestamp) -> bool {
        self.seen_by(at - DETECTED_WITHIN)
            .any(|history| history.sensor != sensor)
    }

    /// Merges a later track of the object; the identity and labels of this track are kept.
    pub(super) fn merge(&mut self, other: Self) {
        self.history.merge(other.history);
        if self.last_seen < other.last_seen {
            self.state = other.state;
            self.last_seen = other.last_seen;
        }
        self.existence.raise(other.existence.log_odds());
        self.is_settled |= other.is_settled;
        self.is_detected |= other.is_detected;
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
        self.existence = Existence::new((existence / (1.0 - existence)).ln(), at);
        self.first_seen = object
            .first_seen_us
            .map_or(self.first_seen, |first| first.min(self.first_seen));
        self.labels = object
            .scores
            .iter()
            .map(|(label, score)| (label.clone(), *score))
            .collect();
        attributes::keep_most_likely(&mut self.labels);
        self.inherited_labels = self.labels.clone();
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
        let matrix = self.state.covariance_at(now);
        let position = self.state.position_at(now);
        let total: f64 = self.labels.iter().map(|(_, weight)| weight).sum();
        let mut scores = BTreeMap::new();
        scores.extend(
            self.labels
                .iter()
                .map(|(label, weight)| (label.clone(), weight / total.max(1e-9))),
        );
        let sigma_m = (matrix.trace() / 2.0).sqrt();
        let usable = 1.0 - (-ERROR_RATE * USABLE_M / sigma_m).exp();
        let covariance = Covariance {
            xx: matrix.m11,
            xy: matrix.m12,
            yy: matrix.m22,
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

    /// The most likely label; a track without labels is a vehicle without detections by others.
    pub(super) fn label(&self, config: &TracksConfig) -> Label {
        let best = self
            .labels
            .iter()
            .max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
        best.map_or_else(|| config.vehicle_label.clone(), |(label, _)| label.clone())
    }

    /// Direction of the velocity, radians; `None` if the velocity is too uncertain.
    fn course_rad(&self) -> Option<f64> {
        let velocity: Vector2<f64> = self.state.velocity;
        let sigma = (self.state.velocity_covariance().trace() / 2.0).sqrt();
        (velocity.norm() > (3.0 * sigma).max(1.0)).then(|| velocity.y.atan2(velocity.x))
    }
}
