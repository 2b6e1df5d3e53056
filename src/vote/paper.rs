//! The paper's tally, to the letter.

use std::collections::{BTreeMap, BTreeSet};

use hashbrown::HashMap;

use super::config::PaperConfig;
use crate::names::{Label, LandmarkId, NodeName};
use crate::wire::{Reputation, Verdict};

/// Lowest and highest reputation: `cap(…, 30, 100)` read as percent, on r_v after the change was added.
///
/// As printed the cap is on Δr_v, so that every verdict would add at least 30 to a reputation that starts at 0.5;
/// the text says that the *scores* remain between 30 and 100.
pub const REPUTATION_RANGE: (f64, f64) = (0.30, 1.00);

#[derive(Debug, Clone)]
struct Vehicle {
    reputation: f64,
    correct: u64,
    incorrect: u64,
    votes: Vec<(LandmarkId, Label)>,
}

impl Vehicle {
    fn new(config: &PaperConfig) -> Self {
        Self { reputation: config.initial_reputation, correct: 0, incorrect: 0, votes: Vec::new() }
    }
}

/// What was said at a location.
#[derive(Debug, Clone, Default)]
struct Place {
    scores: BTreeMap<Label, f64>,
    contributors: BTreeSet<NodeName>,
    /// Whether it was voted on in this round.
    is_touched: bool,
}

/// S(ρ,l) = Σ_v Σ_ω [l_ω = l] r_v c_ω k(ρ,v), never cleared; λ_ρ = argmax_l S(ρ,l); r_v += Δr_v after each verdict.
#[derive(Debug, Clone)]
pub struct PaperTally {
    config: PaperConfig,
    /// By hash, as their order does not matter: a vote is on one of many.
    places: HashMap<LandmarkId, Place>,
    vehicles: BTreeMap<NodeName, Vehicle>,
    touched: Vec<LandmarkId>,
}

impl PaperTally {
    /// An empty tally.
    pub fn new(config: PaperConfig) -> Self {
        Self { config, places: HashMap::new(), vehicles: BTreeMap::new(), touched: Vec::new() }
    }

    /// Makes a location known, so that it has a verdict even without votes.
    pub fn expect(&mut self, landmark: LandmarkId) {
        self.places.entry(landmark).or_default();
    }

    /// Forgets a location.
    pub fn forget(&mut self, landmark: &LandmarkId) {
        self.places.remove(landmark);
    }

    /// Forgets vehicles' reputations and names; what they said stays in the sums.
    pub fn forget_vehicles(&mut self, nodes: &BTreeSet<NodeName>) {
        self.vehicles.retain(|node, _| !nodes.contains(node));
        self.places.values_mut().for_each(|place| place.contributors.retain(|node| !nodes.contains(node)));
    }

    /// Whether a location can take a label with at most `most` labels in all.
    pub fn has_room_for(&self, landmark: &LandmarkId, label: &Label, most: usize) -> bool {
        self.places.get(landmark).is_none_or(|place| place.scores.len() < most || place.scores.contains_key(label))
    }

    /// Adds r_v · c_ω · k for one detection.
    pub fn add(&mut self, landmark: &LandmarkId, node: &NodeName, label: &Label, confidence: f64, visibility: f64) {
        let vehicle = self.vehicles.entry(node.clone()).or_insert_with(|| Vehicle::new(&self.config));
        let place = self.places.entry_ref(landmark).or_default();
        *place.scores.entry(label.clone()).or_insert(0.0) += vehicle.reputation * confidence * visibility;
        place.contributors.insert(node.clone());
        if !std::mem::replace(&mut place.is_touched, true) {
            self.touched.push(landmark.clone());
        }
        vehicle.votes.push((landmark.clone(), label.clone()));
    }

    /// The label with the most score at a location, the first in alphabetical order on a tie.
    pub fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        let Place { scores, contributors, .. } = self.places.get(landmark)?;
        Some(super::verdict(landmark.clone(), scores.clone(), None, contributors.iter().cloned().collect()))
    }

    /// Ends a round: changes every vehicle's reputation by step · (correct − incorrect) / objects over its votes since
    /// the last verdict, and returns the locations that were voted on.
    pub fn close(&mut self) -> BTreeSet<LandmarkId> {
        let touched = std::mem::take(&mut self.touched);
        let mut labels: HashMap<&LandmarkId, Option<Label>> = HashMap::with_capacity(touched.len());
        for landmark in &touched {
            if let Some(place) = self.places.get_mut(landmark) {
                place.is_touched = false;
                labels.insert(landmark, super::best(&place.scores).cloned());
            }
        }
        for vehicle in self.vehicles.values_mut().filter(|v| !v.votes.is_empty()) {
            let objects = vehicle.votes.len() as u64;
            let right =
                |(landmark, label): &&(LandmarkId, Label)| labels.get(landmark).and_then(Option::as_ref) == Some(label);
            let correct = vehicle.votes.iter().filter(right).count() as u64;
            let balance = (2.0 * correct as f64 - objects as f64) / objects as f64;
            let (low, high) = REPUTATION_RANGE;
            vehicle.reputation = (vehicle.reputation + self.config.step * balance).clamp(low, high);
            vehicle.correct += correct;
            vehicle.incorrect += objects - correct;
            vehicle.votes.clear();
        }
        drop(labels);
        touched.into_iter().collect()
    }

    /// Goes on from reputations that an earlier tally arrived at; those of vehicles that it does not name stay.
    pub fn resume(&mut self, reputations: &BTreeMap<NodeName, Reputation>) {
        for (node, Reputation { score, correct, incorrect }) in reputations {
            let vehicle = self.vehicles.entry(node.clone()).or_insert_with(|| Vehicle::new(&self.config));
            let (low, high) = REPUTATION_RANGE;
            vehicle.reputation = score.clamp(low, high);
            (vehicle.correct, vehicle.incorrect) = (*correct, *incorrect);
        }
    }

    /// Every vehicle's reputation.
    pub fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        let entry = |v: &Vehicle| Reputation { score: v.reputation, correct: v.correct, incorrect: v.incorrect };
        self.vehicles.iter().map(|(node, v)| (node.clone(), entry(v))).collect()
    }
}
