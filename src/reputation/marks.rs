//! Where a vehicle's votes in a lane stood at earlier times, so that the latest ones can be told from the rest.

use std::collections::BTreeMap;

use super::share::Lane;
use super::{Counts, Evidence, Record, ReputationLedger};
use crate::epoch::Epoch;
use crate::names::NodeName;
use crate::wire::LedgerMark;

/// Votes from one mark to the next.
const SPACING: u64 = 32;
/// Latest marks of which every one is kept; of older ones only every second, fourth, and so on.
const DENSE: u64 = 4;

/// A vehicle's counts in one lane when it had a multiple of [`SPACING`] votes there, by that multiple.
///
/// Of marks that lie n back, those at multiples of the greatest power of two up to n/2 are kept: two for every
/// doubling, so that where the votes of any span began is known to within half of it. What is kept only shrinks as the
/// latest mark rises: to merge and then drop is a join.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Marks(BTreeMap<u64, Counts>);

impl Marks {
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = (u64, Counts)> {
        self.0.iter().map(|(number, counts)| (*number, *counts))
    }

    /// Takes a mark in, the larger counts if there is one already; true when that changed anything.
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

    /// Whether there is a mark of this number or would be, once told.
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
    /// (correct, incorrect) among the latest votes but the very latest: `skip` of these, and then at most `room`.
    pub(super) fn latest(&self, (mut skip, mut room): (f64, f64)) -> (f64, f64) {
        let (mut correct, mut incorrect) = (0.0, 0.0);
        let mut end = self.sum;
        let begins = self.marks.iter().rev().map(|(_, counts)| counts).chain([Counts::default()]);
        for begin in begins {
            // A mark may have come before the counts that it is of.
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
        self.lanes.iter().flat_map(|(epoch, aggregators)| {
            aggregators.iter().flat_map(move |(aggregator, vehicles)| {
                vehicles.iter().flat_map(move |(node, record)| {
                    record.marks.iter().map(move |(number, counts)| mark((*epoch, aggregator, node), number, counts))
                })
            })
        })
    }

    /// Sets a mark for a vehicle if it has as many votes in a lane as belong to one.
    pub(super) fn reach_mark(&mut self, lane: Lane<'_>, node: &NodeName, sum: Counts) {
        if sum.total().is_multiple_of(SPACING) {
            let present = Epoch::new(lane.0, lane.1.clone());
            self.merge_marks([mark((lane.0, lane.1, node), sum.total() / SPACING, sum)], Some(&present));
        }
    }

    /// The marks that were reached in a lane by `evidence`, the last that was recorded there.
    pub fn marks_reached(&self, epoch: u64, aggregator: &NodeName, evidence: &[Evidence]) -> Vec<LedgerMark> {
        let lane = self.lanes.get(&epoch).and_then(|aggregators| aggregators.get(aggregator));
        let mut votes: BTreeMap<&NodeName, u64> = BTreeMap::new();
        evidence.iter().for_each(|evidence| *votes.entry(&evidence.node).or_default() += 1);
        let reached = |(node, votes): (&NodeName, u64)| {
            let record = lane?.get(node)?;
            let (number, counts) = record.marks.iter().next_back()?;
            let is_new = number * SPACING + votes > record.sum.total();
            is_new.then(|| mark((epoch, aggregator, node), number, counts))
        };
        votes.into_iter().filter_map(reached).collect()
    }

    /// Takes in marks, within the bounds of [`Self::merge_entries`]; true when that changed anything.
    pub fn merge_marks(&mut self, marks: impl IntoIterator<Item = LedgerMark>, present: Option<&Epoch>) -> bool {
        let present = present.map(|epoch| (epoch.term, &epoch.leader));
        let mut changed = false;
        for LedgerMark { epoch, aggregator, node, number, correct, incorrect } in marks {
            let lane = (epoch, &aggregator);
            let known = self.lane(lane).and_then(|vehicles| vehicles.get(&node));
            if known.is_some_and(|record| !record.marks.would_keep(number)) || number == 0 {
                continue;
            }
            let is_known = known.is_some_and(|record| record.marks.has(number));
            if !is_known && !self.make_room(lane, present) {
                continue;
            }
            let Some(record) = self.record_mut(lane, &node, None, present) else { continue };
            let before = record.marks.len();
            changed |= record.marks.insert(number, Counts { correct, incorrect });
            let after = record.marks.len();
            self.entries = self.entries + after - before;
        }
        changed
    }
}

fn mark((epoch, aggregator, node): (u64, &NodeName, &NodeName), number: u64, counts: Counts) -> LedgerMark {
    LedgerMark {
        epoch,
        aggregator: aggregator.clone(),
        node: node.clone(),
        number,
        correct: counts.correct,
        incorrect: counts.incorrect,
    }
}
