//! How likely an object is to exist, by what every vehicle saw and did not see of it.
//!
//! In the manner of integrated probabilistic data association (Musicki, Evans, Stankovic, 1994), every frame in which a
//! vehicle looks at an object adds the log-likelihood ratio of "there" to "not there". Unlike there, frames are not
//! taken as independent: whatever makes a detector see a thing that is not, or overlook one that is, is still there a
//! tenth of a second later. So hits and misses follow a Markov chain, what they can say together is bounded, and n
//! confidences that correlate by ρ weigh as n/(1+ρ(n−1)) (the design effect; Kish, "Survey Sampling", 1965).

use nalgebra::Vector2;

use super::trust::SETTLED_AFTER;
use crate::time::Timestamp;

/// Time in seconds over which evidence fades.
const MEMORY_S: f64 = 3.0;

/// Correlation of the confidences of successive frames.
const CORRELATION: f64 = 0.3;

/// Time in seconds between independent frames: frames in quicker succession count in proportion.
const INDEPENDENT_S: f64 = 0.1;

/// Most nats that the order of hits and misses can speak for an object, and against it.
const MOST_NATS: f64 = 2.5;
const LEAST_NATS: f64 = 2.5;

/// Most nats that one vehicle can speak for an object in all, so that a few others together outweigh it.
const MOST_WORD_NATS: f64 = 8.0;

/// What one vehicle has seen of one object.
#[derive(Debug, Clone)]
pub(super) struct Witness {
    /// Number of the vehicle.
    pub(super) source: u32,
    pub(super) last_look: Timestamp,
    pub(super) last_hit: Option<Timestamp>,
    /// Whether it was detected at the last look.
    pub(super) was_hit: bool,
    /// Where it was last detected, corrected.
    pub(super) position: Vector2<f64>,
    pub(super) looks: u32,
    /// Log-odds of the last confidence.
    pub(super) log_odds: f64,
    /// Since when its word is unjudged, with hits and looks since.
    unsettled: (Timestamp, u32, u32),
    /// Evidence of the order of hits and misses, nats.
    pattern: f64,
    /// Sum of log-odds of confidences, and of their weights, fading.
    score: f64,
    weight: f64,
}

/// Probabilities of being detected at a look.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rates {
    /// After a look at which it was.
    pub(super) stay: f64,
    /// After a look at which it was not.
    pub(super) find: f64,
}

impl Rates {
    pub(super) fn of(&self, was_hit: bool) -> f64 {
        if was_hit { self.stay } else { self.find }
    }
}

/// The same for what only seems to be there.
const UNREAL: Rates = Rates { stay: 0.5, find: 0.02 };

impl Witness {
    pub(super) fn new(source: u32, at: Timestamp) -> Self {
        Self {
            source,
            last_look: at,
            last_hit: None,
            was_hit: false,
            position: Vector2::zeros(),
            looks: 0,
            log_odds: 0.0,
            unsettled: (at, 0, 0),
            pattern: 0.0,
            score: 0.0,
            weight: 0.0,
        }
    }

    /// The object was detected with a confidence of so many nats. `found` is whether it was known already.
    pub(super) fn hit(&mut self, at: Timestamp, position: Vector2<f64>, nats: f64, rates: Rates, known: bool) {
        let share = self.look(at);
        if known {
            let (real, unreal) = (rates.of(self.was_hit), UNREAL.of(self.was_hit));
            self.add(share * (real / unreal).ln());
        }
        self.score += nats;
        self.weight += 1.0;
        self.unsettled.1 += 1;
        if at >= self.last_look {
            self.was_hit = true;
        }
        if self.last_hit.is_none_or(|last| at >= last) {
            self.last_hit = Some(at);
            self.position = position;
        }
    }

    /// The object was in view and not detected.
    pub(super) fn miss(&mut self, at: Timestamp, rates: Rates) {
        let share = self.look(at);
        let (real, unreal) = (rates.of(self.was_hit), UNREAL.of(self.was_hit));
        self.add(share * ((1.0 - real) / (1.0 - unreal)).ln().min(0.0));
        self.was_hit = false;
    }

    /// Lets earlier evidence fade; returns how independent this look is of the last one.
    fn look(&mut self, at: Timestamp) -> f64 {
        let dt = at.since(self.last_look).as_secs_f64();
        let share = if self.looks == 0 { 1.0 } else { (dt / INDEPENDENT_S).min(1.0) };
        let kept = (-dt / MEMORY_S).exp();
        self.score *= kept;
        self.weight *= kept;
        self.pattern *= kept;
        self.last_look = self.last_look.max(at);
        self.looks = self.looks.saturating_add(1);
        self.unsettled.2 += 1;
        share
    }

    /// Hits and looks since its word was last judged, if it is time to judge it again.
    pub(super) fn settled(&mut self, at: Timestamp) -> Option<(u32, u32)> {
        let (since, hits, looks) = self.unsettled;
        (at.since(since) >= SETTLED_AFTER && looks >= 5).then(|| {
            self.unsettled = (at, 0, 0);
            (hits, looks)
        })
    }

    fn add(&mut self, nats: f64) {
        self.pattern = (self.pattern + nats).clamp(-LEAST_NATS, MOST_NATS);
    }

    /// All that the vehicle has to say at `at`, in nats.
    pub(super) fn nats(&self, at: Timestamp) -> f64 {
        let kept = (-at.since(self.last_look).as_secs_f64() / MEMORY_S).exp();
        let weight = kept * self.weight;
        let confidence = if weight > 1e-3 {
            let worth = weight / (1.0 + CORRELATION * (weight - 1.0).max(0.0));
            self.score / self.weight * worth
        } else {
            0.0
        };
        (kept * self.pattern + confidence).min(MOST_WORD_NATS)
    }
}

/// The probability of log-odds.
pub(super) fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
