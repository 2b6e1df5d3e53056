//! Which vehicles can be believed: who asserts objects that others see, and who invents or hides them.
//!
//! Every [`SETTLED_AFTER`] of looks, what a vehicle said of an object is held against what the others say of it, its own
//! word left out. Where they agree that the object is there, to have detected it is right; to have overlooked it all
//! along is wrong if most vehicles detect what is so far away. Where at least two of them look and agree that nothing is
//! there, to have detected it is wrong. One word against another settles nothing.

use std::time::Duration;

use super::evidence::{BASE_NATS, Witness};
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
    pub(super) fn of(witnesses: &[Witness], source: u32, at: Timestamp, trust: impl Fn(u32) -> f64) -> Self {
        let mut others = Self { nats: BASE_NATS, ..Self::default() };
        for witness in witnesses.iter().filter(|witness| witness.source != source) {
            if at.since(witness.last_look) > SETTLED_AFTER {
                continue;
            }
            let weight = trust(witness.source);
            others.nats += weight * witness.nats();
            others.looking += usize::from(weight > 0.5 && witness.looks > 5);
            let lately = witness.last_hit.is_some_and(|hit| at.since(hit) <= SETTLED_AFTER);
            others.detecting += usize::from(weight > 0.5 && lately);
        }
        others
    }
}

/// Judges `hits` of `looks` since the last judgement; `None` where nothing is settled.
pub(super) fn judge(hits: u32, looks: u32, others: &Others) -> Option<Word> {
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

impl Standing {
    /// Words that are remembered.
    const MEMORY: f64 = 200.0;
    /// Right and wrong words that a newcomer starts with.
    const PRIOR: f64 = 5.0;

    /// So many right and wrong ones.
    pub(super) fn new(correct: u64, incorrect: u64) -> Self {
        let mut standing = Self { correct: correct as f64, incorrect: incorrect as f64 };
        standing.fade();
        standing
    }

    /// One more.
    pub(super) fn count(&mut self, correct: bool) {
        *(if correct { &mut self.correct } else { &mut self.incorrect }) += 1.0;
        self.fade();
    }

    fn fade(&mut self) {
        let kept = (Self::MEMORY / (self.correct + self.incorrect)).min(1.0);
        self.correct *= kept;
        self.incorrect *= kept;
    }

    /// Weight of the vehicle's word, 0 to 1: whole from the reputation of a newcomer up, none at that of a proven liar.
    pub(super) fn trust(&self) -> f64 {
        let reputation = (self.correct + Self::PRIOR) / (self.correct + self.incorrect + 2.0 * Self::PRIOR);
        ((reputation - 0.3) / 0.2).clamp(0.0, 1.0)
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
