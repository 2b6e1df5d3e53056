//! HOTA (Luiten et al., IJCV 2021): detection and association in one figure, averaged over how near
//! is near enough.
//!
//! Similarity is 1 − d/d₀, zero from d₀ on, and for unequal labels. Matches of a frame maximise the
//! sum of similarity times how much of their lives the two identities share; thresholds from 0.05
//! to 0.95 are applied to the result. Equal to `trackeval.metrics.HOTA`.

use hashbrown::HashMap;

use super::matching::{MatchedPair, best, near_pairs};
use super::{ScoredFrame, ZERO_DISTANCE_M};

/// Means over all thresholds, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hota {
    pub(super) hota: f64,
    pub(super) deta: f64,
    pub(super) assa: f64,
    pub(super) loca: f64,
}

/// Thresholds on the similarity, in twentieths.
const TWENTIETHS: std::ops::RangeInclusive<u32> = 1..=19;

/// Identities of a matched pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Identities {
    truth: u32,
    said: u32,
}

impl Identities {
    fn of(frame: &ScoredFrame, pair: &MatchedPair) -> Self {
        Self {
            truth: frame.truth[pair.truth].id,
            said: frame.said[pair.said].id,
        }
    }
}

/// Frequency of identities, and the share of their lives that they have in common.
#[derive(Default)]
struct Lives {
    truth: HashMap<u32, f64>,
    said: HashMap<u32, f64>,
    shared: HashMap<Identities, f64>,
}

/// Figures at one threshold.
#[derive(Default)]
struct AtThreshold {
    similarity_sum: f64,
    matches: HashMap<Identities, f64>,
}

pub(super) fn judge(frames: &[ScoredFrame]) -> Hota {
    let similar: Vec<Vec<MatchedPair>> = frames.iter().map(similarities).collect();
    let lives = Lives::of(frames, &similar);
    let mut at: Vec<AtThreshold> = TWENTIETHS.map(|_| AtThreshold::default()).collect();
    for (frame, pairs) in frames.iter().zip(&similar) {
        let ids = |pair: &MatchedPair| Identities::of(frame, pair);
        let worth: Vec<MatchedPair> = pairs
            .iter()
            .map(|pair| MatchedPair {
                value: pair.value * lives.overlap(ids(pair)),
                ..*pair
            })
            .collect();
        for chosen in best(&worth) {
            let distance =
                (frame.truth[chosen.truth].position - frame.said[chosen.said].position).norm();
            let similarity = 1.0 - distance / ZERO_DISTANCE_M;
            for (threshold, twentieths) in at.iter_mut().zip(TWENTIETHS) {
                if similarity >= f64::from(twentieths) / 20.0 - f64::EPSILON {
                    threshold.similarity_sum += similarity;
                    *threshold.matches.entry(ids(&chosen)).or_default() += 1.0;
                }
            }
        }
    }
    let objects: f64 = lives.truth.values().sum();
    let said: f64 = lives.said.values().sum();
    let all: Vec<Hota> = at
        .iter()
        .map(|threshold| threshold.scores(&lives, objects, said))
        .collect();
    let mean = |of: fn(&Hota) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
    Hota {
        hota: mean(|s| s.hota),
        deta: mean(|s| s.deta),
        assa: mean(|s| s.assa),
        loca: mean(|s| s.loca),
    }
}

fn similarities(frame: &ScoredFrame) -> Vec<MatchedPair> {
    let mut pairs = near_pairs(frame, ZERO_DISTANCE_M);
    pairs
        .iter_mut()
        .for_each(|pair| pair.value = 1.0 - pair.value / ZERO_DISTANCE_M);
    pairs
}

impl Lives {
    fn of(frames: &[ScoredFrame], similar: &[Vec<MatchedPair>]) -> Self {
        let mut lives = Self::default();
        for (frame, pairs) in frames.iter().zip(similar) {
            let mut of_truth = vec![0.0; frame.truth.len()];
            let mut of_said = vec![0.0; frame.said.len()];
            for pair in pairs {
                of_truth[pair.truth] += pair.value;
                of_said[pair.said] += pair.value;
            }
            for pair in pairs.iter().filter(|pair| pair.value > 0.0) {
                let share = pair.value / (of_truth[pair.truth] + of_said[pair.said] - pair.value);
                *lives.shared.entry(Identities::of(frame, pair)).or_default() += share;
            }
            frame
                .truth
                .iter()
                .for_each(|object| *lives.truth.entry(object.id).or_default() += 1.0);
            frame
                .said
                .iter()
                .for_each(|object| *lives.said.entry(object.id).or_default() += 1.0);
        }
        lives
    }

    /// Frames with both identities, divided by frames with at least one of them.
    fn overlap(&self, ids: Identities) -> f64 {
        self.jaccard(ids, self.shared.get(&ids).copied().unwrap_or(0.0))
    }

    fn jaccard(&self, ids: Identities, together: f64) -> f64 {
        together / (self.truth[&ids.truth] + self.said[&ids.said] - together).max(1.0)
    }
}

impl AtThreshold {
    fn scores(&self, lives: &Lives, objects: f64, said: f64) -> Hota {
        let matches: f64 = self.matches.values().sum();
        let deta = matches / (objects + said - matches).max(1.0);
        let mut weighted: Vec<f64> = self
            .matches
            .iter()
            .map(|(ids, count)| count * lives.jaccard(*ids, *count))
            .collect();
        // Sorted, because the order of a hash table would make equal inputs give slightly different
        // sums.
        weighted.sort_unstable_by(f64::total_cmp);
        let assa = weighted.iter().sum::<f64>() / matches.max(1.0);
        let loca = if matches > 0.0 {
            self.similarity_sum / matches
        } else {
            1.0
        };
        Hota {
            hota: (deta * assa).sqrt(),
            deta,
            assa,
            loca,
        }
    }
}
