//! Replay of a recorded cell in virtual time: lines in, maps and verdicts out. Equal input gives
//! equal output.
//!
//! Call [`Replay::line`] with every line in the order of arrival, then [`Replay::finish`]. Each
//! line is one report as JSON with two optional fields: `topic`, `"detections"` by default or
//! `"vote_detections"`, and `received_at_us`. The time of a line is its time of receipt or, if
//! absent, of capture, but not earlier than the time of the previous line. An [`Aggregator`], as in
//! a live node, fuses the reports.
//!
//! - One vehicle with a wrong clock must not make all other reports stale. A line does not move the
//!   time if it is ahead of most of the [`LOOKAHEAD`] lines after it, by more than clocks may
//!   differ; without passes it is rejected.
//! - A silence takes at most ten seconds of rounds; then time continues at the next line.
//! - Memory is bounded by the cell, not by the recording.

mod clock;
mod envelope;
mod flaw;
mod journal;
mod records;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

pub use clock::TimeUnit;
pub use journal::{JournalEntry, JournalEvent, JournalReplay, JournalSummary};
pub use records::FusedLine;

use crate::aggregator::{Aggregator, Algorithms, Fused, FusionConfig, Placements};
use crate::model::names::{LandmarkId, NodeName};
use crate::model::time::Timestamp;
use crate::perception::landmark::{Landmark, LandmarkConfig};
use crate::tracking::TracksLosses;
use crate::vote::MAX_LABELS;
pub use crate::wire::Flaw;
use crate::wire::{InvalidValue, Limits, ObjectReport, RejectReason, ReportKind};
use clock::VirtualClock;
use records::RecordedReport;

/// Number of lines that are read ahead to distinguish a wrong clock from a silence.
pub const LOOKAHEAD: usize = 64;

/// Maximum number of locations that an open cell adds for PACE; they are kept until the end.
const MAX_LEARNT_LANDMARKS: usize = 4096;

/// Default maximum number of locations that an open cell keeps for VOTE. It is large because a file
/// is not an attacker: labels are limited by [`MAX_LABELS`] only, the objects of a report by the
/// length of its line.
const MAX_VOTE_LANDMARKS: usize = 1_000_000;

/// Maximum number of rejected lines of one reason whose flaws are kept.
pub const EXAMPLES: usize = 3;

/// A time longer than any recording, in seconds.
const FOREVER_S: f64 = 1e12;

/// Minimum length of a silence that is replayed round by round.
const SILENCE: Duration = Duration::from_secs(10);

/// Settings of a replay.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayConfig {
    /// The aggregator's name in every line of output.
    pub aggregator: NodeName,
    /// Settings of fusion; taken as valid.
    pub fusion: FusionConfig,
    /// The cell's landmarks; if empty, locations are derived from the reports.
    pub landmarks: Vec<Landmark>,
    /// Bounds of a line.
    pub limits: Limits,
    /// Number of times that all stored votes are re-evaluated at the end; only the verdicts of the
    /// last pass are written. Times are ignored in this case: at each location the last vote of
    /// each vehicle in the recording counts.
    pub passes: Option<u32>,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        let mut fusion = FusionConfig::default();
        fusion.vote.max_landmarks = MAX_VOTE_LANDMARKS;
        fusion.vote.max_vehicles = fusion.window.max_vehicles;
        fusion.vote.max_labels = MAX_LABELS;
        Self {
            aggregator: NodeName::from_static("replay"),
            fusion,
            landmarks: Vec::new(),
            limits: Limits {
                objects: usize::MAX,
                ..Limits::default()
            },
            passes: None,
        }
    }
}

/// Statistics of a replay.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Summary {
    /// Lines that are not blank.
    pub lines: u64,
    /// Rejected lines by reason.
    pub rejected: BTreeMap<RejectReason, Rejections>,
    /// Unit that the times seem to be in, if it is not microseconds, by the first readable line.
    pub unit: Option<TimeUnit>,
    /// Used lines with a time before the time of an earlier line.
    pub late: u64,
    /// Objects of used lines for VOTE.
    pub votes: u64,
    /// Objects that did not vote or whose votes were dropped; see [`crate::vote`].
    pub ignored_votes: u64,
    /// Lines of detections by the places of their objects.
    pub placements: Placements,
    /// Lines that only tracking used, because a later report of their vehicle came first.
    pub overtaken: u64,
    /// Reports and objects that tracking did not use.
    pub tracks: TracksLosses,
    /// Maps and sets of verdicts.
    pub written: u64,
}

impl Summary {
    /// Number of used lines.
    pub fn used(&self) -> u64 {
        self.lines
            - self
                .rejected
                .values()
                .map(|rejections| rejections.lines)
                .sum::<u64>()
    }

    /// Number of rejected lines, except lines for an algorithm that the cell does not run and, with
    /// `may_repeat`, reports that a vehicle repeated or sent out of order.
    pub fn faulty(&self, may_repeat: bool) -> u64 {
        let is_fault = |reason: RejectReason| match reason {
            RejectReason::NotFused => false,
            RejectReason::OutOfOrder => !may_repeat,
            _ => true,
        };
        let faults = self
            .rejected
            .iter()
            .filter(|(reason, _)| is_fault(**reason));
        faults.map(|(_, rejections)| rejections.lines).sum()
    }
}

/// Lines that were rejected for one reason.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Rejections {
    /// Number of rejected lines.
    pub lines: u64,
    /// The first ones, [`EXAMPLES`] at most, by line number; lines are counted from 1, blank ones
    /// included.
    pub examples: BTreeMap<u64, Flaw>,
}

/// A running replay; see the module.
#[derive(Debug, Clone)]
pub struct Replay {
    config: ReplayConfig,
    clock: VirtualClock,
    /// Lines that were read ahead, with their numbers.
    ahead: VecDeque<(u64, RecordedReport)>,
    cell: Option<Aggregator>,
    /// True where any report of each kind was used.
    heard: [bool; ReportKind::COUNT],
    /// Locations of an open cell.
    learnt: HashSet<LandmarkId>,
    /// True if any line could be read.
    begun: bool,
    /// True if a report waits for its round to close.
    pending: bool,
    /// True until a round has closed.
    is_first_round: bool,
    /// Line number of the newest line, blank ones included.
    number: u64,
    summary: Summary,
}

impl Replay {
    /// A replay without lines; `config` is taken as valid.
    pub fn new(mut config: ReplayConfig) -> Self {
        if config.passes.is_some() {
            let FusionConfig {
                algorithms,
                window,
                vote,
                ..
            } = &mut config.fusion;
            *algorithms = Algorithms::Vote;
            vote.weighted.freshness_s = FOREVER_S;
            vote.weighted.hysteresis = 0.0;
            vote.weighted.smoothing_share = 0.0;
            vote.max_landmarks = MAX_VOTE_LANDMARKS;
            vote.max_labels = MAX_LABELS;
            vote.max_vehicles = vote.max_vehicles.max(window.max_vehicles);
        }
        Self {
            clock: VirtualClock::new(config.fusion.window.max_clock_offset_s),
            ahead: VecDeque::with_capacity(LOOKAHEAD + 1),
            cell: None,
            heard: [false; ReportKind::COUNT],
            learnt: HashSet::new(),
            begun: false,
            pending: false,
            is_first_round: config.passes.is_none(),
            number: 0,
            summary: Summary::default(),
            config,
        }
    }

    /// Processes the next line, without its line end; returns the output that is ready. Blank lines
    /// are ignored.
    pub fn line(&mut self, text: &[u8]) -> Vec<FusedLine> {
        self.number += 1;
        if text.trim_ascii().is_empty() {
            return Vec::new();
        }
        self.summary.lines += 1;
        self.push(RecordedReport::read(text, &self.config.limits))
    }

    /// Processes the next report of a recording without lines; it counts as one line.
    pub fn report(
        &mut self,
        kind: ReportKind,
        report: ObjectReport,
        received_at: Timestamp,
    ) -> Vec<FusedLine> {
        self.number += 1;
        self.summary.lines += 1;
        let checked = report.check_values(&self.config.limits);
        self.push(match checked {
            Ok(()) => Ok(RecordedReport {
                kind,
                at: received_at,
                is_placed: true,
                report,
            }),
            Err(InvalidValue { field, reason }) => Err(Flaw::new(reason, field, "is not valid")),
        })
    }

    /// Counts a line that was too large to be read at all.
    pub fn oversized_line(&mut self) {
        self.number += 1;
        self.summary.lines += 1;
        self.reject(self.number, flaw::too_large(&self.config.limits));
    }

    /// Processes the lines that were read ahead, closes the last round, and judges an incomplete
    /// packet of VOTE's `paper` mode.
    pub fn finish(mut self) -> (Vec<FusedLine>, Summary) {
        let mut output = Vec::new();
        while !self.ahead.is_empty() {
            output.append(&mut self.process_next());
        }
        let mut end = self.clock.now();
        self.close_first_round(end, &mut output);
        if self.pending
            && let Some(deadline) = self.cell.as_ref().map(Aggregator::deadline)
        {
            end = deadline;
            self.tick(deadline, &mut output);
        }
        if let Some(cell) = &mut self.cell {
            let last = match self.config.passes {
                Some(passes) => cell.refine(passes, self.clock.now()),
                None => cell.end_recording(end),
            };
            self.summary.written += u64::from(last.is_some());
            output.extend(last.map(FusedLine::Verdicts));
            self.summary.ignored_votes = cell.ignored_votes();
            self.summary.overtaken = cell.overtaken();
            self.summary.placements = cell.placements();
            self.summary.tracks = cell.tracks_losses();
        }
        (output, self.summary)
    }

    fn push(&mut self, line: Result<RecordedReport, Flaw>) -> Vec<FusedLine> {
        match line {
            Ok(line) => {
                if !std::mem::replace(&mut self.begun, true) {
                    self.summary.unit = TimeUnit::of(line.report.captured_at_us);
                }
                self.ahead.push_back((self.number, line));
            }
            Err(flaw) => self.reject(self.number, flaw),
        }
        if self.ahead.len() > LOOKAHEAD {
            self.process_next()
        } else {
            Vec::new()
        }
    }

    fn reject(&mut self, number: u64, flaw: Flaw) {
        let Rejections { lines, examples } = self.summary.rejected.entry(flaw.reason).or_default();
        *lines += 1;
        examples.insert(number, flaw);
        // A line that was read ahead is rejected after later ones.
        if examples.len() > EXAMPLES {
            examples.pop_last();
        }
    }

    /// Processes the oldest of the lines that were read ahead.
    fn process_next(&mut self) -> Vec<FusedLine> {
        let mut output = Vec::new();
        let Some((number, mut line)) = self.ahead.pop_front() else {
            return output;
        };
        let is_plausible = self
            .clock
            .is_plausible(line.at, self.ahead.iter().map(|(_, line)| line.at));
        if !is_plausible && self.config.passes.is_none() {
            self.reject(
                number,
                flaw::of_time_ahead(line.at != line.report.captured_at_us),
            );
            return output;
        }
        let before = self.clock.now();
        let is_late = is_plausible && self.clock.advance(line.at);
        let now = self.clock.now();
        if self.config.passes.is_some() {
            line.report.captured_at_us = now;
            line.report.seq = number;
        }
        // Objects are at their landmark, but their distance from the reporter can only be derived
        // from a configured landmark.
        if !line.is_placed && self.config.landmarks.is_empty() {
            line.report.pose = None;
        }
        self.close_due_rounds(before, now, &mut output);
        self.add_landmarks(&line);
        let votes = if line.kind == ReportKind::VoteDetections {
            line.report.objects.len() as u64
        } else {
            0
        };
        match self
            .cell(now)
            .report(line.kind, &Arc::new(line.report), now)
        {
            Ok(fused) => {
                self.summary.late += u64::from(is_late);
                self.summary.votes += votes;
                self.heard[line.kind as usize] = true;
                self.pending = fused.is_none();
                self.write(fused, &mut output);
            }
            Err(reason) => self.reject(number, flaw::of_unused(reason)),
        }
        output
    }

    fn cell(&mut self, now: Timestamp) -> &mut Aggregator {
        let ReplayConfig {
            aggregator,
            fusion,
            landmarks,
            ..
        } = &self.config;
        self.cell.get_or_insert_with(|| {
            Aggregator::new(
                aggregator.clone(),
                1,
                fusion.clone(),
                landmarks.clone(),
                now,
            )
        })
    }

    /// Closes the rounds that were due before `now`; of a silence since `before`, only the rounds
    /// at its beginning.
    ///
    /// A round without reports waits half a period longer for a line, and all lines of one time go
    /// into one round. Otherwise rounds would cut recordings of the same period at arbitrary lines.
    fn close_due_rounds(&mut self, before: Timestamp, now: Timestamp, output: &mut Vec<FusedLine>) {
        if now > before {
            self.close_first_round(before, output);
        }
        let period = Duration::from_secs_f64(self.config.fusion.round.period_s);
        let silent_from = before + SILENCE.max(3 * period);
        while let Some(deadline) = self.cell.as_ref().map(Aggregator::deadline) {
            let patience = if self.pending {
                Duration::ZERO
            } else {
                period / 2
            };
            let due = deadline.max(before);
            if due + patience >= now || deadline > silent_from {
                break;
            }
            self.tick(due, output);
        }
    }

    /// Closes the round of the first time, if it is still open, at that time. There is no earlier
    /// round whose end could be waited for, and a recording with the same period as the rounds then
    /// has a map for its first frame too.
    fn close_first_round(&mut self, at: Timestamp, output: &mut Vec<FusedLine>) {
        if self.pending && std::mem::take(&mut self.is_first_round) {
            let fused = self.cell.as_mut().and_then(|cell| cell.close_early(at));
            self.pending = false;
            self.write(fused, output);
        }
    }

    /// Closes the round that is due at `now`, in recorded time, and appends its results to `output`. No
    /// round is pending until the next report.
    fn tick(&mut self, now: Timestamp, output: &mut Vec<FusedLine>) {
        let fused = self.cell.as_mut().and_then(|cell| cell.tick(now));
        self.pending = false;
        self.write(fused, output);
    }

    /// Writes a round. Algorithms without reports so far are skipped; with passes, only the last
    /// pass writes.
    fn write(&mut self, fused: Option<Fused>, output: &mut Vec<FusedLine>) {
        let Some(Fused { map, verdicts, .. }) = fused.filter(|_| self.config.passes.is_none())
        else {
            return;
        };
        let known = output.len();
        output.extend(
            map.filter(|_| self.heard[ReportKind::Detections as usize])
                .map(FusedLine::Map),
        );
        output.extend(
            verdicts
                .filter(|_| self.heard[ReportKind::VoteDetections as usize])
                .map(FusedLine::Verdicts),
        );
        self.summary.written += (output.len() - known) as u64;
    }

    /// Adds the locations of an open cell: each is at the first object that names it. VOTE needs no
    /// positions and adds locations itself.
    fn add_landmarks(&mut self, line: &RecordedReport) {
        if !self.config.landmarks.is_empty() || line.kind != ReportKind::Detections {
            return;
        }
        let mut fresh = Vec::new();
        for object in &line.report.objects {
            let Some(id) = &object.landmark else { continue };
            if self.learnt.len() < MAX_LEARNT_LANDMARKS && self.learnt.insert(id.clone()) {
                fresh.push(Landmark::from(&LandmarkConfig::at(
                    id.clone(),
                    object.x_m,
                    object.y_m,
                )));
            }
        }
        if !fresh.is_empty() {
            self.cell(self.clock.now()).add_landmarks(fresh);
        }
    }
}

/// The report of a line and its kind, for programs that read a recording without replaying it.
///
/// # Errors
/// Returns the flaw for which a replay would reject the line.
pub fn read_report(text: &[u8], limits: &Limits) -> Result<(ReportKind, ObjectReport), Flaw> {
    RecordedReport::read(text, limits).map(|line| (line.kind, line.report))
}
