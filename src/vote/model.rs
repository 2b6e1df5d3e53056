//! How probable each label is, given who said what: hierarchical Dawid–Skene.

use std::collections::BTreeSet;

use super::config::WeightedConfig;
use super::confusion::{Confusion, LabelIndex};

/// What is known about one vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct Witness {
    /// Evidence of votes that still count and may be judged anew.
    pub(super) live: Confusion,
    /// Evidence of votes that are past, fading.
    pub(super) settled: Confusion,
    /// Evidence told by another aggregator, fading.
    pub(super) inherited: Confusion,
    /// Cumulative sum of how much less often than before the vehicle was right.
    shortfall: f64,
    /// Log-odds of being right, against what the fleet would be on the same classes.
    advantage: f64,
}

impl Witness {
    fn correct(&self) -> f64 {
        self.live.correct() + self.settled.correct() + self.inherited.correct()
    }

    /// Page's (1954) cumulative sum: a vehicle that is suddenly right less often loses most of its past.
    fn watch(&mut self, right: f64) {
        let past = self.settled.total() + self.inherited.total();
        let usual = (self.settled.correct() + self.inherited.correct()) / past.max(1.0);
        self.shortfall = (self.shortfall + usual - right - SHORTFALL_SLACK).max(0.0);
        if self.shortfall > SHORTFALL_ALARM {
            self.shortfall = 0.0;
            self.settled.fade(KEPT_AFTER_ALARM);
            self.inherited.fade(KEPT_AFTER_ALARM);
        }
    }

    /// Votes of evidence.
    pub(super) fn evidence(&self) -> f64 {
        self.live.total() + self.settled.total() + self.inherited.total()
    }
}

/// One vote as the model sees it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Word {
    /// Who.
    pub(super) vehicle: usize,
    /// What.
    pub(super) label: LabelIndex,
    /// Calibrated confidence × visibility, 1 for a plain vote.
    pub(super) weight: f64,
    /// Part of the vote that is the vehicle's own.
    pub(super) own: f64,
}

/// Vehicles' and the fleet's confusion and the shares of the classes.
///
/// A vehicle's probability of stating `l` where `t` is true has a Dirichlet prior whose mean is the fleet's confusion
/// shifted, in log-odds, by the vehicle's overall reliability, itself shrunk towards the fleet's.
#[derive(Debug, Clone)]
pub(super) struct Model {
    config: WeightedConfig,
    pub(super) witnesses: Vec<Witness>,
    live: Confusion,
    settled: Confusion,
    labels: usize,
    /// Expected number of landmarks of each label.
    shares: Vec<f64>,
    log_shares: Vec<f64>,
}

/// Weight, in votes, of the assumed accuracy against the fleet's record of a class.
const FLEET_PRIOR_VOTES: f64 = 1.0;
/// Fall in the rate of right votes that is not taken for a change.
const SHORTFALL_SLACK: f64 = 0.2;
/// Votes that must be missing beyond it: about seven wrong ones of a vehicle that was right 80 % of the time.
const SHORTFALL_ALARM: f64 = 4.0;
/// Part of a vehicle's past that still counts after a change.
const KEPT_AFTER_ALARM: f64 = 0.1;

impl Model {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self {
            config,
            witnesses: Vec::new(),
            live: Confusion::default(),
            settled: Confusion::default(),
            labels: 0,
            shares: Vec::new(),
            log_shares: Vec::new(),
        }
    }

    /// Makes room for a label.
    pub(super) fn add_label(&mut self) {
        self.labels += 1;
        self.shares.push(0.0);
        self.log_shares.push(0.0);
    }

    /// How many labels there is room for.
    pub(super) fn labels(&self) -> usize {
        self.labels
    }

    /// By label, how often it was stated where it was right.
    pub(super) fn support(&self) -> Vec<f64> {
        let evidence = [&self.live, &self.settled].into_iter().chain(self.witnesses.iter().map(|w| &w.inherited));
        let mut support = vec![0.0; self.labels];
        for confusion in evidence {
            for (label, sum) in support.iter_mut().enumerate() {
                *sum += confusion.cell(label as LabelIndex, label as LabelIndex);
            }
        }
        support
    }

    /// Forgets labels, none of which is in the live evidence; their numbers may stand for others from now on.
    pub(super) fn forget_labels(&mut self, labels: &BTreeSet<LabelIndex>) {
        labels.iter().for_each(|label| self.shares[usize::from(*label)] = 0.0);
        let of_vehicles = self.witnesses.iter_mut().flat_map(|w| [&mut w.live, &mut w.settled, &mut w.inherited]);
        [&mut self.live, &mut self.settled].into_iter().chain(of_vehicles).for_each(|c| c.forget_labels(labels));
    }

    fn wrong_labels(&self) -> f64 {
        self.labels.saturating_sub(1).max(1) as f64
    }

    fn fleet_accuracy(&self) -> f64 {
        let correct = self.live.correct() + self.settled.correct();
        let total = self.live.total() + self.settled.total();
        (correct + FLEET_PRIOR_VOTES * self.config.assumed_accuracy) / (total + FLEET_PRIOR_VOTES)
    }

    fn fleet_row(&self, truth: LabelIndex) -> f64 {
        self.live.row(truth) + self.settled.row(truth) + FLEET_PRIOR_VOTES
    }

    fn fleet(&self, truth: LabelIndex, stated: LabelIndex, accuracy: f64) -> f64 {
        let prior = if truth == stated { accuracy } else { (1.0 - accuracy) / self.wrong_labels() };
        let count = self.live.cell(truth, stated) + self.settled.cell(truth, stated);
        (count + FLEET_PRIOR_VOTES * prior) / self.fleet_row(truth)
    }

    /// Recomputes what votes are weighed by; call before [`Self::posterior`] when evidence has changed.
    pub(super) fn prepare(&mut self, vehicles: impl Iterator<Item = usize>) {
        self.prepare_shares();
        let accuracy = self.fleet_accuracy();
        for vehicle in vehicles {
            let witness = &self.witnesses[vehicle];
            let expected = |rows: &Confusion| -> f64 { rows.rows().map(|(t, n)| n * self.fleet(t, t, accuracy)).sum() };
            let counted = witness.evidence();
            let fleet = if counted > 1e-9 {
                ((expected(&witness.live) + expected(&witness.settled) + expected(&witness.inherited)) / counted)
                    .clamp(1e-6, 1.0 - 1e-6)
            } else {
                accuracy.clamp(1e-6, 1.0 - 1e-6)
            };
            let prior = self.config.vehicle_prior_votes;
            let own = ((witness.correct() + prior * fleet) / (witness.evidence() + prior)).clamp(1e-6, 1.0 - 1e-6);
            self.witnesses[vehicle].advantage = log_odds(own) - log_odds(fleet);
        }
    }

    /// James–Stein shrinkage of the shares towards equal ones (Hausser & Strimmer 2009), as if they rested on at most
    /// `class_share_verdicts` draws: confusion, not sampling, limits what is known about them.
    fn prepare_shares(&mut self) {
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

    /// As [`Self::log_of_stating`], but never more than where the stated label is true: no vote counts against its own
    /// label. Otherwise the model has a mirrored solution, in which the honest majority is taken for consistent liars.
    fn log_likelihood(&self, word: &Word, truth: LabelIndex, accuracy: f64) -> f64 {
        let own = self.log_of_stating(word, word.label, accuracy);
        if truth == word.label { own } else { own.min(self.log_of_stating(word, truth, accuracy)) }
    }

    /// The posterior as it would be without `word`: what the other vehicles say about its label.
    pub(super) fn without(&self, posterior: &[(LabelIndex, f64)], word: &Word) -> Vec<(LabelIndex, f64)> {
        let accuracy = self.fleet_accuracy();
        let own = self.log_likelihood(word, word.label, accuracy);
        let others: Vec<_> = posterior
            .iter()
            .map(|&(label, p)| {
                let lead = word.weight * word.own * (own - self.log_likelihood(word, label, accuracy));
                (label, p * lead.min(500.0).exp())
            })
            .collect();
        let total: f64 = others.iter().map(|(_, p)| p).sum();
        if total > 0.0 { others.into_iter().map(|(label, p)| (label, p / total)).collect() } else { posterior.to_vec() }
    }

    /// Natural logarithm of the probability that a vehicle states the word's label where `truth` is.
    fn log_of_stating(&self, word: &Word, truth: LabelIndex, accuracy: f64) -> f64 {
        let witness = &self.witnesses[word.vehicle];
        let right = self.fleet(truth, truth, accuracy).clamp(1e-6, 1.0 - 1e-6);
        let assumed_right = 1.0 / (1.0 + (-(log_odds(right) + witness.advantage)).exp());
        let assumed = if truth == word.label {
            assumed_right
        } else {
            let shared = self.fleet(truth, word.label, accuracy) / (1.0 - right);
            let sharing = self.config.confusion_sharing;
            (1.0 - assumed_right) * (sharing * shared + (1.0 - sharing) / self.wrong_labels())
        };
        let prior = self.config.class_prior_votes;
        let evidence = [&witness.live, &witness.settled, &witness.inherited];
        let count: f64 = evidence.iter().map(|e| e.cell(truth, word.label)).sum();
        let row: f64 = evidence.iter().map(|e| e.row(truth)).sum();
        ((count + prior * assumed) / (row + prior)).max(1e-12).ln()
    }

    /// Probability of each of `candidates` given the words, newcomers together held to their share.
    pub(super) fn posterior(&self, words: &[Word], candidates: &[LabelIndex]) -> Vec<(LabelIndex, f64)> {
        let newcomer = self.newcomer_factor(words);
        let accuracy = self.fleet_accuracy();
        let mut logs: Vec<f64> = candidates
            .iter()
            .map(|&truth| {
                let said = |word: &Word| {
                    let factor = if self.is_newcomer(word.vehicle) { newcomer } else { 1.0 };
                    factor * word.weight * word.own * self.log_likelihood(word, truth, accuracy)
                };
                self.log_shares[usize::from(truth)] + words.iter().map(said).sum::<f64>()
            })
            .collect();
        let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        logs.iter_mut().for_each(|log| *log = (*log - most).exp());
        let total: f64 = logs.iter().sum();
        candidates.iter().zip(logs).map(|(&label, p)| (label, p / total)).collect()
    }

    /// Whether too few of a vehicle's votes are settled to trust it. Votes that still count do not prove it: many at
    /// once would.
    pub(super) fn is_newcomer(&self, vehicle: usize) -> bool {
        let witness = &self.witnesses[vehicle];
        witness.settled.total() + witness.inherited.total() < self.config.probation_votes
    }

    /// Factor that holds the summed weight of newcomers to `newcomer_share` of the proven vehicles'; 1 without proven.
    pub(super) fn newcomer_factor(&self, words: &[Word]) -> f64 {
        let (mut newcomers, mut proven) = (0.0, 0.0);
        for word in words {
            *(if self.is_newcomer(word.vehicle) { &mut newcomers } else { &mut proven }) += word.weight * word.own;
        }
        let most = self.config.newcomer_share * proven;
        if proven > 0.0 && newcomers > most { most / newcomers } else { 1.0 }
    }

    /// Adds the words as live evidence, `sign` −1 to take them back. A vote that stands alone is no evidence of who is
    /// right.
    pub(super) fn count(&mut self, words: &[Word], posterior: &[(LabelIndex, f64)], sign: f64) {
        for &(truth, p) in posterior {
            self.shares[usize::from(truth)] += sign * p;
            for word in words.iter().filter(|_| words.len() > 1) {
                let weight = sign * p * word.weight.min(1.0);
                self.witnesses[word.vehicle].live.add(truth, word.label, weight);
                self.live.add(truth, word.label, weight);
            }
        }
    }

    /// Moves one word, not at present counted as live, to the fading evidence: the vehicle's by what `others` say, the
    /// fleet's by what all say, or few vehicles that outvote one would together seem wrong more often than right.
    pub(super) fn settle(&mut self, word: &Word, others: &[(LabelIndex, f64)], all: &[(LabelIndex, f64)]) {
        let fade = 1.0 - 1.0 / self.config.memory_votes;
        let fleet_fade = 1.0 - 1.0 / (self.config.memory_votes * self.witnesses.len().max(1) as f64);
        let witness = &mut self.witnesses[word.vehicle];
        let right = others.iter().find(|(truth, _)| *truth == word.label).map_or(0.0, |(_, p)| *p);
        witness.watch(right);
        witness.settled.fade(fade);
        witness.inherited.fade(fade);
        self.settled.fade(fleet_fade);
        for (truth, p) in sharpened(others) {
            witness.settled.add(truth, word.label, p * word.weight.min(1.0));
        }
        for (truth, p) in sharpened(all) {
            self.settled.add(truth, word.label, p * word.weight.min(1.0));
        }
    }

    /// Forgets all past evidence.
    pub(super) fn clear_settled(&mut self) {
        self.settled = Confusion::default();
        for witness in &mut self.witnesses {
            witness.settled = Confusion::default();
            witness.inherited = Confusion::default();
        }
    }

    /// Forgets all live evidence.
    pub(super) fn clear_live(&mut self) {
        self.live = Confusion::default();
        self.shares.iter_mut().for_each(|s| *s = 0.0);
        self.witnesses.iter_mut().for_each(|w| w.live = Confusion::default());
    }

    /// Probability that a vehicle is right, shrunk towards the fleet's.
    pub(super) fn reliability(&self, vehicle: usize) -> f64 {
        let witness = &self.witnesses[vehicle];
        let prior = self.config.vehicle_prior_votes;
        let fleet = self.fleet_accuracy().min(self.config.assumed_accuracy);
        (witness.correct() + prior * fleet) / (witness.evidence() + prior)
    }
}

/// Probabilities in proportion to their squares. Evidence that is kept for good leans to what was probably true: what
/// little is left for labels that are never true would add up to rows that say how such labels are stated, all of them
/// from votes on others.
fn sharpened(posterior: &[(LabelIndex, f64)]) -> impl Iterator<Item = (LabelIndex, f64)> + '_ {
    let squares: f64 = posterior.iter().map(|(_, p)| p * p).sum();
    posterior.iter().map(move |&(label, p)| (label, p * p / squares.max(f64::MIN_POSITIVE)))
}

fn log_odds(p: f64) -> f64 {
    (p / (1.0 - p)).ln()
}
