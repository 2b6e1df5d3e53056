//! Probability that an object exists, from the detections and misses of every vehicle.
//!
//! As in integrated probabilistic data association (Musicki, Evans, Stankovic, 1994), every look of a vehicle at an
//! object adds the log-likelihood ratio of "exists" to "is clutter". Here frames are not independent: the cause of a
//! false alarm or a miss is still there a tenth of a second later. So hits and misses follow a Markov chain and their
//! sum is bounded. n confidences with correlation ρ weigh as n/(1+ρ(n−1)) (the design effect; Kish, "Survey Sampling",
//! 1965). Vehicles err alike, too, so that existence counts a part of their evidence only. The odds before any evidence are
//! those of the cell's own tracks ([`BaseRate`]).

use std::collections::BTreeMap;
use std::time::Duration;

use nalgebra::Vector2;

use super::handles::SensorId;
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

/// Shares of the evidence that are independent from vehicle to vehicle: of the sequence, and of the confidences.
const SEQUENCE_WEIGHT: f64 = 0.53;
const CONFIDENCE_WEIGHT: f64 = 0.235;

/// Additional share of a sequence against an object that one vehicle alone detects, by a vehicle that states its view, and
/// maximum of all of these, nats: a few that look and find nothing outweigh one that is sure.
const DENIAL_WEIGHT: f64 = 0.42;
pub(super) const MAX_DENIAL_NATS: f64 = 4.2;

/// Evidence for each e-folding of the time for which an object was detected, nats: the lives of false alarms have a long
/// tail (Lomax).
const PERSISTENCE_NATS: f64 = 0.6;

/// Scale of these lives, seconds.
const PERSISTENCE_S: f64 = 0.05;

/// Time in seconds beyond which a false alarm stays as long as an object.
const MAX_PERSISTENCE_S: f64 = 1.0;

/// Log-odds of existence of a track without evidence at the usual rate of looks, beside the base rate.
const ALONE_NATS: f64 = -0.2;

/// Usual rate of looks, hertz.
pub(super) const USUAL_LOOKS_HZ: f64 = 10.0;

/// Log-odds that each e-folding of the looks per second takes: every look brings clutter, but objects come with time.
const LOOKS_NATS: f64 = 0.3;

/// Log-odds that each nat of a detector's even confidence above the assumed one takes. Such a detector reports more
/// clutter, and its clutter comes back more often than the rule for the even confidence assumes.
const EVEN_NATS: f64 = 0.6;

/// Time between judgements of a vehicle's statement about an object.
pub(super) const JUDGED_AFTER: Duration = Duration::from_secs(2);

/// Minimum number of looks before a vehicle's statement is judged.
const MIN_JUDGED_LOOKS: u32 = 5;

/// Properties of a vehicle that its evidence of any object depends on.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct SensorQuality {
    /// Weight of its evidence, 0 to 1.
    pub(super) trust: f64,
    /// Looks per second.
    pub(super) looks_hz: f64,
    /// Log-odds of its even confidence above the assumed one.
    pub(super) even_excess: f64,
}

/// Log-odds of existence of a track before any evidence, beside the base rate. `looks_hz` is the rate at which all vehicles
/// look at it, `even_excess` the least of those that detect it.
pub(super) fn alone_nats(looks_hz: f64, even_excess: f64) -> f64 {
    let looks = if looks_hz > 0.0 {
        (looks_hz / USUAL_LOOKS_HZ).ln()
    } else {
        0.0
    };
    ALONE_NATS - LOOKS_NATS * looks - EVEN_NATS * even_excess.max(0.0)
}

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
    unjudged: ExistenceStatement,
    judged_at: Timestamp,
    /// Evidence of the sequence of hits and misses, nats.
    sequence: f64,
    /// True if the vehicle stated its view at the last miss.
    is_view_stated: bool,
    /// Fading sums of the log-odds of confidences and of their weights.
    score: f64,
    weight: f64,
}

/// Hits and looks of one vehicle at one object over some time.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ExistenceStatement {
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
    pub(super) const PRIOR: Self = Self {
        after_hit: 0.9,
        after_miss: 0.15,
    };

    /// Usual rates of clutter.
    const CLUTTER: Self = Self {
        after_hit: 0.5,
        after_miss: 0.02,
    };

    /// The rate after a hit or a miss.
    pub(super) fn after(&self, was_hit: bool) -> f64 {
        if was_hit {
            self.after_hit
        } else {
            self.after_miss
        }
    }
}

/// Rates of an object and of clutter at a look.
#[derive(Debug, Clone, Copy)]
pub(super) struct LookRates {
    pub(super) object: DetectionRates,
    pub(super) clutter: DetectionRates,
    /// True if the vehicle states its view; otherwise it may not have looked there.
    pub(super) is_view_stated: bool,
}

impl LookRates {
    /// Usual rates.
    pub(super) const PRIOR: Self = Self {
        object: DetectionRates::PRIOR,
        clutter: DetectionRates::CLUTTER,
        is_view_stated: false,
    };

    /// Ratio of the probabilities of a look's result, if an object is there and if it is clutter.
    fn ratio(&self, was_hit: bool, is_hit: bool) -> f64 {
        let [object, clutter] = [self.object, self.clutter].map(|rates| rates.after(was_hit));
        if is_hit {
            object / clutter
        } else {
            (1.0 - object) / (1.0 - clutter)
        }
    }
}

/// Rates at which a vehicle detects clutter again, learnt on tracks by the probability that they are clutter.
#[derive(Debug, Clone)]
pub(super) struct ClutterRates {
    /// Detections and looks, after a hit and after a miss.
    after_hit: (f64, f64),
    after_miss: (f64, f64),
}

impl Default for ClutterRates {
    fn default() -> Self {
        let DetectionRates {
            after_hit,
            after_miss,
        } = DetectionRates::CLUTTER;
        let usual = |rate: f64| (rate * Self::USUAL_LOOKS, Self::USUAL_LOOKS);
        Self {
            after_hit: usual(after_hit),
            after_miss: usual(after_miss),
        }
    }
}

impl ClutterRates {
    /// Number of looks that the usual rates count as.
    const USUAL_LOOKS: f64 = 100.0;

    /// Number of looks beyond which older ones are forgotten.
    const MEMORY: f64 = 400.0;

    /// The rates.
    pub(super) fn rates(&self) -> DetectionRates {
        let rate = |(hits, looks): (f64, f64)| hits / looks;
        DetectionRates {
            after_hit: rate(self.after_hit),
            after_miss: rate(self.after_miss),
        }
    }

    /// Learns from a look at a track that is clutter with a probability; `was_hit` is the result of the look before.
    pub(super) fn learn(&mut self, probability: f64, was_hit: bool, is_hit: bool) {
        let (hits, looks) = if was_hit {
            &mut self.after_hit
        } else {
            &mut self.after_miss
        };
        *hits += probability * f64::from(u8::from(is_hit));
        *looks += probability;
        let kept = (Self::MEMORY / *looks).min(1.0);
        *hits *= kept;
        *looks *= kept;
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
            unjudged: ExistenceStatement::default(),
            judged_at: at,
            sequence: 0.0,
            is_view_stated: false,
            score: 0.0,
            weight: 0.0,
        }
    }

    /// Records a detection whose confidence is worth `nats`. `rates` are `None` for the detection that spawns a track:
    /// it is no evidence that a known object was found again.
    #[inline]
    pub(super) fn hit(
        &mut self,
        at: Timestamp,
        position: Vector2<f64>,
        nats: f64,
        rates: Option<LookRates>,
    ) {
        let share = self.look(at);
        if let Some(rates) = rates {
            self.add(share * rates.ratio(self.was_hit, true).ln());
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
    pub(super) fn miss(&mut self, at: Timestamp, rates: LookRates) {
        let share = self.look(at);
        self.add(share * rates.ratio(self.was_hit, false).ln().min(0.0));
        self.is_view_stated = rates.is_view_stated;
        self.was_hit = false;
    }

    /// Fades earlier evidence; returns the independence of this look from the last, 0 to 1.
    fn look(&mut self, at: Timestamp) -> f64 {
        let dt = at.since(self.last_look).as_secs_f64();
        let share = if self.looks == 0 {
            1.0
        } else {
            (dt / INDEPENDENT_S).min(1.0)
        };
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
    pub(super) fn take_due(&mut self, at: Timestamp) -> Option<ExistenceStatement> {
        (at.since(self.judged_at) >= JUDGED_AFTER && self.unjudged.looks >= MIN_JUDGED_LOOKS).then(
            || {
                self.judged_at = at;
                std::mem::take(&mut self.unjudged)
            },
        )
    }

    fn add(&mut self, nats: f64) {
        self.sequence = (self.sequence + nats).clamp(-MAX_SEQUENCE_NATS, MAX_SEQUENCE_NATS);
    }

    /// Evidence of the vehicle for the object at `at` if it stood alone, nats.
    pub(super) fn nats(&self, at: Timestamp) -> f64 {
        let (sequence, confidence) = self.evidence(at);
        (sequence + confidence).min(MAX_SENSOR_NATS)
    }

    /// Its part in the evidence of all, and what it denies beyond that, nats.
    pub(super) fn shared_nats(&self, at: Timestamp) -> (f64, f64) {
        let (sequence, confidence) = self.evidence(at);
        let denied = if self.is_view_stated {
            DENIAL_WEIGHT * (-sequence).max(0.0)
        } else {
            0.0
        };
        (
            SEQUENCE_WEIGHT * sequence + CONFIDENCE_WEIGHT * confidence,
            denied,
        )
    }

    /// Evidence of the sequence and of the confidences, nats.
    fn evidence(&self, at: Timestamp) -> (f64, f64) {
        let kept = (-at.since(self.last_look).as_secs_f64() / MEMORY_S).exp();
        let weight = kept * self.weight;
        let confidence = if weight > 1e-3 {
            let effective = weight / (1.0 + CORRELATION * (weight - 1.0).max(0.0));
            self.score / self.weight * effective
        } else {
            0.0
        };
        (kept * self.sequence, confidence)
    }
}

/// Evidence that an object was detected over `time_s` seconds, nats.
pub(super) fn persistence_nats(time_s: f64) -> f64 {
    PERSISTENCE_NATS * (time_s.min(MAX_PERSISTENCE_S) / PERSISTENCE_S).ln_1p()
}

/// Share of the tracks that are objects, learnt from the tracks themselves.
///
/// It is the mean of their existences, which in turn follow from it: one step a round of expectation maximisation
/// (Saerens, Latinne, Decaestecker, "Adjusting the outputs of a classifier to new a priori probabilities", 2002).
#[derive(Debug, Clone, Default)]
pub(super) struct BaseRate {
    /// Fading means of the number of tracks in a round and of the sum of their existences.
    tracks: f64,
    objects: f64,
    at: Timestamp,
}

impl BaseRate {
    /// Time constant in seconds with which rounds are forgotten.
    const MEMORY_S: f64 = 5.0;

    /// Usual share of objects, and the number of tracks that it counts as.
    const USUAL: f64 = 0.33;
    const USUAL_TRACKS: f64 = 10.0;

    /// Number of tracks as which those that one vehicle alone detects count at most: its clutter is its own.
    const MAX_OF_ONE: f64 = 10.0;

    /// Log-odds of the usual share.
    pub(super) fn usual_log_odds() -> f64 {
        (Self::USUAL / (1.0 - Self::USUAL)).ln()
    }

    /// Log-odds that a track is an object.
    pub(super) fn log_odds(&self) -> f64 {
        let objects = Self::USUAL * Self::USUAL_TRACKS + self.objects;
        let clutter =
            (1.0 - Self::USUAL) * Self::USUAL_TRACKS + (self.tracks - self.objects).max(0.0);
        (objects / clutter).ln()
    }

    /// Learns from the existences of all tracks of a round, each with the only vehicle that detects the object, if there is
    /// but one.
    pub(super) fn learn(
        &mut self,
        at: Timestamp,
        existences: impl Iterator<Item = (Option<SensorId>, f64)>,
    ) {
        let mut sums: BTreeMap<Option<SensorId>, (f64, f64)> = BTreeMap::new();
        for (witness, existence) in existences {
            let (tracks, objects) = sums.entry(witness).or_default();
            (*tracks, *objects) = (*tracks + 1.0, *objects + existence);
        }
        let weight = |witness: &Option<SensorId>, tracks| {
            if witness.is_none() {
                1.0
            } else {
                f64::min(1.0, Self::MAX_OF_ONE / tracks)
            }
        };
        let weighted = sums
            .iter()
            .map(|(witness, sums)| (weight(witness, sums.0), sums));
        let (tracks, objects) = weighted.fold((0.0, 0.0), |all, (weight, sums)| {
            (all.0 + weight * sums.0, all.1 + weight * sums.1)
        });
        let kept = (-at.since(self.at).as_secs_f64() / Self::MEMORY_S).exp();
        self.tracks += (1.0 - kept) * (tracks - self.tracks);
        self.objects += (1.0 - kept) * (objects - self.objects);
        self.at = self.at.max(at);
    }
}

/// The probability of log-odds.
pub(super) fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
