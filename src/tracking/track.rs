//! One object that is followed.

use std::collections::BTreeMap;
use std::time::Duration;

use nalgebra::Vector2;
use smallvec::SmallVec;
use uuid::Uuid;

use super::config::TracksConfig;
use super::existence::{Witness, logistic};
use super::history::Witnesses;
use super::joining::Neighbours;
use super::kinematics::{Measurement, Motion};
use crate::geometry::{Covariance, wrap_angle};
use crate::names::{Label, NodeName};
use crate::time::Timestamp;
use crate::wire::{FusedObject, PerceivedObject};

/// Within how much time another vehicle's detection confirms that an object is there.
const CONFIRMED_WITHIN: Duration = Duration::from_millis(500);

/// Labels that are kept of an object, the likeliest.
const MAX_LABELS: usize = 8;

/// Probability of a label that was never read, for the association.
pub(super) const OTHER_LABEL: f64 = 0.02;

/// Distance in metres within which a position is of use.
const USABLE_M: f64 = 1.5;

/// Log-odds of an object before any evidence.
const PRIOR_NATS: f64 = 0.4;

/// Objects that go for good, per second.
const GONE_RATE: f64 = 0.02;

/// Time in seconds after which an object that nobody looks for is as good as gone.
const UNSEEN_S: f64 = 2.0;

/// Odds that what is followed is none of the things that only seem to be there: most tracks are of these.
const PRIOR_ODDS: f64 = 0.07;

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Track {
    pub(super) id: Uuid,
    pub(super) motion: Motion,
    pub(super) witnesses: Witnesses,
    /// Weights of the labels that were read, fading.
    labels: SmallVec<[(Label, f64); 1]>,
    heading_rad: Option<f64>,
    size_m: Option<[f64; 2]>,
    pub(super) first_seen: Timestamp,
    pub(super) last_seen: Timestamp,
    /// Odds that it has gone since it was last seen.
    gone: f64,
    /// Number of the vehicle that it is, by its own word.
    pub(super) vehicle: Option<u32>,
    /// Detections so far.
    pub(super) hits: u32,
    pub(super) neighbours: Neighbours,
    /// Log-odds taken over from another aggregator, fading, and when they were renewed.
    inherited: Option<(f64, Timestamp)>,
}

impl Track {
    /// An object that was seen once.
    pub(super) fn new(id: Uuid, at: Timestamp, seen: &Measurement, config: &TracksConfig) -> Self {
        Self {
            id,
            motion: Motion::new(at, seen, config.speed_mps),
            witnesses: Witnesses::default(),
            labels: SmallVec::new(),
            heading_rad: None,
            size_m: None,
            first_seen: at,
            last_seen: at,
            gone: 0.0,
            vehicle: None,
            hits: 0,
            neighbours: Neighbours::default(),
            inherited: None,
        }
    }

    /// Takes over what a detection says beside its place.
    pub(super) fn describe(&mut self, object: &PerceivedObject, heading_rad: Option<f64>) {
        const KEPT: f64 = 0.95;
        const SHARE: f64 = 0.3;
        self.labels.iter_mut().for_each(|(_, weight)| *weight *= KEPT);
        let one = [(&object.label, object.confidence)];
        let many = object.scores.iter().map(|(label, score)| (label, *score));
        let alone = object.scores.is_empty();
        for (label, score) in many.chain(one.into_iter().filter(|_| alone)) {
            match self.labels.iter_mut().find(|(known, _)| known == label) {
                Some((_, weight)) => *weight += score,
                None => self.labels.push((label.clone(), score)),
            }
        }
        if self.labels.len() > MAX_LABELS {
            self.labels.sort_by(|a, b| b.1.total_cmp(&a.1));
            self.labels.truncate(MAX_LABELS);
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

    /// It was detected at `at`.
    pub(super) fn refresh(&mut self, at: Timestamp) {
        self.last_seen = self.last_seen.max(at);
        self.gone = 0.0;
        self.hits = self.hits.saturating_add(1);
    }

    /// A vehicle that had seen it looked in vain, `dt_s` after it looked before; `rate` is how surely it would be seen.
    pub(super) fn overlooked(&mut self, at: Timestamp, dt_s: f64, rate: f64) {
        if at > self.last_seen {
            self.gone = ((self.gone + GONE_RATE * dt_s) / (1.0 - rate)).min(1e6);
        }
    }

    /// How well a detection's labels go with those read so far, 0 to 1.
    pub(super) fn likeness(&self, object: &PerceivedObject) -> f64 {
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
        let common: f64 = self.labels.iter().map(|(label, weight)| weight / total * share(label)).sum();
        common.max(OTHER_LABEL)
    }

    /// Log-odds that there is such an object, each vehicle's word weighted by the trust in it.
    pub(super) fn nats(&self, at: Timestamp, trust: impl Fn(u32) -> f64) -> f64 {
        let witnessed: f64 = self.witnesses.iter().map(|witness| trust(witness.source) * witness.nats(at)).sum();
        let inherited = self.inherited.map_or(0.0, |(nats, since)| nats * (-at.since(since).as_secs_f64()).exp());
        PRIOR_NATS + witnessed + inherited
    }

    /// Probability that it is still there, if it ever was.
    pub(super) fn presence(&self, now: Timestamp) -> f64 {
        let age = now.since(self.last_seen).as_secs_f64();
        (-age / UNSEEN_S).exp() / (1.0 + self.gone)
    }

    /// The vehicles that detected it since `limit`.
    pub(super) fn seen_by(&self, limit: Timestamp) -> impl Iterator<Item = &Witness> {
        self.witnesses.iter().filter(move |witness| witness.last_hit.is_some_and(|hit| hit >= limit))
    }

    /// Whether any but the vehicle `source` detected it shortly before `at`.
    pub(super) fn is_confirmed(&self, source: u32, at: Timestamp) -> bool {
        self.seen_by(at - CONFIRMED_WITHIN).any(|witness| witness.source != source)
    }

    /// Whether one vehicle told the two apart in one frame.
    pub(super) fn is_told_apart(&self, other: &Self) -> bool {
        self.witnesses.iter().any(|mine| {
            mine.last_hit.is_some()
                && other.witnesses.iter().any(|theirs| theirs.source == mine.source && theirs.last_hit == mine.last_hit)
        })
    }

    /// Takes in a later track of the same object; what this one is called holds.
    pub(super) fn absorb(&mut self, other: Self) {
        self.witnesses.absorb(other.witnesses);
        if self.last_seen < other.last_seen {
            self.motion = other.motion;
            self.last_seen = other.last_seen;
            self.gone = other.gone;
        }
        self.neighbours.absorb(other.neighbours, self.id);
        self.hits = self.hits.saturating_add(other.hits);
        self.vehicle = self.vehicle.or(other.vehicle);
        self.heading_rad = self.heading_rad.or(other.heading_rad);
        self.size_m = self.size_m.or(other.size_m);
    }

    /// Takes over what another aggregator knew.
    pub(super) fn inherit(&mut self, object: &FusedObject, at: Timestamp) {
        let existence = object.existence.unwrap_or(object.confidence).clamp(0.01, 0.99);
        self.inherited = Some(((existence / (1.0 - existence) / PRIOR_ODDS).ln() - PRIOR_NATS, at));
        self.first_seen = object.first_seen_us.map_or(self.first_seen, |first| first.min(self.first_seen));
        self.labels = object.scores.iter().map(|(label, score)| (label.clone(), *score)).collect();
        self.heading_rad = object.heading_rad;
        self.size_m = object.size_m;
    }

    /// The entry of the map at `now`.
    pub(super) fn fused(
        &self,
        now: Timestamp,
        config: &TracksConfig,
        trust: impl Fn(u32) -> f64,
        name: impl Fn(u32) -> Option<NodeName>,
    ) -> FusedObject {
        let covariance = self.motion.covariance_at(now, config.density());
        let position = self.motion.position_at(now);
        let there = believed(logistic(self.nats(now, trust))) * self.presence(now);
        let total: f64 = self.labels.iter().map(|(_, weight)| weight).sum();
        let mut scores = BTreeMap::new();
        scores.extend(self.labels.iter().map(|(label, weight)| (label.clone(), weight / total.max(1e-9))));
        let variance = covariance.trace() / 2.0;
        let usable = 1.0 - (-USABLE_M * USABLE_M / (2.0 * variance)).exp();
        let covariance = Covariance { xx: covariance.m11, xy: covariance.m12, yy: covariance.m22 };
        let confidence = there * usable;
        let moving = self.hits > 1;
        let seen_by = self.seen_by(now - Duration::from_secs_f64(config.life_s));
        let mut contributors = Vec::with_capacity(self.witnesses.len());
        contributors.extend(seen_by.filter_map(|witness| name(witness.source)));
        FusedObject {
            contributors,
            existence: Some(there),
            scores,
            velocity_mps: moving.then_some([self.motion.velocity.x, self.motion.velocity.y]),
            heading_rad: self.heading_rad.or_else(|| self.course_rad()),
            size_m: self.size_m,
            age_s: Some(now.since(self.last_seen).as_secs_f64()),
            first_seen_us: Some(self.first_seen),
            vehicle: self.vehicle.and_then(name),
            ..FusedObject::new(self.id, self.label(config), confidence, position.x, position.y, covariance)
        }
    }

    /// What it is taken for; what nobody has read a label of is a vehicle by its own word.
    pub(super) fn label(&self, config: &TracksConfig) -> Label {
        let best = self.labels.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
        best.map_or_else(|| config.vehicle_label.clone(), |(label, _)| label.clone())
    }

    /// The direction of travel, where it is well known.
    fn course_rad(&self) -> Option<f64> {
        let velocity: Vector2<f64> = self.motion.velocity;
        let sigma = (self.motion.velocity_covariance().trace() / 2.0).sqrt();
        (velocity.norm() > (3.0 * sigma).max(1.0)).then(|| velocity.y.atan2(velocity.x))
    }
}

/// A probability that was reckoned with even odds, with those that tracks have.
fn believed(probability: f64) -> f64 {
    let probability = probability.clamp(0.0, 1.0);
    PRIOR_ODDS * probability / (PRIOR_ODDS * probability + 1.0 - probability)
}
