//! The default voting: estimated reputation × calibrated confidence × visibility.

mod batch;
mod eviction;
mod from_ledger;
mod settlement;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use hashbrown::HashMap;

use super::calibration::{ConfidenceCalibration, Weights};
use super::config::{VoteConfig, WeightedConfig};
use super::dawid_skene::{DawidSkene, VehicleEvidence};
use super::dependence::Dependence;
use super::index_map::LabelIndex;
use super::label_table::LabelTable;
use super::landmark_table::LandmarkTable;
use super::landmark_votes::{LandmarkVotes, RecentStatements, StoredVote};
use super::method::{self, NewVote, VotingMethod};
use super::paper::REPUTATION_RANGE;
use super::parameters::MANY_DEPENDENT;
use super::visibility;
use crate::model::names::{Label, LandmarkId, NodeName};
use crate::model::time::Timestamp;
use crate::reputation::{Counts, Evidence, ReputationLedger};
use crate::wire::{Reputation, Verdict};

/// Incremental expectation maximisation (Neal & Hinton 1998) over the fresh votes.
#[derive(Debug, Clone, Default)]
pub(super) struct WeightedVoting {
    config: WeightedConfig,
    model: DawidSkene,
    calibration: ConfidenceCalibration,
    dependence: Dependence,
    /// Index of each vehicle.
    vehicles: HashMap<NodeName, usize>,
    /// By index of the vehicle.
    names: Vec<NodeName>,
    /// Indices of removed vehicles.
    free: Vec<usize>,
    /// Settled votes, by index of the vehicle.
    counts: Vec<Counts>,
    /// Number of stored votes, by index of the vehicle.
    stored: Vec<usize>,
    labels: LabelTable,
    landmarks: LandmarkTable,
    /// Indices of the landmarks to evaluate when the round closes.
    changed: BTreeSet<usize>,
    /// The next expiry of each landmark that has votes.
    expiries: BTreeSet<(Timestamp, usize)>,
    /// The landmark that was re-evaluated last.
    revisit_after: Option<LandmarkId>,
    /// Votes since the last round.
    fresh_votes: usize,
    evidence: Vec<Evidence>,
    /// Time from which on votes become evidence.
    recorded_from: Timestamp,
    /// Number of dependent vehicles when learning last started again because of them.
    known_dependent: usize,
}

impl WeightedVoting {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self {
            model: DawidSkene::new(config.clone()),
            calibration: ConfidenceCalibration::new(config.calibration_votes),
            dependence: Dependence::new(config.pair_memory_votes),
            config,
            ..Self::default()
        }
    }

    fn freshness(&self) -> Duration {
        Duration::from_secs_f64(self.config.freshness_s)
    }

    /// The index of a vehicle; a new or reused index if the vehicle has none.
    fn vehicle(&mut self, node: &NodeName) -> usize {
        if let Some(&vehicle) = self.vehicles.get(node) {
            return vehicle;
        }
        let vehicle = if let Some(vehicle) = self.free.pop() {
            self.names[vehicle] = node.clone();
            vehicle
        } else {
            self.names.push(node.clone());
            self.counts.push(Counts::default());
            self.stored.push(0);
            self.model.vehicles.push(VehicleEvidence::default());
            self.names.len() - 1
        };
        self.vehicles.insert(node.clone(), vehicle);
        vehicle
    }

    /// Evaluates a landmark's votes from scratch.
    fn judge(&mut self, landmark: usize, weights: &Weights) {
        self.remove_live(landmark);
        let landmark_votes = self.landmarks.votes_mut(landmark);
        landmark_votes.compare(
            &mut self.dependence,
            &mut self.model.label_bias,
            &mut self.calibration,
            |vehicle| vehicle,
        );
        landmark_votes.weigh(&self.dependence, &self.calibration, weights);
        landmark_votes
            .votes
            .iter_mut()
            .for_each(|vote| vote.judged = true);
        let votes = landmark_votes.weighted_votes();
        self.model.refresh(votes.iter().map(|vote| vote.vehicle));
        let candidates = landmark_votes.candidates();
        let judged = self.model.judge(&votes, &candidates);
        landmark_votes.adopt_posterior(judged, &mut self.calibration);
        self.model.add_live(&votes, &landmark_votes.posterior, 1.0);
        landmark_votes.counted = true;
        landmark_votes.publish(self.config.hysteresis);
    }

    /// Finds the vehicles that depend on each other.
    ///
    /// If the main group counts as wrong more often than right and its copies as right, this was
    /// derived from verdicts that the copies themselves decided. Such evidence is void, and
    /// learning starts again. Learning also starts again if many vehicles turn out to be dependent,
    /// because their agreement was mistaken for reliability.
    fn fit_dependence(&mut self) {
        let present: Vec<bool> = self.stored.iter().map(|votes| *votes > 0).collect();
        let groups = self.dependence.fit(&present);
        let trust = |vehicles: &[usize]| {
            vehicles
                .iter()
                .map(|&v| self.model.reliability(v))
                .sum::<f64>()
                / vehicles.len().max(1) as f64
        };
        if trust(&groups.copies) > 0.5 && trust(&groups.main) < 0.5 && !groups.main.is_empty() {
            self.model.clear_settled();
            self.start_again();
        } else if groups.dependent as f64
            >= MANY_DEPENDENT * present.iter().filter(|present| **present).count() as f64
            && groups.dependent > 2 * self.known_dependent
        {
            self.known_dependent = groups.dependent;
            self.start_again();
        }
    }

    /// Re-evaluates older landmarks in turn, within the budget for this round's fresh votes; adds
    /// those whose published label changed to `changed`.
    fn revisit(&mut self, weights: &Weights, changed: &mut BTreeSet<usize>) {
        let mut budget =
            (self.config.revisit_votes * std::mem::take(&mut self.fresh_votes) as f64) as usize;
        // `None` stands for the start of another turn.
        let mut visits: Vec<Option<usize>> = Vec::new();
        let rest = self.landmarks.following(self.revisit_after.as_ref());
        let all = self.landmarks.following(None);
        let turn = rest.map(Some).chain([None]).chain(all.map(Some));
        for visit in turn.take(self.landmarks.len()) {
            if budget == 0 {
                break;
            }
            let cost = |landmark| self.landmarks.votes(landmark).votes.len().max(1);
            budget = budget.saturating_sub(visit.map_or(0, cost));
            visits.push(visit);
        }
        if let Some(last) = visits.last() {
            self.revisit_after = last.map(|landmark| self.landmarks.id(landmark).clone());
        }
        for landmark in visits.into_iter().flatten() {
            let before = self.landmarks.votes(landmark).published;
            self.judge(landmark, weights);
            if self.landmarks.votes(landmark).published != before {
                changed.insert(landmark);
            }
        }
    }

    fn score(&self, vehicle: usize) -> f64 {
        self.model
            .reliability(vehicle)
            .clamp(REPUTATION_RANGE.0, REPUTATION_RANGE.1)
    }
}

impl VotingMethod for WeightedVoting {
    fn configure(&mut self, config: &VoteConfig) {
        self.config = config.weighted.clone();
        self.model.configure(self.config.clone());
        self.calibration.configure(self.config.calibration_votes);
        self.dependence.configure(self.config.pair_memory_votes);
    }

    fn add_landmark(&mut self, landmark: LandmarkId) {
        self.landmarks.intern(&landmark);
    }

    /// The results of the landmark's votes are kept.
    fn remove_landmark(&mut self, landmark: &LandmarkId) {
        let Some(index) = self.landmarks.index(landmark) else {
            return;
        };
        self.remove_votes(index, |_| true);
        if let Some(due) = self.landmarks.votes(index).due {
            self.expiries.remove(&(due, index));
        }
        self.changed.remove(&index);
        self.landmarks.remove(landmark);
    }

    fn has_landmark(&self, landmark: &LandmarkId) -> bool {
        self.landmarks.index(landmark).is_some()
    }

    fn landmarks(&self) -> Vec<LandmarkId> {
        self.landmarks.names().cloned().collect()
    }

    /// Removes the vehicles' votes and all evidence about them; other vehicles reuse their indices.
    fn remove_vehicles(&mut self, nodes: &BTreeSet<NodeName>) {
        self.evict_vehicles(nodes);
    }

    fn make_room_for(&mut self, vote: &NewVote<'_>, max_labels: usize) -> Option<usize> {
        Some(self.evict_labels_for(vote.label, max_labels))
    }

    /// Adds a vote in place of the vehicle's earlier vote on the landmark.
    fn add_vote(&mut self, vote: &NewVote<'_>) {
        let &NewVote { confidence, at, .. } = vote;
        let visibility = vote
            .range_bearing
            .map_or(1.0, |(d, a)| visibility::weighted(&self.config, d, a));
        self.expire(at);
        let vehicle = self.vehicle(vote.node);
        let label = self.label(vote.label, Some((vehicle, at)));
        let landmark = self.landmarks.intern(vote.landmark);
        let freshness = self.freshness();
        let earlier = self.landmarks.votes(landmark).of_vehicle(vehicle).cloned();
        let mut recent = earlier
            .as_ref()
            .map_or_else(RecentStatements::default, StoredVote::recent);
        let age_s = earlier
            .as_ref()
            .map_or(0.0, |earlier| at.since(earlier.at).as_secs_f64());
        let fading_s = self.config.freshness_s * self.config.smoothing_share;
        let kept = if fading_s > 0.0 {
            (-age_s / fading_s).exp()
        } else {
            0.0
        };
        let stated_most = recent.add(label, confidence * visibility, kept);
        let (label, confidence, visibility) = match &earlier {
            Some(earlier) if stated_most != label => {
                (earlier.label, earlier.confidence, earlier.visibility)
            }
            _ => (label, confidence, visibility),
        };
        let first = StoredVote {
            vehicle,
            label,
            confidence,
            visibility,
            recent: earlier.is_some().then(|| Box::new(recent)),
            weight: 1.0,
            independence: 1.0,
            at,
            since: at,
            band: 0,
            agreement: 0.0,
            judged: false,
            compared: false,
        };
        let stored = match earlier {
            Some(earlier) if at.since(earlier.since) >= freshness => {
                self.settle_votes(landmark);
                first
            }
            Some(earlier) => {
                self.remove_live(landmark);
                if earlier.label == label {
                    StoredVote {
                        confidence,
                        visibility,
                        recent: first.recent,
                        at,
                        ..earlier
                    }
                } else {
                    StoredVote {
                        since: earlier.since,
                        compared: earlier.compared,
                        ..first
                    }
                }
            }
            None => {
                self.remove_live(landmark);
                self.stored[vehicle] += 1;
                first
            }
        };
        let landmark_votes = self.landmarks.votes_mut(landmark);
        landmark_votes.store(stored);
        if landmark_votes.due.is_none_or(|due| due > at + freshness) {
            self.schedule_expiry(landmark);
        }
        self.changed.insert(landmark);
        self.fresh_votes += 1;
    }

    /// Evaluates the landmarks that changed, then some older landmarks in turn.
    fn close(&mut self, now: Timestamp) -> (BTreeSet<LandmarkId>, Vec<Evidence>) {
        self.expire(now);
        if self.dependence.is_due() {
            self.fit_dependence();
        }
        let weights = self.calibration.weights();
        let mut changed = std::mem::take(&mut self.changed);
        let mut by_name: Vec<usize> = changed.iter().copied().collect();
        by_name.sort_unstable_by_key(|&landmark| self.landmarks.id(landmark));
        for landmark in by_name {
            self.judge(landmark, &weights);
        }
        self.revisit(&weights, &mut changed);
        let changed = changed
            .into_iter()
            .map(|landmark| self.landmarks.id(landmark).clone())
            .collect();
        (changed, std::mem::take(&mut self.evidence))
    }

    fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        let LandmarkVotes {
            votes,
            posterior,
            published,
            ..
        } = self.landmarks.votes(self.landmarks.index(landmark)?);
        let mass: f64 = votes
            .iter()
            .map(|v| self.score(v.vehicle) * v.weight * v.independence)
            .sum();
        let name = |label: LabelIndex| self.labels.name(label).clone();
        let scores = posterior
            .iter()
            .map(|&(label, p)| (name(label), p * mass))
            .collect();
        let mut contributors: Vec<_> = votes
            .iter()
            .map(|vote| self.names[vote.vehicle].clone())
            .collect();
        contributors.sort();
        Some(method::verdict(
            landmark.clone(),
            scores,
            published.map(name),
            contributors,
        ))
    }

    fn readings(&self, landmark: &LandmarkId) -> BTreeMap<Label, Vec<NodeName>> {
        let mut readings: BTreeMap<Label, Vec<NodeName>> = BTreeMap::new();
        let known = self.landmarks.index(landmark);
        for vote in known
            .into_iter()
            .flat_map(|index| &self.landmarks.votes(index).votes)
        {
            let label = self.labels.name(vote.label).clone();
            readings
                .entry(label)
                .or_default()
                .push(self.names[vote.vehicle].clone());
        }
        readings
    }

    fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        let reputation = |vehicle: usize| {
            let Counts { correct, incorrect } = self.counts[vehicle];
            let live = &self.model.vehicles[vehicle].live;
            let live_correct = live.correct().round() as u64;
            Reputation {
                score: self.score(vehicle),
                correct: correct + live_correct,
                incorrect: incorrect + (live.total().round() as u64).saturating_sub(live_correct),
            }
        };
        self.vehicles
            .iter()
            .map(|(node, &vehicle)| (node.clone(), reputation(vehicle)))
            .collect()
    }

    fn is_proven(&self, node: &NodeName) -> bool {
        let is_proven = |vehicle: usize| {
            !self.model.is_newcomer(vehicle) && self.model.reliability(vehicle) > 0.5
        };
        self.vehicles
            .get(node)
            .is_some_and(|&vehicle| is_proven(vehicle))
    }

    fn is_trusted(&self, node: &NodeName) -> bool {
        self.vehicles
            .get(node)
            .is_none_or(|&vehicle| self.model.reliability(vehicle) > 0.5)
    }

    /// Begins a leadership at `now`: drops collected evidence and restarts the period of every vote.
    /// Votes before `now` still count in verdicts but yield no evidence when they settle.
    fn begin_record(&mut self, now: Timestamp) {
        self.recorded_from = now;
        self.evidence.clear();
        self.landmarks
            .iter_mut()
            .flat_map(|l| &mut l.votes)
            .for_each(|vote| vote.since = now);
    }

    fn refine(&mut self, passes: u32) {
        self.judge_all(passes);
    }

    fn adopt(&mut self, ledger: &ReputationLedger, limits: &VoteConfig) {
        self.take_over(ledger, limits);
    }
}
