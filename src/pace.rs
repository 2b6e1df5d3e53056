//! PACE: one agreed label for every landmark, from the reports of all vehicles.
//!
//! A [`Pace`] processes admitted reports in [`Pace::observe`] and produces the map in
//! [`Pace::close`]. It has two implementations: [`paper`](PaceMode::Paper) has the formulas of the
//! paper; [`bayes`](PaceMode::Bayes), the default, has log-odds for each vehicle.
//! `docs/algorithms.md` compares them.

mod assignment;
mod bayes;
mod grouping;
mod paper;

use std::sync::Arc;
use std::time::Duration;

use nalgebra::Point2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use bayes::BayesPace;
pub use paper::PaperPace;

use crate::config::config_section;
use crate::model::geometry::Covariance;
use crate::model::time::Timestamp;
use crate::perception::landmark::{Landmark, LandmarkGate, LandmarkIndex};
use crate::wire::{LandmarkState, ObjectReport, PerceivedObject};

/// The implementation of PACE.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum PaceMode {
    /// The formulas of the paper, exactly.
    Paper,
    /// Evidence of presence and absence per vehicle as log-odds.
    #[default]
    Bayes,
}

config_section! {
    /// Parameters of PACE.
    pub struct PaceConfig {
        /// The implementation. Default `bayes`.
        pub mode: PaceMode = PaceMode::Bayes;
        /// Largest distance in metres between a detection and its landmark, the paper's δ. Default
        /// 0.5. Below half the distance between neighbouring landmarks no detection is assigned to
        /// a neighbour.
        pub gate_m: f64 = 0.5, in 1e-3 to 1e3;
        /// Largest distance in standard deviations of the detection's covariance. Default 4.
        pub gate_sigmas: f64 = 4.0, in 0.1 to 100.0;
        /// Standard deviation in metres added to every reported covariance. Default 0.05. It covers
        /// errors of pose and map that vehicles cannot report.
        pub position_floor_m: f64 = 0.05, in 1e-4 to 100.0;
        /// True if a landmark takes at most one object of a report. Default true: two plates cannot
        /// share one parking spot, and where gates overlap the nearer landmark may belong to
        /// another object. With false every object counts at the nearest landmark.
        pub one_to_one: bool = true;
        /// Age in seconds beyond which a vehicle's last view of a landmark is ignored. Default 1.0.
        pub max_age_s: f64 = 1.0, in 0.01 to 3600.0;
        /// Probability that an object in view is detected in one frame. Default 0.3: low, so that a
        /// few misses do not erase a reading. A higher value drops labels sooner when objects
        /// leave.
        pub detection_probability: f64 = 0.3, in 0.01 to 0.99;
        /// Probability that one frame reports a non-existent object. Default 0.01.
        pub false_alarm_probability: f64 = 0.01, in 1e-6 to *detection_probability;
        /// Maximum evidence of one vehicle for or against one label, in nats. Default 4 (odds of 55
        /// to 1).
        pub evidence_limit: f64 = 4.0, in 0.1 to 100.0;
        /// Maximum evidence of one vehicle against any object at a landmark, in nats. Default 1.1:
        /// misses repeat for the same hidden cause, so one vehicle that reads a label outweighs
        /// three vehicles with misses, but not four.
        pub absence_limit: f64 = 1.1, in 0.0 to 100.0;
        /// Time in seconds between independent frames; faster frames count in proportion. Default
        /// 0.1.
        pub independent_after_s: f64 = 0.1, in 0.0 to 60.0;
        /// Evidence in nats against any object from which a landmark counts as empty. Default 0.9:
        /// three misses of one vehicle.
        pub empty_evidence: f64 = 0.9, in 0.01 to 100.0;
        /// Lead in nats that another label needs over the one published last. Default 0.5; it
        /// prevents flicker.
        pub switch_lead: f64 = 0.5, in 0.0 to 100.0;
    }
}

impl PaceConfig {
    /// The reported covariance; without one, its default reaches the gate in metres and in sigmas
    /// alike.
    fn covariance(&self, object: &PerceivedObject) -> Covariance {
        object
            .covariance()
            .unwrap_or_else(|| Covariance::isotropic(self.gate_m / self.gate_sigmas))
    }

    fn max_age(&self) -> Duration {
        Duration::from_secs_f64(self.max_age_s)
    }

    /// The gate between a detection and its landmark.
    pub fn gate(&self) -> LandmarkGate {
        LandmarkGate {
            radius_m: self.gate_m,
            sigmas: self.gate_sigmas,
            floor_m: self.position_floor_m,
        }
    }
}

/// The result of one round.
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
    /// PACE as the paper prints it, see [`PaceMode::Paper`].
    Paper(PaperPace),
    /// PACE with evidence of presence and of absence, see [`PaceMode::Bayes`].
    Bayes(BayesPace),
}

impl Pace {
    /// Creates PACE without evidence, in the mode of `config`, which must be valid.
    pub fn new(config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        match config.mode {
            PaceMode::Paper => Self::Paper(PaperPace::new(&config, landmarks)),
            PaceMode::Bayes => Self::Bayes(BayesPace::new(config, landmarks)),
        }
    }

    /// The same evidence under other settings and for other locations, matched by id. Another mode
    /// starts without any.
    #[must_use]
    pub(crate) fn configured(self, config: PaceConfig, landmarks: Arc<LandmarkIndex>) -> Self {
        match (self, config.mode) {
            (Self::Paper(pace), PaceMode::Paper) => {
                Self::Paper(pace.configured(&config, landmarks))
            }
            (Self::Bayes(pace), PaceMode::Bayes) => Self::Bayes(pace.configured(config, landmarks)),
            _ => Self::new(config, landmarks),
        }
    }

    /// Adds landmarks after the existing ones; evidence is kept.
    pub fn add_landmarks(&mut self, added: Vec<Landmark>) {
        match self {
            Self::Paper(pace) => pace.add_landmarks(added),
            Self::Bayes(pace) => pace.add_landmarks(added),
        }
    }

    /// The landmarks, in the order in which rounds list them.
    pub fn landmarks(&self) -> &LandmarkIndex {
        self.places().0
    }

    fn places(&self) -> (&LandmarkIndex, f64) {
        match self {
            Self::Paper(pace) => pace.places(),
            Self::Bayes(pace) => pace.places(),
        }
    }

    /// True if an object names a landmark or is within the gate of one.
    pub fn is_at_landmark(&self, object: &PerceivedObject) -> bool {
        let (landmarks, gate_m) = self.places();
        let point = Point2::new(object.x_m, object.y_m);
        let is_near = || landmarks.within(&point, gate_m).next().is_some();
        object.landmark.is_some() || !landmarks.landmarks().is_empty() && is_near()
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
