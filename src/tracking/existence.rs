//! Probability that an object exists, from the observations of all vehicles.
//!
//! This is integrated probabilistic data association (Musicki, Evans, Stankovic, 1994). An observation is one frame's
//! check of a track by one vehicle; its result is a detection or a miss. Each observation adds the log-likelihood ratio
//! of its result under two hypotheses: the track is an object, or it is clutter. Observations of one vehicle are
//! correlated: an occluder, or a structure that resembles an object, is still there a tenth of a second later. So the
//! results of one vehicle are a Markov chain under both hypotheses, and the probability of a detection depends on the
//! [previous results](ObservationState). All probabilities are estimated by vehicle. Between observations, an object may
//! leave.
//!
//! Confidences are additional evidence. The confidences of one vehicle are correlated: n confidences with correlation ρ
//! weigh as n/(1+ρ(n−1)) (the design effect; Kish, "Survey Sampling", 1965).

use std::time::Duration;

use nalgebra::Vector2;

use super::attributes::StatedAttributes;
use super::fading_mean::FadingMean;
use super::handles::SensorId;
use super::population::LeavingRates;
use crate::model::time::Timestamp;

/// Time constant in seconds with which confidences, and a vehicle's evidence about another vehicle's object, fade.
const MEMORY_S: f64 = 3.0;

/// Correlation of the confidences of successive frames.
const CORRELATION: f64 = 0.3;

/// Share of the evidence of confidences that is independent from vehicle to vehicle.
const CONFIDENCE_WEIGHT: f64 = 0.7;

/// Maximum log-odds of existence from observations; the minimum is -2 times this value.
const MAX_NATS: f64 = 6.0;

/// Maximum evidence of the observations of one vehicle in the judgement of another, nats.
const MAX_PEER_NATS: f64 = 2.5;

/// Minimum log-odds of a confirmed track at a new detection, because the detection continues this track.
const LATENT_NATS: f64 = -3.0;

/// Time between judgements of a vehicle's statement about an object.
pub(super) const JUDGED_AFTER: Duration = Duration::from_secs(2);

/// Minimum time between two detections by one vehicle that both count in [`SensorHistory::max_sole_nats`]: a faster
/// camera sees the cause of a false detection no more often.
const COUNTED_INTERVAL: Duration = Duration::from_millis(75);

/// Minimum number of observations before a vehicle's statement is judged.
const MIN_JUDGED_OBSERVATIONS: u32 = 5;

/// Results of a vehicle's observations of an object so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum ObservationState {
    /// The vehicle has not observed the place yet.
    #[default]
    First,
    /// The vehicle has observed the place without a detection so far.
    Never,
    /// The last observation was a detection.
    Hit,
    /// The last observation was a miss, after an earlier detection.
    Miss,
}

impl ObservationState {
    const COUNT: usize = 4;

    /// The state after another observation.
    fn after(self, is_hit: bool) -> Self {
        match (self, is_hit) {
            (_, true) => Self::Hit,
            (Self::First | Self::Never, false) => Self::Never,
            (Self::Hit | Self::Miss, false) => Self::Miss,
        }
    }

    /// True if the last observation was a detection.
    pub(super) fn is_hit(self) -> bool {
        self == Self::Hit
    }

    /// Index into tables of all states.
    fn index(self) -> usize {
        self as usize
    }
}

/// Probability of a detection at an observation, by the state before it, estimated as the mean of a beta distribution.
#[derive(Debug, Clone, Copy)]
pub(super) struct DetectionRates {
    /// Share of observations that were detections.
    shares: [FadingMean; ObservationState::COUNT],
}

impl DetectionRates {
    /// Number of observations as which the usual rates count.
    const USUAL_OBSERVATIONS: f64 = 10.0;

    fn usual(rates: [f64; ObservationState::COUNT]) -> Self {
        Self {
            shares: rates.map(|rate| FadingMean::new(rate, Self::USUAL_OBSERVATIONS)),
        }
    }

    /// Usual rates of objects.
    pub(super) fn object() -> Self {
        Self::usual([0.5, 0.15, 0.85, 0.4])
    }

    /// Usual rates of clutter.
    pub(super) fn clutter() -> Self {
        Self::usual([0.05, 0.025, 0.15, 0.1])
    }

    /// The rate at an observation in this state.
    pub(super) fn rate(&self, state: ObservationState) -> f64 {
        self.shares[state.index()].mean().clamp(0.01, 0.985)
    }

    /// Updates the mean with an observation of a weight, 0 to 1.
    pub(super) fn learn(&mut self, state: ObservationState, is_hit: bool, weight: f64) {
        self.shares[state.index()].count(is_hit, weight);
    }
}

/// Probabilities of a detection at one observation: if the track is an object, and if it is clutter.
#[derive(Debug, Clone, Copy)]
pub(super) struct ObservationRates {
    pub(super) object: f64,
    pub(super) clutter: f64,
    /// True if the vehicle states its pose. Without a pose, the vehicle may not have observed the place.
    pub(super) has_pose: bool,
}

impl ObservationRates {
    /// Log-likelihood ratio of a result: an object compared with clutter.
    pub(super) fn nats(&self, is_hit: bool) -> f64 {
        if is_hit {
            (self.object / self.clutter).ln().max(0.0)
        } else {
            ((1.0 - self.object) / (1.0 - self.clutter)).ln().min(0.0)
        }
    }
}

/// Log-odds that a track is an object that is still there, from all observations.
#[derive(Debug, Clone, Copy)]
pub(super) struct Existence {
    log_odds: f64,
    at: Timestamp,
}

impl Existence {
    /// Log-odds at a time.
    pub(super) fn new(log_odds: f64, at: Timestamp) -> Self {
        Self {
            log_odds: log_odds.clamp(-MAX_NATS, MAX_NATS),
            at,
        }
    }

    /// Predicts to `at`: objects leave, at a greater rate if no vehicle detects them.
    pub(super) fn predict(&mut self, at: Timestamp, leaving: LeavingRates, is_detected: bool) {
        if at <= self.at {
            return;
        }
        self.log_odds = self.log_odds_at(at, leaving, is_detected);
        self.at = self.at.max(at);
    }

    /// The log-odds at `at` without further observations.
    pub(super) fn log_odds_at(
        &self,
        at: Timestamp,
        leaving: LeavingRates,
        is_detected: bool,
    ) -> f64 {
        let stays = (-leaving.of(is_detected) * at.since(self.at).as_secs_f64()).exp();
        let present = logistic(self.log_odds) * stays;
        (present / (1.0 - present)).ln().max(-2.0 * MAX_NATS)
    }

    pub(super) fn add(&mut self, nats: f64) {
        self.log_odds = (self.log_odds + nats).clamp(-2.0 * MAX_NATS, MAX_NATS);
    }

    /// Sets the minimum for a confirmed track that is detected again after a while.
    pub(super) fn revive(&mut self) {
        self.log_odds = self.log_odds.max(LATENT_NATS);
    }

    /// The log-odds at the time of the last prediction.
    pub(super) fn log_odds(&self) -> f64 {
        self.log_odds
    }

    /// Raises the log-odds to a minimum.
    pub(super) fn raise(&mut self, log_odds: f64) {
        self.log_odds = self.log_odds.max(log_odds.min(MAX_NATS));
    }

    pub(super) fn probability(&self) -> f64 {
        logistic(self.log_odds)
    }
}

/// Observations of one object by one vehicle.
#[derive(Debug, Clone)]
pub(super) struct SensorHistory {
    pub(super) sensor: SensorId,
    pub(super) state: ObservationState,
    pub(super) observed_at: Timestamp,
    pub(super) last_hit: Option<Timestamp>,
    /// Time of the last detection that confirmed the track.
    pub(super) confirmed_at: Option<Timestamp>,
    /// Corrected position of the last detection, metres.
    pub(super) position: Vector2<f64>,
    pub(super) observations: u32,
    /// True if the vehicle stated its pose at the last miss without occlusion.
    is_view_known: bool,
    /// True if the position of the last detection was wrong by more than the vehicle states.
    pub(super) is_shifted: bool,
    /// Label, heading and size that the vehicle states.
    pub(super) attributes: StatedAttributes,
    /// Detections and observations since the last judgement.
    unjudged: ExistenceStatement,
    judged_at: Timestamp,
    /// Evidence of the results, nats; it fades.
    sequence: f64,
    /// Evidence of all misses without occlusion before the first detection, nats.
    absence: f64,
    /// Fading sums of the evidence of confidences, nats, and of their number.
    score: f64,
    weight: f64,
    /// Fading number of detections, at most one in [`COUNTED_INTERVAL`], and time of the last of them.
    detections: f64,
    counted_at: Option<Timestamp>,
}

/// Hits and observations of one object by one vehicle over some time.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ExistenceStatement {
    pub(super) hits: u32,
    pub(super) observations: u32,
}

impl SensorHistory {
    /// A vehicle without observations.
    pub(super) fn new(sensor: SensorId, at: Timestamp) -> Self {
        Self {
            sensor,
            state: ObservationState::First,
            observed_at: at,
            last_hit: None,
            confirmed_at: None,
            position: Vector2::zeros(),
            observations: 0,
            is_view_known: false,
            is_shifted: false,
            attributes: StatedAttributes::default(),
            unjudged: ExistenceStatement::default(),
            judged_at: at,
            sequence: 0.0,
            absence: 0.0,
            score: 0.0,
            weight: 0.0,
            detections: 0.0,
            counted_at: None,
        }
    }

    /// Records a detection. `nats` is the evidence of the result, `confidence_nats` the evidence of the confidence.
    pub(super) fn hit(
        &mut self,
        at: Timestamp,
        position: Vector2<f64>,
        nats: f64,
        confidence_nats: f64,
    ) {
        self.observe(at, nats);
        self.score += confidence_nats;
        self.weight += 1.0;
        if self
            .counted_at
            .is_none_or(|last| at.since(last) >= COUNTED_INTERVAL)
        {
            self.counted_at = Some(at);
            self.detections += 1.0;
        }
        self.unjudged.hits += 1;
        self.unjudged.observations += 1;
        self.state = self.state.after(true);
        self.confirmed_at.get_or_insert(at);
        if self.last_hit.is_none_or(|last| at >= last) {
            self.last_hit = Some(at);
            self.position = position;
        }
    }

    /// Records an observation of the object's place without a detection. `nats` is the evidence of the result.
    pub(super) fn miss(&mut self, at: Timestamp, nats: f64) {
        self.observe(at, nats);
        self.state = self.state.after(false);
    }

    /// Counts a miss as a statement of the vehicle that the place is empty.
    pub(super) fn state_miss(&mut self) {
        self.unjudged.observations += 1;
    }

    /// Counts a miss without occlusion as evidence that the object does not exist; `nats` is the evidence of the result,
    /// `has_pose` is true if the vehicle states its pose.
    pub(super) fn deny(&mut self, nats: f64, has_pose: bool) {
        self.absence = (self.absence + nats).max(-MAX_PEER_NATS);
        self.is_view_known = has_pose;
    }

    /// Fades earlier evidence and counts an observation.
    fn observe(&mut self, at: Timestamp, nats: f64) {
        let kept = (-at.since(self.observed_at).as_secs_f64() / MEMORY_S).exp();
        self.score *= kept;
        self.weight *= kept;
        self.detections *= kept;
        self.sequence = (self.sequence * kept + nats).clamp(-MAX_PEER_NATS, MAX_PEER_NATS);
        self.observed_at = self.observed_at.max(at);
        self.observations = self.observations.saturating_add(1);
    }

    /// The statement since the last judgement, if a judgement is due.
    pub(super) fn take_due(&mut self, at: Timestamp) -> Option<ExistenceStatement> {
        (at.since(self.judged_at) >= JUDGED_AFTER
            && self.unjudged.observations >= MIN_JUDGED_OBSERVATIONS)
            .then(|| {
                self.judged_at = at;
                std::mem::take(&mut self.unjudged)
            })
    }

    /// Evidence of this vehicle alone for the object at `at`, nats.
    pub(super) fn nats(&self, at: Timestamp) -> f64 {
        self.kept(at) * self.sequence + self.confidence_nats(at)
    }

    /// Evidence of the confidences that is added to the evidence of other vehicles, nats. Zero unless the last
    /// observation was a detection, because earlier confidences do not show that the object is still there.
    pub(super) fn shared_confidence_nats(&self, at: Timestamp) -> f64 {
        if self.state.is_hit() {
            CONFIDENCE_WEIGHT * self.confidence_nats(at)
        } else {
            0.0
        }
    }

    /// Evidence against the object by a vehicle that has observed its place and has not detected it, nats.
    pub(super) fn denied_nats(&self, at: Timestamp) -> f64 {
        if self.is_view_known && self.last_hit.is_none() {
            self.kept(at) * self.absence
        } else {
            0.0
        }
    }

    /// Maximum evidence of the detections of this vehicle alone, nats. The cause of a false detection persists with an
    /// unknown probability; if all probabilities are equally likely, n false detections in a row have the probability
    /// 1/(n+1) (Laplace's rule of succession).
    pub(super) fn max_sole_nats(&self) -> f64 {
        self.detections.ln_1p()
    }

    fn confidence_nats(&self, at: Timestamp) -> f64 {
        let weight = self.kept(at) * self.weight;
        if weight > 1e-3 {
            self.score / self.weight * weight / (1.0 + CORRELATION * (weight - 1.0).max(0.0))
        } else {
            0.0
        }
    }

    fn kept(&self, at: Timestamp) -> f64 {
        (-at.since(self.observed_at).as_secs_f64() / MEMORY_S).exp()
    }
}

/// The probability of log-odds.
pub(super) fn logistic(nats: f64) -> f64 {
    1.0 / (1.0 + (-nats).exp())
}
