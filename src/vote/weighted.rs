//! The default tally: learned reputation × calibrated confidence × visibility.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::calibration::{Calibration, Weights};
use super::config::WeightedConfig;
use super::confusion::LabelIndex;
use super::model::{Model, Witness, Word};
use super::paper::REPUTATION_RANGE;
use crate::names::{Label, LandmarkId, NodeName};
use crate::reputation::{Evidence, ReputationLedger};
use crate::time::Timestamp;
use crate::wire::{Reputation, Verdict};

/// A vote that counts.
#[derive(Debug, Clone, Copy)]
struct Cast {
    vehicle: usize,
    label: LabelIndex,
    confidence: f64,
    visibility: f64,
    weight: f64,
    at: Timestamp,
    /// When it began to count once more as evidence.
    since: Timestamp,
    /// Whether a posterior rests on it.
    judged: bool,
}

impl Cast {
    fn word(&self) -> Word {
        Word { vehicle: self.vehicle, label: self.label, weight: self.weight }
    }
}

/// The votes on one landmark, at most one of each vehicle, in order of vehicle.
#[derive(Debug, Clone, Default)]
struct Ballot {
    casts: Vec<Cast>,
    /// As of the last judgement.
    posterior: Vec<(LabelIndex, f64)>,
    /// Whether votes and posterior are in the live evidence at present.
    counted: bool,
    shown: Option<LabelIndex>,
}

impl Ballot {
    fn words(&self) -> Vec<Word> {
        self.casts.iter().map(Cast::word).collect()
    }

    fn candidates(&self) -> Vec<LabelIndex> {
        self.casts.iter().map(|c| c.label).collect::<BTreeSet<_>>().into_iter().collect()
    }

    fn probability(&self, label: LabelIndex) -> f64 {
        self.posterior.iter().find(|(l, _)| *l == label).map_or(0.0, |(_, p)| *p)
    }
}

/// Incremental expectation maximisation (Neal & Hinton 1998) over the votes that are fresh.
#[derive(Debug, Clone)]
pub(super) struct WeightedTally {
    config: WeightedConfig,
    model: Model,
    calibration: Calibration,
    vehicles: BTreeMap<NodeName, usize>,
    names: Vec<NodeName>,
    records: Vec<(u64, u64)>,
    labels: Vec<Label>,
    label_numbers: BTreeMap<Label, LabelIndex>,
    ballots: BTreeMap<LandmarkId, Ballot>,
    touched: BTreeSet<LandmarkId>,
    expiries: BTreeSet<(Timestamp, LandmarkId)>,
    revisit_after: Option<LandmarkId>,
    fresh_votes: usize,
    evidence: Vec<Evidence>,
}

impl WeightedTally {
    pub(super) fn new(config: WeightedConfig) -> Self {
        Self {
            model: Model::new(config.clone()),
            calibration: Calibration::new(config.calibration_votes),
            config,
            vehicles: BTreeMap::new(),
            names: Vec::new(),
            records: Vec::new(),
            labels: Vec::new(),
            label_numbers: BTreeMap::new(),
            ballots: BTreeMap::new(),
            touched: BTreeSet::new(),
            expiries: BTreeSet::new(),
            revisit_after: None,
            fresh_votes: 0,
            evidence: Vec::new(),
        }
    }

    pub(super) fn expect(&mut self, landmark: LandmarkId) {
        self.ballots.entry(landmark).or_default();
    }

    /// Forgets a landmark; what its votes taught stays.
    pub(super) fn forget(&mut self, landmark: &LandmarkId) {
        let everything = |_: &Cast| true;
        self.retire(landmark, everything);
        self.ballots.remove(landmark);
        self.touched.remove(landmark);
    }

    fn vehicle(&mut self, node: &NodeName) -> usize {
        if let Some(&vehicle) = self.vehicles.get(node) {
            return vehicle;
        }
        let vehicle = self.names.len();
        self.vehicles.insert(node.clone(), vehicle);
        self.names.push(node.clone());
        self.records.push((0, 0));
        self.model.witnesses.push(Witness::default());
        vehicle
    }

    fn label(&mut self, label: &Label) -> LabelIndex {
        if let Some(&number) = self.label_numbers.get(label) {
            return number;
        }
        let number = self.labels.len() as LabelIndex;
        self.labels.push(label.clone());
        self.label_numbers.insert(label.clone(), number);
        self.model.add_label();
        number
    }

    /// Whether a label can be taken with at most `most` labels in all.
    pub(super) fn has_room_for(&self, label: &Label, most: usize) -> bool {
        self.labels.len() < most || self.label_numbers.contains_key(label)
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
        let (vehicle, label) = (self.vehicle(node), self.label(label));
        let freshness = Duration::from_secs_f64(self.config.freshness_s);
        let earlier = self.ballots.get(landmark).and_then(|b| b.casts.iter().find(|c| c.vehicle == vehicle).copied());
        let mut since = at;
        if let Some(earlier) = earlier {
            if at.since(earlier.since) >= freshness {
                self.retire(landmark, |c| c.vehicle == vehicle);
            } else {
                since = earlier.since;
                self.uncount(landmark);
            }
        } else {
            self.uncount(landmark);
        }
        let cast = Cast { vehicle, label, confidence, visibility, weight: 1.0, at, since, judged: false };
        let ballot = self.ballots.entry(landmark.clone()).or_default();
        match ballot.casts.binary_search_by_key(&vehicle, |c| c.vehicle) {
            Ok(place) => ballot.casts[place] = cast,
            Err(place) => ballot.casts.insert(place, cast),
        }
        self.expiries.insert((at + freshness, landmark.clone()));
        self.touched.insert(landmark.clone());
        self.fresh_votes += 1;
    }

    /// Takes a landmark's votes out of the live evidence until it is judged again.
    fn uncount(&mut self, landmark: &LandmarkId) {
        if let Some(ballot) = self.ballots.get_mut(landmark)
            && std::mem::take(&mut ballot.counted)
        {
            self.model.count(&ballot.words(), &ballot.posterior, -1.0);
        }
    }

    /// Turns the votes that `is_past` selects into fading evidence and a record, and removes them.
    fn retire(&mut self, landmark: &LandmarkId, is_past: impl Fn(&Cast) -> bool) {
        if !self.ballots.get(landmark).is_some_and(|b| b.casts.iter().any(&is_past)) {
            return;
        }
        self.uncount(landmark);
        let Some(ballot) = self.ballots.get_mut(landmark) else { return };
        let posterior = ballot.posterior.clone();
        let (past, casts) = std::mem::take(&mut ballot.casts).into_iter().partition(is_past);
        ballot.casts = casts;
        let shown = ballot.shown;
        let past: Vec<Cast> = past;
        if ballot.casts.is_empty() {
            ballot.shown = None;
            ballot.posterior.clear();
        }
        for cast in past.iter().filter(|cast| cast.judged) {
            // Judged by the others: a vehicle that decides alone must not prove itself right.
            let others = self.model.without(&posterior, &cast.word());
            self.model.settle(&cast.word(), &others);
            let agreement = posterior.iter().find(|(l, _)| *l == cast.label).map_or(0.0, |(_, p)| *p);
            self.calibration.observe(cast.confidence, agreement);
            let correct = shown == Some(cast.label);
            let record = &mut self.records[cast.vehicle];
            *(if correct { &mut record.0 } else { &mut record.1 }) += 1;
            self.evidence.push(Evidence {
                node: self.names[cast.vehicle].clone(),
                label: self.labels[usize::from(cast.label)].clone(),
                correct,
            });
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
        }
    }

    fn judge(&mut self, landmark: &LandmarkId, weights: &Weights) {
        self.uncount(landmark);
        let Some(ballot) = self.ballots.get_mut(landmark) else { return };
        for cast in &mut ballot.casts {
            cast.weight = weights.of(cast.confidence) * cast.visibility;
            cast.judged = true;
        }
        let words = ballot.words();
        self.model.prepare(words.iter().map(|w| w.vehicle));
        let posterior = self.model.posterior(&words, &ballot.candidates());
        self.model.count(&words, &posterior, 1.0);
        ballot.posterior = posterior;
        ballot.counted = true;
        Self::show(ballot, self.config.hysteresis);
    }

    fn show(ballot: &mut Ballot, hysteresis: f64) {
        let mut best: Option<(LabelIndex, f64)> = None;
        for &(label, p) in &ballot.posterior {
            if best.is_none_or(|(_, most)| p > most) {
                best = Some((label, p));
            }
        }
        let kept = ballot.shown.map_or(0.0, |shown| ballot.probability(shown));
        if kept == 0.0 || best.is_some_and(|(_, p)| p > kept + hysteresis) {
            ballot.shown = best.map(|(label, _)| label);
        }
    }

    /// Judges the landmarks that changed, then some older ones in turn; returns those of which something is new.
    pub(super) fn close(&mut self, now: Timestamp) -> BTreeSet<LandmarkId> {
        self.expire(now);
        let weights = self.calibration.weights();
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

    /// Judges all stored votes `passes` times over, starting from majorities (Dawid & Skene 1979).
    pub(super) fn refine(&mut self, passes: u32) {
        let weights = self.calibration.weights();
        self.model.clear_live();
        for ballot in self.ballots.values_mut() {
            ballot.shown = None;
            ballot.counted = true;
            let total: f64 = ballot.casts.iter().map(|c| c.weight).sum();
            let share = |label| ballot.casts.iter().filter(|c| c.label == label).map(|c| c.weight).sum::<f64>() / total;
            ballot.posterior = ballot.candidates().into_iter().map(|label| (label, share(label))).collect();
            self.model.count(&ballot.words(), &ballot.posterior, 1.0);
        }
        for _ in 0..passes {
            self.model.prepare(0..self.names.len());
            for ballot in self.ballots.values_mut() {
                for cast in &mut ballot.casts {
                    cast.weight = weights.of(cast.confidence) * cast.visibility;
                }
                ballot.posterior = self.model.posterior(&ballot.words(), &ballot.candidates());
            }
            self.model.clear_live();
            for ballot in self.ballots.values_mut() {
                self.model.count(&ballot.words(), &ballot.posterior, 1.0);
                Self::show(ballot, self.config.hysteresis);
            }
        }
    }

    pub(super) fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        let ballot = self.ballots.get(landmark)?;
        let mass: f64 = ballot.casts.iter().map(|c| self.score(c.vehicle) * c.weight).sum();
        let name = |label: LabelIndex| self.labels[usize::from(label)].clone();
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

    /// Takes over what a ledger knows beyond what was counted here, each vehicle's at most `memory_votes` strong: a
    /// standby has counted most of it itself.
    pub(super) fn adopt(&mut self, ledger: &ReputationLedger) {
        for (node, (correct, incorrect)) in ledger.totals() {
            let vehicle = self.vehicle(&node);
            let (own_correct, own_incorrect) = self.records[vehicle];
            let (correct, incorrect) = (correct.saturating_sub(own_correct), incorrect.saturating_sub(own_incorrect));
            let scale = (self.config.memory_votes / correct.saturating_add(incorrect).max(1) as f64).min(1.0);
            self.model.witnesses[vehicle].inherited = (correct as f64 * scale, incorrect as f64 * scale);
        }
    }
}
