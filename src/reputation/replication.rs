//! Replication: counts and marks of the ledger in pieces that fit into messages, how they are
//! merged, and their bounds.

use std::collections::{BTreeMap, BTreeSet};

use super::ledger::ReputationLedger;
use super::marks::SPACING;
use super::record::Record;
use super::{Counts, Evidence};
use crate::model::epoch::Epoch;
use crate::model::names::{Label, NodeName};
use crate::wire::{LedgerEntry, LedgerMark};

/// Maximum number of lanes: the latest are kept. One aggregator has at most half of them.
pub const MAX_LANES: usize = 128;

/// Maximum number of counts and marks, of which one aggregator has at most half. For a new entry
/// the oldest lanes are dropped: lanes of its own aggregator if that aggregator has its half. The
/// entry is refused if only its own and later lanes remain, except in the current leader's lane,
/// for which later lanes are dropped too.
pub const MAX_ENTRIES: usize = 131_072;

/// The key of a count: an entry without its numbers.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct EntryKey {
    /// Leadership that counted the votes.
    pub lane: Epoch,
    /// Vehicle whose votes were counted.
    pub node: NodeName,
    /// The label that it stated.
    pub label: Label,
}

impl ReputationLedger {
    /// Every count, lane by lane.
    pub fn entries(&self) -> impl Iterator<Item = LedgerEntry> {
        self.records().flat_map(|(lane, node, record)| {
            record
                .labels
                .iter()
                .map(move |(label, counts)| entry(lane, node, label, *counts))
        })
    }

    /// The current counts of `keys`.
    pub fn entries_of(&self, keys: &BTreeSet<EntryKey>) -> Vec<LedgerEntry> {
        let find = |EntryKey { lane, node, label }: &EntryKey| {
            Some(entry(
                lane,
                node,
                label,
                *self.lanes.get(lane)?.get(node)?.labels.get(label)?,
            ))
        };
        keys.iter().filter_map(find).collect()
    }

    /// The counts and marks that are missing in `other` or larger than there.
    pub fn beyond(&self, other: &Self) -> (Vec<LedgerEntry>, Vec<LedgerMark>) {
        let entries = self
            .entries()
            .filter(|entry| other.lacks_entry(entry))
            .collect();
        (
            entries,
            self.marks().filter(|mark| other.lacks_mark(mark)).collect(),
        )
    }

    /// True if a count is missing here or larger than here.
    pub fn lacks_entry(&self, entry: &LedgerEntry) -> bool {
        let record = self.record_of(entry.epoch, &entry.aggregator, &entry.node);
        let counts = record.and_then(|record| record.labels.get(&entry.label));
        counts.is_none_or(|counts| {
            counts.correct < entry.correct || counts.incorrect < entry.incorrect
        })
    }

    /// True if a mark is missing here and would be kept.
    pub fn lacks_mark(&self, mark: &LedgerMark) -> bool {
        let record = self.record_of(mark.epoch, &mark.aggregator, &mark.node);
        record.is_none_or(|record| {
            record.marks.would_keep(mark.number) && !record.marks.has(mark.number)
        })
    }

    /// Number of votes in the ledger of a mark's vehicle in its lane.
    pub fn votes_of(&self, mark: &LedgerMark) -> u64 {
        self.record_of(mark.epoch, &mark.aggregator, &mark.node)
            .map_or(0, |record| record.sum.total())
    }

    fn record_of(&self, term: u64, aggregator: &NodeName, node: &NodeName) -> Option<&Record> {
        self.lanes
            .get(&Epoch::new(term, aggregator.clone()))?
            .get(node)
    }

    /// True if there is a lane after this one.
    pub fn has_later_than(&self, lane: &Epoch) -> bool {
        self.lanes
            .last_key_value()
            .is_some_and(|(last, _)| last > lane)
    }

    /// True if there is a lane.
    pub fn has_lane(&self, lane: &Epoch) -> bool {
        self.lanes.contains_key(lane)
    }

    /// Takes the larger of every count; returns true if that changed any.
    ///
    /// Beyond [`MAX_LANES`] and [`MAX_ENTRIES`] the oldest lanes are dropped, so that all nodes
    /// that merge the same entries drop the same lanes. The lane of the `present` leader always has
    /// room and is not dropped.
    pub fn merge_entries(
        &mut self,
        entries: impl IntoIterator<Item = LedgerEntry>,
        present: Option<&Epoch>,
    ) -> bool {
        let mut changed = false;
        for LedgerEntry {
            epoch,
            aggregator,
            node,
            label,
            correct,
            incorrect,
        } in entries
        {
            let lane = Epoch::new(epoch, aggregator);
            let Some(record) = self.record_mut(&lane, &node, Some(&label), present) else {
                continue;
            };
            let counts = record.labels.entry(label).or_default();
            let before = *counts;
            counts.merge(Counts { correct, incorrect });
            changed |= *counts != before;
            let grown = Counts {
                correct: counts.correct - before.correct,
                incorrect: counts.incorrect - before.incorrect,
            };
            record.sum = record.sum.plus(grown);
        }
        changed
    }

    /// Every mark, lane by lane.
    pub fn marks(&self) -> impl Iterator<Item = LedgerMark> {
        self.records().flat_map(|(lane, node, record)| {
            record
                .marks
                .iter()
                .map(move |(number, counts)| mark(lane, node, number, counts))
        })
    }

    /// Sets a mark for a vehicle if its number of votes in a lane is a multiple of [`SPACING`].
    pub(super) fn reach_mark(&mut self, lane: &Epoch, node: &NodeName, sum: Counts) {
        if sum.total().is_multiple_of(SPACING) {
            self.merge_marks([mark(lane, node, sum.total() / SPACING, sum)], Some(lane));
        }
    }

    /// The marks that `evidence` reached in a lane; it must be the evidence that was recorded there
    /// last.
    pub fn marks_reached(
        &self,
        epoch: u64,
        aggregator: &NodeName,
        evidence: &[Evidence],
    ) -> Vec<LedgerMark> {
        let lane = Epoch::new(epoch, aggregator.clone());
        let mut votes: BTreeMap<&NodeName, u64> = BTreeMap::new();
        evidence
            .iter()
            .for_each(|evidence| *votes.entry(&evidence.node).or_default() += 1);
        let reached = |(node, votes): (&NodeName, u64)| {
            let record = self.lanes.get(&lane)?.get(node)?;
            let (number, counts) = record.marks.iter().next_back()?;
            let is_new = number * SPACING + votes > record.sum.total();
            is_new.then(|| mark(&lane, node, number, counts))
        };
        votes.into_iter().filter_map(reached).collect()
    }

    /// Merges marks, within the bounds of [`Self::merge_entries`]; returns true if that changed
    /// any.
    pub fn merge_marks(
        &mut self,
        marks: impl IntoIterator<Item = LedgerMark>,
        present: Option<&Epoch>,
    ) -> bool {
        let mut changed = false;
        for LedgerMark {
            epoch,
            aggregator,
            node,
            number,
            correct,
            incorrect,
        } in marks
        {
            let lane = Epoch::new(epoch, aggregator);
            let known = self
                .lanes
                .get(&lane)
                .and_then(|vehicles| vehicles.get(&node));
            if known.is_some_and(|record| !record.marks.would_keep(number)) || number == 0 {
                continue;
            }
            let is_known = known.is_some_and(|record| record.marks.has(number));
            if !is_known && !self.make_room(&lane, present) {
                continue;
            }
            let Some(record) = self.record_mut(&lane, &node, None, present) else {
                continue;
            };
            let before = record.marks.len();
            changed |= record.marks.insert(number, Counts { correct, incorrect });
            let after = record.marks.len();
            self.resize(&lane.leader, before, after);
        }
        changed
    }

    /// Number of leaderships with counts in the ledger.
    pub fn lanes(&self) -> usize {
        self.lanes.len()
    }

    /// The record of a vehicle in a lane. `None` if it lacks `label` and there is no room for one
    /// more count.
    pub(super) fn record_mut(
        &mut self,
        lane: &Epoch,
        node: &NodeName,
        label: Option<&Label>,
        present: Option<&Epoch>,
    ) -> Option<&mut Record> {
        let known = self.lanes.get(lane).and_then(|vehicles| vehicles.get(node));
        if label.is_some_and(|label| known.is_none_or(|record| !record.labels.contains_key(label)))
        {
            if !self.make_room(lane, present) {
                return None;
            }
            self.resize(&lane.leader, 0, 1);
        }
        Some(
            self.lanes
                .entry(lane.clone())
                .or_default()
                .entry(node.clone())
                .or_default(),
        )
    }

    /// Drops the oldest lanes until there is room for one more count or mark in `lane`; returns
    /// false if the remaining lanes must be kept.
    fn make_room(&mut self, lane: &Epoch, present: Option<&Epoch>) -> bool {
        loop {
            let is_new = !self.lanes.contains_key(lane);
            let of_one = self
                .lanes
                .keys()
                .filter(|other| other.leader == lane.leader)
                .count();
            let has_half = self
                .sizes
                .get(&lane.leader)
                .is_some_and(|size| *size >= MAX_ENTRIES / 2)
                || (is_new && of_one >= MAX_LANES / 2);
            let is_full = self.sizes.values().sum::<usize>() >= MAX_ENTRIES
                || (is_new && self.lanes.len() >= MAX_LANES);
            if !has_half && !is_full {
                return true;
            }
            if !self.drop_oldest(lane, present, has_half) {
                return false;
            }
        }
    }

    /// Drops the oldest lane except the current one, of the same aggregator or of all, if it is
    /// older than `lane` or `lane` is the current one.
    fn drop_oldest(
        &mut self,
        lane: &Epoch,
        present: Option<&Epoch>,
        same_aggregator: bool,
    ) -> bool {
        let may_go = |other: &&Epoch| *other != lane && Some(*other) != present;
        let mut old = self.lanes.keys().filter(may_go);
        let oldest = old
            .find(|other| !same_aggregator || other.leader == lane.leader)
            .cloned();
        let gives_way = |oldest: &Epoch| oldest < lane || present == Some(lane);
        let Some(oldest) = oldest.filter(gives_way) else {
            return false;
        };
        self.drop_lane(&oldest);
        true
    }

    pub(super) fn drop_lane(&mut self, lane: &Epoch) {
        self.resize(&lane.leader, self.size_of(lane), 0);
        self.lanes.remove(lane);
        self.statements.remove(lane);
        self.on_probation.remove(lane);
    }

    /// Records that the number of counts and marks of an aggregator changed from `before` to
    /// `after`.
    pub(super) fn resize(&mut self, aggregator: &NodeName, before: usize, after: usize) {
        let size =
            (self.sizes.remove(aggregator).unwrap_or_default() + after).saturating_sub(before);
        if size > 0 {
            self.sizes.insert(aggregator.clone(), size);
        }
    }

    /// Number of counts and marks in a lane.
    pub(super) fn size_of(&self, lane: &Epoch) -> usize {
        let records = self
            .lanes
            .get(lane)
            .into_iter()
            .flat_map(|vehicles| vehicles.values());
        records
            .map(|record| record.labels.len() + record.marks.len())
            .sum()
    }
}

fn mark(
    lane: &Epoch,
    node: &NodeName,
    number: u64,
    Counts { correct, incorrect }: Counts,
) -> LedgerMark {
    LedgerMark {
        epoch: lane.term,
        aggregator: lane.leader.clone(),
        node: node.clone(),
        number,
        correct,
        incorrect,
    }
}

fn entry(
    lane: &Epoch,
    node: &NodeName,
    label: &Label,
    Counts { correct, incorrect }: Counts,
) -> LedgerEntry {
    LedgerEntry {
        epoch: lane.term,
        aggregator: lane.leader.clone(),
        node: node.clone(),
        label: label.clone(),
        correct,
        incorrect,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reputation::Evidence;

    fn name(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    fn vote(correct: bool) -> Evidence {
        Evidence {
            node: name("euclid"),
            label: "cup".into(),
            correct,
        }
    }

    #[test]
    fn shares_transfer_ledger_unordered() {
        let mut ledger = ReputationLedger::default();
        for epoch in 1..=3 {
            (0..epoch).for_each(|n| ledger.record(epoch, &name("edge"), &vote(n > 0)));
        }
        let mut entries: Vec<_> = ledger.entries().collect();
        entries.reverse();
        let mut copy = ReputationLedger::default();
        for share in entries.chunks(2) {
            assert!(copy.merge_entries(share.to_vec(), None));
            assert!(
                !copy.merge_entries(share.to_vec(), None),
                "a repetition has no effect"
            );
        }
        assert_eq!(copy, ledger);

        let lane = Epoch::new(3, name("edge"));
        ledger.record(3, &name("edge"), &vote(false));
        let changed = [EntryKey {
            lane,
            node: name("euclid"),
            label: "cup".into(),
        }]
        .into();
        copy.merge_entries(ledger.entries_of(&changed), None);
        assert_eq!(copy, ledger);
    }

    #[test]
    fn difference_equalises_ledgers() {
        let mut ledger = ReputationLedger::default();
        (0..200).for_each(|n| ledger.record(2, &name("edge"), &vote(n % 3 > 0)));
        let mut other = ledger.clone();
        (0..200).for_each(|n| ledger.record(2, &name("edge"), &vote(n % 3 > 0)));
        ledger.record(1, &name("gauss"), &vote(true));
        other.record(3, &name("edge"), &vote(true));
        let (entries, marks) = ledger.beyond(&other);
        assert_eq!(entries.len(), 2);
        other.merge_entries(entries, None);
        other.merge_marks(marks, None);
        assert_eq!(ledger.beyond(&other), (Vec::new(), Vec::new()));
        ledger.merge(&other);
        assert_eq!(other, ledger);
    }

    #[test]
    fn only_latest_lanes_are_kept() {
        let mut ledger = ReputationLedger::default();
        for epoch in 0..(2 * MAX_LANES as u64) {
            let lane = Epoch::new(epoch, name("edge"));
            let entry = entry(
                &lane,
                &name("euclid"),
                &"cup".into(),
                Counts {
                    correct: 1,
                    incorrect: 0,
                },
            );
            ledger.merge_entries([entry], None);
        }
        assert_eq!(ledger.lanes(), MAX_LANES / 2);
        let oldest = ledger.entries().next().unwrap();
        assert_eq!(oldest.epoch, (MAX_LANES + MAX_LANES / 2) as u64);
        let dropped = LedgerEntry { epoch: 0, ..oldest };
        assert!(
            !ledger.merge_entries([dropped], None),
            "an old lane does not come back"
        );
    }

    #[test]
    fn current_leaders_lane_is_protected() {
        let counted = Counts {
            correct: 1,
            incorrect: 0,
        };
        let flood = |epoch: u64| {
            let lane = move |n| Epoch::new(epoch, name(&format!("forger{n:03}")));
            (0..2 * MAX_LANES).map(move |n| entry(&lane(n), &name("liar"), &"cup".into(), counted))
        };
        let present = Epoch::new(7, name("edge"));
        let vote_of = |ledger: &ReputationLedger| ledger.totals().get(&name("euclid")).copied();

        let mut own = ReputationLedger::default();
        own.merge_entries(flood(7).chain(flood(8)), None);
        own.record(7, &name("edge"), &vote(true));
        assert_eq!(
            (vote_of(&own), own.lanes()),
            (Some((1, 0)), MAX_LANES),
            "later lanes are evicted"
        );
        own.merge_entries(flood(9), Some(&present));
        assert_eq!(
            (vote_of(&own), own.lanes()),
            (Some((1, 0)), MAX_LANES),
            "and none displaces it"
        );

        let mut copy = ReputationLedger::default();
        copy.merge_entries(flood(8), None);
        let received = entry(&present, &name("euclid"), &"cup".into(), counted);
        assert!(!copy.merge_entries([received.clone()], None));
        assert!(
            copy.merge_entries([received], Some(&present)),
            "nor does it at a later leader"
        );
    }

    #[test]
    fn full_lane_displaces_only_older_lanes() {
        let mut ledger = ReputationLedger::default();
        ledger.record(1, &name("edge"), &vote(true));
        ledger.record(2, &name("edge"), &vote(true));
        for number in 0..MAX_ENTRIES / 2 {
            let node = name(&format!("v{number}"));
            ledger.record(
                2,
                &name("edge"),
                &Evidence {
                    node,
                    label: "cup".into(),
                    correct: true,
                },
            );
        }
        ledger.record(2, &name("edge"), &vote(true));
        assert_eq!(
            (ledger.entries().count(), ledger.lanes()),
            (MAX_ENTRIES / 2, 1)
        );
        assert_eq!(
            ledger.totals()[&name("euclid")],
            (2, 0),
            "a node with counts is counted further"
        );
    }

    /// Its signed shares may invent any number of leaderships and vehicles.
    #[test]
    fn false_leader_keeps_latest_half() {
        let counted = Counts {
            correct: 1,
            incorrect: 0,
        };
        let mut ledger = ReputationLedger::default();
        for term in 0..MAX_LANES as u64 / 2 {
            ledger.record(term, &name("edge"), &vote(true));
        }
        let lane = |term: usize| Epoch::new(1000 + term as u64, name("liar"));
        let lanes =
            (0..2 * MAX_LANES).map(|term| entry(&lane(term), &name("v"), &"cup".into(), counted));
        ledger.merge_entries(lanes, None);
        let present = lane(2 * MAX_LANES);
        let vehicles = (0..2 * MAX_ENTRIES)
            .map(|n| entry(&present, &name(&format!("v{n}")), &"cup".into(), counted));
        ledger.merge_entries(vehicles, Some(&present));
        assert_eq!(ledger.totals()[&name("euclid")], (MAX_LANES as u64 / 2, 0));
        assert!(ledger.entries().count() <= MAX_LANES + MAX_ENTRIES / 2);
    }
}
