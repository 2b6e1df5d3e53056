//! Logs run again: by the journal of the node's aggregator where it has one, else by the reports that an observer took.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::anyhow;
use ecod::landmark::Landmark;
use ecod::replay::{FusedLine, JournalEntry, JournalReplay, Replay, ReplayConfig};
use ecod::wire::{Limits, ObjectReport, RejectReason, ReportKind, decode};

use super::{Failure, report, write_all};
use crate::observe::recorder::{LogError, LogEvent, LogIdentity, LogMessage, LogReader, SchemaName};

/// What was live was within the limits of its node; here they only bound memory.
const LIMITS: Limits = Limits { payload_bytes: 1 << 28, map_bytes: 1 << 28, objects: usize::MAX };

/// The machine that runs the reports again.
enum ReplayEngine {
    /// Nothing has been read that says which.
    Undecided,
    /// The aggregator's journal.
    Journal(Box<JournalReplay>),
    /// Reports by their time of receipt.
    Reports(Box<Replay>),
}

/// Runs the files of a log again, in their order.
pub(super) struct LogReplay<'a> {
    /// Replaces the configuration in the log.
    cell: Option<&'a ReplayConfig>,
    passes: Option<u32>,
    identity: Option<LogIdentity>,
    machine: ReplayEngine,
    unreadable: BTreeMap<RejectReason, u64>,
}

impl<'a> LogReplay<'a> {
    pub(super) fn new(cell: Option<&'a ReplayConfig>, passes: Option<u32>) -> Self {
        Self { cell, passes, identity: None, machine: ReplayEngine::Undecided, unreadable: BTreeMap::new() }
    }

    /// Reads the files and writes what comes of them; what cannot be used is told of and left out.
    pub(super) fn run(mut self, files: &[PathBuf], sink: &mut dyn Write, output: &Path) -> Result<(), Failure> {
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
                if !write_all(sink, &lines, output)? {
                    return Ok(());
                }
            }
            for (schema, messages) in log.unknown() {
                eprintln!("{}: {messages} messages of {schema:?} are not known and left out", file.display());
            }
        }
        self.finish(sink, output)
    }

    fn event(&mut self, event: LogEvent, file: &Path) -> Result<Vec<FusedLine>, Failure> {
        match event {
            LogEvent::Identity(identity) => self.meet(*identity, file),
            LogEvent::Message(message) => Ok(self.message(&message)),
        }
    }

    fn meet(&mut self, identity: LogIdentity, file: &Path) -> Result<Vec<FusedLine>, Failure> {
        let known = self.identity.take();
        if let Some(known) = &known
            && known.node != identity.node
        {
            let (one, other) = (&known.node, &identity.node);
            let what = format!("{} is of node {other}, files before it of {one}", file.display());
            return Err(Failure::usage(anyhow!("{what}: give the files of one node at a time")));
        }
        let (file, version) = (file.display(), &identity.version);
        if version != env!("CARGO_PKG_VERSION") && known.as_ref().is_none_or(|known| known.version != *version) {
            eprintln!("{file} was written by version {version}: rounds may differ from what that version made of it");
        }
        let identity = self.identity.insert(identity);
        let Some(known) = known.filter(|known| known.run != identity.run) else { return Ok(Vec::new()) };
        let is_as_before = (&known.fusion, &known.landmarks) == (&identity.fusion, &identity.landmarks);
        let config = self.config();
        match &mut self.machine {
            ReplayEngine::Journal(rerun) => rerun.restart(config.fusion, config.landmarks),
            ReplayEngine::Reports(replay) if self.cell.is_none() && !is_as_before => {
                eprintln!("{file} is of a run under another configuration: from there on reports are fused anew");
                return Ok(end(std::mem::replace(&mut **replay, Replay::new(config))));
            }
            ReplayEngine::Reports(_) | ReplayEngine::Undecided => {}
        }
        Ok(Vec::new())
    }

    fn message(&mut self, message: &LogMessage) -> Vec<FusedLine> {
        match message.schema {
            SchemaName::JournalEntry if self.passes.is_none() => {
                let Ok(entry) = serde_json::from_slice::<JournalEntry>(&message.json) else {
                    return self.reject(RejectReason::Malformed);
                };
                self.journal_replay().map(|rerun| rerun.entry(&entry)).unwrap_or_default()
            }
            SchemaName::ObjectReport => match read_report(message) {
                Ok((kind, report)) => match self.machine() {
                    ReplayEngine::Journal(rerun) => rerun.report(kind, &Arc::new(report), message.at),
                    ReplayEngine::Reports(replay) => replay.report(kind, report, message.at),
                    ReplayEngine::Undecided => Vec::new(),
                },
                Err(reason) => self.reject(reason),
            },
            _ => Vec::new(),
        }
    }

    fn reject(&mut self, reason: RejectReason) -> Vec<FusedLine> {
        *self.unreadable.entry(reason).or_default() += 1;
        Vec::new()
    }

    /// A journal precedes the reports that it is about.
    fn journal_replay(&mut self) -> Option<&mut JournalReplay> {
        if matches!(self.machine, ReplayEngine::Undecided) {
            let ReplayConfig { fusion, landmarks, .. } = self.config();
            self.machine = ReplayEngine::Journal(Box::new(JournalReplay::new(fusion, landmarks)));
        }
        if let ReplayEngine::Journal(rerun) = &mut self.machine { Some(rerun) } else { None }
    }

    fn machine(&mut self) -> &mut ReplayEngine {
        if matches!(self.machine, ReplayEngine::Undecided) {
            self.machine = ReplayEngine::Reports(Box::new(Replay::new(self.config())));
        }
        &mut self.machine
    }

    /// What the present run is run again under.
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
        ReplayConfig { passes: self.passes, limits: LIMITS, ..config }
    }

    fn finish(self, sink: &mut dyn Write, output: &Path) -> Result<(), Failure> {
        for (reason, messages) in &self.unreadable {
            eprintln!("rejected {reason} {messages}");
        }
        match self.machine {
            ReplayEngine::Undecided => eprintln!("there is no report and no journal in the log"),
            ReplayEngine::Reports(replay) => {
                write_all(sink, &end(*replay), output)?;
            }
            ReplayEngine::Journal(rerun) => say(&rerun),
        }
        Ok(())
    }
}

/// What comes of a log, by its journal or its reports; only built for the fuzz targets.
#[cfg(fuzzing)]
pub fn rounds_of_log(file: &Path) -> Vec<FusedLine> {
    let mut replay = LogReplay::new(None, None);
    let Ok(log) = LogReader::open(file) else { return Vec::new() };
    let mut rounds: Vec<_> = log.flatten().map_while(|event| replay.event(event, file).ok()).flatten().collect();
    if let ReplayEngine::Reports(machine) = replay.machine {
        rounds.extend(machine.finish().0);
    }
    rounds
}

/// The last that comes of reports, and what became of them.
fn end(replay: Replay) -> Vec<FusedLine> {
    let (lines, summary) = replay.finish();
    report(&summary);
    lines
}

fn say(rerun: &JournalReplay) {
    let summary = rerun.summary();
    let used = summary.reports - summary.rejected.values().sum::<u64>();
    eprintln!("{} reports, {used} used, {} written", summary.reports, summary.written);
    for (reason, reports) in &summary.rejected {
        eprintln!("rejected {reason} {reports}");
    }
    if summary.continued {
        eprintln!(
            "the log begins in the middle of a run: its first rounds rest on less evidence than the live ones did"
        );
    }
    if summary.missing > 0 {
        eprintln!(
            "{} entries are missing in the log: rounds after them may differ from the live ones",
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
