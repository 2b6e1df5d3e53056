//! Dependence between vehicles: pairs that agree more often than their reliability explains.
//!
//! Honest vehicles agree because they see the same truth. If their votes depend on each other
//! through the truth alone, the chance-corrected agreement κ of two vehicles is the product r_i ·
//! r_j of their agreements with the truth. This is the one-factor model of Spearman (1904), which
//! needs no truth; κ is Cohen's (1960), with the cell's shares of labels as chance. More agreement
//! means that one vehicle copies the other or that both err for the same reason (Dong,
//! Berti-Équille & Srivastava 2009). ρ = (κ − r_i r_j) / (1 − r_i r_j) is the part of a vote that
//! is not its own.
//!
//! Of two groups that contradict each other, either could be the honest one. The group of more
//! *vehicles* is assumed to be honest, however closely the others agree. The method therefore
//! withstands malicious vehicles only if they are fewer than half.

use std::collections::BTreeSet;

use super::index_map::{IndexMap, LabelIndex};
use super::parameters::{
    ITERATIONS, LONG_MEMORY, MAX_COMPARED, PRIOR_COMPARISONS, SAME_GROUP, SELF_SUPPORT,
    SIGNIFICANCE, TENURE_VOTES,
};

/// A vote that is compared with the other votes on its landmark.
#[derive(Debug, Clone, Copy)]
pub(super) struct ComparedVote {
    pub(super) vehicle: usize,
    pub(super) label: LabelIndex,
    /// Whether it has not been compared before.
    pub(super) is_new: bool,
}

/// Fading counts of how often two vehicles voted on the same landmark and agreed.
#[derive(Debug, Clone, Copy, Default)]
struct Pair {
    compared: f64,
    agreed: f64,
    /// Agreements expected by chance.
    chance: f64,
}

impl Pair {
    fn kappa(&self) -> f64 {
        ((self.agreed - self.chance) / (self.compared - self.chance).max(1e-9)).clamp(-1.0, 1.0)
    }

    /// The dependent part ρ of a vote, where κ = `explained` is expected of independent vehicles.
    fn excess(&self, explained: f64) -> f64 {
        let expected = self.chance + (self.compared - self.chance) * explained;
        let deviation = (expected * (1.0 - expected / self.compared).max(0.0) + 1.0).sqrt();
        if self.agreed - expected > SIGNIFICANCE * deviation {
            ((self.kappa() - explained) / (1.0 - explained)).clamp(0.0, 1.0)
        } else {
            0.0
        }
    }
}

/// Pairs of vehicles by the lower index of both, then by the higher one.
#[derive(Debug, Clone, Default)]
struct Pairs(Vec<IndexMap<u32, Pair>>);

impl Pairs {
    fn entry(&mut self, one: usize, other: usize) -> &mut Pair {
        let lower = one.min(other);
        if self.0.len() <= lower {
            self.0.resize_with(lower + 1, IndexMap::default);
        }
        self.0[lower].entry(one.max(other) as u32)
    }

    /// Both vehicles of each pair and the pair, in order of the vehicles.
    fn iter(&self) -> impl Iterator<Item = (usize, usize, &Pair)> {
        (0..).zip(&self.0).flat_map(|(one, pairs)| {
            let pairs = pairs.iter();
            pairs.map(move |(other, pair)| (one, other as usize, pair))
        })
    }

    fn remove_vehicles(&mut self, vehicles: &BTreeSet<usize>) {
        for (one, pairs) in self.0.iter_mut().enumerate() {
            let is_gone = |other| vehicles.contains(&one) || vehicles.contains(&(other as usize));
            pairs.retain(|other, _| !is_gone(other));
        }
    }
}

/// Vehicles by group, the result of a fit.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct AgreementGroups {
    /// Members of the largest group that agrees.
    pub(super) main: Vec<usize>,
    /// Vehicles outside it whose votes are at most half their own.
    pub(super) copies: Vec<usize>,
    /// Number of vehicles whose votes are at most half their own.
    pub(super) dependent: usize,
}

/// Pairwise agreement of vehicles, and the resulting weights.
#[derive(Debug, Clone, Default)]
pub(super) struct Dependence {
    /// Comparisons over which a pair's counts fade to 1/e.
    memory: f64,
    pairs: Pairs,
    /// Number of pairs.
    known: usize,
    /// Votes for each label, their sum and the sum of their squares.
    stated: Vec<f64>,
    total: f64,
    squares: f64,
    /// Comparisons since the last fit.
    compared: usize,
    /// Number of compared votes, by vehicle.
    tenure: Vec<f64>,
    /// Vehicles that it depends on or that depend on it, with ρ, by vehicle.
    partners: Vec<Vec<(usize, f64)>>,
}

impl Dependence {
    /// Without comparisons; the counts of a pair fade over `memory` comparisons to 1/e.
    pub(super) fn new(memory: f64) -> Self {
        Self {
            memory,
            ..Self::default()
        }
    }

    pub(super) fn configure(&mut self, memory: f64) {
        self.memory = memory;
    }

    /// Removes vehicles, whose indices may be reused.
    pub(super) fn remove_vehicles(&mut self, vehicles: &BTreeSet<usize>) {
        self.pairs.remove_vehicles(vehicles);
        self.known = self.pairs.iter().count();
        self.partners
            .iter_mut()
            .for_each(|partners| partners.retain(|(other, _)| !vehicles.contains(other)));
        for &vehicle in vehicles {
            self.tenure
                .get_mut(vehicle)
                .into_iter()
                .for_each(|tenure| *tenure = 0.0);
            self.partners
                .get_mut(vehicle)
                .into_iter()
                .for_each(Vec::clear);
        }
    }

    /// Clears how often labels were stated; their indices may be reused.
    pub(super) fn remove_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        for &label in labels {
            let Some(stated) = self.stated.get_mut(usize::from(label)).map(std::mem::take) else {
                continue;
            };
            self.total -= stated;
            self.squares -= stated * stated;
        }
    }

    /// Compares the votes on a landmark in pairs of which one is new; their order is fixed.
    pub(super) fn compare(&mut self, votes: &[ComparedVote]) {
        for vote in votes {
            if self.tenure.len() <= vote.vehicle {
                self.tenure.resize(vote.vehicle + 1, 0.0);
            }
            self.tenure[vote.vehicle] += f64::from(vote.is_new);
        }
        let distances = votes.len() / 2;
        for step in 0..distances.min(MAX_COMPARED) {
            let distance = 1 + (self.compared / votes.len() + step) % distances;
            let half_turn = 2 * distance == votes.len();
            for place in 0..if half_turn { distance } else { votes.len() } {
                let one = votes[place];
                let other = votes[(place + distance) % votes.len()];
                if one.is_new || other.is_new {
                    self.compare_pair(one, other);
                }
            }
        }
    }

    /// Counts one comparison of a pair: whether both labels agree, and how often they would by
    /// chance. Earlier comparisons fade.
    fn compare_pair(&mut self, one: ComparedVote, other: ComparedVote) {
        self.count_label(one.label);
        self.count_label(other.label);
        let chance = self.squares / (self.total * self.total);
        let fade = 1.0 - 1.0 / self.memory;
        let pair = self.pairs.entry(one.vehicle, other.vehicle);
        self.known += usize::from(pair.compared == 0.0);
        pair.compared = pair.compared * fade + 1.0;
        pair.agreed = pair.agreed * fade + f64::from(one.label == other.label);
        pair.chance = pair.chance * fade + chance;
        self.compared += 1;
    }

    /// Counts a stated label for the chance agreement. The sums are halved at [`LONG_MEMORY`], so
    /// that old labels fade.
    fn count_label(&mut self, label: LabelIndex) {
        let label = usize::from(label);
        if self.stated.len() <= label {
            self.stated.resize(label + 1, 0.0);
        }
        if self.total >= LONG_MEMORY {
            self.stated.iter_mut().for_each(|n| *n /= 2.0);
            self.total /= 2.0;
            self.squares /= 4.0;
        }
        self.squares += 2.0 * self.stated[label] + 1.0;
        self.stated[label] += 1.0;
        self.total += 1.0;
    }

    /// Part of a vote that is the vehicle's own where the others that `agrees` selects state the
    /// same label: 1 / (1 + Σ ρ), the design effect of correlated answers (Kish 1965).
    pub(super) fn independence(&self, vehicle: usize, agrees: impl Fn(usize) -> bool) -> f64 {
        let partners = self.partners.get(vehicle).map_or(&[][..], Vec::as_slice);
        let shared: f64 = partners
            .iter()
            .filter(|(other, _)| agrees(*other))
            .map(|(_, rho)| rho)
            .sum();
        1.0 / (1.0 + shared)
    }

    /// Whether a fit is due: it then costs at most as much as the comparisons since the last one.
    pub(super) fn is_due(&self) -> bool {
        self.compared >= self.known.max(64)
    }

    /// Finds the dependent pairs again; only vehicles that are `present` count for the main group.
    pub(super) fn fit(&mut self, present: &[bool]) -> AgreementGroups {
        self.compared = 0;
        let vehicles = present.len();
        let influence = |vehicle: usize| {
            let tenure = self.tenure.get(vehicle).copied().unwrap_or(0.0);
            if present[vehicle] {
                tenure / (tenure + TENURE_VOTES)
            } else {
                0.0
            }
        };
        let influences: Vec<f64> = (0..vehicles).map(influence).collect();
        let pairs = &self.pairs;
        let belonging = main_group(&influences, pairs);
        let typical = typical_agreement(&belonging, pairs);
        let mut rhos: Vec<f64> = pairs
            .iter()
            .map(|(_, _, pair)| pair.excess(typical))
            .collect();
        let mut factors = vec![0.5; vehicles];
        for _ in 0..ITERATIONS {
            factors = next_factors(&factors, &belonging, pairs, &rhos);
            for (rho, (one, other, pair)) in rhos.iter_mut().zip(pairs.iter()) {
                *rho = pair.excess(factors[one] * factors[other]);
            }
        }
        self.partners = vec![Vec::new(); vehicles];
        for ((one, other, _), rho) in pairs.iter().zip(rhos).filter(|(_, rho)| *rho > 0.0) {
            self.partners[one].push((other, rho));
            self.partners[other].push((one, rho));
        }
        let is_dependent =
            |v: usize| present[v] && self.independence(v, |other| present[other]) <= 0.5;
        let is_copy = |v: usize| belonging[v] < 0.1 && is_dependent(v);
        AgreementGroups {
            main: (0..vehicles).filter(|&v| belonging[v] >= 0.5).collect(),
            dependent: (0..vehicles).filter(|&v| is_dependent(v)).count(),
            copies: (0..vehicles).filter(|&v| is_copy(v)).collect(),
        }
    }
}

/// Membership of each vehicle, 0 to 1, in the largest group that agrees: a dominant set (Pavan &
/// Pelillo 2007). It is found by power iteration that drops negative parts.
fn main_group(influences: &[f64], pairs: &Pairs) -> Vec<f64> {
    let mut belonging = influences.to_vec();
    for _ in 0..ITERATIONS {
        let mut support: Vec<f64> = belonging.iter().map(|own| SELF_SUPPORT * own).collect();
        for (one, other, pair) in pairs.iter() {
            let affinity = (pair.kappa() / SAME_GROUP).clamp(-1.0, 1.0) * pair.compared
                / (pair.compared + PRIOR_COMPARISONS);
            support[one] += affinity * belonging[other];
            support[other] += affinity * belonging[one];
        }
        let most = support.iter().copied().fold(0.0, f64::max);
        if most <= 0.0 {
            break;
        }
        belonging = support
            .iter()
            .zip(influences)
            .map(|(s, influence)| influence * s.max(0.0) / most)
            .collect();
    }
    belonging
}

/// Mean agreement κ within the main group, of pairs in proportion to their comparisons; at least 0.
fn typical_agreement(belonging: &[f64], pairs: &Pairs) -> f64 {
    let mut weights = 0.0;
    let mut agreed = 0.0;
    for (one, other, pair) in pairs.iter() {
        let weight = belonging[one] * belonging[other] * pair.compared;
        weights += weight;
        agreed += weight * pair.kappa();
    }
    (agreed / f64::max(weights, 1e-9)).clamp(0.0, 0.99)
}

/// One step of alternating least squares for κ = r_i · r_j. Agreement counts if it is with the main
/// group and not excessive.
fn next_factors(factors: &[f64], belonging: &[f64], pairs: &Pairs, rhos: &[f64]) -> Vec<f64> {
    let members: f64 = belonging.iter().sum();
    let typical = factors
        .iter()
        .zip(belonging)
        .map(|(r, b)| r * b)
        .sum::<f64>()
        / members.max(1e-9);
    let prior = PRIOR_COMPARISONS * typical * typical;
    let mut sums = vec![(prior * typical, prior); factors.len()];
    for ((one, other, pair), rho) in pairs.iter().zip(rhos) {
        for (vehicle, reference) in [(one, other), (other, one)] {
            let weight = belonging[reference] * pair.compared * (1.0 - rho);
            sums[vehicle].0 += weight * pair.kappa() * factors[reference];
            sums[vehicle].1 += weight * factors[reference] * factors[reference];
        }
    }
    sums.into_iter()
        .map(|(product, square)| (product / square.max(1e-9)).clamp(0.0, 0.99))
        .collect()
}
