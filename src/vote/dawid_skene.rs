//! Probability of each label given the votes: the model of Dawid & Skene (1979) between one coin per
//! vehicle and one confusion matrix per vehicle.
//!
//! A vehicle states label l where t is true with probability
//!
//! θ(l | t) = (1 − w) · coin(l | t) + w · (n(t, l) + m · coin(l | t)) / (n(t) + m)
//!
//! where coin(l | t) is the vehicle's accuracy for l = t and else spreads the rest evenly over the
//! wrong labels, n counts its votes by true and stated label, m is `class_prior_votes`, and w is the
//! weight of [`LabelBias`]. The accuracy is the rate of right votes, with the fleet's rate as a
//! prior of `vehicle_prior_votes`.

use std::collections::BTreeSet;

use smallvec::SmallVec;

use super::config::WeightedConfig;
use super::confusion::Confusion;
use super::index_map::LabelIndex;
use super::label_bias::LabelBias;
use super::likelihood::{
    LandmarkPosterior, Likelihood, Posterior, WeightedVote, normalise, probability,
};
use super::parameters::{FLEET_PRIOR_VOTES, KEPT_AFTER_ALARM, SHORTFALL_ALARM, SHORTFALL_SLACK};

/// Evidence about one vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct VehicleEvidence {
    /// Evidence of fresh votes, which may be re-evaluated.
    pub(super) live: Confusion,
    /// Fading evidence of votes that went stale.
    pub(super) settled: Confusion,
    /// Fading evidence from the ledger of other aggregators.
    pub(super) inherited: Confusion,
    /// Cumulative sum of the drop in the vehicle's rate of right votes.
    shortfall: f64,
    /// Probability of being right, as of the last [`DawidSkene::refresh`].
    accuracy: f64,
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

    pub(super) fn votes(&self) -> f64 {
        self.live.total() + self.settled.total() + self.inherited.total()
    }
}

/// Right votes and all votes.
#[derive(Debug, Clone, Copy, Default)]
struct FleetVotes {
    right: f64,
    votes: f64,
}

impl FleetVotes {
    fn add(&mut self, right: f64, votes: f64) {
        self.right += right;
        self.votes += votes;
    }

    fn fade(&mut self, factor: f64) {
        self.right *= factor;
        self.votes *= factor;
    }
}

/// The confusion of each vehicle, the accuracy of the fleet, and the shares of the classes.
#[derive(Debug, Clone, Default)]
pub(super) struct DawidSkene {
    config: WeightedConfig,
    pub(super) vehicles: Vec<VehicleEvidence>,
    pub(super) label_bias: LabelBias,
    /// Weight of the confusion matrices, as of the last [`Self::refresh`].
    class_weight: f64,
    /// Fresh votes of the fleet, and fading votes that went stale.
    live: FleetVotes,
    settled: FleetVotes,
    shares: ClassShares,
}

/// The shares of the classes among landmarks with several votes.
#[derive(Debug, Clone, Default)]
struct ClassShares {
    /// Expected number of landmarks of each label, and one landmark that is assumed.
    landmarks: Vec<f64>,
    /// Sum of these numbers, and sum of their squares.
    total: f64,
    squares: f64,
    /// Part of equal shares in the shares, as of the last [`Self::shrink`].
    equal_part: f64,
}

impl ClassShares {
    fn set(&mut self, label: usize, landmarks: f64) {
        let before = std::mem::replace(&mut self.landmarks[label], landmarks);
        self.total += landmarks - before;
        self.squares += landmarks * landmarks - before * before;
    }

    fn add_label(&mut self) {
        self.landmarks.push(0.0);
        self.set(self.landmarks.len() - 1, 1.0);
    }

    fn add(&mut self, label: LabelIndex, landmarks: f64) {
        let label = usize::from(label);
        self.set(label, (self.landmarks[label] + landmarks).max(1.0));
    }

    fn remove(&mut self, label: LabelIndex) {
        self.set(usize::from(label), 1.0);
    }

    /// Clears everything but the assumed landmarks, and with it rounding errors.
    fn clear(&mut self) {
        let labels = self.landmarks.len() as f64;
        self.landmarks.fill(1.0);
        self.total = labels;
        self.squares = labels;
    }

    /// James–Stein shrinkage of the shares towards equal ones (Hausser & Strimmer 2009). The number
    /// of draws is at most `max_draws`, because confusion and not sampling limits the accuracy of
    /// the shares.
    fn shrink(&mut self, max_draws: f64) {
        let labels = self.landmarks.len().max(1) as f64;
        let squares = self.squares / (self.total * self.total).max(1.0);
        let spread = squares - 1.0 / labels;
        let draws = (self.total - labels).clamp(2.0, max_draws);
        self.equal_part = ((1.0 - squares) / ((draws - 1.0) * spread).max(1e-12)).clamp(0.0, 1.0);
    }

    fn log(&self, label: LabelIndex) -> f64 {
        let equal = 1.0 / self.landmarks.len() as f64;
        let share = self.landmarks[usize::from(label)] / self.total;
        (self.equal_part * equal + (1.0 - self.equal_part) * share).ln()
    }
}

impl DawidSkene {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self {
            label_bias: LabelBias::new(config.memory_votes),
            config,
            ..Self::default()
        }
    }

    pub(super) fn configure(&mut self, config: WeightedConfig) {
        self.label_bias.configure(config.memory_votes);
        self.config = config;
    }

    /// Makes room for a label.
    pub(super) fn add_label(&mut self) {
        self.shares.add_label();
    }

    /// Number of labels that there is room for.
    pub(super) fn labels(&self) -> usize {
        self.shares.landmarks.len()
    }

    /// Number of correct votes by label.
    pub(super) fn support(&self) -> Vec<f64> {
        let mut support = vec![0.0; self.labels()];
        for confusion in self
            .vehicles
            .iter()
            .flat_map(|vehicle| [&vehicle.live, &vehicle.settled, &vehicle.inherited])
        {
            for (label, count) in confusion.diagonal() {
                support[usize::from(label)] += count;
            }
        }
        support
    }

    /// Removes labels that do not occur in the live evidence; their indices may be reused.
    pub(super) fn remove_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        labels.iter().for_each(|label| self.shares.remove(*label));
        self.vehicles
            .iter_mut()
            .flat_map(|w| [&mut w.live, &mut w.settled, &mut w.inherited])
            .for_each(|c| c.remove_labels(labels));
        self.label_bias.remove_labels(labels);
    }

    fn wrong_labels(&self) -> f64 {
        self.labels().saturating_sub(1).max(1) as f64
    }

    fn fleet_accuracy(&self) -> f64 {
        let right = self.live.right.max(0.0) + self.settled.right;
        let votes = self.live.votes.max(0.0) + self.settled.votes;
        (right.min(votes) + FLEET_PRIOR_VOTES * self.config.assumed_accuracy)
            / (votes + FLEET_PRIOR_VOTES)
    }

    /// Evaluates votes that the model does not contain; newcomers together are limited to their
    /// share.
    pub(super) fn judge(
        &self,
        votes: &[WeightedVote],
        candidates: &[LabelIndex],
    ) -> LandmarkPosterior {
        let likelihoods: SmallVec<[Likelihood; 4]> = votes
            .iter()
            .map(|vote| self.likelihood(vote, candidates))
            .collect();
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
            .for_each(|(label, log)| *log += self.shares.log(*label));
        let most = labels
            .iter()
            .map(|(_, log)| *log)
            .fold(f64::NEG_INFINITY, f64::max);
        labels
            .iter_mut()
            .for_each(|(_, log)| *log = (*log - most).exp());
        normalise(&mut labels);
        let agreements = votes
            .iter()
            .zip(&likelihoods)
            .map(|(vote, likelihood)| probability(&likelihood.leave_out(vote, &labels), vote.label))
            .collect();
        LandmarkPosterior { labels, agreements }
    }

    /// Recomputes the shares of the classes and the accuracies of `vehicles`; call it before
    /// [`Self::judge`] when evidence has changed.
    pub(super) fn refresh(&mut self, vehicles: impl Iterator<Item = usize>) {
        self.shares.shrink(self.config.class_share_verdicts);
        self.class_weight = self.label_bias.class_weight();
        let fleet = self.fleet_accuracy();
        let prior = self.config.vehicle_prior_votes;
        for vehicle in vehicles {
            let evidence = &mut self.vehicles[vehicle];
            let accuracy = (evidence.correct() + prior * fleet) / (evidence.votes() + prior);
            evidence.accuracy = accuracy.clamp(1e-6, 1.0 - 1e-6);
        }
    }

    /// The posterior without `vote`, given all votes but this one.
    pub(super) fn leave_one_out(
        &self,
        posterior: &[(LabelIndex, f64)],
        vote: &WeightedVote,
    ) -> Posterior {
        let candidates: SmallVec<[LabelIndex; 4]> =
            posterior.iter().map(|(label, _)| *label).collect();
        self.likelihood(vote, &candidates)
            .leave_out(vote, posterior)
    }

    /// Likelihood of a vote under each of `candidates`, among which its label is.
    fn likelihood(&self, vote: &WeightedVote, candidates: &[LabelIndex]) -> Likelihood {
        let vehicle = &self.vehicles[vote.vehicle];
        let wrong = (1.0 - vehicle.accuracy) / self.wrong_labels();
        let coin = |truth: LabelIndex| {
            if truth == vote.label {
                vehicle.accuracy
            } else {
                wrong
            }
        };
        if self.class_weight == 0.0 {
            return Likelihood::new(
                vote,
                candidates,
                candidates.iter().map(|&truth| coin(truth)),
            );
        }
        let prior = self.config.class_prior_votes;
        let evidence = [&vehicle.live, &vehicle.settled, &vehicle.inherited];
        let stating = candidates.iter().map(|&truth| {
            let coin = coin(truth);
            let stated: f64 = evidence.iter().map(|e| e.votes(vote.label, truth)).sum();
            let votes: f64 = evidence.iter().map(|e| e.all_votes(truth)).sum();
            let own = (stated + prior * coin) / (votes + prior);
            coin + self.class_weight * (own - coin)
        });
        Likelihood::new(vote, candidates, stating)
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
        let mut newcomers = 0.0;
        let mut proven = 0.0;
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

    /// Adds the votes as live evidence; with `sign` −1 removes them. A single vote changes
    /// the evidence about its vehicle and the shares of the classes as little as a missing vote,
    /// because a vehicle could invent any number of landmarks.
    pub(super) fn add_live(
        &mut self,
        votes: &[WeightedVote],
        posterior: &[(LabelIndex, f64)],
        sign: f64,
    ) {
        if votes.len() < 2 {
            return;
        }
        for &(truth, p) in posterior {
            self.shares.add(truth, sign * p);
        }
        for vote in votes {
            let weight = sign * vote.weight.min(1.0);
            let live = &mut self.vehicles[vote.vehicle].live;
            live.add(vote.label, posterior.iter().copied(), weight);
            let right = probability(posterior, vote.label);
            self.live.add(weight * right, weight);
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
        let weight = vote.weight.min(1.0);
        evidence.settled.add(vote.label, sharpened(others), weight);
        for (truth, p) in sharpened(all) {
            let right = if truth == vote.label { p * weight } else { 0.0 };
            self.settled.add(right, p * weight);
        }
    }

    /// Clears all evidence that is not live.
    pub(super) fn clear_settled(&mut self) {
        self.settled = FleetVotes::default();
        self.label_bias.clear_inherited();
        for evidence in &mut self.vehicles {
            evidence.settled = Confusion::default();
            evidence.inherited = Confusion::default();
        }
    }

    /// Clears all live evidence.
    pub(super) fn clear_live(&mut self) {
        self.live = FleetVotes::default();
        self.shares.clear();
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
