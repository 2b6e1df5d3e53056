//! The best one-to-one matching of what was said with what is true.

use std::collections::BTreeMap;

use pathfinding::kuhn_munkres::kuhn_munkres;
use pathfinding::matrix::Matrix;
use pathfinding::undirected::connected_components::separate_components;

use super::{Frame, SaidObject, TrueObject};

/// A true object and one that was said, by their places in a frame or in a table of identities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pair {
    pub(super) truth: usize,
    pub(super) said: usize,
    /// Similarity of the pair, or its distance.
    pub(super) value: f64,
}

/// Distance in metres if one may be taken for the other.
pub(super) fn distance_m(truth: &TrueObject, said: &SaidObject, limit_m: f64) -> Option<f64> {
    let distance_m = (truth.position - said.position).norm();
    (distance_m <= limit_m && truth.label == said.label).then_some(distance_m)
}

/// All pairs of a frame within `limit_m`, with their distance.
pub(super) fn near_pairs(frame: &Frame, limit_m: f64) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for (said, object) in frame.said.iter().enumerate() {
        let of_said = frame.truth.iter().enumerate().filter_map(|(truth, candidate)| {
            distance_m(candidate, object, limit_m).map(|value| Pair { truth, said, value })
        });
        pairs.extend(of_said);
    }
    pairs
}

/// The one-to-one choice of pairs whose values have the greatest sum; pairs worth nothing are never chosen.
///
/// Pairs that have nothing in common, not even by way of others, are settled apart.
pub(super) fn best(pairs: &[Pair]) -> Vec<Pair> {
    let pairs: Vec<Pair> = pairs.iter().copied().filter(|pair| units(pair.value) > 0).collect();
    let groups: Vec<Vec<usize>> = pairs.iter().map(|pair| vec![2 * pair.truth, 2 * pair.said + 1]).collect();
    let (_, group_of) = separate_components(&groups);
    let mut contests: BTreeMap<usize, Vec<Pair>> = BTreeMap::new();
    for (pair, group) in pairs.into_iter().zip(group_of) {
        contests.entry(group).or_default().push(pair);
    }
    contests.values().flat_map(|contest| settle(contest)).collect()
}

fn settle(contest: &[Pair]) -> Vec<Pair> {
    if let [only] = contest {
        return vec![*only];
    }
    let places = |of: fn(&Pair) -> usize| {
        let mut all: Vec<usize> = contest.iter().map(of).collect();
        all.sort_unstable();
        all.dedup();
        all
    };
    let (truths, saids) = (places(|pair| pair.truth), places(|pair| pair.said));
    // The algorithm wants at least as many columns as rows.
    let is_turned = truths.len() > saids.len();
    let cell = |pair: &Pair| {
        let truth = truths.partition_point(|place| *place < pair.truth);
        let said = saids.partition_point(|place| *place < pair.said);
        if is_turned { (said, truth) } else { (truth, said) }
    };
    let mut values = Matrix::new(truths.len().min(saids.len()), truths.len().max(saids.len()), 0);
    for pair in contest {
        values[cell(pair)] = units(pair.value);
    }
    let (_, column_of) = kuhn_munkres(&values);
    let is_chosen = |pair: &&Pair| {
        let (row, column) = cell(pair);
        column_of[row] == column
    };
    contest.iter().filter(is_chosen).copied().collect()
}

/// Values in units of 2⁻³², for the algorithm needs numbers that add up exactly.
fn units(value: f64) -> i64 {
    const UNIT: f64 = (1i64 << 32) as f64;
    (value * UNIT) as i64
}
