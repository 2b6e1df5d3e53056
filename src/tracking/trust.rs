//! Which vehicles can be believed: who asserts objects that others see, and who invents or hides them.
//!
//! Every [`SETTLED_AFTER`] of looks, what a vehicle said of an object is held against what the others say of it, its
//! own word left out. Where they agree that the object is there, to have detected it is right; to have overlooked it
//! all along is wrong if most vehicles detect what is so far away. Where at least two of them look and agree that
//! nothing is there, to have detected it is wrong. One word against another settles nothing.

use std::collections::BTreeMap;
use std::time::Duration;

use super::history::Witnesses;
use crate::names::NodeName;
use crate::reputation::ReputationConfig;
use crate::time::Timestamp;

/// Time in view after which a vehicle's word about an object is judged, and judged again.
pub(super) const SETTLED_AFTER: Duration = Duration::from_secs(2);

/// Log-odds, by the others' word, at which an object is taken for real.
const REAL_NATS: f64 = 2.0;

/// Log-odds, by the others' word, at which it is taken for an invention.
const UNREAL_NATS: f64 = -1.5;

/// Least part of looks with a detection for which a vehicle is said to assert an object.
const ASSERTED: f64 = 0.4;

/// Least part of the fleet that detects what is so far away, for which to overlook it is wrong.
const EXPECTED: f64 = 0.6;

/// A vehicle's word about an object, judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Word {
    /// It detected what is there.
    True,
    /// It detected what is not there.
    Invented,
    /// It did not detect what is there.
    Denied,
}

/// What the others say of an object.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Others {
    /// Log-odds that it is there.
    nats: f64,
    /// How many have looked.
    looking: usize,
    /// How many have detected it lately.
    detecting: usize,
}

impl Others {
    /// All but the vehicle `source`; `trust` weighs their words.
    pub(super) fn of(witnesses: &Witnesses, source: u32, at: Timestamp, trust: impl Fn(u32) -> f64) -> Self {
        let mut others = Self::default();
        for witness in witnesses.iter().filter(|witness| witness.source != source) {
            if at.since(witness.last_look) > SETTLED_AFTER {
                continue;
            }
            let weight = trust(witness.source);
            others.nats += weight * witness.nats(at);
            others.looking += usize::from(weight > 0.5 && witness.looks > 5);
            let lately = witness.last_hit.is_some_and(|hit| at.since(hit) <= SETTLED_AFTER);
            others.detecting += usize::from(weight > 0.5 && lately);
        }
        others
    }
}

/// Judges what was said since the last judgement, hits and looks; `None` where nothing is settled.
pub(super) fn judge((hits, looks): (u32, u32), others: &Others) -> Option<Word> {
    let share = f64::from(hits) / f64::from(looks.max(1));
    if others.detecting >= 1 && others.nats >= REAL_NATS && share >= ASSERTED {
        Some(Word::True)
    } else if others.detecting >= 2 && others.nats >= REAL_NATS && hits == 0 {
        Some(Word::Denied)
    } else if others.looking >= 2 && others.detecting == 0 && others.nats <= UNREAL_NATS && share >= ASSERTED {
        Some(Word::Invented)
    } else {
        None
    }
}

/// Right and wrong words, the latest ones counting most.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Standing {
    correct: f64,
    incorrect: f64,
}

/// Part of a newcomer's reputation at and below which a word weighs nothing.
const WORTHLESS: f64 = 0.6;

impl Standing {
    /// So many right and wrong ones.
    pub(super) fn new(correct: u64, incorrect: u64, config: &ReputationConfig) -> Self {
        let mut standing = Self { correct: correct as f64, incorrect: incorrect as f64 };
        standing.fade(config);
        standing
    }

    /// One more.
    pub(super) fn count(&mut self, correct: bool, config: &ReputationConfig) {
        *(if correct { &mut self.correct } else { &mut self.incorrect }) += 1.0;
        self.fade(config);
    }

    fn fade(&mut self, config: &ReputationConfig) {
        let kept = (config.memory_votes / self.words()).min(1.0);
        self.correct *= kept;
        self.incorrect *= kept;
    }

    /// How much is known of the vehicle.
    fn words(&self) -> f64 {
        self.correct + self.incorrect
    }

    /// Weight of the vehicle's word, 0 to 1: whole from the reputation of a newcomer up, none at that of a proven liar.
    pub(super) fn trust(&self, config: &ReputationConfig) -> f64 {
        let reputation = config.mean(self.correct, self.incorrect);
        ((reputation / config.initial - WORTHLESS) / (1.0 - WORTHLESS)).clamp(0.0, 1.0)
    }
}

/// What is known of vehicles that are not heard at present.
#[derive(Debug, Clone, Default)]
pub(super) struct Standings(BTreeMap<NodeName, Standing>);

impl Standings {
    /// Most vehicles that are remembered.
    pub(super) const MOST: usize = 4096;

    /// What is known of a vehicle.
    pub(super) fn of(&self, node: &NodeName) -> Standing {
        self.0.get(node).copied().unwrap_or_default()
    }

    /// Remembers vehicles; those of whom least is known make room.
    pub(super) fn keep(&mut self, vehicles: impl IntoIterator<Item = (NodeName, Standing)>) {
        self.0.extend(vehicles.into_iter().filter(|(_, standing)| standing.words() > 0.0));
        let excess = self.0.len().saturating_sub(Self::MOST);
        if excess > 0 {
            let mut words: Vec<_> = self.0.iter().map(|(node, standing)| (standing.words(), node.clone())).collect();
            words.sort_by(|a, b| a.0.total_cmp(&b.0).then_with(|| a.1.cmp(&b.1)));
            for (_, node) in words.iter().take(excess) {
                self.0.remove(node);
            }
        }
    }
}

/// How many of the fleet's vehicles detect what is really there, by distance.
#[derive(Debug, Clone, Default)]
pub(super) struct Fleet {
    bins: Vec<(f64, f64)>,
}

impl Fleet {
    const BIN_M: f64 = 10.0;
    const BINS: usize = 16;
    const MEMORY: f64 = 500.0;

    /// One vehicle's word about an object so far away that is there.
    pub(super) fn learn(&mut self, distance_m: f64, detected: bool) {
        self.bins.resize(Self::BINS, (0.0, 1.0));
        let (detections, all) = &mut self.bins[Self::bin(distance_m)];
        *detections += f64::from(u8::from(detected));
        *all += 1.0;
        let kept = (Self::MEMORY / *all).min(1.0);
        *detections *= kept;
        *all *= kept;
    }

    /// Whether a vehicle that is right detects what is so far away.
    pub(super) fn expects(&self, distance_m: f64) -> bool {
        let (detections, all) = self.bins.get(Self::bin(distance_m)).copied().unwrap_or((0.0, 1.0));
        all >= 10.0 && detections / all >= EXPECTED
    }

    fn bin(distance_m: f64) -> usize {
        ((distance_m / Self::BIN_M) as usize).min(Self::BINS - 1)
    }
}
