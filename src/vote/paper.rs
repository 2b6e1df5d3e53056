//! The paper's voting without changes.
//!
//! S(ρ,l) = Σ_v Σ_ω [l_ω = l] r_v c_ω k(ρ,v), without clearing; the label is λ_ρ = argmax_l S(ρ,l);
//! r_v += Δr_v after each verdict.

use std::collections::{BTreeMap, BTreeSet};

use hashbrown::HashMap;

use super::config::{PaperConfig, VoteConfig};
use super::method::{self, NewVote, VotingMethod};
use super::visibility;
use crate::model::names::{Label, LandmarkId, NodeName};
use crate::model::time::Timestamp;
use crate::reputation::Evidence;
use crate::wire::{Reputation, Verdict};

/// Lowest and highest reputation: `cap(…, 30, 100)` read as percent, applied to r_v after the
/// change was added.
///
/// The paper prints the cap on Δr_v, in which case every verdict would add at least 30 to a
/// reputation that starts at 0.5. Its text states that the *scores* remain between 30 and 100.
pub const REPUTATION_RANGE: (f64, f64) = (0.30, 1.00);

#[derive(Debug, Clone)]
struct VehicleScore {
    reputation: Reputation,
    /// Votes since the last verdict.
    votes: Vec<(LandmarkId, Label)>,
}

#[derive(Debug, Clone, Default)]
struct LandmarkScores {
    scores: BTreeMap<Label, f64>,
    contributors: BTreeSet<NodeName>,
    /// Whether it has votes in this round.
    has_new_votes: bool,
}

/// The sums S(ρ,l) and reputations r_v.
#[derive(Debug, Clone)]
pub(super) struct PaperVoting {
    config: PaperConfig,
    /// Hashed, because the order is irrelevant: a vote concerns one of many landmarks.
    landmarks: HashMap<LandmarkId, LandmarkScores>,
    vehicles: BTreeMap<NodeName, VehicleScore>,
    changed: Vec<LandmarkId>,
}

impl PaperVoting {
    pub(super) fn new(config: PaperConfig) -> Self {
        Self {
            config,
            landmarks: HashMap::new(),
            vehicles: BTreeMap::new(),
            changed: Vec::new(),
        }
    }

    /// The score of a vehicle; a new vehicle starts with the configured initial reputation.
    fn vehicle(&mut self, node: &NodeName) -> &mut VehicleScore {
        let reputation = Reputation {
            score: self.config.initial_reputation,
            correct: 0,
            incorrect: 0,
        };
        self.vehicles
            .entry(node.clone())
            .or_insert_with(|| VehicleScore {
                reputation,
                votes: Vec::new(),
            })
    }
}

impl VotingMethod for PaperVoting {
    fn configure(&mut self, config: &VoteConfig) {
        self.config = config.paper.clone();
    }

    fn add_landmark(&mut self, landmark: LandmarkId) {
        self.landmarks.entry(landmark).or_default();
    }

    fn remove_landmark(&mut self, landmark: &LandmarkId) {
        self.landmarks.remove(landmark);
    }

    fn has_landmark(&self, landmark: &LandmarkId) -> bool {
        self.landmarks.contains_key(landmark)
    }

    fn landmarks(&self) -> Vec<LandmarkId> {
        let mut landmarks: Vec<_> = self.landmarks.keys().cloned().collect();
        landmarks.sort_unstable();
        landmarks
    }

    /// Removes reputations and names; the votes remain in the sums.
    fn remove_vehicles(&mut self, nodes: &BTreeSet<NodeName>) {
        self.vehicles.retain(|node, _| !nodes.contains(node));
        self.landmarks
            .values_mut()
            .for_each(|known| known.contributors.retain(|node| !nodes.contains(node)));
    }

    fn make_room_for(&mut self, vote: &NewVote<'_>, max_labels: usize) -> Option<usize> {
        let known = self.landmarks.get(vote.landmark);
        known
            .is_none_or(|l| l.scores.len() < max_labels || l.scores.contains_key(vote.label))
            .then_some(0)
    }

    /// Adds r_v · c_ω · k for one detection.
    fn add_vote(&mut self, vote: &NewVote<'_>) {
        let visibility = vote
            .range_bearing
            .map_or(1.0, |(d, a)| visibility::paper(&self.config, d, a));
        let vehicle = self.vehicle(vote.node);
        vehicle
            .votes
            .push((vote.landmark.clone(), vote.label.clone()));
        let score = vehicle.reputation.score * vote.confidence * visibility;
        let landmark = self.landmarks.entry_ref(vote.landmark).or_default();
        *landmark.scores.entry(vote.label.clone()).or_insert(0.0) += score;
        landmark.contributors.insert(vote.node.clone());
        if !std::mem::replace(&mut landmark.has_new_votes, true) {
            self.changed.push(vote.landmark.clone());
        }
    }

    /// Ends a round: changes every vehicle's reputation by step · (correct − incorrect) / objects
    /// over its votes since the last verdict.
    fn close(&mut self, _now: Timestamp) -> (BTreeSet<LandmarkId>, Vec<Evidence>) {
        let changed = std::mem::take(&mut self.changed);
        let mut labels: HashMap<&LandmarkId, Option<Label>> = HashMap::with_capacity(changed.len());
        for id in &changed {
            if let Some(landmark) = self.landmarks.get_mut(id) {
                landmark.has_new_votes = false;
                labels.insert(id, method::best(&landmark.scores).cloned());
            }
        }
        for VehicleScore { reputation, votes } in
            self.vehicles.values_mut().filter(|v| !v.votes.is_empty())
        {
            let objects = votes.len() as u64;
            let is_correct = |(landmark, label): &&(LandmarkId, Label)| {
                labels.get(landmark).and_then(Option::as_ref) == Some(label)
            };
            let correct = votes.iter().filter(is_correct).count() as u64;
            let balance = (2.0 * correct as f64 - objects as f64) / objects as f64;
            let (low, high) = REPUTATION_RANGE;
            reputation.score = (reputation.score + self.config.step * balance).clamp(low, high);
            reputation.correct += correct;
            reputation.incorrect += objects - correct;
            votes.clear();
        }
        drop(labels);
        (changed.into_iter().collect(), Vec::new())
    }

    fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        let LandmarkScores {
            scores,
            contributors,
            ..
        } = self.landmarks.get(landmark)?;
        Some(method::verdict(
            landmark.clone(),
            scores.clone(),
            None,
            contributors.iter().cloned().collect(),
        ))
    }

    fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        self.vehicles
            .iter()
            .map(|(node, vehicle)| (node.clone(), vehicle.reputation))
            .collect()
    }

    /// Reputations of vehicles that are not listed are kept.
    fn resume(&mut self, reputations: &BTreeMap<NodeName, Reputation>) {
        let (low, high) = REPUTATION_RANGE;
        for (node, reputation) in reputations {
            self.vehicle(node).reputation = Reputation {
                score: reputation.score.clamp(low, high),
                ..*reputation
            };
        }
    }
}
