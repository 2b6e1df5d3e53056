//! The journal of an aggregator: what it was told and when, from which it is run again to the last bit.
//!
//! Call [`Rerun::entry`] and [`Rerun::report`] in the order in which the aggregator was told; out come the maps and
//! verdicts that it made. That holds from a [`JournalEvent::Start`] on, with the same configuration and version; where
//! the journal of another run of the node follows, call [`Rerun::restart`] first. After
//! [`JournalEvent::Continue`] or [`JournalEvent::Missing`] the rounds are the same but may rest on less evidence.

use std::collections::BTreeMap;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::FusedLine;
use crate::aggregator::{Aggregator, Command, Fused, FusionConfig};
use crate::epoch::Epoch;
use crate::landmark::Landmark;
use crate::reputation::ReputationLedger;
use crate::round::FirstRound;
use crate::time::Timestamp;
use crate::wire::{ObjectReport, RejectReason, ReportKind};

/// One entry of a journal. Reports are kept beside it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct JournalEntry {
    /// The present time as the aggregator was told.
    pub at_us: Timestamp,
    /// What happened.
    pub event: JournalEvent,
}

/// What happens to an aggregator beside reports.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum JournalEvent {
    /// A run of it began: without votes or detections, as a standby.
    Start {
        /// The evidence that it began with.
        #[schemars(with = "serde_json::Value")]
        ledger: Arc<ReputationLedger>,
    },
    /// The journal begins in the middle of a run.
    Continue {
        /// Whom it leads as, if it does.
        leads: Option<Epoch>,
        /// Number of its next round.
        next_round: u64,
    },
    /// It was told something.
    Command(Command),
    /// About here entries or reports were lost.
    Missing {
        /// How many.
        entries: u64,
    },
}

/// What became of a journal.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RerunSummary {
    /// Reports in it.
    pub reports: u64,
    /// Reports that were not used, by reason; a live aggregator that has two ways to hear of the same report rejects
    /// many.
    pub rejected: BTreeMap<RejectReason, u64>,
    /// Entries and reports that were lost.
    pub missing: u64,
    /// Whether it began in the middle of a run.
    pub continued: bool,
    /// Maps and sets of verdicts made.
    pub written: u64,
}

/// Runs an aggregator again.
#[derive(Debug, Clone)]
pub struct Rerun {
    fusion: FusionConfig,
    landmarks: Vec<Landmark>,
    aggregator: Option<Aggregator>,
    summary: RerunSummary,
}

impl Rerun {
    /// Nothing has happened yet; `fusion` is taken as valid.
    pub fn new(fusion: FusionConfig, landmarks: Vec<Landmark>) -> Self {
        Self { fusion, landmarks, aggregator: None, summary: RerunSummary::default() }
    }

    /// What comes is of another run of the node, under this configuration; `fusion` is taken as valid.
    pub fn restart(&mut self, fusion: FusionConfig, landmarks: Vec<Landmark>) {
        (self.fusion, self.landmarks, self.aggregator) = (fusion, landmarks, None);
    }

    /// Takes the next entry.
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
                let fused = self.running(at).command(command, at);
                self.lines(fused)
            }
            JournalEvent::Missing { entries } => {
                self.summary.missing += entries;
                Vec::new()
            }
        }
    }

    /// Takes the next report.
    pub fn report(&mut self, kind: ReportKind, report: &Arc<ObjectReport>, at: Timestamp) -> Vec<FusedLine> {
        self.summary.reports += 1;
        match self.running(at).report(kind, report, at) {
            Ok(fused) => self.lines(fused),
            Err(reason) => {
                *self.summary.rejected.entry(reason).or_default() += 1;
                Vec::new()
            }
        }
    }

    /// What became of the journal so far.
    pub fn summary(&self) -> &RerunSummary {
        &self.summary
    }

    fn standby(&self, at: Timestamp) -> Aggregator {
        Aggregator::new_standby(self.fusion.clone(), self.landmarks.clone(), at)
    }

    /// The present run; one whose beginning is not in the journal began as a standby.
    fn running(&mut self, at: Timestamp) -> &mut Aggregator {
        if self.aggregator.is_none() {
            self.summary.continued = true;
        }
        let fresh = self.aggregator.take().unwrap_or_else(|| self.standby(at));
        self.aggregator.insert(fresh)
    }

    fn lines(&mut self, fused: Option<Fused>) -> Vec<FusedLine> {
        let Some(Fused { map, verdicts, .. }) = fused else { return Vec::new() };
        let lines: Vec<_> = map.map(FusedLine::Map).into_iter().chain(verdicts.map(FusedLine::Verdicts)).collect();
        self.summary.written += lines.len() as u64;
        lines
    }
}
