//! Probability of each label given the votes: the model of Dawid & Skene (1979) with hierarchical
//! priors.

use std::collections::{BTreeMap, BTreeSet};

use super::config::WeightedConfig;
use super::confusion::{Confusion, LabelIndex};
use super::likelihood::{
    LandmarkPosterior, Likelihood, Posterior, WeightedVote, normalise, probability,
};
use crate::model::names::Label;
use crate::reputation::RememberedVotes;
use crate::wire::ForeignVotes;

/// Evidence about one vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct VehicleEvidence {
    /// Evidence of fresh votes, which may be re-evaluated.
    pub(super) live: Confusion,
    /// Fading evidence of votes that went stale.
    pub(super) settled: Confusion,
    /// Fading evidence from the ledger of other aggregators.
    pub(super) inherited: Confusion,
    /// Votes of other cells. They weight the vehicle's statements, but are not evidence for
    /// conclusions about it.
    pub(super) foreign: ForeignVotes,
    /// Cumulative sum of the drop in the vehicle's rate of right votes.
    shortfall: f64,
    /// Log-odds of being right minus the fleet's log-odds on the same classes, by coupling.
    advantage: [f64; 2],
}

/// The relation between the probabilities of the classes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Coupling {
    /// Each class has its own probabilities, with priors.
    Free,
    /// A vehicle is right equally often on every class, and wrong labels are equally likely: the
    /// one-coin model.
    Tied,
}

impl VehicleEvidence {
    fn correct(&self) -> f64 {
        self.live.correct() + self.settled.correct() + self.inherited.correct()
    }

    /// Page's (1954) cumulative sum test: after a sudden drop in right votes most of the vehicle's
    /// past is dropped.
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

    /// Number of votes.
    pub(super) fn votes(&self) -> f64 {
        self.live.total() + self.settled.total() + self.inherited.total()
    }
}

/// Statements of the fleet's mean vehicle where one label is true.
struct FleetRow {
    truth: LabelIndex,
    /// Log-odds that the statement is right.
    log_odds: f64,
    /// Probability of each label among wrong statements.
    wrong: Posterior,
}

/// Confusion of each vehicle and of the fleet, and the shares of the classes.
///
/// A vehicle's probability of stating `l` where `t` is true has a Dirichlet prior. The prior's mean
/// is the fleet's confusion, shifted in log-odds by the vehicle's overall reliability. That
/// reliability is shrunk towards the fleet's. The fleet's confusion has a Dirichlet prior too,
/// whose mean is one accuracy for all classes. Classes are modelled individually only if that
/// predicts votes better; see [`Coupling`].
#[derive(Debug, Clone, Default)]
pub(super) struct DawidSkene {
    config: WeightedConfig,
    pub(super) vehicles: Vec<VehicleEvidence>,
    live: Confusion,
    settled: Confusion,
    labels: usize,
    /// Expected number of landmarks of each label.
    shares: Vec<f64>,
    log_shares: Vec<f64>,
    /// Fading log loss that [`Coupling::Free`] saved in the prediction of votes, in nats, and
    /// number of these votes.
    saving: (f64, f64),
    /// The same saving, by the ledger of other aggregators.
    inherited_saving: (f64, f64),
}

/// Weight, in votes, of the assumed accuracy against the fleet's record of a class.
const FLEET_PRIOR_VOTES: f64 = 1.0;
/// Weight against the fleet's record, as a share of all its votes: a class with few votes stays
/// close to the accuracy of all.
const FLEET_PRIOR_SHARE: f64 = 0.05;
/// Factor on the weight of the fleet's reliability while the classes are tied.
const TIED_PRIOR_FACTOR: f64 = 4.0;
/// Log loss per vote that individual classes must save, in nats. A model that is wrong in another
/// respect, for example about items that are hard for all vehicles, produces smaller apparent
/// savings (Miller & Dunson 2019).
const MIN_SAVING: f64 = 0.01;
/// Total saving, in nats, that may be chance.
const CHANCE_SAVING: f64 = 5.0;
/// Probability at least that a vote is wrong, or right, before rates by label in a ledger are
/// compared with it.
const MIN_WRONG: f64 = 0.01;
/// Votes over which savings fade to 1/e.
const SAVING_MEMORY_VOTES: f64 = 20_000.0;
/// Drop in the rate of right votes that is tolerated.
const SHORTFALL_SLACK: f64 = 0.2;
/// Cumulative drop beyond it, in votes, that is a change: about seven wrong votes of a vehicle with
/// 80 % right ones.
const SHORTFALL_ALARM: f64 = 4.0;
/// Part of a vehicle's past that still counts after a change.
const KEPT_AFTER_ALARM: f64 = 0.1;

impl DawidSkene {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self {
            config,
            ..Self::default()
        }
    }

    /// Applies other settings.
    pub(super) fn configure(&mut self, config: WeightedConfig) {
        self.config = config;
    }

    /// Makes room for a label.
    pub(super) fn add_label(&mut self) {
        self.labels += 1;
        self.shares.push(0.0);
        self.log_shares.push(0.0);
    }

    /// Number of labels that there is room for.
    pub(super) fn labels(&self) -> usize {
        self.labels
    }

    /// Number of correct votes by label.
    pub(super) fn support(&self) -> Vec<f64> {
        let evidence = [&self.live, &self.settled]
            .into_iter()
            .chain(self.vehicles.iter().map(|w| &w.inherited));
        let mut support = vec![0.0; self.labels];
        for confusion in evidence {
            for (label, sum) in support.iter_mut().enumerate() {
                *sum += confusion.cell(label as LabelIndex, label as LabelIndex);
            }
        }
        support
    }

    /// Removes labels that do not occur in the live evidence; their indices may be reused.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        labels
            .iter()
            .for_each(|label| self.shares[usize::from(*label)] = 0.0);
        let of_vehicles = self
            .vehicles
            .iter_mut()
            .flat_map(|w| [&mut w.live, &mut w.settled, &mut w.inherited]);
        [&mut self.live, &mut self.settled]
            .into_iter()
            .chain(of_vehicles)
            .for_each(|c| c.forget_labels(labels));
    }

    fn wrong_labels(&self) -> f64 {
        self.labels.saturating_sub(1).max(1) as f64
    }

    fn fleet_accuracy(&self) -> f64 {
        let correct = self.live.correct() + self.settled.correct();
        let total = self.live.total() + self.settled.total();
        (correct + FLEET_PRIOR_VOTES * self.config.assumed_accuracy) / (total + FLEET_PRIOR_VOTES)
    }

    fn fleet(&self, truth: LabelIndex, stated: LabelIndex, accuracy: f64) -> f64 {
        let tied = if truth == stated {
            accuracy
        } else {
            (1.0 - accuracy) / self.wrong_labels()
        };
        let row = self.live.row(truth) + self.settled.row(truth);
        let count = self.live.cell(truth, stated) + self.settled.cell(truth, stated);
        let prior =
            FLEET_PRIOR_VOTES + FLEET_PRIOR_SHARE * (self.live.total() + self.settled.total());
        (count + prior * tied) / (row + prior)
    }

    fn coupling(&self) -> Coupling {
        let (saved, votes) = (
            self.saving.0 + self.inherited_saving.0,
            self.saving.1 + self.inherited_saving.1,
        );
        if saved > CHANCE_SAVING + MIN_SAVING * votes {
            Coupling::Free
        } else {
            Coupling::Tied
        }
    }

    /// Evaluates new votes by the coupling that predicts votes better, after both couplings have
    /// predicted every one of these votes from the others. The model must not contain the votes
    /// yet: the evidence on the coupling is prequential (Dawid 1984).
    pub(super) fn judge_new(
        &mut self,
        votes: &[WeightedVote],
        candidates: &[LabelIndex],
    ) -> LandmarkPosterior {
        if votes.len() < 2 {
            return self.judge(votes, candidates);
        }
        let free = self.judge_by(Coupling::Free, votes, candidates);
        let tied = self.judge_by(Coupling::Tied, votes, candidates);
        let predicted: f64 = votes.iter().map(|vote| vote.independence).sum();
        let kept = (-predicted / SAVING_MEMORY_VOTES).exp();
        let saved = free.log_probability - tied.log_probability;
        self.saving = (
            kept * self.saving.0 + saved,
            kept * self.saving.1 + predicted,
        );
        self.inherited_saving = (
            kept * self.inherited_saving.0,
            kept * self.inherited_saving.1,
        );
        if self.coupling() == Coupling::Free {
            free
        } else {
            tied
        }
    }

    /// Evaluates votes that the model does not contain; newcomers together are limited to their
    /// share.
    pub(super) fn judge(
        &self,
        votes: &[WeightedVote],
        candidates: &[LabelIndex],
    ) -> LandmarkPosterior {
        self.judge_by(self.coupling(), votes, candidates)
    }

    fn judge_by(
        &self,
        coupling: Coupling,
        votes: &[WeightedVote],
        candidates: &[LabelIndex],
    ) -> LandmarkPosterior {
        let likelihoods = self.likelihoods(coupling, votes, candidates);
        let newcomer = self.newcomer_factor(votes);
        let mut labels: Posterior = candidates.iter().map(|&label| (label, 0.0)).collect();
        for (vote, likelihood) in votes.iter().zip(&likelihoods) {
            let factor = if self.is_newcomer(vote.vehicle) {
                newcomer
            } else {
                1.0
            };
            let weight = factor * vote.weight * vote.independence;
            labels
                .iter_mut()
                .zip(&likelihood.logs)
                .for_each(|((_, log), said)| *log += weight * said);
        }
        labels
            .iter_mut()
            .for_each(|(label, log)| *log += self.log_shares[usize::from(*label)]);
        let most = labels
            .iter()
            .map(|(_, log)| *log)
            .fold(f64::NEG_INFINITY, f64::max);
        labels
            .iter_mut()
            .for_each(|(_, log)| *log = (*log - most).exp());
        normalise(&mut labels);
        let mut judged = LandmarkPosterior {
            labels,
            agreements: Vec::with_capacity(votes.len()),
            log_probability: 0.0,
        };
        for (vote, likelihood) in votes.iter().zip(&likelihoods) {
            let others = likelihood.leave_out(vote, &judged.labels);
            let predicted: f64 = others
                .iter()
                .zip(&likelihood.stating)
                .map(|((_, p), stating)| p * stating)
                .sum();
            judged.log_probability += vote.independence * predicted.max(1e-9).ln();
            judged.agreements.push(probability(&others, vote.label));
        }
        judged
    }

    /// Replaces the evidence on the coupling that comes from a ledger. It counts right and wrong
    /// votes of each vehicle by stated label. Under equal accuracy on all classes, Bayes' rule
    /// still makes a rare label right less often than a frequent one. Rates by label count as far
    /// as they explain more than that, and more than chance does: the Bayes factor by Laplace's
    /// approximation (Kass & Raftery 1995).
    pub(super) fn inherit_coupling<'a>(
        &mut self,
        vehicles: impl Iterator<Item = &'a RememberedVotes> + Clone,
    ) {
        self.inherited_saving = (0.0, 0.0);
        let mut right: BTreeMap<&Label, f64> = BTreeMap::new();
        for (label, (correct, _)) in vehicles.clone().flatten() {
            *right.entry(label).or_default() += correct;
        }
        if right.len() < 2 {
            return;
        }
        let all: f64 = right.values().map(|correct| correct + 1.0).sum();
        let wrong_labels = (right.len() - 1) as f64;
        let prior = self.config.class_prior_votes;
        for labels in vehicles {
            let (correct, votes) = labels.values().fold((0.0, 0.0), |(c, n), label| {
                (c + label.0, n + label.0 + label.1)
            });
            let accuracy = (correct + self.config.assumed_accuracy) / (votes + 1.0);
            for (label, &(correct, incorrect)) in labels {
                let share = (right[label] + 1.0) / all;
                let (if_right, if_wrong) = (
                    accuracy * share,
                    (1.0 - accuracy) * (1.0 - share) / wrong_labels,
                );
                let tied = (if_right / (if_right + if_wrong)).clamp(MIN_WRONG, 1.0 - MIN_WRONG);
                let for_label = correct + incorrect;
                let own = (correct + prior * tied) / (for_label + prior);
                let saved =
                    correct * (own / tied).ln() + incorrect * ((1.0 - own) / (1.0 - tied)).ln();
                self.inherited_saving.0 += saved - (for_label / prior).ln_1p() / 2.0;
                self.inherited_saving.1 += for_label;
            }
        }
    }

    /// Clears the evidence on the coupling.
    pub(super) fn clear_coupling(&mut self) {
        self.saving = (0.0, 0.0);
    }

    /// Recomputes the shares of the classes and the advantages of `vehicles`; call it before
    /// [`Self::judge`] when evidence has changed.
    pub(super) fn refresh(&mut self, vehicles: impl Iterator<Item = usize>) {
        self.refresh_shares();
        let accuracy = self.fleet_accuracy();
        for vehicle in vehicles {
            let evidence = &self.vehicles[vehicle];
            let expected = |rows: &Confusion| -> f64 {
                rows.rows()
                    .map(|(t, n)| n * self.fleet(t, t, accuracy))
                    .sum()
            };
            let (correct, votes) = (evidence.correct(), evidence.votes());
            let foreign = evidence.foreign;
            let free = if votes > 1e-9 {
                (expected(&evidence.live)
                    + expected(&evidence.settled)
                    + expected(&evidence.inherited))
                    / votes
            } else {
                accuracy
            };
            let prior = self.config.vehicle_prior_votes;
            let advantage = |fleet: f64, prior: f64| {
                let fleet = fleet.clamp(1e-6, 1.0 - 1e-6);
                let (right, all) = (correct + foreign.correct, votes + foreign.total());
                let own = ((right + prior * fleet) / (all + prior)).clamp(1e-6, 1.0 - 1e-6);
                log_odds(own) - log_odds(fleet)
            };
            self.vehicles[vehicle].advantage = [
                advantage(free, prior),
                advantage(accuracy, TIED_PRIOR_FACTOR * prior),
            ];
        }
    }

    /// James–Stein shrinkage of the shares towards equal ones (Hausser & Strimmer 2009). The number
    /// of draws is capped at `class_share_verdicts`, because confusion and not sampling limits the
    /// accuracy of the shares.
    fn refresh_shares(&mut self) {
        let total: f64 = self.shares.iter().map(|s| s.max(0.0) + 1.0).sum();
        let equal = 1.0 / self.labels.max(1) as f64;
        let share = |s: &f64| (s.max(0.0) + 1.0) / total;
        let squares: f64 = self.shares.iter().map(|s| share(s).powi(2)).sum();
        let spread: f64 = self.shares.iter().map(|s| (share(s) - equal).powi(2)).sum();
        let draws = (total - self.labels as f64).clamp(2.0, self.config.class_share_verdicts);
        let shrink = ((1.0 - squares) / ((draws - 1.0) * spread).max(1e-12)).clamp(0.0, 1.0);
        for (log, s) in self.log_shares.iter_mut().zip(&self.shares) {
            *log = (shrink * equal + (1.0 - shrink) * share(s)).ln();
        }
    }

    /// The posterior without `vote`, given all votes but this one.
    pub(super) fn leave_one_out(
        &self,
        posterior: &[(LabelIndex, f64)],
        vote: &WeightedVote,
    ) -> Posterior {
        let candidates: Vec<_> = posterior.iter().map(|(label, _)| *label).collect();
        let likelihoods =
            self.likelihoods(self.coupling(), std::slice::from_ref(vote), &candidates);
        likelihoods
            .first()
            .map_or_else(Vec::new, |likelihood| likelihood.leave_out(vote, posterior))
    }

    /// Likelihood of each vote under each of `candidates`, among which its label is.
    fn likelihoods(
        &self,
        coupling: Coupling,
        votes: &[WeightedVote],
        candidates: &[LabelIndex],
    ) -> Vec<Likelihood> {
        let accuracy = self.fleet_accuracy();
        let stating: Vec<Vec<f64>> = match coupling {
            Coupling::Tied => votes
                .iter()
                .map(|vote| self.stating_tied(vote, candidates, accuracy))
                .collect(),
            Coupling::Free => {
                let fleet: Vec<_> = candidates
                    .iter()
                    .map(|&truth| self.fleet_row(truth, candidates, accuracy))
                    .collect();
                votes
                    .iter()
                    .map(|vote| self.stating_free(vote, &fleet))
                    .collect()
            }
        };
        votes
            .iter()
            .zip(stating)
            .map(|(vote, stating)| Likelihood::new(vote, candidates, stating))
            .collect()
    }

    fn stating_tied(
        &self,
        vote: &WeightedVote,
        candidates: &[LabelIndex],
        accuracy: f64,
    ) -> Vec<f64> {
        let right = shifted(
            log_odds(accuracy.clamp(1e-6, 1.0 - 1e-6)),
            self.vehicles[vote.vehicle].advantage[1],
        );
        let wrong = ((1.0 - right) / self.wrong_labels()).max(1e-12);
        candidates
            .iter()
            .map(|&truth| {
                if truth == vote.label {
                    right.max(1e-12)
                } else {
                    wrong
                }
            })
            .collect()
    }

    fn fleet_row(&self, truth: LabelIndex, candidates: &[LabelIndex], accuracy: f64) -> FleetRow {
        let right = self.fleet(truth, truth, accuracy).clamp(1e-6, 1.0 - 1e-6);
        let sharing = self.config.confusion_sharing;
        let wrong = |stated| {
            sharing * (self.fleet(truth, stated, accuracy) / (1.0 - right))
                + (1.0 - sharing) / self.wrong_labels()
        };
        FleetRow {
            truth,
            log_odds: log_odds(right),
            wrong: candidates
                .iter()
                .map(|&stated| (stated, wrong(stated)))
                .collect(),
        }
    }

    fn stating_free(&self, vote: &WeightedVote, fleet: &[FleetRow]) -> Vec<f64> {
        let known = &self.vehicles[vote.vehicle];
        let evidence = [&known.live, &known.settled, &known.inherited];
        let prior = self.config.class_prior_votes;
        let stating = |row: &FleetRow| {
            let right = shifted(row.log_odds, known.advantage[0]);
            let assumed = if row.truth == vote.label {
                right
            } else {
                (1.0 - right) * probability(&row.wrong, vote.label)
            };
            let count: f64 = evidence.iter().map(|e| e.cell(row.truth, vote.label)).sum();
            let votes: f64 = evidence.iter().map(|e| e.row(row.truth)).sum();
            ((count + prior * assumed) / (votes + prior)).max(1e-12)
        };
        fleet.iter().map(stating).collect()
    }

    /// Whether too few of a vehicle's votes are settled to rely on it. Fresh votes do not count,
    /// because a vehicle could send many at once.
    pub(super) fn is_newcomer(&self, vehicle: usize) -> bool {
        let evidence = &self.vehicles[vehicle];
        evidence.settled.total() + evidence.inherited.total() < self.config.probation_votes
    }

    /// Factor that limits the summed weight of newcomers to `newcomer_share` of the proven
    /// vehicles'; 1 where no vehicle is proven.
    pub(super) fn newcomer_factor(&self, votes: &[WeightedVote]) -> f64 {
        let (mut newcomers, mut proven) = (0.0, 0.0);
        for vote in votes {
            *(if self.is_newcomer(vote.vehicle) {
                &mut newcomers
            } else {
                &mut proven
            }) += vote.weight * vote.independence;
        }
        let most = self.config.newcomer_share * proven;
        if proven > 0.0 && newcomers > most {
            most / newcomers
        } else {
            1.0
        }
    }

    /// Adds the votes as live evidence; with `sign` −1 removes them. A single vote is not evidence
    /// about its vehicle.
    pub(super) fn add_live(
        &mut self,
        votes: &[WeightedVote],
        posterior: &[(LabelIndex, f64)],
        sign: f64,
    ) {
        for &(truth, p) in posterior {
            self.shares[usize::from(truth)] += sign * p;
            for vote in votes.iter().filter(|_| votes.len() > 1) {
                let weight = sign * p * vote.weight.min(1.0);
                self.vehicles[vote.vehicle]
                    .live
                    .add(truth, vote.label, weight);
                self.live.add(truth, vote.label, weight);
            }
        }
    }

    /// Adds a vote, which must not be live, to the fading evidence.
    ///
    /// The vehicle is evaluated by the posterior of the `others`, the fleet by the posterior of
    /// `all`. Otherwise a few vehicles that outvote one would together seem wrong more often than
    /// right.
    pub(super) fn settle(
        &mut self,
        vote: &WeightedVote,
        others: &[(LabelIndex, f64)],
        all: &[(LabelIndex, f64)],
    ) {
        let fade = 1.0 - 1.0 / self.config.memory_votes;
        let fleet_fade = 1.0 - 1.0 / (self.config.memory_votes * self.vehicles.len().max(1) as f64);
        let evidence = &mut self.vehicles[vote.vehicle];
        let right = others
            .iter()
            .find(|(truth, _)| *truth == vote.label)
            .map_or(0.0, |(_, p)| *p);
        evidence.watch_for_drop(right);
        evidence.settled.fade(fade);
        evidence.inherited.fade(fade);
        self.settled.fade(fleet_fade);
        for (truth, p) in sharpened(others) {
            evidence
                .settled
                .add(truth, vote.label, p * vote.weight.min(1.0));
        }
        for (truth, p) in sharpened(all) {
            self.settled
                .add(truth, vote.label, p * vote.weight.min(1.0));
        }
    }

    /// Clears all evidence that is not live.
    pub(super) fn clear_settled(&mut self) {
        self.clear_coupling();
        self.inherited_saving = (0.0, 0.0);
        self.settled = Confusion::default();
        for evidence in &mut self.vehicles {
            evidence.settled = Confusion::default();
            evidence.inherited = Confusion::default();
        }
    }

    /// Clears all live evidence.
    pub(super) fn clear_live(&mut self) {
        self.live = Confusion::default();
        self.shares.iter_mut().for_each(|s| *s = 0.0);
        self.vehicles
            .iter_mut()
            .for_each(|w| w.live = Confusion::default());
    }

    /// Probability that a vehicle is right, shrunk towards the fleet's.
    pub(super) fn reliability(&self, vehicle: usize) -> f64 {
        let evidence = &self.vehicles[vehicle];
        let prior = self.config.vehicle_prior_votes;
        let fleet = self.fleet_accuracy().min(self.config.assumed_accuracy);
        (evidence.correct() + prior * fleet) / (evidence.votes() + prior)
    }

    /// The reliability including votes of other cells: a vehicle's weight. Conclusions from
    /// evidence use [`Self::reliability`], so that other cells' counts alone cannot void evidence.
    pub(super) fn reliability_beside(&self, vehicle: usize) -> f64 {
        let evidence = &self.vehicles[vehicle];
        let prior = self.config.vehicle_prior_votes;
        let own = evidence.votes() + prior;
        (own * self.reliability(vehicle) + evidence.foreign.correct)
            / (own + evidence.foreign.total())
    }
}

/// Probabilities in proportion to their squares, for evidence that is kept.
///
/// Without this, the small probabilities of labels that do not occur would add up: they would
/// describe how such labels are stated, from votes on other labels only.
fn sharpened(posterior: &[(LabelIndex, f64)]) -> impl Iterator<Item = (LabelIndex, f64)> + '_ {
    let squares: f64 = posterior.iter().map(|(_, p)| p * p).sum();
    posterior
        .iter()
        .map(move |&(label, p)| (label, p * p / squares.max(f64::MIN_POSITIVE)))
}

/// Probability whose log-odds are `log_odds + advantage`.
fn shifted(log_odds: f64, advantage: f64) -> f64 {
    1.0 / (1.0 + (-(log_odds + advantage)).exp())
}

fn log_odds(p: f64) -> f64 {
    (p / (1.0 - p)).ln()
}
