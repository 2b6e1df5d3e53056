//! The votes on one landmark.

use smallvec::SmallVec;

use super::calibration::{Band, ConfidenceCalibration, Weights};
use super::dependence::{ComparedVote, Dependence};
use super::index_map::LabelIndex;
use super::label_bias::LabelBias;
use super::likelihood::{LandmarkPosterior, Posterior, WeightedVote, probability};
use super::parameters::{INDEPENDENT_FRAMES, MIN_STATEMENT_WEIGHT};
use crate::model::time::Timestamp;

/// tanh(0.8 z) is the two-sided normal probability of z, within 0.02.
const NORMAL_TO_LOGISTIC: f64 = 0.8;

/// A vote that currently counts. Millions may be stored.
#[derive(Debug, Clone)]
pub(super) struct StoredVote {
    pub(super) vehicle: usize,
    pub(super) label: LabelIndex,
    pub(super) confidence: f64,
    pub(super) visibility: f64,
    /// The vehicle's latest statements, if there are several.
    pub(super) recent: Option<Box<RecentStatements>>,
    pub(super) weight: f64,
    /// Part of the weight that does not depend on other vehicles, 0 to 1.
    pub(super) independence: f64,
    pub(super) at: Timestamp,
    /// Time since which it counts again as evidence.
    pub(super) since: Timestamp,
    /// Band of its confidence as of the last judgement.
    pub(super) band: Band,
    /// Probability that the others assign to its label, as of the last judgement.
    pub(super) agreement: f64,
    /// Whether the posterior includes it.
    pub(super) judged: bool,
    /// Whether it has been compared with the other vehicles' votes since it began to count.
    pub(super) compared: bool,
}

/// The latest statements of one vehicle on one landmark: the fading weight of its votes for each
/// label. A single frame that shows a wrong label does not change the vehicle's vote.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct RecentStatements {
    labels: [LabelIndex; 3],
    /// Fading weight of the statements of each of these labels.
    sums: [f64; 3],
    /// Fading number of statements.
    statements: f64,
}

impl RecentStatements {
    /// Adds a statement of `weight` after earlier ones faded by the factor `kept`; returns the
    /// label stated most.
    pub(super) fn add(&mut self, label: LabelIndex, weight: f64, kept: f64) -> LabelIndex {
        self.statements = self.statements * kept + 1.0;
        self.sums.iter_mut().for_each(|sum| *sum *= kept);
        let places = 0..self.labels.len();
        let by_sum = |a: &usize, b: &usize| self.sums[*a].total_cmp(&self.sums[*b]);
        let known = places
            .clone()
            .find(|&place| self.labels[place] == label && self.sums[place] > 0.0);
        let least = places.clone().min_by(by_sum);
        let stated = known.or(least).unwrap_or_default();
        self.labels[stated] = label;
        self.sums[stated] =
            weight.max(MIN_STATEMENT_WEIGHT) + known.map_or(0.0, |known| self.sums[known]);
        let by_sum = |a: &usize, b: &usize| self.sums[*a].total_cmp(&self.sums[*b]);
        let more = places.filter(|&place| self.sums[place] > self.sums[stated]);
        self.labels[more.max_by(by_sum).unwrap_or(stated)]
    }

    /// Removes statements of labels whose indices may be reused.
    pub(super) fn remove_labels(&mut self, is_gone: impl Fn(LabelIndex) -> bool) {
        for (label, sum) in self.labels.iter_mut().zip(&mut self.sums) {
            if is_gone(*label) {
                *label = 0;
                *sum = 0.0;
            }
        }
    }

    /// Certainty, 0 to 1, that the most stated label is not due to chance: the lead over the next
    /// label in standard deviations of a multinomial draw, as a two-sided probability. A vehicle
    /// that alternates between two labels has almost no vote.
    fn certainty(&self) -> f64 {
        let mut sums = self.sums;
        sums.sort_by(f64::total_cmp);
        let [third, second, first] = sums;
        let total = (first + second + third).max(f64::MIN_POSITIVE);
        let lead = (first - second) / total;
        let variance = ((first + second) / total - lead * lead)
            / (INDEPENDENT_FRAMES * self.statements).max(1.0);
        (NORMAL_TO_LOGISTIC * lead / variance.max(1e-9).sqrt()).tanh()
    }
}

impl StoredVote {
    /// The vehicle's latest statements.
    pub(super) fn recent(&self) -> RecentStatements {
        self.recent.as_deref().copied().unwrap_or_else(|| {
            let mut first = RecentStatements::default();
            first.add(self.label, self.confidence * self.visibility, 0.0);
            first
        })
    }

    pub(super) fn weighted(&self) -> WeightedVote {
        WeightedVote {
            vehicle: self.vehicle,
            label: self.label,
            weight: self.weight,
            independence: self.independence,
        }
    }
}

/// The votes on one landmark, at most one per vehicle, in order of vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct LandmarkVotes {
    pub(super) votes: Vec<StoredVote>,
    /// Probability of each label as of the last judgement.
    pub(super) posterior: Posterior,
    /// Whether the live evidence currently contains votes and posterior.
    pub(super) counted: bool,
    /// Whether the live evidence on confidences currently contains the votes' agreements.
    pub(super) agreements_counted: bool,
    /// The label of the verdict.
    pub(super) published: Option<LabelIndex>,
    /// When its oldest vote goes stale.
    pub(super) due: Option<Timestamp>,
}

impl LandmarkVotes {
    pub(super) fn of_vehicle(&self, vehicle: usize) -> Option<&StoredVote> {
        let place = self.place(vehicle).ok()?;
        Some(&self.votes[place])
    }

    /// The place of a vehicle's vote, or where it would be.
    fn place(&self, vehicle: usize) -> Result<usize, usize> {
        self.votes
            .binary_search_by_key(&vehicle, |vote| vote.vehicle)
    }

    pub(super) fn weighted_votes(&self) -> SmallVec<[WeightedVote; 4]> {
        self.votes.iter().map(StoredVote::weighted).collect()
    }

    pub(super) fn candidates(&self) -> SmallVec<[LabelIndex; 4]> {
        let mut labels: SmallVec<[LabelIndex; 4]> = self.votes.iter().map(|c| c.label).collect();
        labels.sort_unstable();
        labels.dedup();
        labels
    }

    /// Counts new votes as evidence on dependence, label bias and confidences; where there are many
    /// voters, `order` decides which pairs are compared.
    pub(super) fn compare(
        &mut self,
        dependence: &mut Dependence,
        label_bias: &mut LabelBias,
        calibration: &mut ConfidenceCalibration,
        order: impl Fn(usize) -> usize,
    ) {
        if self.votes.iter().any(|c| !c.compared) {
            let mut votes: Vec<_> = self
                .votes
                .iter()
                .map(|c| ComparedVote {
                    vehicle: c.vehicle,
                    label: c.label,
                    is_new: !c.compared,
                })
                .collect();
            votes.sort_by_key(|vote| order(vote.vehicle));
            dependence.compare(&votes);
            label_bias.compare(&votes);
            for vote in self.votes.iter_mut().filter(|c| !c.compared) {
                calibration.record_confidence(vote.vehicle, vote.confidence);
                vote.compared = true;
            }
        }
    }

    /// Sets the weight of every vote.
    pub(super) fn weigh(
        &mut self,
        dependence: &Dependence,
        calibration: &ConfidenceCalibration,
        weights: &Weights,
    ) {
        for place in 0..self.votes.len() {
            let &StoredVote {
                vehicle,
                label,
                confidence,
                visibility,
                ..
            } = &self.votes[place];
            let agrees = |other: usize| {
                self.of_vehicle(other)
                    .is_some_and(|vote| vote.label == label)
            };
            let independence = dependence.independence(vehicle, agrees);
            let band = calibration.band(vehicle, confidence);
            let vote = &mut self.votes[place];
            vote.independence = independence;
            vote.band = band;
            vote.weight = weights.of(band, confidence) * visibility;
            if let Some(recent) = &vote.recent {
                vote.weight *= recent.certainty();
            }
        }
    }

    /// Stores an evaluation, and adds to the evidence on confidences how probable the others make
    /// the label of each vote.
    pub(super) fn adopt_posterior(
        &mut self,
        judged: LandmarkPosterior,
        calibration: &mut ConfidenceCalibration,
    ) {
        if self.has_several_voters() {
            for (vote, agreement) in self.votes.iter_mut().zip(judged.agreements) {
                calibration.count(vote.band, agreement, 1.0);
                vote.agreement = agreement;
            }
            self.agreements_counted = true;
        }
        self.posterior = judged.labels;
    }

    /// Publishes the most probable label, unless the published one is at most `hysteresis` behind.
    pub(super) fn publish(&mut self, hysteresis: f64) {
        let mut best: Option<(LabelIndex, f64)> = None;
        for &(label, p) in &self.posterior {
            if best.is_none_or(|(_, most)| p > most) {
                best = Some((label, p));
            }
        }
        let kept = self
            .published
            .map_or(0.0, |published| probability(&self.posterior, published));
        if kept == 0.0 || best.is_some_and(|(_, p)| p > kept + hysteresis) {
            self.published = best.map(|(label, _)| label);
        }
    }

    /// Share of each label in the weighted votes; equal shares if all voters alternate, so that
    /// their votes have no weight.
    pub(super) fn majority(&self) -> Posterior {
        let total: f64 = self.votes.iter().map(|c| c.weight * c.independence).sum();
        let candidates = self.candidates();
        let equal = 1.0 / candidates.len() as f64;
        let of_label = |label| self.votes.iter().filter(move |c| c.label == label);
        let share = |label| {
            of_label(label)
                .map(|c| c.weight * c.independence)
                .sum::<f64>()
                / total
        };
        candidates
            .into_iter()
            .map(|label| (label, if total > 0.0 { share(label) } else { equal }))
            .collect()
    }

    /// Removes labels with the votes for them; returns the vehicles of these votes. Not allowed
    /// while they are counted.
    pub(super) fn remove_labels(&mut self, is_gone: impl Fn(LabelIndex) -> bool) -> Vec<usize> {
        let gone = self.votes.extract_if(.., |vote| is_gone(vote.label));
        let vehicles = gone.map(|vote| vote.vehicle).collect();
        self.posterior.retain(|(label, _)| !is_gone(*label));
        self.published = self.published.filter(|label| !is_gone(*label));
        let total: f64 = self.posterior.iter().map(|(_, p)| p).sum();
        if total > 0.0 && !self.votes.is_empty() {
            self.posterior.iter_mut().for_each(|(_, p)| *p /= total);
        } else {
            self.posterior.clear();
        }
        vehicles
    }

    /// Stores a vehicle's vote in place of its earlier one. Millions of votes may be stored, so room
    /// is made for at most one more than there are.
    pub(super) fn store(&mut self, vote: StoredVote) {
        match self.place(vote.vehicle) {
            Ok(place) => self.votes[place] = vote,
            Err(place) => {
                if self.votes.len() == self.votes.capacity() {
                    self.votes.reserve_exact(2);
                }
                self.votes.insert(place, vote);
            }
        }
    }

    /// Whether several vehicles voted, so that they can be compared with each other.
    pub(super) fn has_several_voters(&self) -> bool {
        self.votes.len() > 1
    }
}
