//! Confusion counts: how often each label was stated where each was true.

use std::collections::BTreeSet;

use super::index_map::{LabelIndex, LabelMap};

/// Scale below which all counts are rescaled.
const MIN_SCALE: f64 = 1e-60;

/// Maximum number of labels whose counts have fixed places.
const MAX_PLACED: usize = 32;

/// Expected counts of (true label, stated label). All counts share one scale, so that the cost of
/// fading does not depend on their number.
///
/// The counts of the first labels of a cell are in one table, where a vote finds them without a
/// search. A cell may have too many labels for such a table of each vehicle.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Confusion {
    /// Columns by true label: the sums over all stated labels, then the counts of each stated label.
    table: Vec<f64>,
    /// Number of labels in the table.
    labels: usize,
    others: Box<OtherCounts>,
    correct: f64,
    total: f64,
    scale: f64,
}

/// Counts that have no place in the table.
#[derive(Debug, Clone, Default, PartialEq)]
struct OtherCounts {
    /// By stated label, by true label.
    columns: LabelMap<LabelMap<f64>>,
    /// Sums over all stated labels, by true label.
    sums: LabelMap<f64>,
}

impl Default for Confusion {
    fn default() -> Self {
        Self {
            table: Vec::new(),
            labels: 0,
            others: Box::default(),
            correct: 0.0,
            total: 0.0,
            scale: 1.0,
        }
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
        for (truth, p) in truths {
            self.add_count(stated, truth, p * weight);
        }
    }

    fn add_count(&mut self, stated: LabelIndex, truth: LabelIndex, votes: f64) {
        let column = usize::from(stated);
        let row = usize::from(truth);
        let last = if column < MAX_PLACED {
            column.max(row)
        } else {
            row
        };
        if (self.labels..MAX_PLACED).contains(&last) {
            self.place(last + 1);
        }
        if column.max(row) < self.labels {
            self.table[(1 + column) * self.labels + row] += votes;
        } else {
            *self.others.columns.entry(stated).entry(truth) += votes;
        }
        if row < self.labels {
            self.table[row] += votes;
        } else {
            *self.others.sums.entry(truth) += votes;
        }
        self.total += votes;
        if truth == stated {
            self.correct += votes;
        }
    }

    /// Enlarges the table.
    fn place(&mut self, labels: usize) {
        let mut table = vec![0.0; (1 + labels) * labels];
        let columns = self.table.chunks(self.labels.max(1));
        for (column, before) in table.chunks_mut(labels).zip(columns) {
            column[..before.len()].copy_from_slice(before);
        }
        self.table = table;
        self.labels = labels;
    }

    /// Stated labels, true labels and counts.
    fn iter(&self) -> impl Iterator<Item = (LabelIndex, LabelIndex, f64)> {
        let columns = self.table.chunks(self.labels.max(1)).skip(1);
        let placed = (0..).zip(columns).flat_map(|(stated, column)| {
            let column = (0..).zip(column);
            column.map(move |(truth, votes)| (stated, truth, *votes))
        });
        let others = self.others.columns.iter().flat_map(|(stated, column)| {
            let column = column.iter();
            column.map(move |(truth, votes)| (stated, truth, *votes))
        });
        placed.chain(others)
    }

    /// Removes all evidence about any of `labels`.
    pub(super) fn remove_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        let all = std::mem::take(self);
        self.scale = all.scale;
        for (stated, truth, votes) in all.iter() {
            if votes != 0.0 && !labels.contains(&stated) && !labels.contains(&truth) {
                self.add_count(stated, truth, votes);
            }
        }
    }

    /// Multiplies all evidence by `factor`.
    pub(super) fn fade(&mut self, factor: f64) {
        self.scale *= factor;
        if self.scale < MIN_SCALE {
            let others = &mut *self.others;
            let columns = others.columns.values_mut().flat_map(LabelMap::values_mut);
            let all = self.table.iter_mut().chain(columns);
            for votes in all.chain(others.sums.values_mut()) {
                *votes *= self.scale;
            }
            self.correct *= self.scale;
            self.total *= self.scale;
            self.scale = 1.0;
        }
    }

    /// Number of votes for `stated` where `truth` was true.
    pub(super) fn votes(&self, stated: LabelIndex, truth: LabelIndex) -> f64 {
        let column = usize::from(stated);
        let row = usize::from(truth);
        let votes = if column.max(row) < self.labels {
            Some(&self.table[(1 + column) * self.labels + row])
        } else {
            let column = self.others.columns.get(stated);
            column.and_then(|column| column.get(truth))
        };
        self.scale * votes.map_or(0.0, |votes| votes.max(0.0))
    }

    /// Number of votes for any label where `truth` was true.
    pub(super) fn all_votes(&self, truth: LabelIndex) -> f64 {
        let row = usize::from(truth);
        let votes = if row < self.labels {
            Some(&self.table[row])
        } else {
            self.others.sums.get(truth)
        };
        self.scale * votes.map_or(0.0, |votes| votes.max(0.0))
    }

    /// Labels with the number of votes for them where they were true.
    pub(super) fn diagonal(&self) -> impl Iterator<Item = (LabelIndex, f64)> {
        let columns = self.table.chunks(self.labels.max(1)).skip(1);
        let placed = (0..).zip(columns.enumerate().map(|(row, column)| column[row]));
        let others = self.others.columns.iter().map(|(label, column)| {
            let right = column.get(label).copied().unwrap_or_default();
            (label, right)
        });
        placed
            .chain(others)
            .map(|(label, right)| (label, self.scale * right.max(0.0)))
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
    fn counts_outside_table_stay_whole() {
        let mut confusion = Confusion::default();
        let votes = [(40, 3), (3, 40), (2, 1), (40, 9), (9, 9), (3, 9), (40, 40)];
        for round in 1..=2 {
            for (stated, truth) in votes {
                confusion.add(stated, [(truth, 1.0)], 1.0);
                assert_eq!(confusion.votes(stated, truth), f64::from(round));
            }
        }
        for (truth, sum) in [(1, 2.0), (3, 2.0), (9, 6.0), (40, 4.0), (41, 0.0)] {
            assert_eq!(confusion.all_votes(truth), sum, "{truth}");
        }
        confusion.remove_labels(&[9].into());
        assert_eq!(confusion.total(), 8.0);
        assert_eq!(confusion.all_votes(40), 4.0);
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
        let right = confusion.votes(0, 0);
        let both = right + confusion.votes(1, 0);
        assert!((both - confusion.all_votes(0)).abs() < 1e-9);
        assert!((right - confusion.correct()).abs() < 1e-9);
    }
}
