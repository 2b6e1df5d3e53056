//! The aggregator of a cell, without its sockets and clocks: reports go in, maps come out.
//!
//! Call [`Aggregator::report`] with every decoded report and [`Aggregator::tick`] at the latest at
//! [`Aggregator::deadline`]; either may close a round and return what it made. The live node and the replay of a log
//! run this same machine.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::config::ConfigError;
use crate::landmark::{Landmark, LandmarkIndex};
use crate::names::NodeName;
use crate::pace::{Pace, PaceConfig};
use crate::round::{RoundConfig, RoundTrigger};
use crate::time::Timestamp;
use crate::window::{ReportWindow, WindowConfig};
use crate::wire::{GlobalMap, ObjectReport, RejectReason, SCHEMA_VERSION};

/// How a cell's reports are fused.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FusionConfig {
    /// Which reports are fresh enough.
    pub window: WindowConfig,
    /// The rhythm of rounds.
    pub round: RoundConfig,
    /// Parameters of PACE.
    pub pace: PaceConfig,
}

impl FusionConfig {
    /// Checks all values.
    ///
    /// # Errors
    /// [`ConfigError`] naming the key, the value and the allowed range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.window.validate().map_err(|error| error.within("window"))?;
        self.round.validate().map_err(|error| error.within("round"))?;
        self.pace.validate().map_err(|error| error.within("pace"))
    }
}

/// Admits reports, fuses them and numbers the rounds.
#[derive(Debug, Clone)]
pub struct Aggregator {
    name: NodeName,
    epoch: u64,
    round: u64,
    window: ReportWindow,
    rounds: RoundTrigger,
    pace: Pace,
}

impl Aggregator {
    /// An aggregator without evidence that leads in `epoch`; `config` is taken as valid.
    pub fn new(name: NodeName, epoch: u64, config: FusionConfig, landmarks: Vec<Landmark>, now: Timestamp) -> Self {
        let landmarks = Arc::new(LandmarkIndex::new(landmarks, config.pace.gate_m));
        Self {
            name,
            epoch,
            round: 0,
            window: ReportWindow::new(config.window),
            rounds: RoundTrigger::new(config.round, now),
            pace: Pace::new(config.pace, landmarks),
        }
    }

    /// Takes a report received at `now`; returns the map if the round closes with it.
    ///
    /// # Errors
    /// The reason for which the report was not used; no map is changed by it, at most the estimate of its vehicle's clock.
    pub fn report(&mut self, report: &ObjectReport, now: Timestamp) -> Result<Option<GlobalMap>, RejectReason> {
        let captured_at = self.window.admit(report, now)?;
        self.pace.observe(report, captured_at);
        Ok(if self.rounds.report(&report.node, now) { Some(self.close(now)) } else { None })
    }

    /// Closes the round if it is due at `now`.
    pub fn tick(&mut self, now: Timestamp) -> Option<GlobalMap> {
        if self.rounds.tick(now) { Some(self.close(now)) } else { None }
    }

    /// When the round closes without a further report.
    pub fn deadline(&self) -> Timestamp {
        self.rounds.deadline()
    }

    fn close(&mut self, now: Timestamp) -> GlobalMap {
        self.round += 1;
        let round = self.pace.close(now);
        GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: self.name.clone(),
            epoch: self.epoch,
            round: self.round,
            fused_at_us: now,
            oldest_capture_us: round.oldest_capture,
            landmarks: round.landmarks,
            objects: Vec::new(),
        }
    }
}
