//! Evidence about how labels are taken for one another.

use std::collections::{BTreeMap, BTreeSet};

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

    /// Forgets all evidence that is about any of `labels`.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        let is_about =
            |&(truth, stated): &(LabelIndex, LabelIndex)| labels.contains(&truth) || labels.contains(&stated);
        let gone: Vec<_> = self.cells.iter().filter(|(cell, _)| is_about(cell)).map(|(cell, n)| (*cell, *n)).collect();
        for ((truth, stated), count) in gone {
            self.add(truth, stated, -count);
            self.cells.remove(&(truth, stated));
        }
        self.rows.retain(|truth, _| !labels.contains(truth));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forgotten_label_leaves_the_rest_as_if_it_had_never_been() {
        let (mut confusion, mut without) = (Confusion::default(), Confusion::default());
        for (truth, stated, weight) in [(0, 0, 4.0), (0, 1, 1.0), (1, 0, 2.0), (1, 1, 8.0), (2, 0, 0.5)] {
            confusion.add(truth, stated, weight);
            if truth != 1 && stated != 1 {
                without.add(truth, stated, weight);
            }
        }
        confusion.forget_labels(&[1].into());
        assert_eq!(confusion, without);
    }
}
