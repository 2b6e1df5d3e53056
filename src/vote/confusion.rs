//! Confusion counts: how often each label was stated where each was true.

use std::collections::{BTreeMap, BTreeSet};

/// Index of a label in the cell's [`LabelTable`](super::label_table::LabelTable).
pub(super) type LabelIndex = u16;

/// Scale below which all counts are rescaled.
const MIN_SCALE: f64 = 1e-60;

/// Sparse expected counts of (true label, stated label): pairs that did not occur take no memory.
/// All counts share one scale, so that the cost of fading does not depend on their number.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Confusion {
    cells: BTreeMap<(LabelIndex, LabelIndex), f64>,
    rows: BTreeMap<LabelIndex, f64>,
    correct: f64,
    total: f64,
    scale: f64,
}

impl Default for Confusion {
    fn default() -> Self {
        Self {
            cells: BTreeMap::new(),
            rows: BTreeMap::new(),
            correct: 0.0,
            total: 0.0,
            scale: 1.0,
        }
    }
}

impl Confusion {
    /// Adds `weight`; a negative weight removes evidence.
    pub(super) fn add(&mut self, truth: LabelIndex, stated: LabelIndex, weight: f64) {
        self.add_scaled(truth, stated, weight / self.scale);
    }

    fn add_scaled(&mut self, truth: LabelIndex, stated: LabelIndex, weight: f64) {
        *self.cells.entry((truth, stated)).or_insert(0.0) += weight;
        *self.rows.entry(truth).or_insert(0.0) += weight;
        self.total += weight;
        if truth == stated {
            self.correct += weight;
        }
    }

    /// Removes all evidence about any of `labels`.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        let is_about = |&(truth, stated): &(LabelIndex, LabelIndex)| {
            labels.contains(&truth) || labels.contains(&stated)
        };
        let gone: Vec<_> = self
            .cells
            .iter()
            .filter(|(cell, _)| is_about(cell))
            .map(|(cell, n)| (*cell, *n))
            .collect();
        for ((truth, stated), count) in gone {
            self.add_scaled(truth, stated, -count);
            self.cells.remove(&(truth, stated));
        }
        self.rows.retain(|truth, _| !labels.contains(truth));
    }

    /// Multiplies all evidence by `factor`.
    pub(super) fn fade(&mut self, factor: f64) {
        self.scale *= factor;
        if self.scale < MIN_SCALE {
            self.cells.values_mut().for_each(|c| *c *= self.scale);
            self.rows.values_mut().for_each(|r| *r *= self.scale);
            self.correct *= self.scale;
            self.total *= self.scale;
            self.scale = 1.0;
        }
    }

    /// Number of votes for `stated` where `truth` was true.
    pub(super) fn cell(&self, truth: LabelIndex, stated: LabelIndex) -> f64 {
        self.cells
            .get(&(truth, stated))
            .map_or(0.0, |c| self.scale * c.max(0.0))
    }

    /// Number of votes where `truth` was true.
    pub(super) fn row(&self, truth: LabelIndex) -> f64 {
        self.rows
            .get(&truth)
            .map_or(0.0, |r| self.scale * r.max(0.0))
    }

    /// Labels with the number of votes for them where they were true.
    pub(super) fn diagonal(&self) -> impl Iterator<Item = (LabelIndex, f64)> {
        self.rows
            .keys()
            .map(|&truth| (truth, self.cell(truth, truth)))
    }

    /// Number of right votes.
    pub(super) fn correct(&self) -> f64 {
        (self.scale * self.correct).clamp(0.0, self.total())
    }

    /// Number of all votes.
    pub(super) fn total(&self) -> f64 {
        self.scale * self.total.max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_forgotten_label_leaves_the_rest_as_if_it_had_never_been() {
        let (mut confusion, mut without) = (Confusion::default(), Confusion::default());
        for (truth, stated, weight) in [
            (0, 0, 4.0),
            (0, 1, 1.0),
            (1, 0, 2.0),
            (1, 1, 8.0),
            (2, 0, 0.5),
        ] {
            confusion.add(truth, stated, weight);
            if truth != 1 && stated != 1 {
                without.add(truth, stated, weight);
            }
        }
        confusion.forget_labels(&[1].into());
        assert_eq!(confusion, without);
    }

    #[test]
    fn counts_fade_as_if_each_were_faded_however_long() {
        let (mut confusion, mut expected) = (Confusion::default(), 0.0);
        for step in 0..200_000u32 {
            confusion.fade(if step % 1000 == 0 { 0.1 } else { 0.998 });
            confusion.add(0, (step % 2) as LabelIndex, 1.0);
            expected = expected * if step % 1000 == 0 { 0.1 } else { 0.998 } + 1.0;
        }
        assert!(
            (confusion.total() / expected - 1.0).abs() < 1e-9,
            "{} {expected}",
            confusion.total()
        );
        assert!((confusion.cell(0, 0) + confusion.cell(0, 1) - confusion.row(0)).abs() < 1e-9);
        assert!((confusion.cell(0, 0) - confusion.correct()).abs() < 1e-9);
    }
}
