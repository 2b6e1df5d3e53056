//! Confusion counts: how often each label was stated where each was true.

use std::collections::BTreeSet;

/// Index of a label in the cell's [`LabelTable`](super::label_table::LabelTable).
pub(super) type LabelIndex = u16;

/// Scale below which counts are written anew.
const MIN_SCALE: f64 = 1e-60;

/// Statements where one label is true.
#[derive(Debug, Clone, PartialEq)]
struct Row {
    truth: LabelIndex,
    sum: f64,
    /// Counts by stated label, in order of the label.
    cells: Vec<(LabelIndex, f64)>,
}

/// Sparse expected counts of (true label, stated label): only pairs that occurred take memory. All counts share one
/// scale, so that the cost of fading does not depend on their number.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Confusion {
    /// In order of the true label.
    rows: Vec<Row>,
    correct: f64,
    total: f64,
    scale: f64,
}

impl Default for Confusion {
    fn default() -> Self {
        Self { rows: Vec::new(), correct: 0.0, total: 0.0, scale: 1.0 }
    }
}

impl Confusion {
    /// Adds `weight`; a negative one takes evidence back.
    pub(super) fn add(&mut self, truth: LabelIndex, stated: LabelIndex, weight: f64) {
        let weight = weight / self.scale;
        let row = match self.rows.binary_search_by_key(&truth, |row| row.truth) {
            Ok(place) => &mut self.rows[place],
            Err(place) => {
                self.rows.insert(place, Row { truth, sum: 0.0, cells: Vec::new() });
                &mut self.rows[place]
            }
        };
        row.sum += weight;
        match row.cells.binary_search_by_key(&stated, |(label, _)| *label) {
            Ok(place) => row.cells[place].1 += weight,
            Err(place) => row.cells.insert(place, (stated, weight)),
        }
        self.total += weight;
        if truth == stated {
            self.correct += weight;
        }
    }

    /// Removes all evidence about any of `labels`.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        self.rows.retain(|row| !labels.contains(&row.truth));
        (self.total, self.correct) = (0.0, 0.0);
        for row in &mut self.rows {
            row.cells.retain(|(stated, _)| !labels.contains(stated));
            row.sum = row.cells.iter().map(|(_, count)| count).sum();
            self.total += row.sum;
            self.correct += row.cells.iter().filter(|(stated, _)| *stated == row.truth).map(|(_, n)| n).sum::<f64>();
        }
    }

    /// Multiplies all evidence by `factor`.
    pub(super) fn fade(&mut self, factor: f64) {
        self.scale *= factor;
        if self.scale < MIN_SCALE {
            for row in &mut self.rows {
                row.sum *= self.scale;
                row.cells.iter_mut().for_each(|(_, count)| *count *= self.scale);
            }
            self.correct *= self.scale;
            self.total *= self.scale;
            self.scale = 1.0;
        }
    }

    /// Numbers of votes for `stated` where `truth` was true, and of all votes there.
    pub(super) fn cell_and_row(&self, truth: LabelIndex, stated: LabelIndex) -> (f64, f64) {
        let Ok(place) = self.rows.binary_search_by_key(&truth, |row| row.truth) else { return (0.0, 0.0) };
        let Row { sum, cells, .. } = &self.rows[place];
        let cell = cells.binary_search_by_key(&stated, |(label, _)| *label).map_or(0.0, |place| cells[place].1);
        (self.scale * cell.max(0.0), self.scale * sum.max(0.0))
    }

    /// True labels with their numbers of votes.
    pub(super) fn rows(&self) -> impl Iterator<Item = (LabelIndex, f64)> {
        self.rows.iter().map(|row| (row.truth, self.scale * row.sum.max(0.0)))
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
        for (truth, stated, weight) in [(0, 0, 4.0), (0, 1, 1.0), (1, 0, 2.0), (1, 1, 8.0), (2, 0, 0.5)] {
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
        assert!((confusion.total() / expected - 1.0).abs() < 1e-9, "{} {expected}", confusion.total());
        let ((right, row), (wrong, _)) = (confusion.cell_and_row(0, 0), confusion.cell_and_row(0, 1));
        assert!((right + wrong - row).abs() < 1e-9);
        assert!((right - confusion.correct()).abs() < 1e-9);
    }
}
