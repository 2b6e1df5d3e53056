//! Replay of logs: from the aggregator's journal if there is one, otherwise from an observer's
//! reports.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::anyhow;
use ecod::perception::landmark::Landmark;
use ecod::replay::{FusedLine, JournalEntry, JournalReplay, Replay, ReplayConfig};
use ecod::wire::{Limits, ObjectReport, RejectReason, ReportKind, decode};

use super::{Failure, RoundWriter, Usable, print_summary};
use crate::observe::recorder::{
    LogError, LogEvent, LogIdentity, LogMessage, LogReader, SchemaName,
};

/// Bounds of memory only: the node checked its own limits when it recorded.
const LIMITS: Limits = Limits {
    payload_bytes: 1 << 28,
    map_bytes: 1 << 28,
    objects: usize::MAX,
};

/// Way of replaying a log.
enum ReplayEngine {
    /// From the aggregator's journal.
    Journal(Box<JournalReplay>),
    /// From reports, ordered by their time of receipt.
    Reports(Box<Replay>),
}

/// Replay of the files of a log, in their order.
pub(super) struct LogReplay<'a> {
    /// Replaces the configuration in the log.
    cell: Option<&'a ReplayConfig>,
    passes: Option<u32>,
    identity: Option<LogIdentity>,
    /// Chosen by the first journal entry or report.
    engine: Option<ReplayEngine>,
    unreadable: BTreeMap<RejectReason, u64>,
    /// Counts of reports of the completed fusions, and of unreadable reports.
    usable: Usable,
}

impl<'a> LogReplay<'a> {
    pub(super) fn new(cell: Option<&'a ReplayConfig>, passes: Option<u32>) -> Self {
        Self {
            cell,
            passes,
            identity: None,
            engine: None,
            unreadable: BTreeMap::new(),
            usable: Usable::default(),
        }
    }

    /// Reads the files and writes their rounds. Unusable parts are reported and skipped. Returns
    /// `None` for a journal, and if the reader of the output closed it.
    pub(super) fn run(
        mut self,
        files: &[PathBuf],
        mut rounds: RoundWriter,
    ) -> Result<Option<Usable>, Failure> {
        for file in files {
            let mut log = LogReader::open(file).map_err(Failure::usage)?;
            for event in log.by_ref() {
                let lines = match event {
                    Ok(event) => self.event(event, file)?,
                    Err(error @ LogError::Unreadable { .. }) => return Err(anyhow!(error).into()),
                    Err(error) => {
                        eprintln!("ecod-node: {:#}", anyhow!(error));
                        continue;
                    }
                };
                if !rounds.write(&lines)? {
                    return Ok(None);
                }
            }
            for (schema, messages) in log.unknown() {
                eprintln!(
                    "{}: {messages} messages of the unknown kind {schema:?} are skipped",
                    file.display()
                );
            }
        }
        self.finish(rounds)
    }

    fn event(&mut self, event: LogEvent, file: &Path) -> Result<Vec<FusedLine>, Failure> {
        match event {
            LogEvent::Identity(identity) => self.identity(*identity, file),
            LogEvent::Message(message) => Ok(self.message(&message)),
        }
    }

    fn identity(&mut self, identity: LogIdentity, file: &Path) -> Result<Vec<FusedLine>, Failure> {
        let known = self.identity.take();
        if let Some(known) = &known
            && known.node != identity.node
        {
            let one = &known.node;
            let other = &identity.node;
            let what = format!(
                "{} is of node {other}, earlier files are of {one}",
                file.display()
            );
            return Err(Failure::usage(anyhow!(
                "{what}: give the files of one node at a time"
            )));
        }
        let file = file.display();
        let version = &identity.version;
        if version != env!("CARGO_PKG_VERSION")
            && known.as_ref().is_none_or(|known| known.version != *version)
        {
            eprintln!("{file} was written by version {version}: its rounds may differ");
        }
        let identity = self.identity.insert(identity);
        let Some(known) = known.filter(|known| known.run != identity.run) else {
            return Ok(Vec::new());
        };
        let is_as_before =
            (&known.fusion, &known.landmarks) == (&identity.fusion, &identity.landmarks);
        let config = self.config();
        match &mut self.engine {
            Some(ReplayEngine::Journal(rerun)) => rerun.restart(config.fusion, config.landmarks),
            Some(ReplayEngine::Reports(replay)) if self.cell.is_none() && !is_as_before => {
                eprintln!(
                    "{file} is of a run under another configuration: fusion starts again there"
                );
                return Ok(end(
                    std::mem::replace(&mut **replay, Replay::new(config)),
                    &mut self.usable,
                ));
            }
            _ => {}
        }
        Ok(Vec::new())
    }

    fn message(&mut self, message: &LogMessage) -> Vec<FusedLine> {
        match message.schema {
            SchemaName::JournalEntry if self.passes.is_none() => {
                let Ok(entry) = serde_json::from_slice::<JournalEntry>(&message.json) else {
                    return self.reject(RejectReason::Malformed);
                };
                match self.engine(SchemaName::JournalEntry) {
                    ReplayEngine::Journal(rerun) => rerun.entry(&entry),
                    ReplayEngine::Reports(_) => Vec::new(),
                }
            }
            SchemaName::ObjectReport => match read_report(message) {
                Ok((kind, report)) => match self.engine(SchemaName::ObjectReport) {
                    ReplayEngine::Journal(rerun) => {
                        rerun.report(kind, &Arc::new(report), message.at)
                    }
                    ReplayEngine::Reports(replay) => replay.report(kind, report, message.at),
                },
                Err(reason) => self.reject(reason),
            },
            _ => Vec::new(),
        }
    }

    fn reject(&mut self, reason: RejectReason) -> Vec<FusedLine> {
        self.usable = self.usable.plus(Usable {
            reports: 1,
            faulty: 1,
            ..Usable::default()
        });
        *self.unreadable.entry(reason).or_default() += 1;
        Vec::new()
    }

    /// The engine, which the first message chooses: a journal precedes its reports.
    fn engine(&mut self, first: SchemaName) -> &mut ReplayEngine {
        let engine = match (self.engine.take(), first) {
            (Some(engine), _) => engine,
            (None, SchemaName::JournalEntry) => {
                let ReplayConfig {
                    fusion, landmarks, ..
                } = self.config();
                ReplayEngine::Journal(Box::new(JournalReplay::new(fusion, landmarks)))
            }
            (None, _) => ReplayEngine::Reports(Box::new(Replay::new(self.config()))),
        };
        self.engine.insert(engine)
    }

    /// Configuration of the current run.
    fn config(&self) -> ReplayConfig {
        let config = match (self.cell, &self.identity) {
            (Some(cell), _) => cell.clone(),
            (None, Some(identity)) => ReplayConfig {
                aggregator: identity.node.clone(),
                fusion: identity.fusion.clone(),
                landmarks: identity.landmarks.iter().map(Landmark::from).collect(),
                ..ReplayConfig::default()
            },
            (None, None) => ReplayConfig::default(),
        };
        ReplayConfig {
            passes: self.passes,
            limits: LIMITS,
            ..config
        }
    }

    fn finish(mut self, mut rounds: RoundWriter) -> Result<Option<Usable>, Failure> {
        for (reason, messages) in &self.unreadable {
            eprintln!("rejected {reason} {messages}");
        }
        match self.engine {
            None => eprintln!("the log holds no report and no journal"),
            Some(ReplayEngine::Reports(replay)) => {
                rounds.write(&end(*replay, &mut self.usable))?;
            }
            Some(ReplayEngine::Journal(rerun)) => {
                print_rerun(&rerun);
                // Reports that the live aggregator rejected are part of its journal, which may
                // contain no fused report.
                return rounds.finish().map(|()| None);
            }
        }
        rounds.finish().map(|()| Some(self.usable))
    }
}

/// Rounds of a log; only built for the fuzz targets.
#[cfg(fuzzing)]
pub fn rounds_of_log(file: &Path) -> Vec<FusedLine> {
    let mut replay = LogReplay::new(None, None);
    let Ok(log) = LogReader::open(file) else {
        return Vec::new();
    };
    let mut rounds: Vec<_> = log
        .flatten()
        .map_while(|event| replay.event(event, file).ok())
        .flatten()
        .collect();
    if let Some(ReplayEngine::Reports(engine)) = replay.engine {
        rounds.extend(engine.finish().0);
    }
    rounds
}

/// The last rounds of a replay of reports, whose summary is printed and added up.
fn end(replay: Replay, usable: &mut Usable) -> Vec<FusedLine> {
    let (lines, summary) = replay.finish();
    print_summary(&summary);
    // An observer receives every report from two brokers.
    *usable = usable.plus(Usable::of(&summary, true));
    lines
}

fn print_rerun(rerun: &JournalReplay) {
    let summary = rerun.summary();
    let used = summary.reports - summary.rejected.values().sum::<u64>();
    eprintln!(
        "{} reports, {used} used, {} written",
        summary.reports, summary.written
    );
    for (reason, reports) in &summary.rejected {
        eprintln!("rejected {reason} {reports}");
    }
    if summary.continued {
        eprintln!(
            "the log begins in the middle of a run: so its first rounds lack evidence that the live node had"
        );
    }
    if summary.missing > 0 {
        eprintln!(
            "{} entries are missing in the log: later rounds may differ from the live ones",
            summary.missing
        );
    }
}

fn read_report(message: &LogMessage) -> Result<(ReportKind, ObjectReport), RejectReason> {
    let level = message.topic.split('/').next().unwrap_or_default();
    let kind = match level {
        "detections" => ReportKind::Detections,
        "vote_detections" => ReportKind::VoteDetections,
        _ => return Err(RejectReason::UnknownTopic),
    };
    Ok((kind, decode(&message.json, &LIMITS)?))
}
