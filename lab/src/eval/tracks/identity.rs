//! IDF1 (Ristani et al., ECCV workshops 2016): how long each true object bears the one identity
//! that suits it best.
//!
//! True and given identities are matched once for the whole sequence, so that the number of frames
//! in which matched ones are near enough is greatest. Equal to `trackeval.metrics.Identity` at a
//! threshold of 0.5.

use hashbrown::HashMap;

use super::matching::{MatchedPair, best, near_pairs};
use super::{MATCH_DISTANCE_M, ScoredFrame};

/// Counts of a whole sequence.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct IdentityScore {
    /// Reported objects with the identity matched to the true one.
    true_positives: u64,
    /// Number of true and reported objects together.
    all: u64,
}

impl IdentityScore {
    /// Twice the true positives divided by all objects; zero without objects.
    pub(super) fn f1(&self) -> f64 {
        2.0 * self.true_positives as f64 / self.all.max(1) as f64
    }
}

pub(super) fn judge(frames: &[ScoredFrame]) -> IdentityScore {
    let mut together: HashMap<(u32, u32), u64> = HashMap::new();
    for frame in frames {
        for pair in near_pairs(frame, MATCH_DISTANCE_M) {
            *together
                .entry((frame.truth[pair.truth].id, frame.said[pair.said].id))
                .or_default() += 1;
        }
    }
    let mut pairs: Vec<MatchedPair> = together
        .into_iter()
        .map(|((truth, said), count)| MatchedPair {
            truth: truth as usize,
            said: said as usize,
            value: count as f64,
        })
        .collect();
    pairs.sort_unstable_by_key(|pair| (pair.truth, pair.said));
    let all = frames
        .iter()
        .map(|frame| (frame.truth.len() + frame.said.len()) as u64)
        .sum();
    IdentityScore {
        true_positives: best(&pairs).iter().map(|pair| pair.value as u64).sum(),
        all,
    }
}
