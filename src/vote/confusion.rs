//! Confusion counts: how often each label was stated where each was true.

use std::collections::BTreeSet;

use super::label_map::{LabelIndex, LabelMap};

/// Scale below which all counts are rescaled.
const MIN_SCALE: f64 = 1e-60;

/// Sparse expected counts of (true label, stated label). All counts share one scale, so that the
/// cost of fading does not depend on their number.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Confusion {
    /// Counts by true label, by stated label: a vote reads and changes one column.
    columns: LabelMap<LabelMap<f64>>,
    /// Sums over the columns, by true label.
    rows: LabelMap<f64>,
    correct: f64,
    total: f64,
    scale: f64,
}

impl Default for Confusion {
    fn default() -> Self {
        Self {
            columns: LabelMap::default(),
            rows: LabelMap::default(),
            correct: 0.0,
            total: 0.0,
            scale: 1.0,
        }
    }
}

/// The votes for one label, for reading.
pub(super) struct StatedVotes<'a> {
    column: Option<&'a LabelMap<f64>>,
    rows: &'a LabelMap<f64>,
    scale: f64,
}

impl StatedVotes<'_> {
    /// Number of these votes where `truth` was true.
    pub(super) fn where_true(&self, truth: LabelIndex) -> f64 {
        let votes = self.column.and_then(|column| column.get(truth));
        self.scale * votes.map_or(0.0, |votes| votes.max(0.0))
    }

    /// Number of votes for any label where `truth` was true.
    pub(super) fn all_where_true(&self, truth: LabelIndex) -> f64 {
        let votes = self.rows.get(truth);
        self.scale * votes.map_or(0.0, |votes| votes.max(0.0))
    }
}

impl Confusion {
    /// Adds a vote of `weight` for `stated`, given the probability of each true label; a negative
    /// weight removes it.
    pub(super) fn add(
        &mut self,
        stated: LabelIndex,
        truths: impl IntoIterator<Item = (LabelIndex, f64)>,
        weight: f64,
    ) {
        let weight = weight / self.scale;
        let column = self.columns.entry(stated);
        for (truth, p) in truths {
            let votes = p * weight;
            *column.entry(truth) += votes;
            *self.rows.entry(truth) += votes;
            self.total += votes;
            if truth == stated {
                self.correct += votes;
            }
        }
    }

    /// Removes all evidence about any of `labels`.
    pub(super) fn remove_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        let is_kept = |label| !labels.contains(&label);
        self.columns.retain(|stated, _| is_kept(stated));
        for column in self.columns.values_mut() {
            column.retain(|truth, _| is_kept(truth));
        }
        self.rows = LabelMap::default();
        self.correct = 0.0;
        self.total = 0.0;
        for (stated, column) in self.columns.iter() {
            for (truth, votes) in column.iter() {
                *self.rows.entry(truth) += votes;
                self.total += votes;
                if truth == stated {
                    self.correct += votes;
                }
            }
        }
    }

    /// Multiplies all evidence by `factor`.
    pub(super) fn fade(&mut self, factor: f64) {
        self.scale *= factor;
        if self.scale < MIN_SCALE {
            let columns = self.columns.values_mut();
            for votes in columns.flat_map(LabelMap::values_mut) {
                *votes *= self.scale;
            }
            for votes in self.rows.values_mut() {
                *votes *= self.scale;
            }
            self.correct *= self.scale;
            self.total *= self.scale;
            self.scale = 1.0;
        }
    }

    /// The votes for a label.
    pub(super) fn stated(&self, label: LabelIndex) -> StatedVotes<'_> {
        StatedVotes {
            column: self.columns.get(label),
            rows: &self.rows,
            scale: self.scale,
        }
    }

    /// Labels with the number of votes for them where they were true.
    pub(super) fn diagonal(&self) -> impl Iterator<Item = (LabelIndex, f64)> {
        self.columns.iter().map(|(label, column)| {
            let right = column.get(label).copied().unwrap_or_default();
            (label, self.scale * right.max(0.0))
        })
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
    fn removed_label_leaves_rest_unchanged() {
        let mut confusion = Confusion::default();
        let mut without = Confusion::default();
        for (truth, stated, weight) in [
            (0, 0, 4.0),
            (0, 1, 1.0),
            (1, 0, 2.0),
            (1, 1, 8.0),
            (2, 0, 0.5),
        ] {
            confusion.add(stated, [(truth, 1.0)], weight);
            if truth != 1 && stated != 1 {
                without.add(stated, [(truth, 1.0)], weight);
            }
        }
        confusion.remove_labels(&[1].into());
        assert_eq!(confusion, without);
    }

    #[test]
    fn bulk_fading_matches_single_fading() {
        let mut confusion = Confusion::default();
        let mut expected = 0.0;
        for step in 0..200_000u32 {
            confusion.fade(if step % 1000 == 0 { 0.1 } else { 0.998 });
            confusion.add((step % 2) as LabelIndex, [(0, 1.0)], 1.0);
            expected = expected * if step % 1000 == 0 { 0.1 } else { 0.998 } + 1.0;
        }
        assert!(
            (confusion.total() / expected - 1.0).abs() < 1e-9,
            "{} {expected}",
            confusion.total()
        );
        let zero = confusion.stated(0);
        let one = confusion.stated(1);
        let both = zero.where_true(0) + one.where_true(0);
        assert!((both - zero.all_where_true(0)).abs() < 1e-9);
        assert!((zero.where_true(0) - confusion.correct()).abs() < 1e-9);
    }
}
