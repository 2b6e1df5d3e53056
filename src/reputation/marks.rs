//! Marks: a vehicle's earlier counts in a lane, which separate its latest votes from older ones.

use std::collections::BTreeMap;

use super::Counts;

/// Votes from one mark to the next.
pub(super) const SPACING: u64 = 32;
/// Number of the latest marks that are all kept; of older ones every second, fourth, and so on.
const DENSE: u64 = 4;

/// A vehicle's counts in one lane at multiples of [`SPACING`] votes, by that multiple.
///
/// Of the marks that lie n back, those at multiples of the greatest power of two up to n/2 are
/// kept. There are two for every doubling, so that the beginning of any span of votes is determined
/// to within half of it. The set of kept marks only shrinks as the latest mark rises, so that
/// merging and then dropping is a join.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Marks(BTreeMap<u64, Counts>);

impl Marks {
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = (u64, Counts)> {
        self.0.iter().map(|(number, counts)| (*number, *counts))
    }

    /// Merges a mark, taking the larger counts; true if that changed anything.
    pub(super) fn insert(&mut self, number: u64, counts: Counts) -> bool {
        if !self.would_keep(number) {
            return false;
        }
        let mark = self.0.entry(number).or_default();
        let before = *mark;
        mark.merge(counts);
        let changed = *mark != before;
        let last = self.last();
        self.0.retain(|&number, _| is_kept(number, last));
        changed
    }

    /// True if a mark of this number is kept or would be, if it were inserted.
    pub(super) fn would_keep(&self, number: u64) -> bool {
        number > 0 && is_kept(number, self.last().max(number))
    }

    pub(super) fn has(&self, number: u64) -> bool {
        self.0.contains_key(&number)
    }

    fn last(&self) -> u64 {
        self.0.last_key_value().map_or(0, |(number, _)| *number)
    }
}

fn is_kept(number: u64, last: u64) -> bool {
    let back = last - number;
    back < DENSE || number.is_multiple_of(1 << (back.ilog2() - 1))
}
