//! Eviction of vehicles and labels that make room for others.

use std::collections::BTreeSet;

use super::{LandmarkVotes, StoredVote, WeightedVoting};
use crate::model::names::{Label, NodeName};
use crate::model::time::Timestamp;
use crate::reputation::Counts;
use crate::vote::dawid_skene::VehicleEvidence;
use crate::vote::index_map::LabelIndex;

impl WeightedVoting {
    /// Removes vehicles with their votes and the evidence about them; other vehicles reuse their
    /// indices.
    pub(super) fn evict_vehicles(&mut self, nodes: &BTreeSet<NodeName>) {
        let gone: BTreeSet<usize> = nodes
            .iter()
            .filter_map(|node| self.vehicles.remove(node))
            .collect();
        let is_theirs = |vote: &StoredVote| gone.contains(&vote.vehicle);
        for landmark in self.landmarks_where(|l| l.votes.iter().any(is_theirs)) {
            self.remove_votes(landmark, is_theirs);
        }
        self.dependence.remove_vehicles(&gone);
        self.calibration.remove_vehicles(&gone);
        self.model.label_bias.remove_vehicles(&gone);
        self.labels.remove_vehicles(&gone);
        for &vehicle in &gone {
            self.counts[vehicle] = Counts::default();
            self.model.vehicles[vehicle] = VehicleEvidence::default();
        }
        self.free.extend(gone);
    }

    fn landmarks_where(&self, is_affected: impl Fn(&LandmarkVotes) -> bool) -> Vec<usize> {
        let mut landmarks = self.landmarks.by_name();
        landmarks.retain(|landmark| is_affected(self.landmarks.votes(*landmark)));
        landmarks
    }

    /// The index of a label; `stated` is the vehicle that stated it and the time.
    pub(super) fn label(
        &mut self,
        label: &Label,
        stated: Option<(usize, Timestamp)>,
    ) -> LabelIndex {
        let index = self.labels.intern(label, stated);
        if self.model.labels() < self.labels.len() {
            self.model.add_label();
        }
        index
    }

    /// Removes labels with the votes for them, if `label` would exceed `max_labels`; returns the
    /// number of votes.
    pub(super) fn evict_labels_for(&mut self, label: &Label, max_labels: usize) -> usize {
        if self.labels.has_room_for(label, max_labels) {
            return 0;
        }
        let gone = self.labels.make_room(&self.model.support());
        let is_gone = |label: LabelIndex| gone.contains(&label);
        let is_affected = |l: &LandmarkVotes| {
            l.votes.iter().any(|vote| is_gone(vote.label))
                || l.posterior.iter().any(|(label, _)| is_gone(*label))
        };
        let mut dropped = 0;
        for landmark in self.landmarks_where(is_affected) {
            // Without settling: the other votes would become evidence more often than by their age.
            self.remove_live(landmark);
            for vehicle in self.landmarks.votes_mut(landmark).remove_labels(is_gone) {
                self.stored[vehicle] -= 1;
                dropped += 1;
            }
            self.changed.insert(landmark);
        }
        let votes = self.landmarks.iter_mut().flat_map(|l| &mut l.votes);
        for recent in votes.filter_map(|vote| vote.recent.as_deref_mut()) {
            recent.remove_labels(is_gone);
        }
        self.model.remove_labels(&gone);
        self.dependence.remove_labels(&gone);
        dropped
    }
}
