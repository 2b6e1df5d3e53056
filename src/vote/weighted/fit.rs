//! Fits of all stored votes: online whenever they have grown, and as passes over a recording.

use std::collections::BTreeSet;

use super::WeightedVoting;
use crate::model::names::LandmarkId;
use crate::vote::calibration::ConfidenceCalibration;
use crate::vote::confusion::LabelIndex;
use crate::vote::dependence::Dependence;
use crate::vote::landmark_votes::LandmarkVotes;
use crate::vote::model::Structure;
use crate::vote::parameters::{CONVERGED, CORRELATIONS, FIT_GROWTH, FIT_PASSES, MANY_VOTES, MIN_FIT_VOTES};

/// How well the last pass of a fit predicts each vote from the others on its landmark.
#[derive(Debug, Clone, Copy, Default)]
struct Prediction {
    /// Log probability, in nats, by correlation.
    logs: [f64; CORRELATIONS.len()],
    votes: f64,
}

impl WeightedVoting {
    pub(super) fn is_fit_due(&self) -> bool {
        self.since_fit >= MIN_FIT_VOTES.max((FIT_GROWTH * self.stored as f64) as usize)
    }

    /// Fits all stored votes, or, of very many, goes on from their present verdicts by one pass. Returns the landmarks whose
    /// published label changed.
    pub(super) fn fit_online(&mut self) -> BTreeSet<LandmarkId> {
        let before: Vec<_> = self.landmarks.values().map(|landmark| landmark.published).collect();
        if self.stored <= MANY_VOTES {
            self.fit(FIT_PASSES);
        } else {
            self.since_fit = 0;
            self.pass();
        }
        let hysteresis = self.config.hysteresis;
        self.landmarks.values_mut().for_each(|landmark| landmark.publish(hysteresis));
        let changed = self.landmarks.iter().zip(before).filter(|((_, landmark), before)| landmark.published != *before);
        changed.map(|((id, _), _)| id.clone()).collect()
    }

    /// Fits all stored votes in at most `passes` passes, independently of their order of arrival.
    pub(super) fn fit_stored(&mut self, passes: u32) {
        let mut dependence = Dependence::of_stored();
        let mut calibration = ConfidenceCalibration::new(self.config.calibration_votes);
        let mut by_name = vec![0; self.names.len()];
        self.vehicles.values().enumerate().for_each(|(rank, &vehicle)| by_name[vehicle] = rank);
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.votes.iter_mut().for_each(|vote| vote.compared = false);
            landmark_votes.compare(&mut dependence, &mut calibration, |vehicle| by_name[vehicle]);
        }
        dependence.fit(&vec![true; self.names.len()]);
        let online = std::mem::replace(&mut self.dependence, dependence);
        let settled = std::mem::replace(&mut self.calibration, calibration);
        self.fit(passes);
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.published = None;
            landmark_votes.publish(0.0);
        }
        self.dependence = online;
        let calibration = std::mem::replace(&mut self.calibration, settled);
        self.calibration.take_live(calibration);
    }

    /// Fits both structures, each from the majority, and keeps the structure that pays.
    fn fit(&mut self, passes: u32) {
        self.since_fit = 0;
        let present = self.model.structure;
        let other = if present == Structure::OneCoin { Structure::PerClass } else { Structure::OneCoin };
        let by_other = self.fit_structure(other, passes);
        let mut chosen = self.fit_structure(present, passes);
        let saved = by_other.logs[0] - chosen.logs[0];
        self.model.choose_structure(if other == Structure::PerClass { saved } else { -saved }, chosen.votes);
        if self.model.structure == other {
            chosen = self.fit_structure(other, passes);
        }
        for (sum, log) in self.predictions.iter_mut().zip(chosen.logs) {
            *sum = *sum / 2.0 + log;
        }
    }

    /// Starts from the majority of the fresh votes, with the past as prior, and judges all landmarks in turn.
    fn fit_structure(&mut self, structure: Structure, passes: u32) -> Prediction {
        self.model.structure = structure;
        self.model.clear_live();
        self.calibration.clear_live();
        let weights = self.calibration.weights();
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.weigh(&self.dependence, &self.calibration, &weights);
            landmark_votes.votes.iter_mut().for_each(|vote| (vote.agreement, vote.judged) = (None, true));
            landmark_votes.counted = true;
            landmark_votes.posterior = landmark_votes.majority();
            self.model.add_live(&landmark_votes.weighted_votes(), &landmark_votes.posterior, 1.0);
        }
        for _ in 0..passes.max(1) {
            if self.pass() < CONVERGED {
                break;
            }
        }
        self.predict()
    }

    /// Judges all landmarks in turn, each by the evidence of the others; returns the mean change of their probabilities.
    fn pass(&mut self) -> f64 {
        self.model.refresh();
        let weights = self.calibration.is_informed().then(|| self.calibration.weights());
        let mut change = 0.0;
        for landmark_votes in self.landmarks.values_mut().filter(|landmark| !landmark.votes.is_empty()) {
            landmark_votes.remove_live(&mut self.model, &mut self.calibration);
            if let Some(weights) = &weights {
                landmark_votes.weigh(&self.dependence, &self.calibration, weights);
            }
            let votes = landmark_votes.weighted_votes();
            let judged = self.model.judge(&votes, &landmark_votes.candidates());
            let before = &landmark_votes.posterior;
            change += before.iter().zip(&judged.posterior).map(|((_, a), (_, b))| (a - b).abs()).sum::<f64>();
            landmark_votes.take(judged, &votes, &mut self.model, &mut self.calibration);
        }
        change / self.landmarks.len().max(1) as f64
    }

    /// Predicts votes from the others on their landmarks; of many landmarks, evenly spaced ones.
    fn predict(&mut self) -> Prediction {
        let mut prediction = Prediction::default();
        let step = self.stored.div_ceil(MANY_VOTES).max(1);
        let several = self.landmarks.values_mut().filter(|landmark| landmark.has_several_voters());
        for landmark_votes in several.step_by(step) {
            let votes = landmark_votes.weighted_votes();
            self.model.add_live(&votes, &landmark_votes.posterior, -1.0);
            let judged = self.model.judge(&votes, &landmark_votes.candidates());
            self.model.add_live(&votes, &landmark_votes.posterior, 1.0);
            let effective = landmark_votes.effective_votes();
            for (n, vote) in votes.iter().enumerate() {
                for (log, correlation) in prediction.logs.iter_mut().zip(CORRELATIONS) {
                    *log += vote.independence * judged.log_prediction(n, exponent(effective - 1.0, correlation));
                }
                prediction.votes += vote.independence;
            }
        }
        prediction
    }

    /// Published probabilities of the labels of a landmark: the model's, as if the votes on one item were
    /// correlated by the amount that predicts them best.
    pub(super) fn published(&self, landmark_votes: &LandmarkVotes) -> impl Iterator<Item = (LabelIndex, f64)> {
        let best = (1..CORRELATIONS.len()).fold(
            0,
            |best, n| {
                if self.predictions[n] > self.predictions[best] { n } else { best }
            },
        );
        let exponent = exponent(landmark_votes.effective_votes(), CORRELATIONS[best]);
        let powers = landmark_votes.posterior.iter().map(move |&(label, p)| (label, p.powf(exponent)));
        let total: f64 = powers.clone().map(|(_, p)| p).sum();
        powers.map(move |(label, p)| (label, p / total)).collect::<Vec<_>>().into_iter()
    }
}

/// Design effect of `votes` votes that are correlated (Kish 1965): so much does each count.
fn exponent(votes: f64, correlation: f64) -> f64 {
    1.0 / (1.0 + (votes - 1.0).max(0.0) * correlation)
}
