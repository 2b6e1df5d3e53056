//! The ledger in pieces that fit into messages, and bounded.

use std::collections::BTreeSet;

use super::{Counts, Record, ReputationLedger};
use crate::epoch::Epoch;
use crate::names::{Label, NodeName};
use crate::wire::LedgerEntry;

/// Most lanes that are kept: the latest.
pub const MAX_LANES: usize = 64;

/// Most counts and marks that are kept: for a new one the oldest lanes are dropped, and it is not taken where only its own and
/// later ones are left.
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

    /// Takes the larger of every count; true when that changed anything. What is beyond [`MAX_LANES`] and
    /// [`MAX_ENTRIES`] is forgotten, the oldest lanes first, so that all who merge the same forget the same.
    pub fn merge_entries(&mut self, entries: impl IntoIterator<Item = LedgerEntry>) -> bool {
        let mut changed = false;
        for LedgerEntry { epoch, aggregator, node, label, correct, incorrect } in entries {
            let Some(record) = self.record_mut(epoch, &aggregator, &node, Some(&label)) else { continue };
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

    /// What a lane knows of a vehicle, where there is room for `label` or older lanes make some; `None` elsewhere.
    pub(super) fn record_mut(
        &mut self,
        epoch: u64,
        aggregator: &NodeName,
        node: &NodeName,
        label: Option<&Label>,
    ) -> Option<&mut Record> {
        let lane = self.lanes.get(&epoch).and_then(|aggregators| aggregators.get(aggregator));
        let knows =
            |label| lane.and_then(|lane| lane.get(node)).is_some_and(|record| record.labels.contains_key(label));
        if label.is_some_and(|label| !knows(label)) {
            if !self.make_room(epoch, aggregator) {
                return None;
            }
            self.entries += 1;
        }
        let lane = self.lanes.entry(epoch).or_default().entry(aggregator.clone()).or_default();
        Some(lane.entry(node.clone()).or_default())
    }

    /// Forgets the oldest lanes until there is room for one more count or mark in that of `epoch` and `aggregator`;
    /// false where only that lane and later ones are left.
    pub(super) fn make_room(&mut self, epoch: u64, aggregator: &NodeName) -> bool {
        let is_full = |ledger: &Self| {
            ledger.entries >= MAX_ENTRIES || (lane_is_new(ledger, epoch, aggregator) && ledger.lanes() >= MAX_LANES)
        };
        while is_full(self) {
            if !self.forget_lane_before(epoch, aggregator) {
                return false;
            }
        }
        true
    }

    /// Forgets the oldest lane if it is older than that of `epoch` and `aggregator`.
    fn forget_lane_before(&mut self, epoch: u64, aggregator: &NodeName) -> bool {
        let Some(mut oldest) = self.lanes.first_entry() else { return false };
        let term = *oldest.key();
        if oldest.get().keys().next().is_none_or(|leader| (term, leader) >= (epoch, aggregator)) {
            return false;
        }
        let forgotten = oldest.get_mut().pop_first();
        if oldest.get().is_empty() {
            oldest.remove();
        }
        let records = forgotten.iter().flat_map(|(_, lane)| lane.values());
        self.entries -= records.map(|record| record.labels.len() + record.marks.len()).sum::<usize>();
        true
    }
}

fn lane_is_new(ledger: &ReputationLedger, epoch: u64, aggregator: &NodeName) -> bool {
    !ledger.lanes.get(&epoch).is_some_and(|aggregators| aggregators.contains_key(aggregator))
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
            assert!(copy.merge_entries(share.to_vec()));
            assert!(!copy.merge_entries(share.to_vec()), "the same again changes nothing");
        }
        assert_eq!(copy, ledger);

        let lane = Epoch::new(3, name("edge"));
        ledger.record(3, &name("edge"), &vote(false));
        let changed = [EntryKey { lane, node: name("euclid"), label: "cup".into() }].into();
        copy.merge_entries(ledger.entries_of(&changed));
        assert_eq!(copy, ledger);
    }

    #[test]
    fn only_the_latest_lanes_are_kept() {
        let mut ledger = ReputationLedger::default();
        for epoch in 0..(2 * MAX_LANES as u64) {
            let entry =
                entry(epoch, &name("edge"), &name("euclid"), &"cup".into(), Counts { correct: 1, incorrect: 0 });
            ledger.merge_entries([entry]);
        }
        assert_eq!(ledger.lanes(), MAX_LANES);
        let oldest = ledger.entries().next().unwrap();
        assert_eq!(oldest.epoch, MAX_LANES as u64);
        let forgotten = LedgerEntry { epoch: 0, ..oldest };
        assert!(!ledger.merge_entries([forgotten]), "an old lane does not come back");
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
