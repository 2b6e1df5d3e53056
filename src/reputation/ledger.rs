//! The ledger: settled votes by epoch, vehicle and label, and the reputations that follow from
//! them.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::marks::Marks;
use super::record::Record;
use super::statements::Statements;
use super::{Counts, Evidence, RememberedVotes, ReputationConfig};
use crate::model::epoch::Epoch;
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::wire::{LedgerMark, Reputation};

/// The evidence of all epochs. Serialised, it is the snapshot that is persisted and replicated.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "LedgerSnapshot", into = "LedgerSnapshot")]
pub struct ReputationLedger {
    /// By the epoch whose aggregator writes the lane, and by vehicle.
    pub(super) lanes: BTreeMap<Epoch, BTreeMap<NodeName, Record>>,
    /// Number of counts and marks by aggregator.
    pub(super) sizes: BTreeMap<NodeName, usize>,
    /// Signed shares of aggregators, by lane. They are not serialised with the counts.
    pub(super) statements: BTreeMap<Epoch, Statements>,
    /// Signed shares on probation, by lane, and when the probation ends.
    pub(super) on_probation: BTreeMap<Epoch, (Statements, Timestamp)>,
    /// Time of the last reset, in cells without certificates; 0 without a reset.
    pub(super) reset_at: Timestamp,
}

/// Counts by vehicle and label.
type SnapshotLane = BTreeMap<NodeName, BTreeMap<Label, Counts>>;

/// A ledger in its serialised form; snapshots of early versions have no marks.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LedgerSnapshot {
    /// By term, and by the aggregator that wrote the lane.
    lanes: BTreeMap<u64, BTreeMap<NodeName, SnapshotLane>>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    marks: Vec<LedgerMark>,
}

impl From<LedgerSnapshot> for ReputationLedger {
    fn from(LedgerSnapshot { lanes, marks }: LedgerSnapshot) -> Self {
        let mut ledger = Self::default();
        for (term, aggregators) in lanes {
            for (aggregator, vehicles) in aggregators {
                ledger.resize(&aggregator, 0, vehicles.values().map(BTreeMap::len).sum());
                let lane = ledger
                    .lanes
                    .entry(Epoch::new(term, aggregator))
                    .or_default();
                for (node, labels) in vehicles {
                    let sum = labels
                        .values()
                        .copied()
                        .fold(Counts::default(), Counts::plus);
                    lane.insert(
                        node,
                        Record {
                            labels,
                            sum,
                            marks: Marks::default(),
                        },
                    );
                }
            }
        }
        ledger.merge_marks(marks, None);
        ledger
    }
}

impl From<ReputationLedger> for LedgerSnapshot {
    fn from(ledger: ReputationLedger) -> Self {
        let marks = ledger.marks().collect();
        let mut lanes: BTreeMap<u64, BTreeMap<_, _>> = BTreeMap::new();
        for (Epoch { term, leader }, vehicles) in ledger.lanes {
            let labels = vehicles
                .into_iter()
                .map(|(node, record)| (node, record.labels))
                .collect();
            lanes.entry(term).or_default().insert(leader, labels);
        }
        Self { lanes, marks }
    }
}

impl ReputationLedger {
    /// A ledger without evidence from before a reset.
    pub fn reset(reset_at: Timestamp) -> Self {
        Self {
            reset_at,
            ..Self::default()
        }
    }

    /// Time of the last reset; 0 without a reset.
    pub fn reset_at(&self) -> Timestamp {
        self.reset_at
    }

    /// Counts one vote in the lane of `epoch` and `aggregator`; only that aggregator may write this
    /// lane. Other lanes are removed to make room, see [`Self::merge_entries`]. The vote is not
    /// counted if its lane alone takes all the room.
    pub fn record(&mut self, epoch: u64, aggregator: &NodeName, evidence: &Evidence) {
        let lane = Epoch::new(epoch, aggregator.clone());
        let Some(record) =
            self.record_mut(&lane, &evidence.node, Some(&evidence.label), Some(&lane))
        else {
            return;
        };
        record
            .labels
            .entry(evidence.label.clone())
            .or_default()
            .add(evidence.correct);
        record.sum.add(evidence.correct);
        let sum = record.sum;
        self.reach_mark(&lane, &evidence.node, sum);
    }

    /// Merges all evidence of `other`, within the same bounds.
    pub fn merge(&mut self, other: &Self) {
        self.merge_entries(other.entries(), None);
        self.merge_marks(other.marks(), None);
    }

    /// Every record, lane by lane.
    pub(super) fn records(&self) -> impl Iterator<Item = (&Epoch, &NodeName, &Record)> {
        let of_lane = |(lane, vehicles)| std::iter::repeat(lane).zip(vehicles);
        self.lanes
            .iter()
            .flat_map(of_lane)
            .map(|(lane, (node, record))| (lane, node, record))
    }

    /// Every record with its vehicle, the latest lanes first.
    fn latest_first(&self) -> impl Iterator<Item = (&NodeName, &Record)> {
        self.lanes.values().rev().flatten()
    }

    /// The latest term in which each vehicle was counted.
    pub fn latest_lanes(&self) -> BTreeMap<NodeName, u64> {
        self.records()
            .map(|(lane, node, _)| (node.clone(), lane.term))
            .collect()
    }

    /// Every vehicle's (correct, incorrect) over all lanes.
    pub fn totals(&self) -> BTreeMap<NodeName, (u64, u64)> {
        let mut totals: BTreeMap<NodeName, Counts> = BTreeMap::new();
        for (node, record) in self.latest_first() {
            let total = totals.entry(node.clone()).or_default();
            *total = total.plus(record.sum);
        }
        totals
            .into_iter()
            .map(|(node, Counts { correct, incorrect })| (node, (correct, incorrect)))
            .collect()
    }

    /// The reputations to publish: scores from the kept votes by [`ReputationConfig::mean`], 0.30
    /// to 1.00, and the counts of all votes.
    pub fn reputations(&self, config: &ReputationConfig) -> BTreeMap<NodeName, Reputation> {
        let latest = self.latest(config.memory_votes);
        let reputation = |(node, (correct, incorrect)): (NodeName, (u64, u64))| {
            let latest = latest.get(&node).copied().unwrap_or_default();
            let score = config.mean(latest.0, latest.1).clamp(0.30, 1.00);
            (
                node,
                Reputation {
                    score,
                    correct,
                    incorrect,
                },
            )
        };
        self.totals().into_iter().map(reputation).collect()
    }

    /// (correct, incorrect) among each vehicle's `memory_votes` latest votes.
    pub(crate) fn latest(&self, memory_votes: f64) -> BTreeMap<&NodeName, (f64, f64)> {
        let mut latest: BTreeMap<&NodeName, (f64, f64)> = BTreeMap::new();
        for (node, record) in self.latest_first() {
            let sum = latest.entry(node).or_default();
            let (correct, incorrect) = record.latest(0.0, memory_votes - (sum.0 + sum.1));
            *sum = (sum.0 + correct, sum.1 + incorrect);
        }
        latest
    }

    /// The (correct, incorrect) votes of every vehicle by stated label. Takes the `memory_votes`
    /// latest votes of each vehicle after skipping the newest `own(vehicle)` votes. If only part of
    /// a lane is used, its labels keep the proportions of the whole lane.
    pub fn remembered(
        &self,
        memory_votes: f64,
        own: impl Fn(&NodeName) -> u64,
    ) -> BTreeMap<NodeName, RememberedVotes> {
        /// Votes of a vehicle that are still to be skipped, and to be taken.
        struct Room {
            skip: f64,
            take: f64,
        }
        let mut rooms: BTreeMap<&NodeName, Room> = BTreeMap::new();
        let mut remembered: BTreeMap<NodeName, RememberedVotes> = BTreeMap::new();
        for (node, record) in self.latest_first() {
            let room = rooms.entry(node).or_insert_with(|| Room {
                skip: own(node) as f64,
                take: memory_votes,
            });
            let (correct, incorrect) = record.latest(room.skip, room.take);
            room.skip = (room.skip - record.sum.total() as f64).max(0.0);
            room.take -= correct + incorrect;
            let share_correct = correct / record.sum.correct.max(1) as f64;
            let share_incorrect = incorrect / record.sum.incorrect.max(1) as f64;
            let labels = remembered.entry(node.clone()).or_default();
            for (label, counts) in &record.labels {
                let sum = labels.entry(label.clone()).or_default();
                sum.0 += share_correct * counts.correct as f64;
                sum.1 += share_incorrect * counts.incorrect as f64;
            }
        }
        remembered
    }
}
