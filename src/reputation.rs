//! Evidence about vehicles that aggregators can merge without counting anything twice.
//!
//! Every aggregator writes only the lane of its own epoch, and counts only grow, so that the state of a lane at any
//! time is an upper bound of its earlier states: merging takes the larger count, lane by lane. Merging is idempotent,
//! commutative and associative (a state-based grow-only counter, Shapiro et al. 2011); two partitions that each went on
//! counting merge to the sum of what they saw.

mod share;

use std::collections::BTreeMap;

pub use share::{EntryKey, MAX_ENTRIES, MAX_LANES};

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_range};
use crate::names::{Label, NodeName};
use crate::wire::Reputation;

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
    fn merge(&mut self, other: Self) {
        self.correct = self.correct.max(other.correct);
        self.incorrect = self.incorrect.max(other.incorrect);
    }
}

/// Settings of reputations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReputationConfig {
    /// Score of a vehicle without evidence, 0.3 to 1; default 0.5. Below what a proven vehicle reaches.
    pub initial: f64,
    /// Weight of the initial score in votes; default 10. More trusts newcomers and new liars later.
    pub initial_votes: f64,
    /// Votes that are remembered of a vehicle; default 500. Of older epochs only as much counts as later ones leave
    /// room for, so that a change of leadership alone changes no score. Less notices a change of mind sooner.
    pub memory_votes: f64,
}

impl Default for ReputationConfig {
    fn default() -> Self {
        Self { initial: 0.5, initial_votes: 10.0, memory_votes: 500.0 }
    }
}

impl ReputationConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`ConfigError`] naming the first value out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("initial", self.initial, 0.3, 1.0)?;
        check_range("initial_votes", self.initial_votes, 1e-3, 1e6)?;
        check_range("memory_votes", self.memory_votes, 1.0, 1e9)
    }

    /// The reputation of a vehicle with so many right and wrong votes: the mean of a Beta distribution (Jøsang, Ismail 2002).
    pub fn mean(&self, correct: f64, incorrect: f64) -> f64 {
        (correct + self.initial * self.initial_votes) / (correct + incorrect + self.initial_votes)
    }
}

type Vehicles = BTreeMap<NodeName, BTreeMap<Label, Counts>>;
type Lanes = BTreeMap<u64, BTreeMap<NodeName, Vehicles>>;

/// The evidence of all epochs. Serialised, it is the snapshot that is persisted and replicated.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Snapshot")]
pub struct ReputationLedger {
    /// By epoch, the aggregator that wrote the lane, vehicle and stated label.
    lanes: Lanes,
    /// Number of counts in all lanes.
    #[serde(skip)]
    entries: usize,
}

/// A ledger as it was written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Snapshot {
    lanes: Lanes,
}

impl From<Snapshot> for ReputationLedger {
    fn from(Snapshot { lanes }: Snapshot) -> Self {
        let entries = lanes.values().flat_map(BTreeMap::values).flat_map(BTreeMap::values).map(BTreeMap::len).sum();
        Self { lanes, entries }
    }
}

impl ReputationLedger {
    /// Counts one vote in the lane of `epoch` and `aggregator`; only that aggregator may write there. It is not counted
    /// where the bounds leave no room, see [`Self::merge_entries`].
    pub fn record(&mut self, epoch: u64, aggregator: &NodeName, evidence: &Evidence) {
        let Some(counts) = self.counts_mut(epoch, aggregator, &evidence.node, &evidence.label) else { return };
        let count = if evidence.correct { &mut counts.correct } else { &mut counts.incorrect };
        *count = count.saturating_add(1);
    }

    /// Takes in all that `other` knows, within the same bounds.
    pub fn merge(&mut self, other: &Self) {
        self.merge_entries(other.entries());
    }

    fn counts(&self) -> impl Iterator<Item = (u64, &NodeName, &Label, Counts)> {
        self.lanes.iter().flat_map(|(epoch, aggregators)| {
            let vehicles = aggregators.values().flatten();
            vehicles.flat_map(move |(node, labels)| labels.iter().map(move |(label, c)| (*epoch, node, label, *c)))
        })
    }

    /// Every vehicle's (correct, incorrect) over all lanes.
    pub fn totals(&self) -> BTreeMap<NodeName, (u64, u64)> {
        let mut totals: BTreeMap<_, (u64, u64)> = BTreeMap::new();
        for (_, node, _, counts) in self.counts() {
            let total = totals.entry(node.clone()).or_default();
            *total = (total.0.saturating_add(counts.correct), total.1.saturating_add(counts.incorrect));
        }
        totals
    }

    /// A vehicle's counts by the label that it stated, over all lanes.
    pub fn by_label(&self, vehicle: &NodeName) -> BTreeMap<Label, Counts> {
        let mut labels: BTreeMap<Label, Counts> = BTreeMap::new();
        for (_, _, label, counts) in self.counts().filter(|(_, node, ..)| *node == vehicle) {
            let sum = labels.entry(label.clone()).or_default();
            sum.correct = sum.correct.saturating_add(counts.correct);
            sum.incorrect = sum.incorrect.saturating_add(counts.incorrect);
        }
        labels
    }

    /// What is published: the mean of a Beta distribution (Jøsang & Ismail 2002) over the evidence that is remembered,
    /// 0.30 to 1.00.
    pub fn reputations(&self, config: &ReputationConfig) -> BTreeMap<NodeName, Reputation> {
        let mut remembered: BTreeMap<&NodeName, (f64, f64)> = BTreeMap::new();
        for (node, labels) in self.lanes.values().rev().flat_map(|aggregators| aggregators.values().rev().flatten()) {
            let (correct, incorrect) = labels.values().fold((0.0, 0.0), |(correct, incorrect), counts| {
                (correct + counts.correct as f64, incorrect + counts.incorrect as f64)
            });
            let sum = remembered.entry(node).or_default();
            let room = config.memory_votes - (sum.0 + sum.1);
            let share = (room / f64::max(correct + incorrect, 1.0)).clamp(0.0, 1.0);
            *sum = (sum.0 + share * correct, sum.1 + share * incorrect);
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
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn ledger() -> impl Strategy<Value = ReputationLedger> {
        let vote = (0u64..3, 0usize..2, 0usize..3, 0usize..2, any::<bool>());
        proptest::collection::vec(vote, 0..40).prop_map(|votes| {
            let name = |prefix: &str, n: usize| NodeName::new(format!("{prefix}{n}")).unwrap();
            let mut ledger = ReputationLedger::default();
            for (epoch, aggregator, node, label, correct) in votes {
                let evidence = Evidence { node: name("v", node), label: format!("l{label}").into(), correct };
                ledger.record(epoch, &name("a", aggregator), &evidence);
            }
            ledger
        })
    }

    fn merged(a: &ReputationLedger, b: &ReputationLedger) -> ReputationLedger {
        let mut merged = a.clone();
        merged.merge(b);
        merged
    }

    proptest! {
        #[test]
        fn merging_is_a_join_semilattice(a in ledger(), b in ledger(), c in ledger()) {
            prop_assert_eq!(merged(&a, &a), a.clone());
            prop_assert_eq!(merged(&a, &b), merged(&b, &a));
            prop_assert_eq!(merged(&merged(&a, &b), &c), merged(&a, &merged(&b, &c)));
        }

        #[test]
        fn scores_stay_within_bounds_and_snapshots_come_back(a in ledger()) {
            for reputation in a.reputations(&ReputationConfig::default()).values() {
                prop_assert!((0.30..=1.00).contains(&reputation.score));
            }
            let snapshot = serde_json::to_string(&a).unwrap();
            prop_assert_eq!(serde_json::from_str::<ReputationLedger>(&snapshot).unwrap(), a);
        }
    }

    #[test]
    fn a_new_epoch_alone_changes_no_score_and_new_evidence_displaces_old() {
        let name = |n: &str| NodeName::new(n).unwrap();
        let config = ReputationConfig::default();
        let vote = |correct| Evidence { node: name("euclid"), label: "cup".into(), correct };
        let mut ledger = ReputationLedger::default();
        (0..2000).for_each(|_| ledger.record(1, &name("edge"), &vote(true)));
        let score = |ledger: &ReputationLedger| ledger.reputations(&config)[&name("euclid")].score;
        let before = score(&ledger);
        ledger.record(1_732_154_400, &name("gauss"), &vote(true));
        assert!((score(&ledger) - before).abs() < 1e-9, "{} {before}", score(&ledger));
        (0..400).for_each(|_| ledger.record(1_732_154_400, &name("gauss"), &vote(false)));
        assert!(score(&ledger) < 0.35, "{}", score(&ledger));
    }

    #[test]
    fn partitions_that_counted_apart_merge_to_their_sum() {
        let name = |n: &str| NodeName::new(n).unwrap();
        let evidence = Evidence { node: name("euclid"), label: "cup".into(), correct: true };
        let mut common = ReputationLedger::default();
        common.record(1, &name("edge"), &evidence);
        let (mut left, mut right) = (common.clone(), common);
        left.record(2, &name("left"), &evidence);
        right.record(2, &name("right"), &evidence);
        left.merge(&right);
        assert_eq!(left.totals()[&name("euclid")], (3, 0));
    }
}
