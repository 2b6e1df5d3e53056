//! How much vehicles differ in the labels that they prefer, and how much therefore speaks for a
//! confusion matrix of each vehicle.
//!
//! Whether a vehicle is right equally often on every class, or on some classes more often, cannot
//! be read from estimates of the truth: a model with classes fits votes better even if its classes
//! are not the true ones. A difference between vehicles that answer about the same landmarks needs
//! no truth. The bias of a vehicle towards a label is the mean of [it states the label] − (share of
//! the label among the other votes on the landmark). Its variance between vehicles is estimated by
//! the method of moments without the part that chance explains (random effects; DerSimonian & Laird
//! 1986), and divided by the label's share and summed over labels, which makes it Pearson's φ² of
//! vehicles and labels. The weight of confusion matrices is 1 − (φ₀/φ)⁴, at least 0. It is the
//! positive-part shrinkage of James & Stein (1961) of φ², and close to a choice between two models
//! without its jump.

use std::collections::{BTreeMap, BTreeSet};

use super::confusion::LabelIndex;

/// φ₀: the contingency of vehicles and labels up to which one accuracy per vehicle describes them
/// better than a confusion matrix that is estimated from votes.
const TOLERATED_PHI: f64 = 0.22;

/// Fading sums of one vehicle over its votes that could be compared.
#[derive(Debug, Clone, Default)]
struct Preferences {
    votes: f64,
    /// Sum of the squares of the votes' weights.
    squares: f64,
    labels: BTreeMap<LabelIndex, LabelSums>,
}

/// Sums over a vehicle's votes on landmarks where it or another stated a label.
#[derive(Debug, Clone, Copy, Default)]
struct LabelSums {
    /// Votes for the label.
    stated: f64,
    /// Deviations of its votes from the share of the others' votes.
    deviation: f64,
    /// Squares of the deviations.
    squares: f64,
}

impl Preferences {
    /// Adds a vote; `own` is 1 if it is for the label, else 0.
    fn add(&mut self, label: LabelIndex, own: f64, share_of_others: f64) {
        let sums = self.labels.entry(label).or_default();
        let deviation = own - share_of_others;
        sums.stated += own;
        sums.deviation += deviation;
        sums.squares += deviation * deviation;
    }

    fn fade(&mut self, factor: f64) {
        self.votes *= factor;
        self.squares *= factor * factor;
        for sums in self.labels.values_mut() {
            sums.stated *= factor;
            sums.deviation *= factor;
            sums.squares *= factor * factor;
        }
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

/// The preferences of all vehicles.
#[derive(Debug, Clone, Default)]
pub(super) struct LabelBias {
    /// Votes over which preferences fade to 1/e.
    memory_votes: f64,
    /// By index of the vehicle.
    vehicles: Vec<Preferences>,
    /// The same by the ledger of other aggregators.
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

    /// Applies another memory.
    pub(super) fn configure(&mut self, memory_votes: f64) {
        self.memory_votes = memory_votes;
    }

    /// Counts the new votes (vehicle, label, is new) on a landmark against all others there.
    pub(super) fn compare(&mut self, votes: &[(usize, LabelIndex, bool)]) {
        if votes.len() < 2 {
            return;
        }
        let mut stated: BTreeMap<LabelIndex, f64> = BTreeMap::new();
        for (_, label, _) in votes {
            *stated.entry(*label).or_default() += 1.0;
        }
        let others = (votes.len() - 1) as f64;
        let fade = 1.0 - 1.0 / self.memory_votes;
        for &(vehicle, stated_label, _) in votes.iter().filter(|(.., is_new)| *is_new) {
            if self.vehicles.len() <= vehicle {
                self.vehicles.resize(vehicle + 1, Preferences::default());
            }
            let preferences = &mut self.vehicles[vehicle];
            preferences.fade(fade);
            preferences.votes += 1.0;
            preferences.squares += 1.0;
            for (&label, &count) in &stated {
                let own = f64::from(u8::from(label == stated_label));
                preferences.add(label, own, (count - own) / others);
            }
            self.since += 1;
        }
    }

    /// Replaces what a ledger says about a vehicle: right and wrong votes by stated label. The
    /// truth behind a wrong vote is any other label with equal probability.
    pub(super) fn inherit(&mut self, vehicle: usize, labels: &[(LabelIndex, f64, f64)]) {
        if self.inherited.len() <= vehicle {
            self.inherited.resize(vehicle + 1, Preferences::default());
        }
        let votes: f64 = labels.iter().map(|(_, right, wrong)| right + wrong).sum();
        let incorrect: f64 = labels.iter().map(|(.., wrong)| wrong).sum();
        let others = labels.len().saturating_sub(1).max(1) as f64;
        let of_label = |&(label, right, wrong): &(LabelIndex, f64, f64)| {
            let missed = (incorrect - wrong) / others;
            let sums = LabelSums {
                stated: right + wrong,
                deviation: wrong - missed,
                squares: wrong + missed,
            };
            (label, sums)
        };
        self.inherited[vehicle] = Preferences {
            votes,
            squares: votes,
            labels: labels.iter().map(of_label).collect(),
        };
        self.since = self.since.max(self.read);
    }

    /// Clears what ledgers say.
    pub(super) fn clear_inherited(&mut self) {
        self.inherited.clear();
        self.since = self.since.max(self.read);
    }

    /// Removes vehicles, whose indices may be reused.
    pub(super) fn forget(&mut self, vehicles: &BTreeSet<usize>) {
        for &vehicle in vehicles {
            for preferences in [&mut self.vehicles, &mut self.inherited] {
                if let Some(preferences) = preferences.get_mut(vehicle) {
                    *preferences = Preferences::default();
                }
            }
        }
    }

    /// Removes labels, whose indices may be reused.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        for preferences in self.vehicles.iter_mut().chain(&mut self.inherited) {
            preferences
                .labels
                .retain(|label, _| !labels.contains(label));
        }
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

    fn phi_squared(&mut self) -> f64 {
        let mut read = 0;
        // Votes for each label, and the variance of the bias towards it.
        let mut labels: BTreeMap<LabelIndex, (f64, f64)> = BTreeMap::new();
        for preferences in self.vehicles.iter().chain(&self.inherited) {
            read += preferences.labels.len();
            for (&label, &sums) in &preferences.labels {
                let (stated, variance) = labels.entry(label).or_default();
                *stated += sums.stated;
                *variance += preferences.weighted_variance(sums);
            }
        }
        self.read = read;
        // The share of a label is `stated / votes`, the variance of a bias `variance / votes`.
        labels
            .values()
            .filter(|(stated, _)| *stated > 0.0)
            .map(|(stated, variance)| variance / stated)
            .sum()
    }
}
