//! Counts of other cells about vehicles, and their weight here.
//!
//! Each cell states absolute counts, which only grow until it is reset. Merging keeps the later
//! reset, and the larger of every count after one reset: a join like the ledger's, so that messages
//! may arrive late, twice, or in any order. Only the counts that the cell still keeps have weight.
//!
//! Here they are votes in addition to the prior (Jøsang & Ismail 2002, section 3: discounting), few
//! enough that
//! - one cell alone moves a vehicle by at most half of the prior's weight, so that it cannot ban a
//!   newcomer;
//! - all cells together weigh at most twice the prior, so that own evidence soon outweighs them.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::Counts;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{CellReputation, ForeignVotes, SCHEMA_VERSION};

/// Weight of another cell's vote relative to an own vote.
const DISCOUNT: f64 = 0.2;

/// Maximum weight of one cell's votes about a vehicle, as a share of the prior's weight. With a
/// half, the worst counts of one cell leave a newcomer two thirds of its score, which is above the
/// score that tracking treats as worthless.
const MAX_SHARE_EACH: f64 = 0.5;

/// Maximum weight of all cells' votes about a vehicle, as a multiple of the prior's weight.
const MAX_SHARE: f64 = 2.0;

/// Minimum number of kept own votes about a vehicle for checking other cells' counts of that
/// vehicle.
const MIN_OWN_VOTES: u64 = 20;

/// Minimum number of kept votes of another cell about a vehicle for checking that cell's counts.
const MIN_JUDGED_VOTES: u64 = 5;

/// Difference of the shares of right votes from which two cells contradict each other about a
/// vehicle.
const CONTRADICTION: f64 = 0.35;

/// Minimum trust in a cell's counts. Vehicles that report falsely in one cell only make that cell's
/// counts look wrong.
const MIN_WORD_TRUST: f64 = 0.5;

/// Maximum number of cells about one vehicle; the cells with most votes are kept.
const MAX_CELLS_EACH: usize = 16;

/// Maximum number of vehicles.
pub const MAX_FOREIGN_VEHICLES: usize = 1024;

/// A cell's counts about one vehicle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellCounts {
    /// Time of the last reset of the cell's evidence; 0 without a reset.
    #[serde(default)]
    pub reset_at: Timestamp,
    /// All votes since.
    pub all: Counts,
    /// Votes that the cell has already dropped.
    #[serde(default)]
    pub old: Counts,
}

impl CellCounts {
    /// Takes over values that are later or larger; returns true if that changed any.
    pub fn merge(&mut self, other: Self) -> bool {
        let before = *self;
        if other.reset_at > self.reset_at {
            *self = other;
        } else if other.reset_at == self.reset_at {
            self.all.merge(other.all);
            self.old.merge(other.old);
        }
        *self != before
    }

    /// The votes that the cell still keeps.
    pub fn remembered(&self) -> Counts {
        self.all.minus(self.old)
    }

    /// The votes after `before`, an earlier state of the same counts. The oldest votes are dropped
    /// first.
    pub fn since(&self, before: Self) -> Self {
        Self {
            all: self.all.minus(before.all),
            old: self.old.minus(before.all),
            ..*self
        }
    }

    /// These counts and `later` votes after the same reset.
    pub fn plus(&self, later: Self) -> Self {
        Self {
            all: self.all.plus(later.all),
            old: self.old.plus(later.old),
            ..*self
        }
    }

    /// The message of a cell about a vehicle.
    pub fn message(&self, cell: NodeName, vehicle: NodeName) -> CellReputation {
        let Self { reset_at, all, old } = *self;
        CellReputation {
            schema: SCHEMA_VERSION,
            cell,
            vehicle,
            correct: all.correct,
            incorrect: all.incorrect,
            old_correct: old.correct,
            old_incorrect: old.incorrect,
            reset_at_us: (reset_at > Timestamp::default()).then_some(reset_at),
        }
    }
}

impl From<&CellReputation> for CellCounts {
    fn from(message: &CellReputation) -> Self {
        Self {
            reset_at: message.reset_at_us.unwrap_or_default(),
            all: Counts {
                correct: message.correct,
                incorrect: message.incorrect,
            },
            old: Counts {
                correct: message.old_correct,
                incorrect: message.old_incorrect,
            },
        }
    }
}

/// Counts of other cells, and the trust in these cells.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForeignReputations {
    /// By vehicle and cell.
    counts: BTreeMap<NodeName, BTreeMap<NodeName, CellCounts>>,
    /// Trust, 0 to 1, in cells whose counts this cell's own evidence contradicts.
    word_trust: BTreeMap<NodeName, f64>,
}

impl ForeignReputations {
    /// Merges a cell's counts about a vehicle; returns true if that changed the state. Counts
    /// beyond the maxima are left out.
    pub fn merge(&mut self, cell: &NodeName, vehicle: &NodeName, counts: CellCounts) -> bool {
        if self.counts.len() >= MAX_FOREIGN_VEHICLES && !self.counts.contains_key(vehicle) {
            return false;
        }
        let cells = self.counts.entry(vehicle.clone()).or_default();
        let is_news = cells.entry(cell.clone()).or_default().merge(counts);
        if cells.len() > MAX_CELLS_EACH {
            // Totals only grow, so that the result does not depend on the order of messages.
            let least = cells
                .iter()
                .min_by_key(|(cell, counts)| (counts.all.total(), (*cell).clone()));
            if let Some(least) = least.map(|(cell, _)| cell.clone()) {
                cells.remove(&least);
                return is_news && least != *cell;
            }
        }
        is_news
    }

    /// Removes vehicles for which `is_wanted` is false; returns true if there were any.
    pub fn retain(&mut self, mut is_wanted: impl FnMut(&NodeName) -> bool) -> bool {
        let before = self.counts.len();
        self.counts.retain(|vehicle, _| is_wanted(vehicle));
        self.counts.len() < before
    }

    /// True if a cell has counts about a vehicle.
    pub fn has(&self, cell: &NodeName, vehicle: &NodeName) -> bool {
        self.counts
            .get(vehicle)
            .is_some_and(|cells| cells.contains_key(cell))
    }

    /// The cells with counts.
    pub fn cells(&self) -> BTreeSet<&NodeName> {
        self.counts.values().flat_map(BTreeMap::keys).collect()
    }

    /// Compares every cell's counts with the own kept votes about the same vehicles; returns true
    /// if that changes any weight. One contradiction among n compared vehicles reduces the trust by
    /// 1/(n + 2); at least a half remains.
    pub fn judge(&mut self, own: impl Fn(&NodeName) -> Option<Counts>) -> bool {
        let mut judged = BTreeMap::<&NodeName, [f64; 2]>::new();
        for (vehicle, cells) in &self.counts {
            let Some(own) = own(vehicle).filter(|own| own.total() >= MIN_OWN_VOTES) else {
                continue;
            };
            let said = cells
                .iter()
                .map(|(cell, counts)| (cell, counts.remembered()));
            for (cell, said) in said.filter(|(_, said)| said.total() >= MIN_JUDGED_VOTES) {
                let [contradicted, all] = judged.entry(cell).or_default();
                *contradicted +=
                    f64::from(u8::from((said.share() - own.share()).abs() > CONTRADICTION));
                *all += 1.0;
            }
        }
        let contradicted = judged
            .into_iter()
            .filter(|(_, [contradicted, _])| *contradicted > 0.0);
        let trust =
            |[contradicted, all]: [f64; 2]| (1.0 - contradicted / (all + 2.0)).max(MIN_WORD_TRUST);
        let word_trust = contradicted
            .map(|(cell, counts)| (cell.clone(), trust(counts)))
            .collect();
        let is_news = self.word_trust != word_trust;
        self.word_trust = word_trust;
        is_news
    }

    /// Every vehicle's votes in addition to a prior of this weight in votes; `trust` in each cell's
    /// map is 0 to 1.
    pub fn votes(
        &self,
        prior_votes: f64,
        trust: impl Fn(&NodeName) -> f64,
    ) -> BTreeMap<NodeName, ForeignVotes> {
        let of_vehicle = |(vehicle, cells): (&NodeName, &BTreeMap<NodeName, CellCounts>)| {
            let mut sum = ForeignVotes::default();
            for (cell, counts) in cells {
                let Counts { correct, incorrect } = counts.remembered();
                let votes = (correct as f64 + incorrect as f64).max(1.0);
                let trust = trust(cell)
                    .min(self.word_trust.get(cell).copied().unwrap_or(1.0))
                    .clamp(0.0, 1.0);
                let weight = trust * DISCOUNT.min(MAX_SHARE_EACH * prior_votes / votes);
                sum.correct += weight * correct as f64;
                sum.incorrect += weight * incorrect as f64;
            }
            let kept = (MAX_SHARE * prior_votes / sum.total().max(f64::MIN_POSITIVE)).min(1.0);
            (
                vehicle.clone(),
                ForeignVotes {
                    correct: kept * sum.correct,
                    incorrect: kept * sum.incorrect,
                },
            )
        };
        self.counts
            .iter()
            .map(of_vehicle)
            .filter(|(_, votes)| votes.total() > 0.0)
            .collect()
    }
}
