//! The life of a vote: live evidence while it is fresh, then settled evidence that fades.

use super::{StoredVote, WeightedVoting};
use crate::model::names::LandmarkId;
use crate::model::time::Timestamp;
use crate::reputation::Evidence;
use crate::vote::model::probability;

impl WeightedVoting {
    /// Sets the next expiry of a landmark: when its oldest vote goes stale.
    pub(super) fn schedule_expiry(&mut self, landmark: &LandmarkId) {
        let freshness = self.freshness();
        let Some(landmark_votes) = self.landmarks.get_mut(landmark) else { return };
        let oldest = landmark_votes.votes.iter().map(|vote| vote.at).min();
        let due = oldest.map(|at| at + freshness);
        if let Some(before) = std::mem::replace(&mut landmark_votes.due, due) {
            self.expiries.remove(&(before, landmark.clone()));
        }
        self.expiries.extend(due.map(|due| (due, landmark.clone())));
    }

    /// Removes the votes that are stale at `now`.
    pub(super) fn expire(&mut self, now: Timestamp) {
        let freshness = self.freshness();
        while self.expiries.first().is_some_and(|(due, _)| *due <= now) {
            let Some((_, landmark)) = self.expiries.pop_first() else { break };
            self.remove_votes(&landmark, |vote| vote.at + freshness <= now);
            self.schedule_expiry(&landmark);
        }
    }

    /// Removes the votes that `is_past` selects, after all votes on the landmark have been settled.
    pub(super) fn remove_votes(&mut self, landmark: &LandmarkId, is_past: impl Fn(&StoredVote) -> bool) {
        if !self.landmarks.get(landmark).is_some_and(|l| l.votes.iter().any(&is_past)) {
            return;
        }
        self.settle_votes(landmark);
        let Some(landmark_votes) = self.landmarks.get_mut(landmark) else { return };
        let before = landmark_votes.votes.len();
        landmark_votes.votes.retain(|vote| !is_past(vote));
        self.stored -= before - landmark_votes.votes.len();
        if landmark_votes.votes.is_empty() {
            landmark_votes.published = None;
            landmark_votes.posterior.clear();
        }
    }

    /// Takes a landmark's votes out of the live evidence until it is judged again.
    pub(super) fn remove_live(&mut self, landmark: &LandmarkId) {
        if let Some(landmark_votes) = self.landmarks.get_mut(landmark) {
            landmark_votes.remove_live(&mut self.model, &mut self.calibration);
        }
    }

    /// Turns the judged votes on a landmark into settled evidence; they begin to count anew.
    ///
    /// All are settled at once. If they were settled in turn, the first would be judged by evidence that the others
    /// still lack.
    pub(super) fn settle_votes(&mut self, landmark: &LandmarkId) {
        self.remove_live(landmark);
        let Some(landmark_votes) = self.landmarks.get_mut(landmark) else { return };
        if landmark_votes.has_several_voters() {
            let votes = landmark_votes.weighted_votes();
            let witnesses = self.model.judge_as_witnesses(&votes, &landmark_votes.candidates());
            for (n, vote) in landmark_votes.votes.iter().enumerate().filter(|(_, vote)| vote.judged) {
                let others = witnesses.without(n, 1.0);
                self.calibration.settle(usize::from(vote.band), probability(&others, vote.label));
                let settled = self.model.settle(&votes[n], &others, &landmark_votes.posterior);
                let Some(correct) = settled else { continue };
                let vehicle = vote.vehicle as usize;
                self.counts[vehicle].add(correct);
                if vote.at >= self.recorded_from {
                    let (node, label) = (&self.names[vehicle], self.labels.name(vote.label));
                    self.evidence.push(Evidence { node: node.clone(), label: label.clone(), correct });
                }
            }
        }
        self.since_fit = self.since_fit.saturating_add(landmark_votes.votes.len());
        for vote in &mut landmark_votes.votes {
            (vote.since, vote.judged, vote.compared) = (vote.at, false, false);
        }
        self.changed.insert(landmark.clone());
    }
}
