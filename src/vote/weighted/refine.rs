//! Judging all stored votes at once, whatever the order they came in.

use super::WeightedTally;
use crate::vote::calibration::Calibration;
use crate::vote::dependence::Dependence;

impl WeightedTally {
    /// Judges all stored votes `passes` times over, starting from majorities (Dawid & Skene 1979).
    pub(in super::super) fn refine(&mut self, passes: u32) {
        let mut dependence = Dependence::of_stored();
        let mut calibration = Calibration::new(self.config.calibration_votes);
        let mut by_name = vec![0; self.names.len()];
        self.vehicles.values().enumerate().for_each(|(rank, &vehicle)| by_name[vehicle] = rank);
        for ballot in self.ballots.values_mut() {
            ballot.casts.iter_mut().for_each(|cast| cast.compared = false);
            ballot.compare(&mut dependence, &mut calibration, |vehicle| by_name[vehicle]);
        }
        dependence.fit(&vec![true; self.names.len()]);
        self.start_from_majorities(&dependence, &calibration);
        for _ in 0..passes {
            self.model.prepare(0..self.names.len());
            let weights = calibration.weights();
            for ballot in self.ballots.values_mut() {
                ballot.weigh(&dependence, &calibration, &weights);
                ballot.posterior = self.model.posterior(&ballot.words(), &ballot.candidates());
            }
            calibration.clear_live();
            self.ballots.values_mut().for_each(|ballot| ballot.agree(&self.model, &mut calibration));
            self.model.clear_live();
            for ballot in self.ballots.values_mut() {
                self.model.count(&ballot.words(), &ballot.posterior, 1.0);
                ballot.shown = None;
                ballot.show(0.0);
            }
        }
        self.calibration.take_live(calibration);
    }

    pub(super) fn start_from_majorities(&mut self, dependence: &Dependence, calibration: &Calibration) {
        let weights = calibration.weights();
        self.model.clear_live();
        self.calibration.clear_live();
        for ballot in self.ballots.values_mut() {
            ballot.shown = None;
            ballot.counted = true;
            ballot.weigh(dependence, calibration, &weights);
            ballot.casts.iter_mut().for_each(|cast| cast.agreement = None);
            ballot.posterior = ballot.majority();
            self.model.count(&ballot.words(), &ballot.posterior, 1.0);
        }
    }
}
