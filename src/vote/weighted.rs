//! The default tally: learned reputation × calibrated confidence × visibility.

mod adopt;
mod refine;
mod room;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::ballot::{Ballot, Cast, Recent, probability};
use super::calibration::{Calibration, Weights};
use super::config::WeightedConfig;
use super::confusion::LabelIndex;
use super::dependence::Dependence;
use super::labels::Labels;
use super::model::{Model, Witness};
use super::paper::REPUTATION_RANGE;
use crate::names::{Label, LandmarkId, NodeName};
use crate::reputation::Evidence;
use crate::time::Timestamp;
use crate::wire::{Reputation, Verdict};

/// A statement counts this much at least among the vehicle's own.
const LEAST_WEIGHT: f64 = 0.01;

/// Incremental expectation maximisation (Neal & Hinton 1998) over the votes that are fresh.
#[derive(Debug, Clone)]
pub(super) struct WeightedTally {
    config: WeightedConfig,
    model: Model,
    calibration: Calibration,
    dependence: Dependence,
    vehicles: BTreeMap<NodeName, usize>,
    names: Vec<NodeName>,
    /// Numbers of forgotten vehicles.
    free: Vec<usize>,
    records: Vec<(u64, u64)>,
    labels: Labels,
    ballots: BTreeMap<LandmarkId, Ballot>,
    touched: BTreeSet<LandmarkId>,
    /// When which landmark is due, each once at most.
    expiries: BTreeSet<(Timestamp, LandmarkId)>,
    revisit_after: Option<LandmarkId>,
    fresh_votes: usize,
    evidence: Vec<Evidence>,
    /// Votes from then on become evidence.
    recorded_from: Timestamp,
}

impl WeightedTally {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self {
            model: Model::new(config.clone()),
            calibration: Calibration::new(config.calibration_votes),
            dependence: Dependence::new(config.pair_memory_votes),
            config,
            vehicles: BTreeMap::new(),
            names: Vec::new(),
            free: Vec::new(),
            records: Vec::new(),
            labels: Labels::default(),
            ballots: BTreeMap::new(),
            touched: BTreeSet::new(),
            expiries: BTreeSet::new(),
            revisit_after: None,
            fresh_votes: 0,
            evidence: Vec::new(),
            recorded_from: Timestamp::default(),
        }
    }

    /// See [`super::Vote::begin_record`].
    pub(super) fn begin_record(&mut self, now: Timestamp) {
        self.recorded_from = now;
        self.evidence.clear();
        self.ballots.values_mut().flat_map(|ballot| &mut ballot.casts).for_each(|cast| cast.since = now);
    }

    pub(super) fn expect(&mut self, landmark: LandmarkId) {
        self.ballots.entry(landmark).or_default();
    }

    /// Forgets a landmark; what its votes taught stays.
    pub(super) fn forget(&mut self, landmark: &LandmarkId) {
        let everything = |_: &Cast| true;
        self.retire(landmark, everything);
        if let Some(due) = self.ballots.remove(landmark).and_then(|ballot| ballot.due) {
            self.expiries.remove(&(due, landmark.clone()));
        }
        self.touched.remove(landmark);
    }

    /// Whether a vehicle has voted often enough to be judged, and was right more often than wrong.
    pub(super) fn is_proven(&self, node: &NodeName) -> bool {
        let is_good = |vehicle: usize| !self.model.is_newcomer(vehicle) && self.model.reliability(vehicle) > 0.5;
        self.vehicles.get(node).is_some_and(|&vehicle| is_good(vehicle))
    }

    fn vehicle(&mut self, node: &NodeName) -> usize {
        if let Some(&vehicle) = self.vehicles.get(node) {
            return vehicle;
        }
        if let Some(vehicle) = self.free.pop() {
            self.vehicles.insert(node.clone(), vehicle);
            self.names[vehicle] = node.clone();
            return vehicle;
        }
        let vehicle = self.names.len();
        self.vehicles.insert(node.clone(), vehicle);
        self.names.push(node.clone());
        self.records.push((0, 0));
        self.model.witnesses.push(Witness::default());
        vehicle
    }

    /// Takes a vote in the place of the vehicle's earlier one on the landmark.
    pub(super) fn cast(
        &mut self,
        landmark: &LandmarkId,
        node: &NodeName,
        (label, confidence, visibility): (&Label, f64, f64),
        at: Timestamp,
    ) {
        self.expire(at);
        let vehicle = self.vehicle(node);
        let label = self.label(label, Some((vehicle, at)));
        let freshness = Duration::from_secs_f64(self.config.freshness_s);
        let earlier = self.ballots.get(landmark).and_then(|b| b.casts.iter().find(|c| c.vehicle == vehicle).copied());
        let mut recent = earlier.map_or_else(Recent::default, |earlier| earlier.recent);
        let age_s = earlier.map_or(0.0, |earlier| at.since(earlier.at).as_secs_f64());
        let fading_s = self.config.freshness_s * self.config.smoothing_share;
        let kept = if fading_s > 0.0 { (-age_s / fading_s).exp() } else { 0.0 };
        let stated_most = recent.state(label, (confidence * visibility).max(LEAST_WEIGHT), kept);
        let (label, confidence, visibility) = match earlier {
            Some(earlier) if stated_most != label => (earlier.label, earlier.confidence, earlier.visibility),
            _ => (label, confidence, visibility),
        };
        let first = Cast {
            vehicle,
            label,
            confidence,
            visibility,
            recent,
            weight: 1.0,
            own: 1.0,
            at,
            since: at,
            band: 0,
            agreement: None,
            judged: false,
            compared: false,
        };
        let cast = match earlier {
            Some(earlier) if at.since(earlier.since) >= freshness => {
                self.settle_all(landmark);
                first
            }
            Some(Cast { since, compared, .. }) => {
                self.uncount(landmark);
                let said_before = earlier.filter(|earlier| earlier.label == label);
                let rest = said_before.map_or(first, |earlier| Cast { confidence, visibility, recent, at, ..earlier });
                Cast { since, compared, agreement: None, ..rest }
            }
            None => {
                self.uncount(landmark);
                first
            }
        };
        let ballot = self.ballots.entry(landmark.clone()).or_default();
        match ballot.casts.binary_search_by_key(&vehicle, |c| c.vehicle) {
            Ok(place) => ballot.casts[place] = cast,
            Err(place) => ballot.casts.insert(place, cast),
        }
        if ballot.due.is_none_or(|due| due > at + freshness) {
            self.look_again(landmark);
        }
        self.touched.insert(landmark.clone());
        self.fresh_votes += 1;
    }

    /// Makes a landmark due when the oldest of its votes will be past.
    fn look_again(&mut self, landmark: &LandmarkId) {
        let Some(ballot) = self.ballots.get_mut(landmark) else { return };
        let oldest = ballot.casts.iter().map(|cast| cast.at).min();
        let due = oldest.map(|at| at + Duration::from_secs_f64(self.config.freshness_s));
        if let Some(before) = std::mem::replace(&mut ballot.due, due) {
            self.expiries.remove(&(before, landmark.clone()));
        }
        self.expiries.extend(due.map(|due| (due, landmark.clone())));
    }

    /// Takes a landmark's votes out of the live evidence until it is judged again.
    fn uncount(&mut self, landmark: &LandmarkId) {
        if let Some(ballot) = self.ballots.get_mut(landmark)
            && std::mem::take(&mut ballot.counted)
        {
            self.model.count(&ballot.words(), &ballot.posterior, -1.0);
            for cast in &mut ballot.casts {
                if let Some(agreement) = cast.agreement.take() {
                    self.calibration.count(cast.band, agreement, -1.0);
                }
            }
        }
    }

    /// Removes the votes that `is_past` selects, once all on the landmark have become evidence.
    fn retire(&mut self, landmark: &LandmarkId, is_past: impl Fn(&Cast) -> bool) {
        if !self.ballots.get(landmark).is_some_and(|b| b.casts.iter().any(&is_past)) {
            return;
        }
        self.settle_all(landmark);
        let Some(ballot) = self.ballots.get_mut(landmark) else { return };
        ballot.casts.retain(|cast| !is_past(cast));
        if ballot.casts.is_empty() {
            ballot.shown = None;
            ballot.posterior.clear();
        }
    }

    /// Turns the judged votes on a landmark into fading evidence and a record; they begin to count anew. All at once:
    /// were each settled in its turn, the first would for a while be judged by evidence that the others still lack.
    fn settle_all(&mut self, landmark: &LandmarkId) {
        self.uncount(landmark);
        let Some(ballot) = self.ballots.get_mut(landmark) else { return };
        if ballot.is_witnessed() {
            let judged = ballot.casts.iter().filter(|cast| cast.judged);
            // Judged by the others: a vehicle that decides alone must not prove itself right.
            let settled: Vec<_> =
                judged.map(|cast| (*cast, self.model.without(&ballot.posterior, &cast.word()))).collect();
            for (cast, others) in settled {
                self.model.settle(&cast.word(), &others, &ballot.posterior);
                self.calibration.settle(cast.band, probability(&others, cast.label));
                let correct = ballot.shown == Some(cast.label);
                let record = &mut self.records[cast.vehicle];
                *(if correct { &mut record.0 } else { &mut record.1 }) += 1;
                if cast.at >= self.recorded_from {
                    self.evidence.push(Evidence {
                        node: self.names[cast.vehicle].clone(),
                        label: self.labels.name(cast.label).clone(),
                        correct,
                    });
                }
            }
        }
        for cast in &mut ballot.casts {
            (cast.since, cast.judged, cast.compared) = (cast.at, false, false);
        }
        self.touched.insert(landmark.clone());
    }

    fn expire(&mut self, now: Timestamp) {
        let freshness = Duration::from_secs_f64(self.config.freshness_s);
        while let Some((due, landmark)) = self.expiries.first().cloned() {
            if due > now {
                break;
            }
            self.expiries.pop_first();
            self.retire(&landmark, |cast| cast.at + freshness <= now);
            self.look_again(&landmark);
        }
    }

    fn judge(&mut self, landmark: &LandmarkId, weights: &Weights) {
        self.uncount(landmark);
        let Some(ballot) = self.ballots.get_mut(landmark) else { return };
        ballot.compare(&mut self.dependence, &mut self.calibration, |vehicle| vehicle);
        ballot.weigh(&self.dependence, &self.calibration, weights);
        ballot.casts.iter_mut().for_each(|cast| cast.judged = true);
        let words = ballot.words();
        self.model.prepare(words.iter().map(|w| w.vehicle));
        ballot.posterior = self.model.posterior(&words, &ballot.candidates());
        ballot.agree(&self.model, &mut self.calibration);
        self.model.count(&words, &ballot.posterior, 1.0);
        ballot.counted = true;
        ballot.show(self.config.hysteresis);
    }

    /// Finds who depends on whom. If the main group is thought wrong more often than right and those who copy right,
    /// then verdicts of the copies' own making taught it: that evidence is void, and learning starts again.
    fn fit_dependence(&mut self) {
        let mut present = vec![false; self.names.len()];
        self.ballots.values().flat_map(|b| &b.casts).for_each(|c| present[c.vehicle] = true);
        let groups = self.dependence.fit(&present);
        let trust = |vehicles: &[usize]| {
            vehicles.iter().map(|&v| self.model.reliability(v)).sum::<f64>() / vehicles.len().max(1) as f64
        };
        if trust(&groups.copies) > 0.5 && trust(&groups.main) < 0.5 && !groups.main.is_empty() {
            self.model.clear_settled();
            let (dependence, calibration) = (self.dependence.clone(), self.calibration.clone());
            self.start_from_majorities(&dependence, &calibration);
        }
    }

    /// Judges the landmarks that changed, then some older ones in turn; returns those of which something is new.
    pub(super) fn close(&mut self, now: Timestamp) -> BTreeSet<LandmarkId> {
        self.expire(now);
        let weights = self.calibration.weights();
        if self.dependence.is_due() {
            self.fit_dependence();
        }
        let mut changed = std::mem::take(&mut self.touched);
        for landmark in &changed {
            self.judge(landmark, &weights);
        }
        let mut budget = (self.config.revisit_votes * std::mem::take(&mut self.fresh_votes) as f64) as usize;
        let mut visits = self.ballots.len();
        while budget > 0 && visits > 0 {
            visits -= 1;
            let next = match &self.revisit_after {
                Some(after) => {
                    let later = (std::ops::Bound::Excluded(after), std::ops::Bound::Unbounded);
                    self.ballots.range::<LandmarkId, _>(later).next()
                }
                None => self.ballots.first_key_value(),
            };
            let Some((landmark, ballot)) = next.map(|(l, b)| (l.clone(), b)) else {
                self.revisit_after = None;
                continue;
            };
            budget = budget.saturating_sub(ballot.casts.len().max(1));
            let before = ballot.shown;
            self.judge(&landmark, &weights);
            if self.ballots.get(&landmark).is_some_and(|b| b.shown != before) {
                changed.insert(landmark.clone());
            }
            self.revisit_after = Some(landmark);
        }
        changed
    }

    pub(super) fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        let ballot = self.ballots.get(landmark)?;
        let mass: f64 = ballot.casts.iter().map(|c| self.score(c.vehicle) * c.weight * c.own).sum();
        let name = |label: LabelIndex| self.labels.name(label).clone();
        let votes = ballot.posterior.iter().map(|&(label, p)| (name(label), p * mass)).collect();
        let mut contributors: Vec<_> = ballot.casts.iter().map(|c| self.names[c.vehicle].clone()).collect();
        contributors.sort();
        Some(super::verdict(landmark.clone(), votes, ballot.shown.map(name), contributors))
    }

    fn score(&self, vehicle: usize) -> f64 {
        self.model.reliability(vehicle).clamp(REPUTATION_RANGE.0, REPUTATION_RANGE.1)
    }

    pub(super) fn take_evidence(&mut self) -> Vec<Evidence> {
        std::mem::take(&mut self.evidence)
    }

    pub(super) fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        let entry = |vehicle: usize| {
            let (correct, incorrect) = self.records[vehicle];
            let live = &self.model.witnesses[vehicle].live;
            let live_correct = live.correct().round() as u64;
            Reputation {
                score: self.score(vehicle),
                correct: correct + live_correct,
                incorrect: incorrect + (live.total().round() as u64).saturating_sub(live_correct),
            }
        };
        self.vehicles.iter().map(|(node, &vehicle)| (node.clone(), entry(vehicle))).collect()
    }
}
