//! Batch estimation: all stored votes are judged together, whatever their order of arrival.

use super::WeightedVoting;
use crate::vote::calibration::Calibration;
use crate::vote::dependence::Dependence;

impl WeightedVoting {
    /// Judges all stored votes `passes` times, starting from majorities (Dawid & Skene 1979).
    pub(super) fn judge_all(&mut self, passes: u32) {
        let mut dependence = Dependence::of_stored();
        let mut calibration = Calibration::new(self.config.calibration_votes);
        let mut by_name = vec![0; self.names.len()];
        self.vehicles.values().enumerate().for_each(|(rank, &vehicle)| by_name[vehicle] = rank);
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.votes.iter_mut().for_each(|vote| vote.compared = false);
            landmark_votes.compare(&mut dependence, &mut calibration, |vehicle| by_name[vehicle]);
        }
        dependence.fit(&vec![true; self.names.len()]);
        self.start_from_majorities(&dependence, &calibration);
        for _ in 0..passes {
            self.model.refresh(0..self.names.len());
            let weights = calibration.weights();
            for landmark_votes in self.landmarks.values_mut() {
                landmark_votes.weigh(&dependence, &calibration, &weights);
                landmark_votes.posterior =
                    self.model.posterior(&landmark_votes.weighted_votes(), &landmark_votes.candidates());
            }
            calibration.clear_live();
            self.landmarks
                .values_mut()
                .for_each(|landmark_votes| landmark_votes.record_agreement(&self.model, &mut calibration));
            self.model.clear_live();
            for landmark_votes in self.landmarks.values_mut() {
                self.model.add_live(&landmark_votes.weighted_votes(), &landmark_votes.posterior, 1.0);
                landmark_votes.published = None;
                landmark_votes.publish(0.0);
            }
        }
        self.calibration.take_live(calibration);
    }

    /// Replaces all live evidence by that of the weighted majorities.
    pub(super) fn start_from_majorities(&mut self, dependence: &Dependence, calibration: &Calibration) {
        let weights = calibration.weights();
        self.model.clear_live();
        self.calibration.clear_live();
        for landmark_votes in self.landmarks.values_mut() {
            landmark_votes.published = None;
            landmark_votes.counted = true;
            landmark_votes.weigh(dependence, calibration, &weights);
            landmark_votes.votes.iter_mut().for_each(|vote| vote.agreement = None);
            landmark_votes.posterior = landmark_votes.majority();
            self.model.add_live(&landmark_votes.weighted_votes(), &landmark_votes.posterior, 1.0);
        }
    }
}
