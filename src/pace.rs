//! PACE: what the vehicles see together, one agreed label for every known location.
//!
//! A [`Pace`] takes admitted reports by [`Pace::observe`] and makes the map by [`Pace::close`]. The two modes are two
//! implementations behind it: [`paper`](PaceMode::Paper) is the formulas of the paper, [`bayes`](PaceMode::Bayes), the
//! default, keeps the evidence of each vehicle as log-odds. `docs/algorithms.md` compares them.

mod assignment;
mod bayes;
mod grouping;
mod paper;

use std::sync::Arc;
use std::time::Duration;

use nalgebra::Point2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, check_range};
use crate::geometry::Covariance;
use crate::landmark::{Gate, Landmark, LandmarkIndex};
use crate::time::Timestamp;
use crate::wire::{LandmarkState, ObjectReport, PerceivedObject};

pub use bayes::BayesPace;
pub use paper::PaperPace;

/// Which PACE.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PaceMode {
    /// The formulas of the paper, exactly.
    Paper,
    /// Evidence of presence and absence per vehicle as log-odds.
    #[default]
    Bayes,
}

/// Parameters of PACE.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PaceConfig {
    /// Which PACE. Default `bayes`.
    pub mode: PaceMode,
    /// Largest distance in metres between a detection and its landmark, the paper's δ. Default 0.5; below half the
    /// distance between neighbouring landmarks no detection is ever taken for a neighbour's.
    pub gate_m: f64,
    /// Largest distance in standard deviations of the detection's covariance. Default 4.
    pub gate_sigmas: f64,
    /// Standard deviation in metres added to every reported covariance. Default 0.05; it stands for errors of pose and
    /// map that vehicles do not know of.
    pub position_floor_m: f64,
    /// Whether at most one object of a report is taken for one landmark. Default true: two plates cannot share one
    /// parking spot, and where gates overlap the nearer landmark may be another's. False lets every object count where
    /// it is nearest.
    pub one_to_one: bool,
    /// Age in seconds beyond which a vehicle's last look at a landmark no longer counts. Default 1.0.
    pub max_age_s: f64,
    /// Probability that an object within reach is detected in one frame. Default 0.3: low, so that a few misses do
    /// not erase a hard-won reading; higher lets labels go sooner when objects leave.
    pub detection_probability: f64,
    /// Probability that one frame reports an object where there is none. Default 0.01.
    pub false_alarm_probability: f64,
    /// Most evidence that one vehicle can hold for or against one label, in nats. Default 4 (odds of 55 to 1).
    pub evidence_limit: f64,
    /// Most evidence that one vehicle can hold against anything being at a landmark, in nats. Default 1: misses repeat
    /// for the same hidden cause, so a vehicle that reads a label outweighs three that look and find nothing.
    pub absence_limit: f64,
    /// Time in seconds between independent frames: frames in quicker succession count in proportion. Default 0.1.
    pub independent_after_s: f64,
    /// Evidence in nats that a landmark must gather against any object before it is known to be empty. Default 0.9:
    /// three misses of one vehicle.
    pub empty_evidence: f64,
    /// Lead in nats that another label needs over the one published last. Default 0.5; it prevents flicker.
    pub switch_lead: f64,
}

impl Default for PaceConfig {
    fn default() -> Self {
        Self {
            mode: PaceMode::Bayes,
            gate_m: 0.5,
            gate_sigmas: 4.0,
            position_floor_m: 0.05,
            one_to_one: true,
            max_age_s: 1.0,
            detection_probability: 0.3,
            false_alarm_probability: 0.01,
            evidence_limit: 4.0,
            absence_limit: 1.0,
            independent_after_s: 0.1,
            empty_evidence: 0.9,
            switch_lead: 0.5,
        }
    }
}

impl PaceConfig {
    /// Checks all values.
    ///
    /// # Errors
    /// [`ConfigError`] naming the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("gate_m", self.gate_m, 1e-3, 1e3)?;
        check_range("gate_sigmas", self.gate_sigmas, 0.1, 100.0)?;
        check_range("position_floor_m", self.position_floor_m, 1e-4, 100.0)?;
        check_range("max_age_s", self.max_age_s, 0.01, 3600.0)?;
        check_range("detection_probability", self.detection_probability, 0.01, 0.99)?;
        check_range("false_alarm_probability", self.false_alarm_probability, 1e-6, self.detection_probability)?;
        check_range("evidence_limit", self.evidence_limit, 0.1, 100.0)?;
        check_range("absence_limit", self.absence_limit, 0.0, 100.0)?;
        check_range("independent_after_s", self.independent_after_s, 0.0, 60.0)?;
        check_range("empty_evidence", self.empty_evidence, 0.01, 100.0)?;
        check_range("switch_lead", self.switch_lead, 0.0, 100.0)
    }

    /// The reported covariance; a position without one counts as known to the gate.
    fn covariance(&self, object: &PerceivedObject) -> Covariance {
        object.covariance().unwrap_or_else(|| Covariance::isotropic(self.gate_m / self.gate_sigmas))
    }

    fn max_age(&self) -> Duration {
        Duration::from_secs_f64(self.max_age_s)
    }

    /// How near a detection must be to its landmark.
    pub fn gate(&self) -> Gate {
        Gate { radius_m: self.gate_m, sigmas: self.gate_sigmas, floor_m: self.position_floor_m }
    }
}

/// What one round made of the reports.
#[derive(Debug, Clone, PartialEq)]
pub struct PaceRound {
    /// One entry per landmark in configuration order.
    pub landmarks: Vec<LandmarkState>,
    /// Capture time of the oldest report that an entry rests on.
    pub oldest_capture: Option<Timestamp>,
}

/// PACE in the configured mode.
#[derive(Debug, Clone)]
pub enum Pace {
    /// See [`PaceMode::Paper`].
    Paper(PaperPace),
    /// See [`PaceMode::Bayes`].
    Bayes(BayesPace),
}

impl Pace {
    /// No evidence yet.
    pub fn new(config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        match config.mode {
            PaceMode::Paper => Self::Paper(PaperPace::new(&config, landmarks)),
            PaceMode::Bayes => Self::Bayes(BayesPace::new(config, landmarks)),
        }
    }

    /// Adds known locations after those there are; evidence stays.
    pub fn add_landmarks(&mut self, added: Vec<Landmark>) {
        match self {
            Self::Paper(pace) => pace.add_landmarks(added),
            Self::Bayes(pace) => pace.add_landmarks(added),
        }
    }

    /// Whether an object names a known location or is within the gate of one.
    pub fn is_at_landmark(&self, object: &PerceivedObject) -> bool {
        let (landmarks, gate_m) = match self {
            Self::Paper(pace) => pace.places(),
            Self::Bayes(pace) => pace.places(),
        };
        let point = Point2::new(object.x_m, object.y_m);
        object.landmark.is_some() || landmarks.within(&point, gate_m).next().is_some()
    }

    /// Takes one admitted report, captured at `captured_at` on the aggregator's clock.
    pub fn observe(&mut self, report: &ObjectReport, captured_at: Timestamp) {
        match self {
            Self::Paper(pace) => pace.observe(report, captured_at),
            Self::Bayes(pace) => pace.observe(report, captured_at),
        }
    }

    /// Closes a round at `now`.
    pub fn close(&mut self, now: Timestamp) -> PaceRound {
        match self {
            Self::Paper(pace) => pace.close(now),
            Self::Bayes(pace) => pace.close(now),
        }
    }
}
