//! The best one-to-one matching of reported objects with true ones.

use ecod::association::{Candidate, assign};

use super::{ReportedObject, ScoredFrame, TrueObject};

/// A true and a reported object, by their places in a frame or in a table of identities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MatchedPair {
    pub(super) truth: usize,
    pub(super) said: usize,
    /// Similarity of the pair, or its distance.
    pub(super) value: f64,
}

/// Distance in metres if the two may match.
pub(super) fn distance_m(truth: &TrueObject, said: &ReportedObject, limit_m: f64) -> Option<f64> {
    let distance_m = (truth.position - said.position).norm();
    (distance_m <= limit_m && truth.label == said.label).then_some(distance_m)
}

/// All pairs of a frame within `limit_m`, with their distance.
pub(super) fn near_pairs(frame: &ScoredFrame, limit_m: f64) -> Vec<MatchedPair> {
    let mut pairs = Vec::new();
    for (said, object) in frame.said.iter().enumerate() {
        let of_said = frame
            .truth
            .iter()
            .enumerate()
            .filter_map(|(truth, candidate)| {
                distance_m(candidate, object, limit_m).map(|value| MatchedPair {
                    truth,
                    said,
                    value,
                })
            });
        pairs.extend(of_said);
    }
    pairs
}

/// The one-to-one selection of pairs whose values have the greatest sum; pairs without value are
/// not selected.
pub(super) fn best(pairs: &[MatchedPair]) -> Vec<MatchedPair> {
    assign(
        pairs
            .iter()
            .copied()
            .filter(|pair| pair.benefit() > 0)
            .collect(),
        |_, _| None,
    )
}

impl Candidate for MatchedPair {
    fn row(&self) -> u32 {
        self.truth as u32
    }

    fn column(&self) -> u32 {
        self.said as u32
    }

    /// The value in units of 2⁻³².
    fn benefit(&self) -> i64 {
        const UNIT: f64 = (1i64 << 32) as f64;
        (self.value * UNIT) as i64
    }
}
