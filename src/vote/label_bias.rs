//! How much vehicles differ in the labels that they prefer, and how much this supports a confusion
//! matrix of each vehicle.
//!
//! Whether a vehicle is right equally often on every class, or on some classes more often, cannot
//! be read from verdicts: a model with classes can predict votes better even if its classes are not
//! the true ones. A difference between vehicles that vote on the same landmarks needs no verdict.
//! The bias of a vehicle towards a label is the mean of [it states the label] − (share of the label
//! among the other votes on the landmark). Its variance between vehicles is estimated by the method
//! of moments without the part that chance explains (random effects; DerSimonian & Laird 1986),
//! divided by the label's share and summed over labels. The result resembles Pearson's φ² of
//! vehicles and labels; it is larger where few vote on a landmark. The weight of confusion matrices
//! is 1 − (φ₀/φ)⁴, at least 0. The form is that of James & Stein's (1961) positive-part shrinkage;
//! the weight rises steeply above φ₀, but without a jump.
//!
//! Votes count as independent, also repeated ones on a landmark that stays: a vehicle that misreads
//! one landmark for long has a bias. The counts of a ledger enter, too; they come from verdicts.

use std::collections::{BTreeMap, BTreeSet};

use super::dependence::ComparedVote;
use super::index_map::{LabelIndex, LabelMap};
use super::parameters::TOLERATED_PHI;

/// Fading sums of one vehicle over its votes that could be compared.
#[derive(Debug, Clone, Default)]
struct Preferences {
    votes: f64,
    /// Sum of the squares of the votes' weights.
    squares: f64,
    labels: LabelMap<LabelSums>,
}

/// Least sum of shares that is kept.
const MIN_SHARE: f64 = 1e-6;

/// Sums over a vehicle's votes on landmarks where it or another stated a label.
#[derive(Debug, Clone, Copy, Default)]
struct LabelSums {
    /// Shares of the label, each the mean of the vehicle's own vote (0 or 1) and of the others'
    /// share.
    share: f64,
    /// Deviations of its votes from the share of the others' votes.
    deviation: f64,
    /// Squares of the deviations.
    squares: f64,
}

impl Preferences {
    /// Adds a vote; `own` is 1 if it is for the label, else 0.
    fn add(&mut self, label: LabelIndex, own: f64, share_of_others: f64) {
        let sums = self.labels.entry(label);
        let deviation = own - share_of_others;
        sums.share += (own + share_of_others) / 2.0;
        sums.deviation += deviation;
        sums.squares += deviation * deviation;
    }

    /// Reduces the weight of all earlier votes by `factor`, and drops labels whose share has become
    /// negligible.
    fn fade(&mut self, factor: f64) {
        self.votes *= factor;
        self.squares *= factor * factor;
        for sums in self.labels.values_mut() {
            sums.share *= factor;
            sums.deviation *= factor;
            sums.squares *= factor * factor;
        }
        self.labels.retain(|_, sums| sums.share > MIN_SHARE);
    }

    /// The mean square of the vehicle's bias towards a label, times its votes: chance cancels in the
    /// products of different votes.
    fn weighted_variance(&self, sums: LabelSums) -> f64 {
        let pairs = self.votes * self.votes - self.squares;
        if pairs > 1e-9 {
            self.votes * (sums.deviation * sums.deviation - sums.squares) / pairs
        } else {
            0.0
        }
    }
}

/// A vehicle's right and wrong votes for one label, according to a ledger.
#[derive(Debug, Clone, Copy)]
pub(super) struct LabelRecord {
    pub(super) label: LabelIndex,
    pub(super) right: f64,
    pub(super) wrong: f64,
}

/// The preferences of all vehicles.
#[derive(Debug, Clone, Default)]
pub(super) struct LabelBias {
    /// Votes over which preferences fade to 1/e.
    memory_votes: f64,
    /// By index of the vehicle.
    vehicles: Vec<Preferences>,
    /// Preferences according to the ledger of other aggregators, by index of the vehicle.
    inherited: Vec<Preferences>,
    /// Votes since [`Self::class_weight`] was last computed, and sums that it then read.
    since: usize,
    read: usize,
    class_weight: f64,
}

impl LabelBias {
    /// Without votes; preferences fade over `memory_votes` to 1/e.
    pub(super) fn new(memory_votes: f64) -> Self {
        Self {
            memory_votes,
            ..Self::default()
        }
    }

    pub(super) fn configure(&mut self, memory_votes: f64) {
        self.memory_votes = memory_votes;
    }

    /// Counts the new votes on a landmark against all others there.
    pub(super) fn compare(&mut self, votes: &[ComparedVote]) {
        if votes.len() < 2 {
            return;
        }
        let mut stated: LabelMap<f64> = LabelMap::default();
        for vote in votes {
            *stated.entry(vote.label) += 1.0;
        }
        let others = (votes.len() - 1) as f64;
        let fade = 1.0 - 1.0 / self.memory_votes;
        for vote in votes.iter().filter(|vote| vote.is_new) {
            let vehicle = vote.vehicle;
            if self.vehicles.len() <= vehicle {
                self.vehicles.resize(vehicle + 1, Preferences::default());
            }
            let preferences = &mut self.vehicles[vehicle];
            preferences.fade(fade);
            if let Some(inherited) = self.inherited.get_mut(vehicle) {
                inherited.fade(fade);
            }
            preferences.votes += 1.0;
            preferences.squares += 1.0;
            for (label, &count) in stated.iter() {
                let own = f64::from(u8::from(label == vote.label));
                preferences.add(label, own, (count - own) / others);
            }
            self.since += 1;
        }
    }

    /// Replaces the counts of a ledger about a vehicle: right and wrong votes by stated label. The
    /// truth behind a wrong vote is any other label with equal probability.
    pub(super) fn inherit(&mut self, vehicle: usize, records: &[LabelRecord]) {
        if self.inherited.len() <= vehicle {
            self.inherited.resize(vehicle + 1, Preferences::default());
        }
        let incorrect: f64 = records.iter().map(|record| record.wrong).sum();
        let votes = incorrect + records.iter().map(|record| record.right).sum::<f64>();
        let others = records.len().saturating_sub(1).max(1) as f64;
        let sums_of = |record: &LabelRecord| {
            let missed = (incorrect - record.wrong) / others;
            let sums = LabelSums {
                share: record.right + (record.wrong + missed) / 2.0,
                deviation: record.wrong - missed,
                squares: record.wrong + missed,
            };
            (record.label, sums)
        };
        self.inherited[vehicle] = Preferences {
            votes,
            squares: votes,
            labels: records.iter().map(sums_of).collect(),
        };
        self.since = self.since.max(self.read);
    }

    /// Removes the counts of ledgers.
    pub(super) fn clear_inherited(&mut self) {
        self.inherited.clear();
        self.since = self.since.max(self.read);
    }

    /// Removes vehicles, whose indices may be reused.
    pub(super) fn remove_vehicles(&mut self, vehicles: &BTreeSet<usize>) {
        for &vehicle in vehicles {
            for preferences in [&mut self.vehicles, &mut self.inherited] {
                if let Some(preferences) = preferences.get_mut(vehicle) {
                    *preferences = Preferences::default();
                }
            }
        }
        self.since = self.since.max(self.read);
    }

    /// Removes labels, whose indices may be reused.
    pub(super) fn remove_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        for preferences in self.vehicles.iter_mut().chain(&mut self.inherited) {
            preferences
                .labels
                .retain(|label, _| !labels.contains(&label));
        }
        self.since = self.since.max(self.read);
    }

    /// Weight, 0 to 1, of a vehicle's confusion matrix against one accuracy for all classes. It is
    /// computed anew when there are as many new votes as sums to read.
    pub(super) fn class_weight(&mut self) -> f64 {
        if self.since > 0 && self.since >= self.read {
            self.since = 0;
            let tolerated = TOLERATED_PHI.powi(2) / self.phi_squared().max(1e-9);
            self.class_weight = (1.0 - tolerated.powi(2)).max(0.0);
        }
        self.class_weight
    }

    /// Sum over all labels of the variance of the vehicles' bias, relative to the share of the
    /// label: φ² of the votes. It is about 0 if all vehicles make the same errors.
    fn phi_squared(&mut self) -> f64 {
        let mut read = 0;
        // Sums of the shares of each label, and of the variances of the bias towards it.
        let mut labels: BTreeMap<LabelIndex, (f64, f64)> = BTreeMap::new();
        for preferences in self.vehicles.iter().chain(&self.inherited) {
            read += preferences.labels.len();
            for (label, &sums) in preferences.labels.iter() {
                let (share, variance) = labels.entry(label).or_default();
                *share += sums.share;
                *variance += preferences.weighted_variance(sums);
            }
        }
        self.read = read;
        // Both are sums over the same votes, so that the number of votes cancels.
        labels
            .values()
            .filter(|(share, _)| *share > MIN_SHARE)
            .map(|(share, variance)| variance / share)
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MEMORY_VOTES: f64 = 500.0;

    /// Counts a landmark with the votes of the vehicles 0, 1, 2, …
    fn compare(bias: &mut LabelBias, labels: &[LabelIndex]) {
        let votes: Vec<_> = labels
            .iter()
            .enumerate()
            .map(|(vehicle, &label)| ComparedVote {
                vehicle,
                label,
                is_new: true,
            })
            .collect();
        bias.compare(&votes);
    }

    #[test]
    fn common_errors_need_no_matrices() {
        let mut bias = LabelBias::new(MEMORY_VOTES);
        for landmark in 0..400u16 {
            let truth = landmark % 2;
            let votes: Vec<_> = (0..5)
                .map(|vehicle| truth * u16::from((landmark / 2 + 7 * vehicle) % 4 != 0))
                .collect();
            compare(&mut bias, &votes);
        }
        assert!(bias.class_weight() < 0.1, "{}", bias.class_weight());
    }

    #[test]
    fn opposite_preferences_need_matrices() {
        let mut bias = LabelBias::new(MEMORY_VOTES);
        for landmark in 0..400u16 {
            let truth = landmark % 2;
            let is_hard = (landmark / 2) % 2 == 0;
            let likes = |label| if is_hard { label } else { truth };
            compare(&mut bias, &[likes(0), likes(1), truth, likes(0), likes(1)]);
        }
        assert!(bias.class_weight() > 0.9, "{}", bias.class_weight());
    }

    #[test]
    fn silent_vehicles_leave_no_bias() {
        let mut bias = LabelBias::new(MEMORY_VOTES);
        for landmark in 0..300u16 {
            let truth = landmark % 2;
            let first = if landmark % 100 == 0 { 2 } else { truth };
            compare(&mut bias, &[first, truth, truth]);
        }
        for landmark in 0..8000u16 {
            let vote = |vehicle, is_new| ComparedVote {
                vehicle,
                label: landmark % 2,
                is_new,
            };
            bias.compare(&[vote(0, true), vote(1, false)]);
        }
        assert!(bias.class_weight() < 0.1, "{}", bias.class_weight());
    }
}
