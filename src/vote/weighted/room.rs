//! Making room: vehicles and labels that are forgotten for others.

use std::collections::BTreeSet;

use super::WeightedTally;
use crate::names::{Label, NodeName};
use crate::time::Timestamp;
use crate::vote::ballot::{Ballot, Cast};
use crate::vote::confusion::LabelIndex;
use crate::vote::model::Witness;

impl WeightedTally {
    /// Forgets vehicles with their votes and all that is known of them; others take their numbers.
    pub(in super::super) fn forget_vehicles(&mut self, nodes: &BTreeSet<NodeName>) {
        let gone: BTreeSet<usize> = nodes.iter().filter_map(|node| self.vehicles.remove(node)).collect();
        let is_theirs = |cast: &Cast| gone.contains(&cast.vehicle);
        let landmarks: Vec<_> =
            self.ballots.iter().filter(|(_, b)| b.casts.iter().any(is_theirs)).map(|(l, _)| l.clone()).collect();
        for landmark in landmarks {
            self.retire(&landmark, is_theirs);
        }
        self.dependence.forget(&gone);
        self.calibration.forget(&gone);
        self.labels.forget_vehicles(&gone);
        for &vehicle in &gone {
            self.records[vehicle] = (0, 0);
            self.model.witnesses[vehicle] = Witness::default();
        }
        self.free.extend(gone);
    }

    /// The number of a label; `stated` tells by whom and when.
    pub(super) fn label(&mut self, label: &Label, stated: Option<(usize, Timestamp)>) -> LabelIndex {
        let number = self.labels.take(label, stated);
        if self.model.labels() < self.labels.len() {
            self.model.add_label();
        }
        number
    }

    /// Forgets labels, with the votes for them, if one more would be more than `most`; returns how many votes.
    pub(in super::super) fn make_room_for(&mut self, label: &Label, most: usize) -> usize {
        if self.labels.has_room_for(label, most) {
            return 0;
        }
        let gone = self.labels.make_room(&self.model.support());
        let is_gone = |label: LabelIndex| gone.contains(&label);
        let has_gone = |ballot: &Ballot| {
            ballot.casts.iter().any(|cast| is_gone(cast.label)) || ballot.posterior.iter().any(|(l, _)| is_gone(*l))
        };
        let landmarks: Vec<_> = self.ballots.iter().filter(|(_, b)| has_gone(b)).map(|(l, _)| l.clone()).collect();
        let mut forgotten = 0;
        for landmark in landmarks {
            // Not settled: the other votes would become evidence more often than by their age.
            self.uncount(&landmark);
            forgotten += self.ballots.get_mut(&landmark).map_or(0, |ballot| ballot.forget_labels(is_gone));
            self.touched.insert(landmark);
        }
        for ballot in self.ballots.values_mut() {
            ballot.casts.iter_mut().for_each(|cast| cast.recent.forget_labels(is_gone));
        }
        self.model.forget_labels(&gone);
        self.dependence.forget_labels(&gone);
        forgotten
    }
}
