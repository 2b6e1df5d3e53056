//! The labels of a cell by index, and the choice of labels to evict when room is short.

use std::collections::{BTreeMap, BTreeSet};

use super::index_map::LabelIndex;
use crate::model::names::Label;
use crate::model::time::Timestamp;

/// Inverse share of the labels that is evicted at once, so that the cost per new label stays small.
const EVICTION_DIVISOR: usize = 8;

/// Correct votes from which a label is supported: unsupported labels are evicted first.
const SUPPORTED_VOTES: f64 = 1.0;

#[derive(Debug, Clone)]
struct LabelEntry {
    name: Label,
    /// The vehicle that stated the label first; `None` once that vehicle was removed.
    introduced_by: Option<usize>,
    stated_at: Option<Timestamp>,
}

/// Labels, numbered in order of first appearance; a label that leaves makes its index free for
/// another.
#[derive(Debug, Clone, Default)]
pub(super) struct LabelTable {
    entries: Vec<LabelEntry>,
    indices: BTreeMap<Label, LabelIndex>,
    free: Vec<LabelIndex>,
}

impl LabelTable {
    /// Number of indices that are or were in use.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn name(&self, index: LabelIndex) -> &Label {
        &self.entries[usize::from(index)].name
    }

    pub(super) fn index(&self, label: &Label) -> Option<LabelIndex> {
        self.indices.get(label).copied()
    }

    /// Whether a label is in the table, or one more label is within `max_labels`.
    pub(super) fn has_room_for(&self, label: &Label, max_labels: usize) -> bool {
        self.indices.len() < max_labels || self.indices.contains_key(label)
    }

    /// The index of a label; a new or reused index if the label has none. `stated` is the vehicle
    /// that stated it and the time.
    pub(super) fn intern(
        &mut self,
        label: &Label,
        stated: Option<(usize, Timestamp)>,
    ) -> LabelIndex {
        let (introduced_by, stated_at) = stated.unzip();
        if let Some(index) = self.index(label) {
            let entry = &mut self.entries[usize::from(index)];
            entry.stated_at = stated_at.or(entry.stated_at);
            return index;
        }
        let entry = LabelEntry {
            name: label.clone(),
            introduced_by,
            stated_at,
        };
        let index = if let Some(index) = self.free.pop() {
            self.entries[usize::from(index)] = entry;
            index
        } else {
            self.entries.push(entry);
            (self.entries.len() - 1) as LabelIndex
        };
        self.indices.insert(label.clone(), index);
        index
    }

    /// Clears which labels these vehicles stated first: their indices may be reused.
    pub(super) fn remove_vehicles(&mut self, vehicles: &BTreeSet<usize>) {
        for entry in &mut self.entries {
            entry.introduced_by = entry.introduced_by.filter(|by| !vehicles.contains(by));
        }
    }

    /// Evicts the least useful labels and returns their indices; `support` is the number of correct
    /// votes of each.
    ///
    /// Unsupported labels are evicted first. Among these, the labels of the vehicle that introduced
    /// most are evicted first (longest queue drop, as in fair queueing, McKenney 1990), the longest
    /// unseen first. A vehicle that invents labels therefore loses its own labels.
    pub(super) fn make_room(&mut self, support: &[f64]) -> BTreeSet<LabelIndex> {
        let is_supported = |index: LabelIndex| support[usize::from(index)] >= SUPPORTED_VOTES;
        let mut latest: Vec<_> = self
            .indices
            .values()
            .map(|&n| (&self.entries[usize::from(n)], n))
            .collect();
        latest.sort_by_key(|(entry, index)| (std::cmp::Reverse(entry.stated_at), *index));
        let mut introduced: BTreeMap<(bool, Option<usize>), usize> = BTreeMap::new();
        let mut ranked: Vec<_> = latest
            .into_iter()
            .map(|(entry, index)| {
                let rank = introduced
                    .entry((is_supported(index), entry.introduced_by))
                    .or_default();
                *rank += 1;
                (
                    is_supported(index),
                    std::cmp::Reverse(*rank),
                    entry.stated_at,
                    index,
                )
            })
            .collect();
        ranked.sort();
        let count = ranked.len().div_ceil(EVICTION_DIVISOR);
        let evicted: BTreeSet<_> = ranked
            .into_iter()
            .take(count)
            .map(|(.., index)| index)
            .collect();
        self.indices.retain(|_, index| !evicted.contains(index));
        self.free.extend(&evicted);
        evicted
    }
}
