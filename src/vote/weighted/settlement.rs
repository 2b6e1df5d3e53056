//! The life of a vote: live evidence while it is fresh, then settled evidence that fades.

use super::{StoredVote, WeightedVoting};
use crate::model::time::Timestamp;
use crate::reputation::Evidence;
use crate::vote::likelihood::probability;

impl WeightedVoting {
    /// Sets the next expiry of a landmark: when its oldest vote goes stale.
    pub(super) fn schedule_expiry(&mut self, landmark: usize) {
        let freshness = self.freshness();
        let landmark_votes = self.landmarks.votes_mut(landmark);
        let oldest = landmark_votes.votes.iter().map(|vote| vote.at).min();
        let due = oldest.map(|at| at + freshness);
        if let Some(before) = std::mem::replace(&mut landmark_votes.due, due) {
            self.expiries.remove(&(before, landmark));
        }
        self.expiries.extend(due.map(|due| (due, landmark)));
    }

    /// Removes the votes that are stale at `now`.
    pub(super) fn expire(&mut self, now: Timestamp) {
        let freshness = self.freshness();
        let mut due = Vec::new();
        while let Some(&(at, landmark)) = self.expiries.first()
            && at <= now
        {
            self.expiries.pop_first();
            due.push((at, landmark));
        }
        // By name and not by index, which depends on the order of arrival.
        due.sort_by_key(|&(at, landmark)| (at, self.landmarks.id(landmark).clone()));
        for (_, landmark) in due {
            self.remove_votes(landmark, |vote| vote.at + freshness <= now);
            self.schedule_expiry(landmark);
        }
    }

    /// Removes the votes that `is_past` selects, after all votes on the landmark have been settled.
    pub(super) fn remove_votes(&mut self, landmark: usize, is_past: impl Fn(&StoredVote) -> bool) {
        if !self.landmarks.votes(landmark).votes.iter().any(&is_past) {
            return;
        }
        self.settle_votes(landmark);
        let landmark_votes = self.landmarks.votes_mut(landmark);
        for vote in landmark_votes.votes.extract_if(.., |vote| is_past(vote)) {
            self.stored[vote.vehicle] -= 1;
        }
        if landmark_votes.votes.is_empty() {
            landmark_votes.published = None;
            landmark_votes.posterior.clear();
        }
    }

    /// Removes a landmark's votes from the live evidence until it is evaluated again.
    pub(super) fn remove_live(&mut self, landmark: usize) {
        let landmark_votes = self.landmarks.votes_mut(landmark);
        if std::mem::take(&mut landmark_votes.counted) {
            self.model.add_live(
                &landmark_votes.weighted_votes(),
                &landmark_votes.posterior,
                -1.0,
            );
            if std::mem::take(&mut landmark_votes.agreements_counted) {
                for vote in &landmark_votes.votes {
                    self.calibration.count(vote.band, vote.agreement, -1.0);
                }
            }
        }
    }

    /// Turns the evaluated votes on a landmark into settled evidence; new votes are counted from
    /// then on.
    ///
    /// All are settled at once. If they were settled in turn, the first would be evaluated by
    /// evidence that the others still lack.
    pub(super) fn settle_votes(&mut self, landmark: usize) {
        self.remove_live(landmark);
        let landmark_votes = self.landmarks.votes_mut(landmark);
        if landmark_votes.has_several_voters() {
            // The model evaluates a vote by the others: a vehicle that decides alone must not
            // confirm itself.
            let judged = landmark_votes.votes.iter().filter(|vote| vote.judged);
            let settled: Vec<_> = judged
                .map(|vote| {
                    (
                        vote,
                        self.model
                            .leave_one_out(&landmark_votes.posterior, &vote.weighted()),
                    )
                })
                .collect();
            for (vote, others) in settled {
                self.model
                    .settle(&vote.weighted(), &others, &landmark_votes.posterior);
                self.calibration
                    .settle(vote.band, probability(&others, vote.label));
                let correct = landmark_votes.published == Some(vote.label);
                self.counts[vote.vehicle].add(correct);
                if vote.at >= self.recorded_from {
                    let node = &self.names[vote.vehicle];
                    let label = self.labels.name(vote.label);
                    self.evidence.push(Evidence {
                        node: node.clone(),
                        label: label.clone(),
                        correct,
                    });
                }
            }
        }
        for vote in &mut landmark_votes.votes {
            vote.since = vote.at;
            vote.judged = false;
            vote.compared = false;
        }
        self.changed.insert(landmark);
    }
}
