//! Trust in vehicles: whether a vehicle reports objects that other vehicles confirm, or fabricates or hides objects.
//!
//! Every [`JUDGED_AFTER`] of observations, a vehicle's statement about an object is compared with the evidence of the
//! others. If the others agree that the object exists, a detection counts as correct. No detection since the last
//! judgement counts as a miss if most of the others that observe the place detect the object, and most vehicles detect
//! objects at that distance. If at least two others observe the place and agree that it is empty, a detection counts as
//! a false positive. Two vehicles that disagree yield no judgement.

use std::collections::BTreeMap;

use super::detection_history::DetectionHistory;
use super::existence::{ExistenceStatement, JUDGED_AFTER};
use super::fading_mean::FadingMean;
use super::handles::SensorId;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::reputation::ReputationConfig;

/// Minimum log-odds, by the others' evidence, of an object that exists.
const EXISTS_NATS: f64 = 2.0;

/// Maximum log-odds, by the others' evidence, of an object that does not exist.
const ABSENT_NATS: f64 = -1.5;

/// Minimum share of observations with a detection for which a vehicle states that an object exists.
const MIN_STATED: f64 = 0.4;

/// Minimum share of vehicles that detect objects at a distance, for a miss there to be judged.
const MIN_EXPECTED: f64 = 0.6;

/// Minimum weight of a vehicle whose evidence is used to judge others.
const MIN_PEER_WEIGHT: f64 = 0.5;

/// Share of a newcomer's reputation at and below which evidence has no weight.
const WORTHLESS: f64 = 0.6;

/// Judgement of a vehicle's statement about an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Judgement {
    /// The vehicle detected an object that exists.
    Correct,
    /// The vehicle detected an object that does not exist.
    FalsePositive,
    /// The vehicle did not detect an object that exists.
    Miss,
    /// The vehicle detected an object that exists, with a position error larger than the vehicle states.
    Shifted,
}

/// Evidence of all vehicles except the judged vehicle about an object.
#[derive(Debug, Clone, Copy, Default)]
struct PeerEvidence {
    /// Log-odds of existence.
    nats: f64,
    /// Number of vehicles that observed the place.
    observing: usize,
    /// Number of vehicles that detected the object recently.
    detecting: usize,
}

impl PeerEvidence {
    /// Collects the recent observations of one object by all vehicles except `sensor`, by the
    /// weight of each vehicle in `fleet`.
    fn of(
        history: &DetectionHistory,
        sensor: Option<SensorId>,
        at: Timestamp,
        fleet: &Fleet,
    ) -> Self {
        let mut peers = Self::default();
        for history in history
            .iter()
            .filter(|history| Some(history.sensor) != sensor)
        {
            if at.since(history.observed_at) > JUDGED_AFTER {
                continue;
            }
            let weight = fleet.trust(history.sensor);
            peers.nats += weight * history.nats(at);
            peers.observing += usize::from(weight > MIN_PEER_WEIGHT && history.observations > 5);
            let is_recent = history
                .last_hit
                .is_some_and(|hit| at.since(hit) <= JUDGED_AFTER);
            peers.detecting += usize::from(weight > MIN_PEER_WEIGHT && is_recent);
        }
        peers
    }

    /// Judges a statement by this evidence; `None` if the evidence is insufficient.
    fn judge(&self, statement: ExistenceStatement) -> Option<Judgement> {
        let share = f64::from(statement.hits) / f64::from(statement.observations.max(1));
        let exists = self.nats >= EXISTS_NATS;
        if self.detecting >= 1 && exists && share >= MIN_STATED {
            Some(Judgement::Correct)
        } else if self.detecting >= 2
            && 2 * self.detecting > self.observing
            && exists
            && statement.hits == 0
        {
            Some(Judgement::Miss)
        } else if self.observing >= 2
            && self.detecting == 0
            && self.nats <= ABSENT_NATS
            && share >= MIN_STATED
        {
            Some(Judgement::FalsePositive)
        } else {
            None
        }
    }
}

/// Correct and incorrect statements of one vehicle; the latest statements have the highest weight.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct TrustCounts {
    correct: f64,
    incorrect: f64,
}

impl TrustCounts {
    /// Counts from a ledger.
    pub(super) fn new(correct: f64, incorrect: f64, config: &ReputationConfig) -> Self {
        let mut counts = Self { correct, incorrect };
        counts.fade(config);
        counts
    }

    pub(super) fn count(&mut self, is_correct: bool, config: &ReputationConfig) {
        *(if is_correct {
            &mut self.correct
        } else {
            &mut self.incorrect
        }) += 1.0;
        self.fade(config);
    }

    fn fade(&mut self, config: &ReputationConfig) {
        let kept = (config.memory_votes / self.total()).min(1.0);
        self.correct *= kept;
        self.incorrect *= kept;
    }

    fn total(&self) -> f64 {
        self.correct + self.incorrect
    }

    /// True if the number of statements is at least the weight of the initial score, and the reputation is not below
    /// that score.
    pub(super) fn is_proven(&self, config: &ReputationConfig) -> bool {
        self.total() >= config.initial_votes
            && config.mean(self.correct, self.incorrect) >= config.initial
    }

    /// Weight of the vehicle's evidence: 1 from a newcomer's reputation up, 0 for a vehicle with proven false
    /// statements.
    pub(super) fn trust(&self, config: &ReputationConfig) -> f64 {
        let reputation = config.mean(self.correct, self.incorrect);
        ((reputation / config.initial - WORTHLESS) / (1.0 - WORTHLESS)).clamp(0.0, 1.0)
    }
}

/// Counts of vehicles that do not report at present.
#[derive(Debug, Clone, Default)]
pub(super) struct DormantCounts(BTreeMap<NodeName, TrustCounts>);

impl DormantCounts {
    /// Maximum number of vehicles.
    pub(super) const MAX: usize = 4096;

    /// The counts of a vehicle.
    pub(super) fn of(&self, node: &NodeName) -> TrustCounts {
        self.0.get(node).copied().unwrap_or_default()
    }

    /// Keeps the counts of vehicles; the vehicles with the fewest statements are evicted.
    pub(super) fn keep(&mut self, vehicles: impl IntoIterator<Item = (NodeName, TrustCounts)>) {
        self.0.extend(
            vehicles
                .into_iter()
                .filter(|(_, counts)| counts.total() > 0.0),
        );
        let excess = self.0.len().saturating_sub(Self::MAX);
        if excess > 0 {
            let mut totals: Vec<_> = self
                .0
                .iter()
                .map(|(node, counts)| (counts.total(), node.clone()))
                .collect();
            totals.sort_by(|a, b| a.0.total_cmp(&b.0).then_with(|| a.1.cmp(&b.1)));
            for (_, node) in totals.iter().take(excess) {
                self.0.remove(node);
            }
        }
    }
}

/// Trust in every vehicle, and detection rates of all vehicles for judging a single vehicle.
#[derive(Debug, Clone)]
pub(super) struct Fleet {
    reputation: ReputationConfig,
    /// Weight of the evidence of each vehicle by its id, 0 to 1.
    trust: Vec<f64>,
    /// By distance, the share of vehicles that detected an existing object.
    detections: Vec<FadingMean>,
}

impl Fleet {
    const BIN_M: f64 = 10.0;
    const BINS: usize = 16;

    /// Minimum weight of a bin from which detections are expected.
    const MIN_WEIGHT: f64 = 10.0;

    /// A fleet without vehicles.
    pub(super) fn new(reputation: ReputationConfig) -> Self {
        Self {
            reputation,
            trust: Vec::new(),
            detections: vec![FadingMean::new(0.0, 1.0); Self::BINS],
        }
    }

    /// Changes the parameters of reputations.
    pub(super) fn configure(&mut self, reputation: ReputationConfig) {
        self.reputation = reputation;
    }

    pub(super) fn reputation(&self) -> &ReputationConfig {
        &self.reputation
    }

    /// Weight of a vehicle's evidence, 0 to 1.
    pub(super) fn trust(&self, sensor: SensorId) -> f64 {
        self.trust.get(sensor.number()).copied().unwrap_or(0.0)
    }

    /// Sets the counts from which the trust in a vehicle is computed.
    pub(super) fn set_counts(&mut self, sensor: SensorId, counts: &TrustCounts) {
        let number = sensor.number();
        let room = self.trust.len().max(number + 1);
        self.trust.resize(room, 0.0);
        self.trust[number] = counts.trust(&self.reputation);
    }

    pub(super) fn remove(&mut self, sensor: SensorId) {
        self.trust[sensor.number()] = 0.0;
    }

    /// Adds a statement to a vehicle's counts.
    pub(super) fn count(&mut self, sensor: SensorId, counts: &mut TrustCounts, is_correct: bool) {
        counts.count(is_correct, &self.reputation);
        self.set_counts(sensor, counts);
    }

    /// Judges a vehicle's statement about an object `distance_m` away by the evidence of the other vehicles; `None` if
    /// that evidence is insufficient.
    pub(super) fn judge(
        &mut self,
        sensor: SensorId,
        statement: ExistenceStatement,
        history: &DetectionHistory,
        distance_m: f64,
        at: Timestamp,
    ) -> Option<Judgement> {
        let judgement = PeerEvidence::of(history, Some(sensor), at, self).judge(statement)?;
        if judgement != Judgement::FalsePositive {
            self.learn(distance_m, judgement == Judgement::Correct);
        }
        (judgement != Judgement::Miss || self.expects(distance_m)).then_some(judgement)
    }

    /// Judges the statement of another cell that an object exists, by the observations of these vehicles.
    pub(super) fn judge_stated(
        &self,
        history: &DetectionHistory,
        at: Timestamp,
    ) -> Option<Judgement> {
        PeerEvidence::of(history, None, at, self).judge(ExistenceStatement {
            hits: 1,
            observations: 1,
        })
    }

    fn learn(&mut self, distance_m: f64, is_detected: bool) {
        self.detections[Self::bin(distance_m)].count(is_detected, 1.0);
    }

    /// Whether most vehicles detect objects at a distance.
    fn expects(&self, distance_m: f64) -> bool {
        let detections = &self.detections[Self::bin(distance_m)];
        detections.weight() >= Self::MIN_WEIGHT && detections.mean() >= MIN_EXPECTED
    }

    fn bin(distance_m: f64) -> usize {
        ((distance_m / Self::BIN_M) as usize).min(Self::BINS - 1)
    }
}
