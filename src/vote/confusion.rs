//! Evidence about how labels are taken for one another.

use std::collections::BTreeMap;

/// Number of a label within a cell, in order of first appearance.
pub(super) type LabelIndex = u16;

/// Expected counts of (true label, stated label), sparse: what was never seen takes no memory.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Confusion {
    cells: BTreeMap<(LabelIndex, LabelIndex), f64>,
    rows: BTreeMap<LabelIndex, f64>,
    correct: f64,
    total: f64,
}

impl Confusion {
    /// Adds `weight`, negative to take back.
    pub(super) fn add(&mut self, truth: LabelIndex, stated: LabelIndex, weight: f64) {
        *self.cells.entry((truth, stated)).or_insert(0.0) += weight;
        *self.rows.entry(truth).or_insert(0.0) += weight;
        self.total += weight;
        if truth == stated {
            self.correct += weight;
        }
    }

    /// Lets all evidence fade by `factor`.
    pub(super) fn fade(&mut self, factor: f64) {
        self.cells.values_mut().for_each(|c| *c *= factor);
        self.rows.values_mut().for_each(|r| *r *= factor);
        self.correct *= factor;
        self.total *= factor;
    }

    /// Count of `truth` stated as `stated`.
    pub(super) fn cell(&self, truth: LabelIndex, stated: LabelIndex) -> f64 {
        self.cells.get(&(truth, stated)).map_or(0.0, |c| c.max(0.0))
    }

    /// Count of votes on `truth`.
    pub(super) fn row(&self, truth: LabelIndex) -> f64 {
        self.rows.get(&truth).map_or(0.0, |r| r.max(0.0))
    }

    /// True labels with their counts.
    pub(super) fn rows(&self) -> impl Iterator<Item = (LabelIndex, f64)> {
        self.rows.iter().map(|(&truth, &count)| (truth, count.max(0.0)))
    }

    /// Votes that were right.
    pub(super) fn correct(&self) -> f64 {
        self.correct.clamp(0.0, self.total())
    }

    /// All votes.
    pub(super) fn total(&self) -> f64 {
        self.total.max(0.0)
    }
}
