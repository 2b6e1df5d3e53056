//! The labels of a cell by number, and which of them leave when room is short.

use std::collections::{BTreeMap, BTreeSet};

use super::confusion::LabelIndex;
use crate::names::Label;
use crate::time::Timestamp;

/// Part of the labels that leaves at once when room is short, so that the cost per new label stays small.
const LEAVING_AT_ONCE: usize = 8;

/// Votes by which a label must have been found right to outlast all that nobody else has stated.
const SUPPORTED_VOTES: f64 = 1.0;

#[derive(Debug, Clone)]
struct Entry {
    name: Label,
    /// The vehicle that brought it in, as long as that is known.
    by: Option<usize>,
    stated_at: Option<Timestamp>,
}

/// Labels, numbered in order of first appearance; a label that leaves makes its number free for another.
#[derive(Debug, Clone, Default)]
pub(super) struct Labels {
    entries: Vec<Entry>,
    numbers: BTreeMap<Label, LabelIndex>,
    free: Vec<LabelIndex>,
}

impl Labels {
    /// How many numbers are or were in use.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn name(&self, number: LabelIndex) -> &Label {
        &self.entries[usize::from(number)].name
    }

    pub(super) fn number(&self, label: &Label) -> Option<LabelIndex> {
        self.numbers.get(label).copied()
    }

    /// Whether a label can be taken with at most `most` in all.
    pub(super) fn has_room_for(&self, label: &Label, most: usize) -> bool {
        self.numbers.len() < most || self.numbers.contains_key(label)
    }

    /// The number of a label, a new or free one if it has none; `stated` tells by whom and when.
    pub(super) fn take(&mut self, label: &Label, stated: Option<(usize, Timestamp)>) -> LabelIndex {
        let (by, stated_at) = stated.unzip();
        if let Some(number) = self.number(label) {
            let entry = &mut self.entries[usize::from(number)];
            entry.stated_at = stated_at.or(entry.stated_at);
            return number;
        }
        let entry = Entry { name: label.clone(), by, stated_at };
        let number = if let Some(number) = self.free.pop() {
            self.entries[usize::from(number)] = entry;
            number
        } else {
            self.entries.push(entry);
            (self.entries.len() - 1) as LabelIndex
        };
        self.numbers.insert(label.clone(), number);
        number
    }

    /// Forgets who brought labels in, as the numbers of these vehicles may stand for others from now on.
    pub(super) fn forget_vehicles(&mut self, vehicles: &BTreeSet<usize>) {
        for entry in &mut self.entries {
            entry.by = entry.by.filter(|by| !vehicles.contains(by));
        }
    }

    /// Frees the numbers of the labels that others can best do without, and returns them; `support` is how often each
    /// was found right.
    ///
    /// Those without support go first, and of these the most who brought in the most (longest queue drop, as in fair
    /// queueing, McKenney 1990), the longest unseen first: who invents labels loses them.
    pub(super) fn make_room(&mut self, support: &[f64]) -> BTreeSet<LabelIndex> {
        let is_supported = |number: LabelIndex| support[usize::from(number)] >= SUPPORTED_VOTES;
        let mut latest: Vec<_> = self.numbers.values().map(|&n| (&self.entries[usize::from(n)], n)).collect();
        latest.sort_by_key(|(entry, number)| (std::cmp::Reverse(entry.stated_at), *number));
        let mut brought: BTreeMap<(bool, Option<usize>), usize> = BTreeMap::new();
        let mut leaving: Vec<_> = latest
            .into_iter()
            .map(|(entry, number)| {
                let rank = brought.entry((is_supported(number), entry.by)).or_default();
                *rank += 1;
                (is_supported(number), std::cmp::Reverse(*rank), entry.stated_at, number)
            })
            .collect();
        leaving.sort();
        let count = leaving.len().div_ceil(LEAVING_AT_ONCE);
        let gone: BTreeSet<_> = leaving.into_iter().take(count).map(|(.., number)| number).collect();
        self.numbers.retain(|_, number| !gone.contains(number));
        self.free.extend(&gone);
        gone
    }
}
