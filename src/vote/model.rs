//! The hierarchical confusion model: how probable each label is, given the votes.
//!
//! Dawid & Skene (1979) estimate how often voter v states l where t is true. Here that probability is a Dirichlet mean
//! with a prior of `vehicle_prior_votes`. The prior is the fleet's confusion, shifted in log-odds by how much more often
//! v is right than the fleet. The fleet's confusion is shrunk to one accuracy for all classes. In the one-coin model
//! (Raykar et al. 2010) a voter is right equally often on every class, and wrong labels are equally likely.

use std::collections::BTreeSet;

use super::config::WeightedConfig;
use super::confusion::{Confusion, LabelIndex};
use super::parameters::{
    CONVICTION, FLEET_PRIOR_SHARE, KEPT_AFTER_ALARM, MIN_PROVEN, MIN_SAVING, NEGLIGIBLE, SAVING_PRIOR_VOTES,
    SHORTFALL_ALARM, SHORTFALL_SLACK,
};
use crate::wire::ForeignVotes;

/// Probabilities of labels.
pub(super) type Posterior = Vec<(LabelIndex, f64)>;

/// A vote as the model takes it.
#[derive(Debug, Clone, Copy)]
pub(super) struct WeightedVote {
    /// Index of the vehicle.
    pub(super) vehicle: usize,
    /// The stated label.
    pub(super) label: LabelIndex,
    /// Calibrated confidence × visibility × certainty, 1 for a plain vote.
    pub(super) weight: f64,
    /// Part of the vote that does not depend on other vehicles, 0 to 1.
    pub(super) independence: f64,
}

/// The kind of a vehicle's confusion.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Structure {
    /// One accuracy for all classes.
    #[default]
    OneCoin,
    /// A row for each class.
    PerClass,
}

/// The votes on one landmark as the model sees them: log-likelihoods by vote and candidate.
#[derive(Debug, Clone)]
pub(super) struct LandmarkJudgement {
    /// Probability of each candidate.
    pub(super) posterior: Posterior,
    /// Unnormalised log probability of each candidate.
    sums: Vec<f64>,
    /// Probability that each vote states its label, by vote and candidate.
    stating: Vec<f64>,
    /// Its log times the vote's weight, at most that where the stated label is true, by vote and candidate.
    logs: Vec<f64>,
}

impl LandmarkJudgement {
    /// The posterior without vote `n`, raised to the power `exponent`.
    pub(super) fn without(&self, n: usize, exponent: f64) -> Posterior {
        let candidates = self.posterior.len();
        let logs = &self.logs[n * candidates..(n + 1) * candidates];
        let mut others: Posterior = self
            .posterior
            .iter()
            .zip(&self.sums)
            .zip(logs)
            .map(|((&(label, _), sum), log)| (label, exponent * (sum - log)))
            .collect();
        normalise_logs(&mut others);
        others
    }

    /// Log probability of vote `n` given the others' posterior, raised to the power `exponent`.
    pub(super) fn log_prediction(&self, n: usize, exponent: f64) -> f64 {
        let others = self.without(n, exponent);
        let stating = &self.stating[n * others.len()..(n + 1) * others.len()];
        others.iter().zip(stating).map(|((_, p), stating)| p * stating).sum::<f64>().max(1e-9).ln()
    }
}

/// Evidence about one vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct VehicleEvidence {
    /// Evidence of fresh votes, which may be judged again.
    pub(super) live: Confusion,
    /// Fading evidence of votes that went stale.
    pub(super) settled: Confusion,
    /// Fading evidence from the ledger of other aggregators.
    pub(super) inherited: Confusion,
    /// Votes of other cells. They shift its reliability and are no evidence here.
    pub(super) foreign: ForeignVotes,
    /// Cumulative sum of the drop in the vehicle's rate of right votes.
    shortfall: f64,
    /// Rate of right votes of the fleet on the classes that this vehicle met, and the votes from which it follows.
    expected: (f64, f64),
}

impl VehicleEvidence {
    fn all(&self) -> [&Confusion; 3] {
        [&self.live, &self.settled, &self.inherited]
    }

    fn correct(&self) -> f64 {
        self.all().iter().map(|c| c.correct()).sum()
    }

    /// Number of votes.
    fn votes(&self) -> f64 {
        self.all().iter().map(|c| c.total()).sum()
    }

    /// Page's (1954) cumulative sum test: after a sudden drop in right votes most of the vehicle's past is removed.
    fn watch_for_drop(&mut self, right: f64) {
        let past = self.settled.total() + self.inherited.total();
        let usual = (self.settled.correct() + self.inherited.correct()) / past.max(1.0);
        self.shortfall = (self.shortfall + usual - right - SHORTFALL_SLACK).max(0.0);
        if self.shortfall > SHORTFALL_ALARM {
            self.shortfall = 0.0;
            self.settled.fade(KEPT_AFTER_ALARM);
            self.inherited.fade(KEPT_AFTER_ALARM);
        }
    }
}

/// Confusion of each vehicle and of the fleet, and the shares of the classes.
#[derive(Debug, Clone, Default)]
pub(super) struct HierarchicalModel {
    config: WeightedConfig,
    pub(super) vehicles: Vec<VehicleEvidence>,
    pub(super) structure: Structure,
    live: Confusion,
    settled: Confusion,
    /// Expected number of landmarks of each label.
    shares: Vec<f64>,
    log_shares: Vec<f64>,
    /// Landmarks added since the shares were computed.
    since_shares: usize,
    /// Log loss that [`Structure::PerClass`] saves, in nats, and the number of votes in which that was measured.
    saving: (f64, f64),
}

impl HierarchicalModel {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self { config, ..Self::default() }
    }

    /// Goes on under other settings.
    pub(super) fn configure(&mut self, config: WeightedConfig) {
        self.config = config;
    }

    /// Makes room for a label.
    pub(super) fn add_label(&mut self) {
        self.shares.push(0.0);
        self.log_shares.push(0.0);
        self.refresh_shares();
    }

    /// Number of labels that there is room for.
    pub(super) fn labels(&self) -> usize {
        self.shares.len()
    }

    /// Number of correct votes by label.
    pub(super) fn support(&self) -> Vec<f64> {
        let evidence: Vec<_> =
            [&self.live, &self.settled].into_iter().chain(self.vehicles.iter().map(|v| &v.inherited)).collect();
        let of =
            |label: usize| evidence.iter().map(|c| c.cell_and_row(label as LabelIndex, label as LabelIndex).0).sum();
        (0..self.labels()).map(of).collect()
    }

    /// Removes labels that are absent from the live evidence; their indices may be reused.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        labels.iter().for_each(|label| self.shares[usize::from(*label)] = 0.0);
        let of_vehicles = self.vehicles.iter_mut().flat_map(|w| [&mut w.live, &mut w.settled, &mut w.inherited]);
        [&mut self.live, &mut self.settled].into_iter().chain(of_vehicles).for_each(|c| c.forget_labels(labels));
    }

    fn wrong_labels(&self) -> f64 {
        self.labels().saturating_sub(1).max(1) as f64
    }

    fn fleet_votes(&self) -> f64 {
        self.live.total() + self.settled.total()
    }

    fn fleet_accuracy(&self) -> f64 {
        let correct = self.live.correct() + self.settled.correct();
        bounded((correct + self.config.assumed_accuracy) / (self.fleet_votes() + 1.0))
    }

    /// Probability that the fleet states `stated` where `truth` is true.
    fn fleet(&self, truth: LabelIndex, stated: LabelIndex, accuracy: f64) -> f64 {
        let coin = if truth == stated { accuracy } else { (1.0 - accuracy) / self.wrong_labels() };
        let (live, live_row) = self.live.cell_and_row(truth, stated);
        let (settled, settled_row) = self.settled.cell_and_row(truth, stated);
        let (count, row) = (live + settled, live_row + settled_row);
        let prior = 1.0 + FLEET_PRIOR_SHARE * self.fleet_votes();
        (count + prior * coin) / (row + prior)
    }

    /// Rate of right votes of a vehicle, shrunk to `prior`.
    fn accuracy(&self, vehicle: usize, prior: f64) -> f64 {
        let evidence = &self.vehicles[vehicle];
        let weight = self.config.vehicle_prior_votes;
        let right = evidence.correct() + evidence.foreign.correct + weight * prior;
        bounded(right / (evidence.votes() + evidence.foreign.total() + weight))
    }

    /// Judges votes that the model does not contain; newcomers together are limited to their share.
    pub(super) fn judge(&mut self, votes: &[WeightedVote], candidates: &[LabelIndex]) -> LandmarkJudgement {
        let stating = match self.structure {
            Structure::OneCoin => {
                let prior = self.fleet_accuracy();
                stating_coin(votes, candidates, |vehicle| {
                    let right = self.accuracy(vehicle, prior);
                    (right, (1.0 - right) / self.wrong_labels())
                })
            }
            Structure::PerClass => self.stating_per_class(votes, candidates),
        };
        let newcomer = self.newcomer_factor(votes);
        let weight = |vote: &WeightedVote| {
            let factor = if self.is_newcomer(vote.vehicle) { newcomer } else { 1.0 };
            factor * vote.weight * vote.independence
        };
        let weights: Vec<f64> = votes.iter().map(weight).collect();
        judgement(votes, &weights, candidates, stating, |label| self.log_shares[usize::from(label)])
    }

    /// Judges votes by what each vehicle is worth as a witness, without class shares. Where fewer than [`MIN_PROVEN`] proven
    /// vehicles vote, none is worth more than a newcomer, however good its settled record and what other cells say of it. Evidence that rests on one vehicle's record would be of its own making.
    pub(super) fn judge_as_witnesses(&self, votes: &[WeightedVote], candidates: &[LabelIndex]) -> LandmarkJudgement {
        let assumed = self.config.assumed_accuracy;
        let prior = self.config.vehicle_prior_votes;
        let proven = votes.iter().filter(|vote| !self.is_newcomer(vote.vehicle)).count();
        let most = if proven >= MIN_PROVEN { 1.0 } else { assumed };
        let accuracy = |vehicle: usize| {
            let VehicleEvidence { settled, inherited, foreign, .. } = &self.vehicles[vehicle];
            let right = settled.correct() + inherited.correct() + foreign.correct + prior * assumed;
            let votes = settled.total() + inherited.total() + foreign.total() + prior;
            bounded((right / votes).min(most))
        };
        let wrong_labels = self.wrong_labels();
        let stating = stating_coin(votes, candidates, |vehicle| {
            let right = accuracy(vehicle);
            (right, (1.0 - right) / wrong_labels)
        });
        let weights: Vec<f64> = votes.iter().map(|vote| vote.weight.min(1.0) * vote.independence).collect();
        judgement(votes, &weights, candidates, stating, |_| 0.0)
    }

    /// Odds against a vote from which it settles as wrong: just more than those that one newcomer alone would give, where
    /// so many labels are candidates. So two witnesses have to agree.
    pub(super) fn conviction(&self, candidates: usize) -> f64 {
        let right = self.config.assumed_accuracy;
        let others = candidates.saturating_sub(1).max(1) as f64 * (1.0 - right) / self.wrong_labels();
        CONVICTION * right / others
    }

    fn stating_per_class(&mut self, votes: &[WeightedVote], candidates: &[LabelIndex]) -> Vec<f64> {
        let accuracy = self.fleet_accuracy();
        votes.iter().for_each(|vote| self.refresh_expected(vote.vehicle, accuracy));
        // By candidate: the fleet's odds of being right. By pair of candidates: the share of a label in its errors.
        let odds_right: Vec<f64> =
            candidates.iter().map(|&truth| odds(bounded(self.fleet(truth, truth, accuracy)))).collect();
        let mut error_shares = Vec::with_capacity(candidates.len() * candidates.len());
        for (&truth, odds) in candidates.iter().zip(&odds_right) {
            let share = |&stated: &LabelIndex| self.fleet(truth, stated, accuracy) * (1.0 + odds);
            error_shares.extend(candidates.iter().map(share));
        }
        let prior = self.config.vehicle_prior_votes;
        let mut stating = Vec::with_capacity(votes.len() * candidates.len());
        for vote in votes {
            let known = &self.vehicles[vote.vehicle];
            let expected = bounded(known.expected.0);
            let advantage = odds(self.accuracy(vote.vehicle, expected)) / odds(expected);
            let place = candidates.binary_search(&vote.label).unwrap_or_default();
            for (row, &truth) in candidates.iter().enumerate() {
                let wrong = 1.0 / (1.0 + odds_right[row] * advantage);
                let share = error_shares[row * candidates.len() + place];
                let assumed = if truth == vote.label { 1.0 - wrong } else { wrong * share };
                let (mut count, mut votes) = (0.0, 0.0);
                for evidence in known.all().into_iter().filter(|evidence| evidence.total() > 0.0) {
                    let (cell, row) = evidence.cell_and_row(truth, vote.label);
                    (count, votes) = (count + cell, votes + row);
                }
                stating.push(((count + prior * assumed) / (votes + prior)).max(1e-9));
            }
        }
        stating
    }

    /// Computes how often the fleet is right on a vehicle's classes, again after each tenth of its votes.
    fn refresh_expected(&mut self, vehicle: usize, accuracy: f64) {
        let known = &self.vehicles[vehicle];
        let votes = known.votes();
        if (votes - known.expected.1).abs() > 0.1 * known.expected.1 {
            let rows = known.all().into_iter().flat_map(Confusion::rows);
            let right: f64 = rows.map(|(truth, n)| n * self.fleet(truth, truth, accuracy)).sum();
            let expected = if votes > 1e-9 { right / votes } else { accuracy };
            self.vehicles[vehicle].expected = (expected, votes);
        }
    }

    /// Begins a pass: everything that is computed once in a while is computed again.
    pub(super) fn refresh(&mut self) {
        self.refresh_shares();
        let accuracy = self.fleet_accuracy();
        for vehicle in 0..self.vehicles.len() {
            self.vehicles[vehicle].expected.1 = f64::NEG_INFINITY;
            self.refresh_expected(vehicle, accuracy);
        }
    }

    /// James–Stein shrinkage of the shares towards equal ones (Hausser & Strimmer 2009). The number of draws is capped
    /// at `class_share_verdicts`, because confusion and not sampling limits the accuracy of the shares.
    fn refresh_shares(&mut self) {
        self.since_shares = 0;
        let total: f64 = self.shares.iter().map(|s| s.max(0.0) + 1.0).sum();
        let equal = 1.0 / self.labels().max(1) as f64;
        let share = |s: &f64| (s.max(0.0) + 1.0) / total;
        let squares: f64 = self.shares.iter().map(|s| share(s).powi(2)).sum();
        let spread: f64 = self.shares.iter().map(|s| (share(s) - equal).powi(2)).sum();
        let draws = (total - self.labels() as f64).clamp(2.0, self.config.class_share_verdicts);
        let shrink = ((1.0 - squares) / ((draws - 1.0) * spread).max(1e-12)).clamp(0.0, 1.0);
        for (log, s) in self.log_shares.iter_mut().zip(&self.shares) {
            *log = (shrink * equal + (1.0 - shrink) * share(s)).ln();
        }
    }

    /// Takes the log loss per vote that [`Structure::PerClass`] saves in `votes` votes, and chooses the structure.
    pub(super) fn choose_structure(&mut self, saved: f64, votes: f64) {
        let kept = SAVING_PRIOR_VOTES / (SAVING_PRIOR_VOTES + votes);
        self.saving = (kept * self.saving.0 + saved, kept * self.saving.1 + votes);
        let is_worth = self.saving.0 > MIN_SAVING * (self.saving.1 + SAVING_PRIOR_VOTES);
        self.structure = if is_worth { Structure::PerClass } else { Structure::OneCoin };
    }

    /// Whether few of a vehicle's votes are settled. Fresh votes do not prove it: a vehicle could send
    /// many at once.
    pub(super) fn is_newcomer(&self, vehicle: usize) -> bool {
        let evidence = &self.vehicles[vehicle];
        evidence.settled.total() + evidence.inherited.total() < self.config.probation_votes
    }

    /// Factor that limits the summed weight of newcomers to `newcomer_share` of the proven vehicles'; 1 where fewer than
    /// two vehicles are proven: the tenure of one vehicle outweighs no other vehicle.
    fn newcomer_factor(&self, votes: &[WeightedVote]) -> f64 {
        let (mut newcomers, mut proven, mut vehicles) = (0.0, 0.0, 0);
        for vote in votes {
            if self.is_newcomer(vote.vehicle) {
                newcomers += vote.weight * vote.independence;
            } else {
                proven += vote.weight * vote.independence;
                vehicles += 1;
            }
        }
        let most = self.config.newcomer_share * proven;
        if vehicles > 1 && newcomers > most { most / newcomers } else { 1.0 }
    }

    /// Adds the votes as live evidence; `sign` −1 takes them back. A single vote is no evidence about its vehicle.
    pub(super) fn add_live(&mut self, votes: &[WeightedVote], posterior: &[(LabelIndex, f64)], sign: f64) {
        let mut stated: Posterior = posterior.iter().map(|(label, _)| (*label, 0.0)).collect();
        for vote in votes {
            if let Ok(place) = stated.binary_search_by_key(&vote.label, |(label, _)| *label) {
                stated[place].1 += vote.weight.min(1.0);
            }
        }
        for &(truth, p) in posterior.iter().filter(|(_, p)| *p > NEGLIGIBLE) {
            self.shares[usize::from(truth)] += sign * p;
            if votes.len() > 1 {
                votes.iter().for_each(|vote| {
                    self.vehicles[vote.vehicle].live.add(truth, vote.label, sign * p * vote.weight.min(1.0));
                });
                stated.iter().for_each(|(label, weight)| self.live.add(truth, *label, sign * p * weight));
            }
        }
        self.since_shares += 1;
        if self.since_shares > self.labels() {
            self.refresh_shares();
        }
    }

    /// Turns a vote, which must not be live at present, into fading evidence. Returns whether it was right, or `None` if
    /// that stays open: the vote is right if `others`, the witnesses' posterior without it, support its label most. It is
    /// wrong only if they support another label by the odds of [`Self::conviction`].
    pub(super) fn settle(
        &mut self,
        vote: &WeightedVote,
        others: &[(LabelIndex, f64)],
        all: &[(LabelIndex, f64)],
    ) -> Option<bool> {
        let right = probability(others, vote.label);
        let other = others.iter().filter(|(label, _)| *label != vote.label).map(|(_, p)| *p).fold(0.0, f64::max);
        if right <= other && odds(other) < self.conviction(others.len()) {
            return None;
        }
        let fade = 1.0 - 1.0 / self.config.memory_votes;
        let fleet_fade = 1.0 - 1.0 / (self.config.memory_votes * self.vehicles.len().max(1) as f64);
        let evidence = &mut self.vehicles[vote.vehicle];
        evidence.watch_for_drop(right);
        evidence.settled.fade(fade);
        evidence.inherited.fade(fade);
        self.settled.fade(fleet_fade);
        for (truth, p) in sharpened(others) {
            evidence.settled.add(truth, vote.label, p * vote.weight.min(1.0));
        }
        for (truth, p) in sharpened(all) {
            self.settled.add(truth, vote.label, p * vote.weight.min(1.0));
        }
        Some(right > other)
    }

    /// Removes settled and inherited evidence.
    pub(super) fn clear_settled(&mut self) {
        self.settled = Confusion::default();
        for evidence in &mut self.vehicles {
            evidence.settled = Confusion::default();
            evidence.inherited = Confusion::default();
        }
    }

    /// Removes all live evidence.
    pub(super) fn clear_live(&mut self) {
        self.live = Confusion::default();
        self.shares.iter_mut().for_each(|s| *s = 0.0);
        self.vehicles.iter_mut().for_each(|w| w.live = Confusion::default());
    }

    /// Probability that a vehicle is right, shrunk towards the fleet's.
    pub(super) fn reliability(&self, vehicle: usize) -> f64 {
        let evidence = &self.vehicles[vehicle];
        let prior = self.config.vehicle_prior_votes;
        let fleet = self.fleet_accuracy().min(self.config.assumed_accuracy);
        (evidence.correct() + prior * fleet) / (evidence.votes() + prior)
    }

    /// [`Self::reliability`] with the votes of other cells: the published score. Conclusions about evidence rest on
    /// [`Self::reliability`], so that a report of another cell alone voids no evidence.
    pub(super) fn reliability_beside(&self, vehicle: usize) -> f64 {
        let evidence = &self.vehicles[vehicle];
        let own = evidence.votes() + self.config.vehicle_prior_votes;
        (own * self.reliability(vehicle) + evidence.foreign.correct) / (own + evidence.foreign.total())
    }
}

/// Probability that each vote states its label, by vote and candidate. A vehicle has one probability of the right label
/// and one of each wrong label.
fn stating_coin(
    votes: &[WeightedVote],
    candidates: &[LabelIndex],
    right_and_wrong: impl Fn(usize) -> (f64, f64),
) -> Vec<f64> {
    let mut stating = Vec::with_capacity(votes.len() * candidates.len());
    for vote in votes {
        let (right, wrong) = right_and_wrong(vote.vehicle);
        stating.extend(candidates.iter().map(|&truth| if truth == vote.label { right } else { wrong }));
    }
    stating
}

/// The judgement of weighted votes. The likelihood of a vote is highest where its own label is true: otherwise a mirrored solution
/// exists, in which an honest majority is consistently wrong.
fn judgement(
    votes: &[WeightedVote],
    weights: &[f64],
    candidates: &[LabelIndex],
    stating: Vec<f64>,
    log_prior: impl Fn(LabelIndex) -> f64,
) -> LandmarkJudgement {
    let mut posterior: Posterior = candidates.iter().map(|&label| (label, log_prior(label))).collect();
    let mut logs = Vec::with_capacity(stating.len());
    for ((vote, weight), stating) in votes.iter().zip(weights).zip(stating.chunks(candidates.len().max(1))) {
        let own = candidates.binary_search(&vote.label).map_or(1.0, |place| stating[place]);
        for ((_, sum), p) in posterior.iter_mut().zip(stating) {
            let log = weight * p.min(own).ln();
            *sum += log;
            logs.push(log);
        }
    }
    let sums = posterior.iter().map(|(_, sum)| *sum).collect();
    normalise_logs(&mut posterior);
    LandmarkJudgement { posterior, sums, stating, logs }
}

/// Turns logarithms into probabilities.
fn normalise_logs(logs: &mut Posterior) {
    let most = logs.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
    logs.iter_mut().for_each(|(_, log)| *log = (*log - most).exp());
    let total: f64 = logs.iter().map(|(_, p)| p).sum();
    logs.iter_mut().for_each(|(_, p)| *p /= total);
}

/// Probability of a label; 0 if it is not listed.
pub(super) fn probability(posterior: &[(LabelIndex, f64)], label: LabelIndex) -> f64 {
    posterior.iter().find(|(l, _)| *l == label).map_or(0.0, |(_, p)| *p)
}

/// Probabilities in proportion to their squares, for evidence that is kept.
///
/// Without this, the small probabilities of labels that are never true would add up: they would describe how such labels
/// are stated, from votes on other labels only.
fn sharpened(posterior: &[(LabelIndex, f64)]) -> impl Iterator<Item = (LabelIndex, f64)> + '_ {
    let squares: f64 = posterior.iter().map(|(_, p)| p * p).sum();
    posterior.iter().map(move |&(label, p)| (label, p * p / squares.max(f64::MIN_POSITIVE)))
}

fn bounded(p: f64) -> f64 {
    p.clamp(1e-4, 1.0 - 1e-4)
}

fn odds(p: f64) -> f64 {
    p / (1.0 - p)
}
