//! Probability that an object exists, from the detections and misses of every vehicle.
//!
//! As in integrated probabilistic data association (Musicki, Evans, Stankovic, 1994), every look of a vehicle at an
//! object adds the log-likelihood ratio of "exists" to "is clutter". Here frames are not independent: the cause of a
//! false alarm or a miss is still there a tenth of a second later. So hits and misses follow a Markov chain and their
//! sum is bounded. n confidences with correlation ρ weigh as n/(1+ρ(n−1)) (the design effect; Kish, "Survey Sampling",
//! 1965).

use nalgebra::Vector2;

use super::sensors::SensorId;
use super::trust::JUDGED_AFTER;
use crate::model::time::Timestamp;

/// Time constant in seconds with which evidence fades.
const MEMORY_S: f64 = 3.0;

/// Correlation of the confidences of successive frames.
const CORRELATION: f64 = 0.3;

/// Seconds between independent frames; frames in quicker succession count in proportion.
const INDEPENDENT_S: f64 = 0.1;

/// Maximum evidence of the sequence of hits and misses, for and against an object, nats.
const MAX_SEQUENCE_NATS: f64 = 2.5;

/// Maximum evidence of one vehicle for an object, nats: a few others together outweigh it.
const MAX_SENSOR_NATS: f64 = 8.0;

/// Minimum number of looks before a vehicle's statement is judged.
const MIN_JUDGED_LOOKS: u32 = 5;

/// Detections and misses of one object by one vehicle.
#[derive(Debug, Clone)]
pub(super) struct SensorHistory {
    pub(super) sensor: SensorId,
    pub(super) last_look: Timestamp,
    pub(super) last_hit: Option<Timestamp>,
    /// Whether the last look was a hit.
    pub(super) was_hit: bool,
    /// Corrected position of the last detection, metres.
    pub(super) position: Vector2<f64>,
    pub(super) looks: u32,
    /// Log-odds of the last confidence.
    pub(super) confidence_log_odds: f64,
    /// Hits and looks since the last judgement.
    unjudged: Statement,
    judged_at: Timestamp,
    /// Evidence of the sequence of hits and misses, nats.
    sequence: f64,
    /// Fading sums of the log-odds of confidences and of their weights.
    score: f64,
    weight: f64,
}

/// Hits and looks of one vehicle at one object over some time.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Statement {
    pub(super) hits: u32,
    pub(super) looks: u32,
}

/// Probabilities of detection at a look.
#[derive(Debug, Clone, Copy)]
pub(super) struct DetectionRates {
    pub(super) after_hit: f64,
    pub(super) after_miss: f64,
}

impl DetectionRates {
    /// Rates of a real object in an unknown view.
    pub(super) const PRIOR: Self = Self { after_hit: 0.9, after_miss: 0.15 };

    /// Rates of clutter.
    const CLUTTER: Self = Self { after_hit: 0.5, after_miss: 0.02 };

    /// The rate after a hit or a miss.
    pub(super) fn after(&self, was_hit: bool) -> f64 {
        if was_hit { self.after_hit } else { self.after_miss }
    }
}

impl SensorHistory {
    /// A vehicle that has not looked yet.
    pub(super) fn new(sensor: SensorId, at: Timestamp) -> Self {
        Self {
            sensor,
            last_look: at,
            last_hit: None,
            was_hit: false,
            position: Vector2::zeros(),
            looks: 0,
            confidence_log_odds: 0.0,
            unjudged: Statement::default(),
            judged_at: at,
            sequence: 0.0,
            score: 0.0,
            weight: 0.0,
        }
    }

    /// Records a detection whose confidence is worth `nats`. `rates` are `None` for the detection that spawns a track:
    /// it is no evidence that a known object was found again.
    #[inline]
    pub(super) fn hit(&mut self, at: Timestamp, position: Vector2<f64>, nats: f64, rates: Option<DetectionRates>) {
        let share = self.look(at);
        if let Some(rates) = rates {
            let ratio = rates.after(self.was_hit) / DetectionRates::CLUTTER.after(self.was_hit);
            self.add(share * ratio.ln());
        }
        self.score += nats;
        self.weight += 1.0;
        self.unjudged.hits += 1;
        if at >= self.last_look {
            self.was_hit = true;
        }
        if self.last_hit.is_none_or(|last| at >= last) {
            self.last_hit = Some(at);
            self.position = position;
        }
    }

    /// Records a look at the object in view without a detection.
    pub(super) fn miss(&mut self, at: Timestamp, rates: DetectionRates) {
        let share = self.look(at);
        let ratio = (1.0 - rates.after(self.was_hit)) / (1.0 - DetectionRates::CLUTTER.after(self.was_hit));
        self.add(share * ratio.ln().min(0.0));
        self.was_hit = false;
    }

    /// Fades earlier evidence; returns the independence of this look from the last, 0 to 1.
    fn look(&mut self, at: Timestamp) -> f64 {
        let dt = at.since(self.last_look).as_secs_f64();
        let share = if self.looks == 0 { 1.0 } else { (dt / INDEPENDENT_S).min(1.0) };
        let kept = (-dt / MEMORY_S).exp();
        self.score *= kept;
        self.weight *= kept;
        self.sequence *= kept;
        self.last_look = self.last_look.max(at);
        self.looks = self.looks.saturating_add(1);
        self.unjudged.looks += 1;
        share
    }

    /// The statement since the last judgement, if a judgement is due.
    pub(super) fn take_due(&mut self, at: Timestamp) -> Option<Statement> {
        (at.since(self.judged_at) >= JUDGED_AFTER && self.unjudged.looks >= MIN_JUDGED_LOOKS).then(|| {
            self.judged_at = at;
            std::mem::take(&mut self.unjudged)
        })
    }

    fn add(&mut self, nats: f64) {
        self.sequence = (self.sequence + nats).clamp(-MAX_SEQUENCE_NATS, MAX_SEQUENCE_NATS);
    }

    /// Evidence of the vehicle for the object at `at`, nats.
    pub(super) fn nats(&self, at: Timestamp) -> f64 {
        let kept = (-at.since(self.last_look).as_secs_f64() / MEMORY_S).exp();
        let weight = kept * self.weight;
        let confidence = if weight > 1e-3 {
            let effective = weight / (1.0 + CORRELATION * (weight - 1.0).max(0.0));
            self.score / self.weight * effective
        } else {
            0.0
        };
        (kept * self.sequence + confidence).min(MAX_SENSOR_NATS)
    }
}

/// The probability of log-odds.
pub(super) fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
