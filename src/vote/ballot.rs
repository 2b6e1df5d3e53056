//! The votes on one landmark.

use std::collections::BTreeSet;

use super::calibration::{Calibration, Weights};
use super::confusion::LabelIndex;
use super::dependence::Dependence;
use super::model::{Model, Word};
use crate::time::Timestamp;

/// Part of a vehicle's statements that counts as independent: one frame is much like the next.
const INDEPENDENT_FRAMES: f64 = 1.0 / 3.0;
/// tanh(0.8 z) is the two-sided normal probability of z, within 0.02.
const NORMAL_TO_LOGISTIC: f64 = 0.8;

/// A vote that counts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cast {
    pub(super) vehicle: usize,
    pub(super) label: LabelIndex,
    pub(super) confidence: f64,
    pub(super) visibility: f64,
    /// What the vehicle stated lately.
    pub(super) recent: Recent,
    pub(super) weight: f64,
    /// Part of it that is the vehicle's own.
    pub(super) own: f64,
    pub(super) at: Timestamp,
    /// When it began to count once more as evidence.
    pub(super) since: Timestamp,
    /// Rank of its confidence as of the last judgement.
    pub(super) band: usize,
    /// How far the others agreed, if that is in the live evidence on confidences.
    pub(super) agreement: Option<f64>,
    /// Whether a posterior rests on it.
    pub(super) judged: bool,
    /// Whether it has been compared with the other vehicles' since it began to count.
    pub(super) compared: bool,
}

/// What one vehicle stated lately on one landmark: the weight of its votes for each label, fading. One frame in which
/// an object was taken for another does not change the vehicle's vote.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Recent {
    labels: [(LabelIndex, f64); 3],
    /// Number of statements, fading likewise.
    statements: f64,
}

impl Recent {
    /// Adds a statement of `weight` when all before have faded to `kept`; returns the label stated most.
    pub(super) fn state(&mut self, label: LabelIndex, weight: f64, kept: f64) -> LabelIndex {
        self.statements = self.statements * kept + 1.0;
        self.labels.iter_mut().for_each(|(_, sum)| *sum *= kept);
        let known = self.labels.iter().position(|(known, sum)| *known == label && *sum > 0.0);
        let least = (0..self.labels.len()).min_by(|&a, &b| self.labels[a].1.total_cmp(&self.labels[b].1));
        let place = &mut self.labels[known.or(least).unwrap_or_default()];
        *place = (label, weight + known.map_or(0.0, |_| place.1));
        let stated = *place;
        let more = self.labels.iter().copied().filter(|(_, sum)| *sum > stated.1);
        more.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or(stated).0
    }

    /// Forgets what was stated for labels whose numbers may stand for others from now on.
    pub(super) fn forget_labels(&mut self, is_gone: impl Fn(LabelIndex) -> bool) {
        self.labels.iter_mut().filter(|(label, _)| is_gone(*label)).for_each(|place| *place = (0, 0.0));
    }

    /// How sure it is that the label stated most is not so by chance, 0 to 1: the difference to the next in standard
    /// deviations of a multinomial draw, as a two-sided probability. Who wavers between two labels hardly votes.
    pub(super) fn certainty(&self) -> f64 {
        let mut sums = self.labels.map(|(_, sum)| sum);
        sums.sort_by(f64::total_cmp);
        let [third, second, first] = sums;
        let total = (first + second + third).max(f64::MIN_POSITIVE);
        let lead = (first - second) / total;
        let variance = ((first + second) / total - lead * lead) / (INDEPENDENT_FRAMES * self.statements).max(1.0);
        (NORMAL_TO_LOGISTIC * lead / variance.max(1e-9).sqrt()).tanh()
    }
}

impl Cast {
    pub(super) fn word(&self) -> Word {
        Word { vehicle: self.vehicle, label: self.label, weight: self.weight, own: self.own }
    }
}

/// The votes on one landmark, at most one of each vehicle, in order of vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct Ballot {
    pub(super) casts: Vec<Cast>,
    /// As of the last judgement.
    pub(super) posterior: Vec<(LabelIndex, f64)>,
    /// Whether votes and posterior are in the live evidence at present.
    pub(super) counted: bool,
    pub(super) shown: Option<LabelIndex>,
    /// When it is next searched for votes that are past.
    pub(super) due: Option<Timestamp>,
}

impl Ballot {
    pub(super) fn words(&self) -> Vec<Word> {
        self.casts.iter().map(Cast::word).collect()
    }

    pub(super) fn candidates(&self) -> Vec<LabelIndex> {
        self.casts.iter().map(|c| c.label).collect::<BTreeSet<_>>().into_iter().collect()
    }

    /// Takes in what is new about who agrees with whom, and who states which confidences; of many voters, `order`
    /// decides who is compared.
    pub(super) fn compare(
        &mut self,
        dependence: &mut Dependence,
        calibration: &mut Calibration,
        order: impl Fn(usize) -> usize,
    ) {
        if self.casts.iter().any(|c| !c.compared) {
            let mut votes: Vec<_> = self.casts.iter().map(|c| (c.vehicle, c.label, !c.compared)).collect();
            votes.sort_by_key(|(vehicle, ..)| order(*vehicle));
            dependence.compare(&votes);
            for cast in self.casts.iter_mut().filter(|c| !c.compared) {
                calibration.state(cast.vehicle, cast.confidence);
                cast.compared = true;
            }
        }
    }

    pub(super) fn weigh(&mut self, dependence: &Dependence, calibration: &Calibration, weights: &Weights) {
        for place in 0..self.casts.len() {
            let Cast { vehicle, label, confidence, visibility, recent, .. } = self.casts[place];
            let says_the_same = |other: usize| {
                self.casts.binary_search_by_key(&other, |c| c.vehicle).is_ok_and(|at| self.casts[at].label == label)
            };
            let own = dependence.own_part(vehicle, says_the_same);
            let band = calibration.band(vehicle, confidence);
            let cast = &mut self.casts[place];
            (cast.own, cast.band, cast.weight) =
                (own, band, weights.of(band, confidence) * visibility * recent.certainty());
        }
    }

    /// Adds to the evidence on confidences how far the others agree with each vote.
    pub(super) fn agree(&mut self, model: &Model, calibration: &mut Calibration) {
        if self.is_witnessed() {
            for cast in &mut self.casts {
                let agreement = probability(&model.without(&self.posterior, &cast.word()), cast.label);
                calibration.count(cast.band, agreement, 1.0);
                cast.agreement = Some(agreement);
            }
        }
    }

    /// Shows the most probable label, unless the one shown is less than `hysteresis` behind.
    pub(super) fn show(&mut self, hysteresis: f64) {
        let mut best: Option<(LabelIndex, f64)> = None;
        for &(label, p) in &self.posterior {
            if best.is_none_or(|(_, most)| p > most) {
                best = Some((label, p));
            }
        }
        let kept = self.shown.map_or(0.0, |shown| probability(&self.posterior, shown));
        if kept == 0.0 || best.is_some_and(|(_, p)| p > kept + hysteresis) {
            self.shown = best.map(|(label, _)| label);
        }
    }

    /// Share of each label in the weighted votes; equal ones if all who voted waver, so that no vote weighs anything.
    pub(super) fn majority(&self) -> Vec<(LabelIndex, f64)> {
        let total: f64 = self.casts.iter().map(|c| c.weight * c.own).sum();
        let candidates = self.candidates();
        let equal = 1.0 / candidates.len() as f64;
        let of_label = |label| self.casts.iter().filter(move |c| c.label == label);
        let share = |label| of_label(label).map(|c| c.weight * c.own).sum::<f64>() / total;
        candidates.into_iter().map(|label| (label, if total > 0.0 { share(label) } else { equal })).collect()
    }

    /// Forgets labels with the votes for them, and returns how many these were; not while it is counted.
    pub(super) fn forget_labels(&mut self, is_gone: impl Fn(LabelIndex) -> bool) -> usize {
        let votes = self.casts.len();
        self.casts.retain(|cast| !is_gone(cast.label));
        self.posterior.retain(|(label, _)| !is_gone(*label));
        self.shown = self.shown.filter(|label| !is_gone(*label));
        let total: f64 = self.posterior.iter().map(|(_, p)| p).sum();
        if total > 0.0 && !self.casts.is_empty() {
            self.posterior.iter_mut().for_each(|(_, p)| *p /= total);
        } else {
            self.posterior.clear();
        }
        votes - self.casts.len()
    }

    /// Whether several vehicles voted, so that they can judge each other.
    pub(super) fn is_witnessed(&self) -> bool {
        self.casts.len() > 1
    }
}

pub(super) fn probability(posterior: &[(LabelIndex, f64)], label: LabelIndex) -> f64 {
    posterior.iter().find(|(l, _)| *l == label).map_or(0.0, |(_, p)| *p)
}
