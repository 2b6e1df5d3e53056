//! Reputations: evidence about vehicles that aggregators merge without counting any vote twice.
//!
//! The ledger is a state-based grow-only counter (Shapiro et al. 2011). Every aggregator writes
//! only the lane of its own epoch, and counts only grow. Merging takes the larger count in each
//! lane: it is idempotent, commutative and associative. Two partitions that counted separately
//! merge to the sum of their votes.
//!
//! A mark stores a vehicle's counts at an earlier number of votes, so that older votes can be
//! dropped. A mark never changes. Only the latest mark determines which marks are kept, so merging
//! marks is also a join.

mod ledger;
mod marks;
mod record;
mod replication;
mod signed_evidence;
mod statements;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

pub use ledger::ReputationLedger;
pub use replication::{EntryKey, MAX_ENTRIES, MAX_LANES};

use crate::config::config_section;
use crate::model::names::{Label, NodeName};
use crate::wire::MAX_INTEGER;

/// A settled vote: its agreement with the verdict no longer changes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Evidence {
    /// Vehicle that voted.
    pub node: NodeName,
    /// The label that it stated.
    pub label: Label,
    /// True if the verdict has the stated label.
    pub correct: bool,
}

/// Numbers of votes that agreed and disagreed with the verdict. Counting and adding stop at
/// [`MAX_INTEGER`], the largest count that receivers accept.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Counts {
    /// Number of votes that agreed with the verdict.
    pub correct: u64,
    /// Number of votes that disagreed with the verdict.
    pub incorrect: u64,
}

impl Counts {
    /// Number of votes that agreed or disagreed.
    pub fn total(self) -> u64 {
        self.correct.saturating_add(self.incorrect)
    }

    pub(crate) fn add(&mut self, correct: bool) {
        let count = if correct {
            &mut self.correct
        } else {
            &mut self.incorrect
        };
        *count = sum(*count, 1);
    }

    fn plus(self, other: Self) -> Self {
        Self {
            correct: sum(self.correct, other.correct),
            incorrect: sum(self.incorrect, other.incorrect),
        }
    }

    fn merge(&mut self, other: Self) {
        self.correct = self.correct.max(other.correct);
        self.incorrect = self.incorrect.max(other.incorrect);
    }
}

fn sum(one: u64, other: u64) -> u64 {
    one.saturating_add(other).min(MAX_INTEGER)
}

config_section! {
    /// Settings of the reputation that a vehicle gets from its evidence.
    pub struct ReputationConfig {
        /// Score of a vehicle without evidence, 0.3 to 1; default 0.5. It should be below the score
        /// of a proven vehicle.
        pub initial: f64 = 0.5, in 0.3 to 1.0;
        /// Weight of the initial score in votes; default 10. A higher value reacts later to
        /// newcomers and to new false reports.
        pub initial_votes: f64 = 10.0, in 1e-3 to 1e6;
        /// Number of the latest votes of a vehicle that count; default 500. Their beginning is
        /// interpolated between marks. A lower value notices changed behaviour sooner.
        pub memory_votes: f64 = 500.0, in 1.0 to 1e9;
    }
}

impl ReputationConfig {
    /// The reputation of a vehicle with these numbers of votes: the mean of a Beta distribution
    /// (Jøsang & Ismail 2002). Unlike there, the prior is not uniform but [`Self::initial`] with
    /// the weight [`Self::initial_votes`].
    pub fn mean(&self, correct: f64, incorrect: f64) -> f64 {
        let prior = self.initial * self.initial_votes;
        (correct + prior) / (correct + incorrect + self.initial_votes)
    }
}

/// A vehicle's kept votes, (correct, incorrect), by the label that it stated.
pub type RememberedVotes = BTreeMap<Label, (f64, f64)>;

#[cfg(test)]
mod tests;
