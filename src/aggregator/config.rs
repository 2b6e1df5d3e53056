//! Settings of fusion.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::admission::report_window::WindowConfig;
use crate::aggregator::round::RoundConfig;
use crate::config::ConfigError;
use crate::pace::PaceConfig;
use crate::reputation::ReputationConfig;
use crate::tracking::{TracksConfig, TracksMode};
use crate::vote::VoteConfig;

/// The algorithms that a cell runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Algorithms {
    /// PACE: rounds produce maps.
    Pace,
    /// VOTE: rounds produce verdicts.
    Vote,
    /// PACE and VOTE: rounds produce maps and, from the first vote on, verdicts.
    #[default]
    Both,
}

impl Algorithms {
    /// True if PACE is among them.
    pub fn pace(self) -> bool {
        self != Self::Vote
    }

    /// True if VOTE is among them.
    pub fn vote(self) -> bool {
        self != Self::Pace
    }
}

/// Settings of the fusion of a cell's reports.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FusionConfig {
    /// The algorithms that run: maps by PACE, and from the first vote on verdicts by VOTE. Default
    /// `both`. Reports for an algorithm that does not run are rejected.
    pub algorithms: Algorithms,
    /// Admission of reports by age and clock.
    pub window: WindowConfig,
    /// The interval of rounds.
    pub round: RoundConfig,
    /// Parameters of PACE; without effect if `algorithms` is `vote`.
    pub pace: PaceConfig,
    /// Parameters of tracking, which produces the objects in maps that are not at a landmark.
    pub tracks: TracksConfig,
    /// Parameters of VOTE; without effect if `algorithms` is `pace`.
    pub vote: VoteConfig,
    /// Parameters of the published reputations.
    pub reputation: ReputationConfig,
}

impl FusionConfig {
    /// True if objects are tracked in a cell with or without landmarks.
    pub fn tracks_objects(&self, has_landmarks: bool) -> bool {
        let is_wanted = match self.tracks.mode {
            TracksMode::Auto => !has_landmarks,
            TracksMode::On => true,
            TracksMode::Off => false,
        };
        self.algorithms.pace() && is_wanted
    }

    /// True if rounds yield evidence about vehicles in a cell with or without landmarks.
    pub fn rates_vehicles(&self, has_landmarks: bool) -> bool {
        self.algorithms.vote() || self.tracks_objects(has_landmarks)
    }

    /// Checks all values.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] that names the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.window
            .validate()
            .map_err(|error| error.within("window"))?;
        self.round
            .validate()
            .map_err(|error| error.within("round"))?;
        self.pace.validate().map_err(|error| error.within("pace"))?;
        self.tracks
            .validate()
            .map_err(|error| error.within("tracks"))?;
        self.vote.validate().map_err(|error| error.within("vote"))?;
        self.reputation
            .validate()
            .map_err(|error| error.within("reputation"))
    }
}
