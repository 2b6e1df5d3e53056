//! Evidence about vehicles that aggregators can merge without counting anything twice.
//!
//! Every aggregator writes only the lane of its own epoch, and counts only grow, so that the state of a lane at any
//! time is an upper bound of its earlier states: merging takes the larger count, lane by lane. Merging is idempotent,
//! commutative and associative (a state-based grow-only counter, Shapiro et al. 2011); two partitions that each went on
//! counting merge to the sum of what they saw.
//!
//! So that votes can be forgotten, a lane has marks: what a vehicle's counts were when it had so many votes. Marks are
//! written once; those that are kept follow from the latest, so that merging them is a join too.

mod marks;
mod share;

use std::collections::BTreeMap;

pub use share::{EntryKey, MAX_ENTRIES, MAX_LANES};

use serde::{Deserialize, Serialize};

use crate::config::config_section;
use crate::names::{Label, NodeName};
use crate::wire::{LedgerMark, Reputation};

use marks::Marks;

/// One vote of which it is settled whether it agreed with the verdict.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Evidence {
    /// Who voted.
    pub node: NodeName,
    /// What for.
    pub label: Label,
    /// Whether the verdict was the same.
    pub correct: bool,
}

/// Votes that agreed with the verdict and votes that did not.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Votes that agreed.
    pub correct: u64,
    /// Votes that did not.
    pub incorrect: u64,
}

impl Counts {
    /// All votes.
    pub fn total(self) -> u64 {
        self.correct.saturating_add(self.incorrect)
    }

    /// Counts one vote.
    pub(crate) fn add(&mut self, correct: bool) {
        let count = if correct { &mut self.correct } else { &mut self.incorrect };
        *count = count.saturating_add(1);
    }

    fn plus(self, other: Self) -> Self {
        Self {
            correct: self.correct.saturating_add(other.correct),
            incorrect: self.incorrect.saturating_add(other.incorrect),
        }
    }

    fn merge(&mut self, other: Self) {
        self.correct = self.correct.max(other.correct);
        self.incorrect = self.incorrect.max(other.incorrect);
    }
}

config_section! {
    /// Settings of reputations.
    pub struct ReputationConfig {
        /// Score of a vehicle without evidence, 0.3 to 1; default 0.5. Below what a proven vehicle reaches.
        pub initial: f64 = 0.5, in 0.3 to 1.0;
        /// Weight of the initial score in votes; default 10. More trusts newcomers and new liars later.
        pub initial_votes: f64 = 10.0, in 1e-3 to 1e6;
        /// Votes that are remembered of a vehicle, the latest; default 500. Where they begin is
        /// interpolated between marks. Less notices a change of mind sooner.
        pub memory_votes: f64 = 500.0, in 1.0 to 1e9;
    }
}

impl ReputationConfig {
    /// The reputation of a vehicle with so many right and wrong votes: the mean of a Beta distribution (Jøsang, Ismail
    /// 2002).
    pub fn mean(&self, correct: f64, incorrect: f64) -> f64 {
        (correct + self.initial * self.initial_votes) / (correct + incorrect + self.initial_votes)
    }
}

/// A vehicle's (correct, incorrect) votes that are remembered, by the label that it stated.
pub type RememberedVotes = BTreeMap<Label, (f64, f64)>;

type Vehicles<T> = BTreeMap<NodeName, T>;
type Lanes<T> = BTreeMap<u64, BTreeMap<NodeName, Vehicles<T>>>;

/// What one lane knows of one vehicle.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Record {
    labels: BTreeMap<Label, Counts>,
    /// Their sum.
    sum: Counts,
    marks: Marks,
}

/// The evidence of all epochs. Serialised, it is the snapshot that is persisted and replicated.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Snapshot", into = "Snapshot")]
pub struct ReputationLedger {
    /// By epoch, the aggregator that wrote the lane, and vehicle.
    lanes: Lanes<Record>,
    /// Number of counts and marks in all lanes.
    entries: usize,
}

/// A ledger as it is written: without marks if it comes from before there were any.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Snapshot {
    lanes: Lanes<BTreeMap<Label, Counts>>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    marks: Vec<LedgerMark>,
}

impl From<Snapshot> for ReputationLedger {
    fn from(Snapshot { lanes, marks }: Snapshot) -> Self {
        let mut ledger = Self::default();
        for (epoch, aggregators) in lanes {
            for (aggregator, vehicles) in aggregators {
                let lane = ledger.lanes.entry(epoch).or_default().entry(aggregator).or_default();
                for (node, labels) in vehicles {
                    ledger.entries += labels.len();
                    let sum = labels.values().copied().fold(Counts::default(), Counts::plus);
                    lane.insert(node, Record { labels, sum, marks: Marks::default() });
                }
            }
        }
        ledger.merge_marks(marks, None);
        ledger
    }
}

impl From<ReputationLedger> for Snapshot {
    fn from(ledger: ReputationLedger) -> Self {
        let marks = ledger.marks().collect();
        let labels = |vehicles: Vehicles<Record>| vehicles.into_iter().map(|(node, r)| (node, r.labels)).collect();
        let lanes = |aggregators: BTreeMap<NodeName, Vehicles<Record>>| {
            aggregators.into_iter().map(|(aggregator, vehicles)| (aggregator, labels(vehicles))).collect()
        };
        Self { lanes: ledger.lanes.into_iter().map(|(epoch, all)| (epoch, lanes(all))).collect(), marks }
    }
}

impl ReputationLedger {
    /// Counts one vote in the lane of `epoch` and `aggregator`; only that aggregator may write there. Any other lane
    /// gives way to it, see [`Self::merge_entries`]; the vote is not counted where it takes all the room itself.
    pub fn record(&mut self, epoch: u64, aggregator: &NodeName, evidence: &Evidence) {
        let lane = (epoch, aggregator);
        let Some(record) = self.record_mut(lane, &evidence.node, Some(&evidence.label), Some(lane)) else { return };
        let counts = record.labels.entry(evidence.label.clone()).or_default();
        counts.add(evidence.correct);
        record.sum.add(evidence.correct);
        let sum = record.sum;
        self.reach_mark(lane, &evidence.node, sum);
    }

    /// Takes in all that `other` knows, within the same bounds.
    pub fn merge(&mut self, other: &Self) {
        self.merge_entries(other.entries(), None);
        self.merge_marks(other.marks(), None);
    }

    /// What every lane knows of every vehicle, the latest lanes first.
    fn latest_first(&self) -> impl Iterator<Item = (&NodeName, &Record)> {
        self.lanes.values().rev().flat_map(|aggregators| aggregators.values().rev().flatten())
    }

    /// The latest epoch in which each vehicle was counted.
    pub fn latest_lanes(&self) -> BTreeMap<NodeName, u64> {
        let nodes = |(epoch, aggregators): (&u64, &BTreeMap<NodeName, Vehicles<Record>>)| {
            let epoch = *epoch;
            aggregators.values().flat_map(BTreeMap::keys).map(move |node| (node.clone(), epoch)).collect::<Vec<_>>()
        };
        self.lanes.iter().flat_map(nodes).collect()
    }

    /// Every vehicle's (correct, incorrect) over all lanes.
    pub fn totals(&self) -> BTreeMap<NodeName, (u64, u64)> {
        let mut totals: BTreeMap<NodeName, Counts> = BTreeMap::new();
        for (node, record) in self.latest_first() {
            let total = totals.entry(node.clone()).or_default();
            *total = total.plus(record.sum);
        }
        totals.into_iter().map(|(node, Counts { correct, incorrect })| (node, (correct, incorrect))).collect()
    }

    /// What is published: the mean of a Beta distribution (Jøsang & Ismail 2002) over the votes that are remembered,
    /// 0.30 to 1.00, and the counts of all.
    pub fn reputations(&self, config: &ReputationConfig) -> BTreeMap<NodeName, Reputation> {
        let mut remembered: BTreeMap<&NodeName, (f64, f64)> = BTreeMap::new();
        for (node, record) in self.latest_first() {
            let sum = remembered.entry(node).or_default();
            let (correct, incorrect) = record.latest((0.0, config.memory_votes - (sum.0 + sum.1)));
            *sum = (sum.0 + correct, sum.1 + incorrect);
        }
        let score = |node: &NodeName| {
            let (correct, incorrect) = remembered.get(node).copied().unwrap_or_default();
            config.mean(correct, incorrect).clamp(0.30, 1.00)
        };
        self.totals()
            .into_iter()
            .map(|(node, (correct, incorrect))| {
                let score = score(&node);
                (node, Reputation { score, correct, incorrect })
            })
            .collect()
    }

    /// By vehicle and stated label, the (correct, incorrect) votes among the `memory_votes` latest before as many as
    /// `own` tells; how they divide among the labels is taken from their whole lane.
    pub fn remembered(&self, memory_votes: f64, own: impl Fn(&NodeName) -> u64) -> BTreeMap<NodeName, RememberedVotes> {
        let mut rooms: BTreeMap<&NodeName, (f64, f64)> = BTreeMap::new();
        let mut remembered: BTreeMap<NodeName, RememberedVotes> = BTreeMap::new();
        for (node, record) in self.latest_first() {
            let room = rooms.entry(node).or_insert_with(|| (own(node) as f64, memory_votes));
            let (correct, incorrect) = record.latest(*room);
            room.0 = (room.0 - record.sum.total() as f64).max(0.0);
            room.1 -= correct + incorrect;
            let shares = (correct / record.sum.correct.max(1) as f64, incorrect / record.sum.incorrect.max(1) as f64);
            let labels = remembered.entry(node.clone()).or_default();
            for (label, counts) in &record.labels {
                let sum = labels.entry(label.clone()).or_default();
                sum.0 += shares.0 * counts.correct as f64;
                sum.1 += shares.1 * counts.incorrect as f64;
            }
        }
        remembered
    }
}

#[cfg(test)]
mod tests;
