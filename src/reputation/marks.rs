//! Marks: a vehicle's earlier counts in a lane, which separate its latest votes from older ones.

use std::collections::BTreeMap;

use super::ledger::{Record, ReputationLedger};
use super::{Counts, Evidence};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::wire::LedgerMark;

/// Votes from one mark to the next.
const SPACING: u64 = 32;
/// Number of the latest marks that are all kept; of older ones every second, fourth, and so on.
const DENSE: u64 = 4;

/// A vehicle's counts in one lane at multiples of [`SPACING`] votes, by that multiple.
///
/// Of marks that lie n back, those at multiples of the greatest power of two up to n/2 are kept. These are two for every
/// doubling, so that the beginning of any span of votes is known to within half of it. The set of kept marks only shrinks
/// as the latest mark rises, so that merging and then dropping is a join.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Marks(BTreeMap<u64, Counts>);

impl Marks {
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = (u64, Counts)> {
        self.0.iter().map(|(number, counts)| (*number, *counts))
    }

    /// Merges a mark, taking the larger counts; true when that changed anything.
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

impl Record {
    /// (correct, incorrect) among the at most `room` latest votes that remain after the very latest `skip` votes.
    pub(super) fn latest(&self, (mut skip, mut room): (f64, f64)) -> (f64, f64) {
        let (mut correct, mut incorrect) = (0.0, 0.0);
        let mut end = self.sum;
        let begins = self.marks.iter().rev().map(|(_, counts)| counts).chain([Counts::default()]);
        for begin in begins {
            // A mark may arrive before its counts.
            let right = end.correct.saturating_sub(begin.correct) as f64;
            let wrong = end.incorrect.saturating_sub(begin.incorrect) as f64;
            end = Counts { correct: end.correct.min(begin.correct), incorrect: end.incorrect.min(begin.incorrect) };
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

impl ReputationLedger {
    /// Every mark, lane by lane.
    pub fn marks(&self) -> impl Iterator<Item = LedgerMark> {
        self.records().flat_map(|(lane, node, record)| {
            record.marks.iter().map(move |(number, counts)| mark(lane, node, number, counts))
        })
    }

    /// Sets a mark for a vehicle if its number of votes in a lane is a multiple of [`SPACING`].
    pub(super) fn reach_mark(&mut self, lane: &Epoch, node: &NodeName, sum: Counts) {
        if sum.total().is_multiple_of(SPACING) {
            self.merge_marks([mark(lane, node, sum.total() / SPACING, sum)], Some(lane));
        }
    }

    /// The marks that `evidence` reached in a lane; it must be what was recorded there last.
    pub fn marks_reached(&self, epoch: u64, aggregator: &NodeName, evidence: &[Evidence]) -> Vec<LedgerMark> {
        let lane = Epoch::new(epoch, aggregator.clone());
        let mut votes: BTreeMap<&NodeName, u64> = BTreeMap::new();
        evidence.iter().for_each(|evidence| *votes.entry(&evidence.node).or_default() += 1);
        let reached = |(node, votes): (&NodeName, u64)| {
            let record = self.lanes.get(&lane)?.get(node)?;
            let (number, counts) = record.marks.iter().next_back()?;
            let is_new = number * SPACING + votes > record.sum.total();
            is_new.then(|| mark(&lane, node, number, counts))
        };
        votes.into_iter().filter_map(reached).collect()
    }

    /// Takes in marks, within the bounds of [`Self::merge_entries`]; true when that changed anything.
    pub fn merge_marks(&mut self, marks: impl IntoIterator<Item = LedgerMark>, present: Option<&Epoch>) -> bool {
        let mut changed = false;
        for LedgerMark { epoch, aggregator, node, number, correct, incorrect } in marks {
            let lane = Epoch::new(epoch, aggregator);
            let known = self.lanes.get(&lane).and_then(|vehicles| vehicles.get(&node));
            if known.is_some_and(|record| !record.marks.would_keep(number)) || number == 0 {
                continue;
            }
            let is_known = known.is_some_and(|record| record.marks.has(number));
            if !is_known && !self.make_room(&lane, present) {
                continue;
            }
            let Some(record) = self.record_mut(&lane, &node, None, present) else { continue };
            let before = record.marks.len();
            changed |= record.marks.insert(number, Counts { correct, incorrect });
            let after = record.marks.len();
            self.resize(&lane.leader, before, after);
        }
        changed
    }
}

fn mark(lane: &Epoch, node: &NodeName, number: u64, Counts { correct, incorrect }: Counts) -> LedgerMark {
    LedgerMark { epoch: lane.term, aggregator: lane.leader.clone(), node: node.clone(), number, correct, incorrect }
}
