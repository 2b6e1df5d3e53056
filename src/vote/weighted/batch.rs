//! Batch estimation: all stored votes are evaluated together, independent of their order of
//! arrival.

use super::WeightedVoting;
use crate::model::names::NodeName;
use crate::vote::calibration::ConfidenceCalibration;
use crate::vote::dependence::Dependence;
use crate::vote::label_bias::LabelBias;

impl WeightedVoting {
    /// Evaluates all stored votes `passes` times together, starting from the majorities (Dawid &
    /// Skene 1979).
    pub(super) fn judge_all(&mut self, passes: u32) {
        let mut dependence = Dependence::new(f64::INFINITY);
        let mut label_bias = LabelBias::new(f64::INFINITY);
        let mut calibration = ConfidenceCalibration::new(self.config.calibration_votes);
        let mut vehicles: Vec<(&NodeName, &usize)> = self.vehicles.iter().collect();
        vehicles.sort_unstable();
        let mut by_name = vec![0; self.names.len()];
        for (rank, (_, vehicle)) in vehicles.into_iter().enumerate() {
            by_name[*vehicle] = rank;
        }
        for landmark in self.landmarks.by_name() {
            let landmark_votes = self.landmarks.votes_mut(landmark);
            landmark_votes
                .votes
                .iter_mut()
                .for_each(|vote| vote.compared = false);
            landmark_votes.compare(
                &mut dependence,
                &mut label_bias,
                &mut calibration,
                |vehicle| by_name[vehicle],
            );
        }
        dependence.fit(&vec![true; self.names.len()]);
        std::mem::swap(&mut self.dependence, &mut dependence);
        std::mem::swap(&mut self.model.label_bias, &mut label_bias);
        let settled = std::mem::replace(&mut self.calibration, calibration);
        self.start_again();
        (0..passes).for_each(|_| self.judge_together());
        self.dependence = dependence;
        self.model.label_bias = label_bias;
        self.model.refresh(std::iter::empty());
        let calibration = std::mem::replace(&mut self.calibration, settled);
        self.calibration.merge_live(calibration);
    }

    /// One pass: evaluates every landmark by the same evidence, then replaces the live evidence.
    fn judge_together(&mut self) {
        let landmarks = self.landmarks.by_name();
        self.model.refresh(0..self.names.len());
        let weights = self.calibration.weights();
        for &landmark in &landmarks {
            let landmark_votes = self.landmarks.votes_mut(landmark);
            landmark_votes.weigh(&self.dependence, &self.calibration, &weights);
        }
        self.calibration.clear_live();
        for &landmark in &landmarks {
            let landmark_votes = self.landmarks.votes_mut(landmark);
            let judged = self.model.judge(
                &landmark_votes.weighted_votes(),
                &landmark_votes.candidates(),
            );
            landmark_votes.adopt_posterior(judged, &mut self.calibration);
        }
        self.model.clear_live();
        for &landmark in &landmarks {
            let landmark_votes = self.landmarks.votes_mut(landmark);
            self.model.add_live(
                &landmark_votes.weighted_votes(),
                &landmark_votes.posterior,
                1.0,
            );
            landmark_votes.published = None;
            landmark_votes.publish(0.0);
        }
    }

    /// Replaces all live evidence by the evidence from the weighted majorities; all landmarks are
    /// evaluated when the round closes.
    pub(super) fn start_again(&mut self) {
        self.model.clear_live();
        self.calibration.clear_live();
        let weights = self.calibration.weights();
        for landmark in self.landmarks.by_name() {
            self.changed.insert(landmark);
            let landmark_votes = self.landmarks.votes_mut(landmark);
            landmark_votes.published = None;
            landmark_votes.counted = true;
            landmark_votes.weigh(&self.dependence, &self.calibration, &weights);
            landmark_votes.agreements_counted = false;
            landmark_votes.posterior = landmark_votes.majority();
            self.model.add_live(
                &landmark_votes.weighted_votes(),
                &landmark_votes.posterior,
                1.0,
            );
        }
    }
}
