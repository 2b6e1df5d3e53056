//! The ledger in pieces that fit into messages, and bounded.

use std::collections::BTreeSet;

use super::{Counts, ReputationLedger};
use crate::epoch::Epoch;
use crate::names::{Label, NodeName};
use crate::wire::LedgerEntry;

/// Most lanes that are kept: the latest.
pub const MAX_LANES: usize = 64;

/// Most entries that are kept: lanes are dropped, the oldest first, until the rest fits; entries of the latest lane
/// beyond it are not taken.
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
                vehicles.iter().flat_map(move |(node, labels)| {
                    labels.iter().map(move |(label, counts)| entry(*epoch, aggregator, node, label, *counts))
                })
            })
        })
    }

    /// The counts that `keys` name, as they are now.
    pub fn entries_of(&self, keys: &BTreeSet<EntryKey>) -> Vec<LedgerEntry> {
        let find = |EntryKey { lane, node, label }: &EntryKey| {
            let counts = self.lanes.get(&lane.term)?.get(&lane.leader)?.get(node)?.get(label)?;
            Some(entry(lane.term, &lane.leader, node, label, *counts))
        };
        keys.iter().filter_map(find).collect()
    }

    /// Takes the larger of every count; true when that changed anything. What is beyond [`MAX_LANES`] and
    /// [`MAX_ENTRIES`] is forgotten, the oldest lanes first, so that all who merge the same forget the same.
    pub fn merge_entries(&mut self, entries: &[LedgerEntry]) -> bool {
        let mut changed = false;
        for LedgerEntry { epoch, aggregator, node, label, correct, incorrect } in entries {
            if !self.has_room_in(*epoch, aggregator) {
                continue;
            }
            let lane = self.lanes.entry(*epoch).or_default().entry(aggregator.clone()).or_default();
            let counts = lane.entry(node.clone()).or_default().entry(label.clone()).or_default();
            let before = *counts;
            counts.merge(Counts { correct: *correct, incorrect: *incorrect });
            changed |= *counts != before;
        }
        self.prune();
        changed
    }

    /// How many lanes there are.
    pub fn lanes(&self) -> usize {
        self.lanes.values().map(|aggregators| aggregators.len()).sum()
    }

    /// False for a new lane that would be the first to be forgotten.
    fn has_room_in(&self, epoch: u64, aggregator: &NodeName) -> bool {
        let oldest = self.lanes.iter().next().and_then(|(term, lanes)| Some((*term, lanes.keys().next()?)));
        self.lanes() < MAX_LANES || oldest.is_none_or(|oldest| (epoch, aggregator) >= oldest)
    }

    /// Forgets the oldest lanes beyond the bounds.
    pub(super) fn prune(&mut self) {
        let mut entries = self.entries().count();
        while self.lanes() > MAX_LANES || (entries > MAX_ENTRIES && self.lanes() > 1) {
            let Some(mut aggregators) = self.lanes.first_entry() else { return };
            if let Some((_, vehicles)) = aggregators.get_mut().pop_first() {
                entries -= vehicles.values().map(|labels| labels.len()).sum::<usize>();
            }
            if aggregators.get().is_empty() {
                aggregators.remove();
            }
        }
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
            assert!(copy.merge_entries(share));
            assert!(!copy.merge_entries(share), "the same again changes nothing");
        }
        assert_eq!(copy, ledger);

        let lane = Epoch::new(3, name("edge"));
        ledger.record(3, &name("edge"), &vote(false));
        let changed = [EntryKey { lane, node: name("euclid"), label: "cup".into() }].into();
        copy.merge_entries(&ledger.entries_of(&changed));
        assert_eq!(copy, ledger);
    }

    #[test]
    fn only_the_latest_lanes_are_kept() {
        let mut ledger = ReputationLedger::default();
        for epoch in 0..(2 * MAX_LANES as u64) {
            let entry =
                entry(epoch, &name("edge"), &name("euclid"), &"cup".into(), Counts { correct: 1, incorrect: 0 });
            ledger.merge_entries(&[entry]);
        }
        assert_eq!(ledger.lanes(), MAX_LANES);
        let oldest = ledger.entries().next().unwrap();
        assert_eq!(oldest.epoch, MAX_LANES as u64);
        let forgotten = LedgerEntry { epoch: 0, ..oldest };
        assert!(!ledger.merge_entries(&[forgotten]), "an old lane does not come back");
    }
}
