//! Record: the votes of one vehicle in one lane.

use std::collections::BTreeMap;

use super::Counts;
use super::marks::Marks;
use crate::model::names::Label;

/// The votes of one vehicle in one lane.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Record {
    pub(super) labels: BTreeMap<Label, Counts>,
    pub(super) sum: Counts,
    pub(super) marks: Marks,
}

impl Record {
    /// (correct, incorrect) among the at most `room` latest votes that remain after the very latest
    /// `skip` votes.
    pub(super) fn latest(&self, mut skip: f64, mut room: f64) -> (f64, f64) {
        let mut correct = 0.0;
        let mut incorrect = 0.0;
        let mut end = self.sum;
        let begins = self
            .marks
            .iter()
            .rev()
            .map(|(_, counts)| counts)
            .chain([Counts::default()]);
        for begin in begins {
            // A mark may arrive before its counts.
            let right = end.correct.saturating_sub(begin.correct) as f64;
            let wrong = end.incorrect.saturating_sub(begin.incorrect) as f64;
            end = Counts {
                correct: end.correct.min(begin.correct),
                incorrect: end.incorrect.min(begin.incorrect),
            };
            let votes = right + wrong;
            let skipped = skip.min(votes);
            skip -= skipped;
            let taken = (votes - skipped).min(room).max(0.0);
            room -= taken;
            let share = taken / votes.max(1.0);
            correct += share * right;
            incorrect += share * wrong;
        }
        (correct, incorrect)
    }
}
