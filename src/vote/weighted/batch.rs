//! Batch estimation: all stored votes are evaluated together, independent of their order of
//! arrival.

use super::{START_SWEEPS, WeightedVoting};
use crate::vote::calibration::ConfidenceCalibration;
use crate::vote::dependence::Dependence;

/// Log loss per vote, in nats, by which passes may predict votes worse than their start.
const MAX_LOSS: f64 = 0.01;

impl WeightedVoting {
    /// Evaluates all stored votes as online but in the order of the landmarks' names, then `passes`
    /// times together (Dawid & Skene 1979).
    ///
    /// Evaluation in turn is the better start, because each landmark is evaluated without its own
    /// votes in the evidence.
    pub(super) fn judge_all(&mut self, passes: u32) {
        let mut dependence = Dependence::of_stored();
        let mut calibration = ConfidenceCalibration::new(self.config.calibration_votes);
        let mut by_name = vec![0; self.names.len()];
        self.vehicles
            .values()
            .enumerate()
            .for_each(|(rank, &vehicle)| by_name[vehicle] = rank);
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes
                .votes
                .iter_mut()
                .for_each(|vote| vote.compared = false);
            landmark_votes.compare(&mut dependence, &mut calibration, |vehicle| {
                by_name[vehicle]
            });
        }
        dependence.fit(&vec![true; self.names.len()]);
        let online = std::mem::replace(&mut self.dependence, dependence);
        let settled = std::mem::replace(&mut self.calibration, calibration);
        self.start_again(START_SWEEPS);
        let in_turn = (
            self.model.clone(),
            self.calibration.clone(),
            self.landmarks.clone(),
        );
        let before = self.log_probability();
        (0..passes).for_each(|_| self.judge_together());
        let after = self.log_probability();
        let judged = self
            .landmarks
            .values()
            .filter(|landmark_votes| landmark_votes.has_several_voters());
        let votes: usize = judged
            .map(|landmark_votes| landmark_votes.votes.len())
            .sum();
        if before - after > MAX_LOSS * votes as f64 {
            (self.model, self.calibration, self.landmarks) = in_turn;
            // In the order of time, labels with a small lead would persist.
            for landmark_votes in self.landmarks.values_mut() {
                landmark_votes.published = None;
                landmark_votes.publish(0.0);
            }
        }
        self.dependence = online;
        let calibration = std::mem::replace(&mut self.calibration, settled);
        self.calibration.take_live(calibration);
    }

    /// Log of the probability of all votes, each predicted from the other votes on the landmark and
    /// those on others.
    fn log_probability(&mut self) -> f64 {
        let mut sum = 0.0;
        for landmark_votes in self
            .landmarks
            .values()
            .filter(|landmark_votes| landmark_votes.has_several_voters())
        {
            let votes = landmark_votes.weighted_votes();
            self.model.add_live(&votes, &landmark_votes.posterior, -1.0);
            self.model.refresh(votes.iter().map(|vote| vote.vehicle));
            sum += self
                .model
                .judge(&votes, &landmark_votes.candidates())
                .log_probability;
            self.model.add_live(&votes, &landmark_votes.posterior, 1.0);
        }
        sum
    }

    /// One pass: evaluates every landmark by the same evidence, then replaces the live evidence.
    fn judge_together(&mut self) {
        self.model.refresh(0..self.names.len());
        let weights = self.calibration.weights();
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.weigh(&self.dependence, &self.calibration, &weights);
        }
        self.calibration.clear_live();
        for landmark_votes in self.landmarks.values_mut() {
            let judged = self.model.judge(
                &landmark_votes.weighted_votes(),
                &landmark_votes.candidates(),
            );
            landmark_votes.take(judged, &mut self.calibration);
        }
        self.model.clear_live();
        for landmark_votes in self.landmarks.values_mut() {
            self.model.add_live(
                &landmark_votes.weighted_votes(),
                &landmark_votes.posterior,
                1.0,
            );
            landmark_votes.published = None;
            landmark_votes.publish(0.0);
        }
    }

    /// Clears all live evidence and every verdict, and evaluates all landmarks in turn, `sweeps`
    /// times.
    pub(super) fn start_again(&mut self, sweeps: u32) {
        self.model.clear_live();
        self.model.clear_coupling();
        self.calibration.clear_live();
        for landmark_votes in self.landmarks.values_mut() {
            (landmark_votes.published, landmark_votes.counted) = (None, false);
            for vote in &mut landmark_votes.votes {
                (vote.agreement, vote.judged) = (None, false);
            }
        }
        let landmarks: Vec<_> = self.landmarks.keys().cloned().collect();
        for _ in 0..sweeps {
            let weights = self.calibration.weights();
            landmarks
                .iter()
                .for_each(|landmark| self.judge(landmark, &weights));
        }
    }

    /// Replaces all live evidence by the evidence from the weighted majorities.
    pub(super) fn start_from_majorities(&mut self) {
        let weights = self.calibration.weights();
        self.model.clear_live();
        self.calibration.clear_live();
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.published = None;
            landmark_votes.counted = true;
            landmark_votes.weigh(&self.dependence, &self.calibration, &weights);
            landmark_votes
                .votes
                .iter_mut()
                .for_each(|vote| vote.agreement = None);
            landmark_votes.posterior = landmark_votes.majority();
            self.model.add_live(
                &landmark_votes.weighted_votes(),
                &landmark_votes.posterior,
                1.0,
            );
        }
    }
}
