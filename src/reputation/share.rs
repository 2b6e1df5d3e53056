//! The ledger in pieces that fit into messages, and bounded.

use std::collections::BTreeSet;

use super::{Counts, Record, ReputationLedger, Vehicles};
use crate::epoch::Epoch;
use crate::names::{Label, NodeName};
use crate::wire::{LedgerEntry, LedgerMark};

/// Most lanes that are kept: the latest.
pub const MAX_LANES: usize = 64;

/// Most counts and marks that are kept: for a new one the oldest lanes are dropped, and it is not taken where only its
/// own and later ones are left, unless it is of the present leader's lane, to which later ones give way too.
pub const MAX_ENTRIES: usize = 65_536;

/// Which count: what an entry is about, without the numbers.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct EntryKey {
    /// The lane.
    pub lane: Epoch,
    /// Who voted.
    pub node: NodeName,
    /// What for.
    pub label: Label,
}

/// A lane: its term and who writes it.
pub(super) type Lane<'a> = (u64, &'a NodeName);

impl ReputationLedger {
    /// Every count, lane by lane.
    pub fn entries(&self) -> impl Iterator<Item = LedgerEntry> {
        self.lanes.iter().flat_map(|(epoch, aggregators)| {
            aggregators.iter().flat_map(move |(aggregator, vehicles)| {
                vehicles.iter().flat_map(move |(node, record)| {
                    record.labels.iter().map(move |(label, counts)| entry(*epoch, aggregator, node, label, *counts))
                })
            })
        })
    }

    /// The counts that `keys` name, as they are now.
    pub fn entries_of(&self, keys: &BTreeSet<EntryKey>) -> Vec<LedgerEntry> {
        let find = |EntryKey { lane, node, label }: &EntryKey| {
            let counts = self.lanes.get(&lane.term)?.get(&lane.leader)?.get(node)?.labels.get(label)?;
            Some(entry(lane.term, &lane.leader, node, label, *counts))
        };
        keys.iter().filter_map(find).collect()
    }

    /// The counts and marks that `other` would learn something from.
    pub fn beyond(&self, other: &Self) -> (Vec<LedgerEntry>, Vec<LedgerMark>) {
        let is_news = |entry: &LedgerEntry| {
            let lane = other.lane((entry.epoch, &entry.aggregator));
            let known = lane.and_then(|lane| lane.get(&entry.node)?.labels.get(&entry.label));
            known.is_none_or(|known| known.correct < entry.correct || known.incorrect < entry.incorrect)
        };
        let is_new_mark = |mark: &LedgerMark| {
            let lane = other.lane((mark.epoch, &mark.aggregator));
            let known = lane.and_then(|lane| lane.get(&mark.node)).map(|record| &record.marks);
            known.is_none_or(|known| known.would_keep(mark.number) && !known.has(mark.number))
        };
        (self.entries().filter(is_news).collect(), self.marks().filter(is_new_mark).collect())
    }

    /// Takes the larger of every count; true when that changed anything. What is beyond [`MAX_LANES`] and
    /// [`MAX_ENTRIES`] is forgotten, the oldest lanes first, so that all who merge the same forget the same. The lane of the
    /// `present` leader always has room and is never forgotten.
    pub fn merge_entries(&mut self, entries: impl IntoIterator<Item = LedgerEntry>, present: Option<&Epoch>) -> bool {
        let present = present.map(|epoch| (epoch.term, &epoch.leader));
        let mut changed = false;
        for LedgerEntry { epoch, aggregator, node, label, correct, incorrect } in entries {
            let Some(record) = self.record_mut((epoch, &aggregator), &node, Some(&label), present) else { continue };
            let counts = record.labels.entry(label).or_default();
            let before = *counts;
            counts.merge(Counts { correct, incorrect });
            changed |= *counts != before;
            let grown =
                Counts { correct: counts.correct - before.correct, incorrect: counts.incorrect - before.incorrect };
            record.sum = record.sum.plus(grown);
        }
        changed
    }

    /// How many lanes there are.
    pub fn lanes(&self) -> usize {
        self.lanes.values().map(|aggregators| aggregators.len()).sum()
    }

    /// What a lane knows of a vehicle, where there is room for `label` or other lanes make some; `None` elsewhere.
    pub(super) fn record_mut(
        &mut self,
        lane: Lane<'_>,
        node: &NodeName,
        label: Option<&Label>,
        present: Option<Lane<'_>>,
    ) -> Option<&mut Record> {
        let known = self.lane(lane).and_then(|known| known.get(node));
        let knows = |label| known.is_some_and(|record| record.labels.contains_key(label));
        if label.is_some_and(|label| !knows(label)) {
            if !self.make_room(lane, present) {
                return None;
            }
            self.entries += 1;
        }
        let (epoch, aggregator) = lane;
        let lane = self.lanes.entry(epoch).or_default().entry(aggregator.clone()).or_default();
        Some(lane.entry(node.clone()).or_default())
    }

    /// Forgets the oldest lanes until there is room for one more count or mark in `lane`; false where only those are
    /// left that do not give way to it.
    pub(super) fn make_room(&mut self, lane: Lane<'_>, present: Option<Lane<'_>>) -> bool {
        let is_full = |ledger: &Self| {
            ledger.entries >= MAX_ENTRIES || (ledger.lane(lane).is_none() && ledger.lanes() >= MAX_LANES)
        };
        while is_full(self) {
            if !self.forget_oldest(lane, present) {
                return false;
            }
        }
        true
    }

    pub(super) fn lane(&self, (epoch, aggregator): Lane<'_>) -> Option<&Vehicles<Record>> {
        self.lanes.get(&epoch)?.get(aggregator)
    }

    /// Forgets the oldest lane but the present one: one that is older than `lane`, or any if that is the present one.
    fn forget_oldest(&mut self, lane: Lane<'_>, present: Option<Lane<'_>>) -> bool {
        let lanes = self.lanes.iter().flat_map(|(epoch, aggregators)| aggregators.keys().map(|name| (*epoch, name)));
        let oldest = lanes.into_iter().find(|other| *other != lane && Some(*other) != present);
        let Some((epoch, name)) = oldest.filter(|oldest| *oldest < lane || present == Some(lane)) else { return false };
        let name = name.clone();
        let Some(aggregators) = self.lanes.get_mut(&epoch) else { return false };
        let forgotten = aggregators.remove(&name);
        if aggregators.is_empty() {
            self.lanes.remove(&epoch);
        }
        let records = forgotten.iter().flat_map(|lane| lane.values());
        self.entries -= records.map(|record| record.labels.len() + record.marks.len()).sum::<usize>();
        true
    }
}

fn entry(epoch: u64, aggregator: &NodeName, node: &NodeName, label: &Label, counts: Counts) -> LedgerEntry {
    LedgerEntry {
        epoch,
        aggregator: aggregator.clone(),
        node: node.clone(),
        label: label.clone(),
        correct: counts.correct,
        incorrect: counts.incorrect,
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
        Evidence { node: name("euclid"), label: "cup".into(), correct }
    }

    #[test]
    fn shares_carry_a_ledger_over_in_any_order_and_number() {
        let mut ledger = ReputationLedger::default();
        for epoch in 1..=3 {
            (0..epoch).for_each(|n| ledger.record(epoch, &name("edge"), &vote(n > 0)));
        }
        let mut entries: Vec<_> = ledger.entries().collect();
        entries.reverse();
        let mut copy = ReputationLedger::default();
        for share in entries.chunks(2) {
            assert!(copy.merge_entries(share.to_vec(), None));
            assert!(!copy.merge_entries(share.to_vec(), None), "the same again changes nothing");
        }
        assert_eq!(copy, ledger);

        let lane = Epoch::new(3, name("edge"));
        ledger.record(3, &name("edge"), &vote(false));
        let changed = [EntryKey { lane, node: name("euclid"), label: "cup".into() }].into();
        copy.merge_entries(ledger.entries_of(&changed), None);
        assert_eq!(copy, ledger);
    }

    #[test]
    fn what_another_lacks_makes_it_the_same_and_no_more() {
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
    fn only_the_latest_lanes_are_kept() {
        let mut ledger = ReputationLedger::default();
        for epoch in 0..(2 * MAX_LANES as u64) {
            let entry =
                entry(epoch, &name("edge"), &name("euclid"), &"cup".into(), Counts { correct: 1, incorrect: 0 });
            ledger.merge_entries([entry], None);
        }
        assert_eq!(ledger.lanes(), MAX_LANES);
        let oldest = ledger.entries().next().unwrap();
        assert_eq!(oldest.epoch, MAX_LANES as u64);
        let forgotten = LedgerEntry { epoch: 0, ..oldest };
        assert!(!ledger.merge_entries([forgotten], None), "an old lane does not come back");
    }

    #[test]
    fn the_present_leaders_lane_has_room_whatever_others_claim() {
        let counted = Counts { correct: 1, incorrect: 0 };
        let flood = |epoch: u64| {
            (0..2 * MAX_LANES)
                .map(move |n| entry(epoch, &name(&format!("forger{n:03}")), &name("liar"), &"cup".into(), counted))
        };
        let present = Epoch::new(7, name("edge"));
        let vote_of = |ledger: &ReputationLedger| ledger.totals().get(&name("euclid")).copied();

        let mut own = ReputationLedger::default();
        own.merge_entries(flood(7).chain(flood(8)), None);
        own.record(7, &name("edge"), &vote(true));
        assert_eq!((vote_of(&own), own.lanes()), (Some((1, 0)), MAX_LANES), "later lanes give way");
        own.merge_entries(flood(9), Some(&present));
        assert_eq!((vote_of(&own), own.lanes()), (Some((1, 0)), MAX_LANES), "and none displaces it");

        let mut copy = ReputationLedger::default();
        copy.merge_entries(flood(8), None);
        let told = entry(7, &name("edge"), &name("euclid"), &"cup".into(), counted);
        assert!(!copy.merge_entries([told.clone()], None));
        assert!(copy.merge_entries([told], Some(&present)), "nor does it at whoever follows");
    }

    #[test]
    fn names_used_up_in_one_lane_displace_older_lanes_and_nothing_else() {
        let mut ledger = ReputationLedger::default();
        ledger.record(1, &name("edge"), &vote(true));
        ledger.record(2, &name("edge"), &vote(true));
        for number in 0..MAX_ENTRIES {
            let node = name(&format!("v{number}"));
            ledger.record(2, &name("edge"), &Evidence { node, label: "cup".into(), correct: true });
        }
        ledger.record(2, &name("edge"), &vote(true));
        assert_eq!((ledger.entries().count(), ledger.lanes()), (MAX_ENTRIES, 1));
        assert_eq!(ledger.totals()[&name("euclid")], (2, 0), "who is known goes on being counted");
    }
}
