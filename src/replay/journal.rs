//! The journal of an aggregator: its inputs and their times, from which a replay gives bit-equal
//! rounds.
//!
//! Call [`JournalReplay::entry`] and [`JournalReplay::report`] in the recorded order; they return
//! the aggregator's maps and verdicts. Rounds are equal from a [`JournalEvent::Start`] on, with the
//! same configuration and version. After [`JournalEvent::Continue`] or [`JournalEvent::Missing`]
//! they may be based on less evidence. Call [`JournalReplay::restart`] where the journal of another
//! run of the node follows.

use std::collections::BTreeMap;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::FusedLine;
use crate::aggregator::round::FirstRound;
use crate::aggregator::{Aggregator, Command, Fused, FusionConfig};
use crate::model::epoch::Epoch;
use crate::model::time::Timestamp;
use crate::perception::landmark::Landmark;
use crate::reputation::ReputationLedger;
use crate::wire::{ObjectReport, RejectReason, ReportKind};

/// One entry of a journal. Reports are stored separately.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct JournalEntry {
    /// The current time that was passed to the aggregator.
    pub at_us: Timestamp,
    /// The event.
    pub event: JournalEvent,
}

/// An input of an aggregator other than a report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum JournalEvent {
    /// A run began as a standby without votes or detections.
    Start {
        /// The evidence at the beginning.
        #[schemars(with = "serde_json::Value")]
        ledger: Arc<ReputationLedger>,
    },
    /// The journal begins in the middle of a run.
    Continue {
        /// The leadership, if it leads.
        leads: Option<Epoch>,
        /// Number of the next round.
        next_round: u64,
    },
    /// A command.
    Command(Command),
    /// Entries or reports were lost about here.
    Missing {
        /// Their number.
        entries: u64,
    },
}

/// Statistics of a journal's replay.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JournalSummary {
    /// Number of reports in the journal, rejected reports included.
    pub reports: u64,
    /// Rejected reports by reason; many where a live aggregator gets the same report over two
    /// links.
    pub rejected: BTreeMap<RejectReason, u64>,
    /// Entries and reports that were lost.
    pub missing: u64,
    /// True if it began in the middle of a run.
    pub continued: bool,
    /// Maps and sets of verdicts.
    pub written: u64,
}

/// A running replay of a journal.
#[derive(Debug, Clone)]
pub struct JournalReplay {
    fusion: FusionConfig,
    landmarks: Vec<Landmark>,
    aggregator: Option<Aggregator>,
    summary: JournalSummary,
}

impl JournalReplay {
    /// A replay without entries; `fusion` is taken as valid.
    pub fn new(fusion: FusionConfig, landmarks: Vec<Landmark>) -> Self {
        Self {
            fusion,
            landmarks,
            aggregator: None,
            summary: JournalSummary::default(),
        }
    }

    /// Begins another run of the node with this configuration; `fusion` is taken as valid.
    pub fn restart(&mut self, fusion: FusionConfig, landmarks: Vec<Landmark>) {
        self.fusion = fusion;
        self.landmarks = landmarks;
        self.aggregator = None;
    }

    /// Processes the next entry.
    pub fn entry(&mut self, entry: &JournalEntry) -> Vec<FusedLine> {
        let at = entry.at_us;
        match &entry.event {
            JournalEvent::Start { ledger } => {
                let mut aggregator = self.standby(at);
                aggregator.adopt(ledger);
                self.aggregator = Some(aggregator);
                Vec::new()
            }
            // The next file of a journal whose last file was read.
            JournalEvent::Continue { .. } if self.aggregator.is_some() => Vec::new(),
            JournalEvent::Continue { leads, next_round } => {
                self.summary.continued = true;
                let aggregator = self.running(at);
                if let Some(epoch) = leads {
                    aggregator.lead(epoch.clone(), *next_round, FirstRound::OnTime, at);
                }
                Vec::new()
            }
            JournalEvent::Command(command) => {
                if let Command::Configure { fusion, landmarks } = command {
                    // A later run of the aggregator starts with them.
                    self.fusion = FusionConfig::clone(fusion);
                    self.landmarks = landmarks.iter().map(Landmark::from).collect();
                }
                let fused = self.running(at).command(command, at);
                self.lines(fused)
            }
            JournalEvent::Missing { entries } => {
                self.summary.missing += entries;
                Vec::new()
            }
        }
    }

    /// Processes the next report.
    pub fn report(
        &mut self,
        kind: ReportKind,
        report: &Arc<ObjectReport>,
        at: Timestamp,
    ) -> Vec<FusedLine> {
        self.summary.reports += 1;
        match self.running(at).report(kind, report, at) {
            Ok(fused) => self.lines(fused),
            Err(reason) => {
                *self.summary.rejected.entry(reason).or_default() += 1;
                Vec::new()
            }
        }
    }

    /// Statistics of the entries that were replayed so far.
    pub fn summary(&self) -> &JournalSummary {
        &self.summary
    }

    fn standby(&self, at: Timestamp) -> Aggregator {
        Aggregator::new_standby(self.fusion.clone(), self.landmarks.clone(), at)
    }

    /// The current run; a run without a recorded beginning starts as a standby.
    fn running(&mut self, at: Timestamp) -> &mut Aggregator {
        if self.aggregator.is_none() {
            self.summary.continued = true;
        }
        let fresh = self.aggregator.take().unwrap_or_else(|| self.standby(at));
        self.aggregator.insert(fresh)
    }

    fn lines(&mut self, fused: Option<Fused>) -> Vec<FusedLine> {
        let Some(Fused { map, verdicts, .. }) = fused else {
            return Vec::new();
        };
        let lines: Vec<_> = map
            .map(FusedLine::Map)
            .into_iter()
            .chain(verdicts.map(FusedLine::Verdicts))
            .collect();
        self.summary.written += lines.len() as u64;
        lines
    }
}
