//! Which vehicles agree with one another more than their reliability explains.
//!
//! Honest vehicles agree because they see the same truth. If what they say depends on each other through the truth
//! alone, the chance-corrected agreement κ (Cohen 1960, with the cell's shares of labels as chance) of two vehicles is
//! the product r_i · r_j of what each shares with the truth: the one-factor model of Spearman (1904), which needs no
//! truth. Agreement beyond it means that one copies the other or that both err for the same reason (Dong,
//! Berti-Équille & Srivastava 2009), and ρ = (κ − r_i r_j) / (1 − r_i r_j) is the part of a vote that is not its own.
//!
//! Two groups that contradict each other could each be the honest one. The group that more *vehicles* belong to is
//! taken for it, however closely the others agree: that is what bounds the number of liars at fewer than half.

use std::collections::{BTreeMap, BTreeSet};

use super::confusion::LabelIndex;

/// Most others on a landmark that a vote is compared with; bounds the cost of a vote.
const MOST_COMPARED: usize = 8;
/// The same over stored votes.
const MOST_COMPARED_STORED: usize = 32;
/// Standard deviations by which agreement must exceed what is explained.
const SIGNIFICANCE: f64 = 4.0;
/// The same over stored votes: all of a pair's count, and many pairs are tested at once (one in 3 million by chance).
const SIGNIFICANCE_STORED: f64 = 5.0;
/// Agreement κ from which two vehicles belong to one group as much as they can: more closeness earns no more say.
const SAME_GROUP: f64 = 0.3;
/// Weight, in comparisons, of doubt about two vehicles' agreement and of the typical reliability against a vehicle's.
const PRIOR_COMPARISONS: f64 = 10.0;
/// Votes after which a vehicle has half a say in which group is the main one; bounds what new names gain.
const TENURE_VOTES: f64 = 50.0;
const GROUPING_STEPS: u32 = 30;
const FACTOR_STEPS: u32 = 15;
/// Comparisons after which the shares of the labels count half.
const SHARES_MEMORY: f64 = 10_000.0;

/// Fading counts of how often two vehicles voted on the same landmark and agreed.
#[derive(Debug, Clone, Copy, Default)]
struct Pair {
    met: f64,
    agreed: f64,
    /// Agreements expected by chance.
    chance: f64,
}

impl Pair {
    fn kappa(&self) -> f64 {
        ((self.agreed - self.chance) / (self.met - self.chance).max(1e-9)).clamp(-1.0, 1.0)
    }

    /// The part ρ of a vote that is not its own where κ = `explained` is expected.
    fn excess(&self, explained: f64, significance: f64) -> f64 {
        let expected = self.chance + (self.met - self.chance) * explained;
        let deviation = (expected * (1.0 - expected / self.met).max(0.0) + 1.0).sqrt();
        if self.agreed - expected > significance * deviation {
            ((self.kappa() - explained) / (1.0 - explained)).clamp(0.0, 1.0)
        } else {
            0.0
        }
    }
}

/// What a fit came to: vehicles by group.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Groups {
    /// Surely in the largest group that agrees.
    pub(super) main: Vec<usize>,
    /// Outside it, with a voice that is at most half their own.
    pub(super) copies: Vec<usize>,
}

/// Pairwise agreement of vehicles and what follows from it.
#[derive(Debug, Clone)]
pub(super) struct Dependence {
    memory: f64,
    most_compared: usize,
    significance: f64,
    pairs: BTreeMap<(usize, usize), Pair>,
    stated: Vec<f64>,
    total: f64,
    squares: f64,
    compared: usize,
    /// By vehicle, votes that were compared.
    tenure: Vec<f64>,
    /// By vehicle, those that it depends on or that depend on it, with ρ.
    partners: Vec<Vec<(usize, f64)>>,
}

impl Dependence {
    /// Nothing known; the counts of a pair fade over `memory` comparisons to 1/e.
    pub(super) fn new(memory: f64) -> Self {
        Self {
            memory,
            most_compared: MOST_COMPARED,
            significance: SIGNIFICANCE,
            pairs: BTreeMap::new(),
            stated: Vec::new(),
            total: 0.0,
            squares: 0.0,
            compared: 0,
            tenure: Vec::new(),
            partners: Vec::new(),
        }
    }

    /// As [`Self::new`], for all stored votes together: nothing fades.
    pub(super) fn of_stored() -> Self {
        let (most_compared, significance) = (MOST_COMPARED_STORED, SIGNIFICANCE_STORED);
        Self { most_compared, significance, ..Self::new(f64::INFINITY) }
    }

    /// Forgets vehicles; their numbers may stand for others from now on.
    pub(super) fn forget(&mut self, vehicles: &BTreeSet<usize>) {
        self.pairs.retain(|(one, other), _| !vehicles.contains(one) && !vehicles.contains(other));
        self.partners.iter_mut().for_each(|partners| partners.retain(|(other, _)| !vehicles.contains(other)));
        for &vehicle in vehicles {
            self.tenure.get_mut(vehicle).into_iter().for_each(|tenure| *tenure = 0.0);
            self.partners.get_mut(vehicle).into_iter().for_each(Vec::clear);
        }
    }

    /// Forgets how often labels were stated; their numbers may stand for others from now on.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        for &label in labels {
            let Some(stated) = self.stated.get_mut(usize::from(label)).map(std::mem::take) else { continue };
            self.total -= stated;
            self.squares -= stated * stated;
        }
    }

    /// Compares the votes on a landmark, (vehicle, label, whether new) in any fixed order, where one of a pair is new.
    pub(super) fn compare(&mut self, votes: &[(usize, LabelIndex, bool)]) {
        for &(vehicle, _, is_new) in votes {
            if self.tenure.len() <= vehicle {
                self.tenure.resize(vehicle + 1, 0.0);
            }
            self.tenure[vehicle] += f64::from(is_new);
        }
        let distances = votes.len() / 2;
        for step in 0..distances.min(self.most_compared) {
            let distance = 1 + (self.compared / votes.len() + step) % distances;
            let half_turn = 2 * distance == votes.len();
            for place in 0..if half_turn { distance } else { votes.len() } {
                let (one, other) = (votes[place], votes[(place + distance) % votes.len()]);
                if one.2 || other.2 {
                    self.meet((one.0, one.1), (other.0, other.1));
                }
            }
        }
    }

    fn meet(&mut self, one: (usize, LabelIndex), other: (usize, LabelIndex)) {
        self.state(one.1);
        self.state(other.1);
        let chance = self.squares / (self.total * self.total);
        let fade = 1.0 - 1.0 / self.memory;
        let pair = self.pairs.entry((one.0.min(other.0), one.0.max(other.0))).or_default();
        pair.met = pair.met * fade + 1.0;
        pair.agreed = pair.agreed * fade + f64::from(one.1 == other.1);
        pair.chance = pair.chance * fade + chance;
        self.compared += 1;
    }

    fn state(&mut self, label: LabelIndex) {
        let label = usize::from(label);
        if self.stated.len() <= label {
            self.stated.resize(label + 1, 0.0);
        }
        if self.total >= SHARES_MEMORY {
            self.stated.iter_mut().for_each(|n| *n /= 2.0);
            (self.total, self.squares) = (self.total / 2.0, self.squares / 4.0);
        }
        self.squares += 2.0 * self.stated[label] + 1.0;
        self.stated[label] += 1.0;
        self.total += 1.0;
    }

    /// Part of each vote that is the vehicle's own where `vehicles` state the same label: 1 / (1 + Σ ρ), the design
    /// effect of correlated answers (Kish 1965).
    pub(super) fn own_part(&self, vehicle: usize, others: impl Fn(usize) -> bool) -> f64 {
        let partners = self.partners.get(vehicle).map_or(&[][..], Vec::as_slice);
        let shared: f64 = partners.iter().filter(|(other, _)| others(*other)).map(|(_, rho)| rho).sum();
        1.0 / (1.0 + shared)
    }

    /// Whether enough has been compared since the last fit that the next one costs no more than the comparisons.
    pub(super) fn is_due(&self) -> bool {
        self.compared >= self.pairs.len().max(64)
    }

    /// Finds the dependent pairs anew; the main group is sought among those that are `present`.
    pub(super) fn fit(&mut self, present: &[bool]) -> Groups {
        self.compared = 0;
        let vehicles = present.len();
        let say = |vehicle: usize| {
            let tenure = self.tenure.get(vehicle).copied().unwrap_or(0.0);
            if present[vehicle] { tenure / (tenure + TENURE_VOTES) } else { 0.0 }
        };
        let says: Vec<f64> = (0..vehicles).map(say).collect();
        let pairs: Vec<_> = self.pairs.iter().map(|(&(one, other), &pair)| (one, other, pair)).collect();
        let belonging = main_group(&says, &pairs);
        let mut rhos = vec![0.0; pairs.len()];
        let mut factors = vec![0.5; vehicles];
        for _ in 0..FACTOR_STEPS {
            factors = next_factors(&factors, &belonging, &pairs, &rhos);
            for (rho, (one, other, pair)) in rhos.iter_mut().zip(&pairs) {
                *rho = pair.excess(factors[*one] * factors[*other], self.significance);
            }
        }
        self.partners = vec![Vec::new(); vehicles];
        for ((one, other, _), rho) in pairs.into_iter().zip(rhos).filter(|(_, rho)| *rho > 0.0) {
            self.partners[one].push((other, rho));
            self.partners[other].push((one, rho));
        }
        let is_copy = |v: usize| present[v] && belonging[v] < 0.1 && self.own_part(v, |other| present[other]) <= 0.5;
        Groups {
            main: (0..vehicles).filter(|&v| belonging[v] >= 0.5).collect(),
            copies: (0..vehicles).filter(|&v| is_copy(v)).collect(),
        }
    }
}

/// How far each vehicle, 0 to 1, belongs to the largest group of vehicles that agree: a dominant set (Pavan & Pelillo
/// 2007) by power iteration without negative parts.
fn main_group(says: &[f64], pairs: &[(usize, usize, Pair)]) -> Vec<f64> {
    let mut belonging = says.to_vec();
    for _ in 0..GROUPING_STEPS {
        let mut support = vec![0.0; says.len()];
        for (one, other, pair) in pairs {
            let affinity = (pair.kappa() / SAME_GROUP).clamp(-1.0, 1.0) * pair.met / (pair.met + PRIOR_COMPARISONS);
            support[*one] += affinity * belonging[*other];
            support[*other] += affinity * belonging[*one];
        }
        let most = support.iter().copied().fold(0.0, f64::max);
        if most <= 0.0 {
            break;
        }
        belonging = support.iter().zip(says).map(|(s, say)| say * s.max(0.0) / most).collect();
    }
    belonging
}

/// One step of alternating least squares for κ = r_i · r_j over agreement with the main group that is not excessive.
fn next_factors(factors: &[f64], belonging: &[f64], pairs: &[(usize, usize, Pair)], rhos: &[f64]) -> Vec<f64> {
    let members: f64 = belonging.iter().sum();
    let typical = factors.iter().zip(belonging).map(|(r, b)| r * b).sum::<f64>() / members.max(1e-9);
    let prior = PRIOR_COMPARISONS * typical * typical;
    let mut sums = vec![(prior * typical, prior); factors.len()];
    for ((one, other, pair), rho) in pairs.iter().zip(rhos) {
        for (vehicle, reference) in [(*one, *other), (*other, *one)] {
            let weight = belonging[reference] * pair.met * (1.0 - rho);
            sums[vehicle].0 += weight * pair.kappa() * factors[reference];
            sums[vehicle].1 += weight * factors[reference] * factors[reference];
        }
    }
    sums.into_iter().map(|(product, square)| (product / square.max(1e-9)).clamp(0.0, 0.99)).collect()
}
