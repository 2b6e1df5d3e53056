//! A recorded cell run again, in virtual time: lines in, maps and verdicts out, equal for equal input.
//!
//! Call [`Replay::line`] with every line in the order of arrival, then [`Replay::finish`]. Each line is one report as
//! JSON, with two more fields that may be absent: `topic`, `"detections"` by default or `"vote_detections"`, and
//! `received_at_us`. The time of a line is when it was received or else captured, and never before the line before it.
//! The machine behind it is the [`Aggregator`] of a live node.
//!
//! A line that is ahead of most of the [`LOOKAHEAD`] lines after it, by more than clocks may differ, does not move the
//! time and, without passes, is rejected: one vehicle with a wrong clock must not make all others stale. A silence
//! costs at most ten seconds' rounds; then time goes on at the next line. Memory is bounded by the cell and not by the
//! recording.

mod clock;
mod journal;
mod line;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

pub use journal::{JournalEntry, JournalEvent, Rerun, RerunSummary};
pub use line::FusedLine;

use crate::aggregator::{Aggregator, Algorithms, Fused, FusionConfig};
use crate::landmark::Landmark;
use crate::names::{LandmarkId, NodeName};
use crate::time::Timestamp;
use crate::tracking::TracksLosses;
use crate::vote::MAX_LABELS;
use crate::wire::{Limits, ObjectReport, RejectReason, ReportKind};
use clock::VirtualClock;
use line::Line;

/// How many lines are read ahead to tell a wrong clock from a silence.
pub const LOOKAHEAD: usize = 64;

/// Most locations that an open cell learns for PACE; they are never forgotten.
const MAX_LEARNT: usize = 4096;

/// Most locations that an open cell keeps for VOTE unless its configuration says otherwise: nobody floods a file. For
/// the same reason its labels are only limited by their numbers, and the objects of a report by the length of its line.
const MAX_VOTED_ON: usize = 1_000_000;

/// Longer than any recording, in seconds.
const FOREVER_S: f64 = 1e12;

/// Silence that is replayed round by round, at least.
const SILENCE: Duration = Duration::from_secs(10);

/// The cell that a recording is replayed in.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayConfig {
    /// The aggregator that is written into every line of output.
    pub aggregator: NodeName,
    /// How reports are fused; taken as valid.
    pub fusion: FusionConfig,
    /// The cell's known locations; without any, they are taken from the reports as they appear.
    pub landmarks: Vec<Landmark>,
    /// Bounds of a line.
    pub limits: Limits,
    /// Go over the stored votes so many times at the end and write only the verdicts of the last pass. Times play no
    /// part then: of each vehicle, the vote that comes last in the recording counts at each location.
    pub passes: Option<u32>,
}

impl Default for ReplayConfig {
    fn default() -> Self {
        let mut fusion = FusionConfig::default();
        fusion.vote.max_landmarks = MAX_VOTED_ON;
        fusion.vote.max_vehicles = fusion.window.max_vehicles;
        fusion.vote.max_labels = MAX_LABELS;
        Self {
            aggregator: NodeName::from_static("replay"),
            fusion,
            landmarks: Vec::new(),
            limits: Limits { objects: usize::MAX, ..Limits::default() },
            passes: None,
        }
    }
}

/// What became of the lines.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Summary {
    /// Lines that are not blank.
    pub lines: u64,
    /// Lines that were not used, by reason.
    pub rejected: BTreeMap<RejectReason, Rejections>,
    /// Lines that were used and whose own time is before that of a line before them.
    pub late: u64,
    /// Objects of used lines that voted for nothing or whose votes had to make room; see [`crate::vote`].
    pub ignored_votes: u64,
    /// Used lines of which only tracking made use, because later ones of their vehicles came before.
    pub overtaken: u64,
    /// Reports and objects that tracking left out.
    pub tracks: TracksLosses,
    /// Maps and sets of verdicts made.
    pub written: u64,
}

impl Summary {
    /// Lines that were used.
    pub fn used(&self) -> u64 {
        self.lines - self.rejected.values().map(|rejections| rejections.lines).sum::<u64>()
    }
}

/// Lines that were not used for one reason.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Rejections {
    /// How many.
    pub lines: u64,
    /// Number of the first in the input, from 1, blank lines included.
    pub first_line: u64,
}

/// Replays a recording; see the module.
#[derive(Debug, Clone)]
pub struct Replay {
    config: ReplayConfig,
    clock: VirtualClock,
    /// Lines that were read ahead, with their numbers.
    ahead: VecDeque<(u64, Line)>,
    cell: Option<Aggregator>,
    /// By kind, whether any report came.
    heard: [bool; ReportKind::COUNT],
    /// Locations of an open cell.
    learnt: HashSet<LandmarkId>,
    /// Whether a report waits for its round to close.
    pending: bool,
    /// Number of the newest line, blank ones included.
    number: u64,
    summary: Summary,
}

impl Replay {
    /// A cell that has heard nothing; `config` is taken as valid.
    pub fn new(mut config: ReplayConfig) -> Self {
        if config.passes.is_some() {
            let FusionConfig { algorithms, window, vote, .. } = &mut config.fusion;
            *algorithms = Algorithms::Vote;
            (vote.weighted.freshness_s, vote.weighted.hysteresis) = (FOREVER_S, 0.0);
            vote.weighted.smoothing_share = 0.0;
            (vote.max_landmarks, vote.max_labels) = (MAX_VOTED_ON, MAX_LABELS);
            vote.max_vehicles = vote.max_vehicles.max(window.max_vehicles);
        }
        Self {
            clock: VirtualClock::new(config.fusion.window.max_clock_offset_s),
            config,
            ahead: VecDeque::with_capacity(LOOKAHEAD + 1),
            cell: None,
            heard: [false; ReportKind::COUNT],
            learnt: HashSet::new(),
            pending: false,
            number: 0,
            summary: Summary::default(),
        }
    }

    /// Takes the next line, without its end; returns what has come of the lines so far. Blank lines are passed over.
    pub fn line(&mut self, text: &[u8]) -> Vec<FusedLine> {
        self.number += 1;
        if text.trim_ascii().is_empty() {
            return Vec::new();
        }
        self.summary.lines += 1;
        self.take(Line::read(text, &self.config.limits))
    }

    /// Takes the next report of a recording that is not made of lines; each counts as one.
    pub fn report(&mut self, kind: ReportKind, report: ObjectReport, received_at: Timestamp) -> Vec<FusedLine> {
        self.number += 1;
        self.summary.lines += 1;
        let checked = report.validate(&self.config.limits);
        self.take(checked.map(|()| Line { kind, at: received_at, report }))
    }

    /// Counts a line that was too large to be read at all.
    pub fn oversized_line(&mut self) {
        self.number += 1;
        self.summary.lines += 1;
        self.reject(self.number, RejectReason::TooLarge);
    }

    /// Takes the lines that were read ahead, closes the last round, and judges what VOTE's `paper` mode has of a
    /// packet.
    pub fn finish(mut self) -> (Vec<FusedLine>, Summary) {
        let mut output = Vec::new();
        while !self.ahead.is_empty() {
            output.append(&mut self.next());
        }
        let mut end = self.clock.now();
        if self.pending
            && let Some(deadline) = self.cell.as_ref().map(Aggregator::deadline)
        {
            end = deadline;
            self.tick(deadline, &mut output);
        }
        if let Some(cell) = &mut self.cell {
            let last = match self.config.passes {
                Some(passes) => cell.refine(passes, self.clock.now()),
                None => cell.end_packet(end),
            };
            self.summary.written += u64::from(last.is_some());
            output.extend(last.map(FusedLine::Verdicts));
            self.summary.ignored_votes = cell.ignored_votes();
            self.summary.overtaken = cell.overtaken();
            self.summary.tracks = cell.tracks_losses();
        }
        (output, self.summary)
    }

    fn take(&mut self, line: Result<Line, RejectReason>) -> Vec<FusedLine> {
        match line {
            Ok(line) => self.ahead.push_back((self.number, line)),
            Err(reason) => self.reject(self.number, reason),
        }
        if self.ahead.len() > LOOKAHEAD { self.next() } else { Vec::new() }
    }

    fn reject(&mut self, number: u64, reason: RejectReason) {
        let rejections = self.summary.rejected.entry(reason).or_insert(Rejections { lines: 0, first_line: number });
        rejections.lines += 1;
        rejections.first_line = rejections.first_line.min(number);
    }

    /// Takes the oldest of the lines that were read ahead.
    fn next(&mut self) -> Vec<FusedLine> {
        let mut output = Vec::new();
        let Some((number, mut line)) = self.ahead.pop_front() else { return output };
        let is_plausible = self.clock.is_plausible(line.at, self.ahead.iter().map(|(_, line)| line.at));
        if !is_plausible && self.config.passes.is_none() {
            self.reject(number, RejectReason::FromTheFuture);
            return output;
        }
        let before = self.clock.now();
        let is_late = is_plausible && self.clock.advance(line.at);
        let now = self.clock.now();
        if self.config.passes.is_some() {
            (line.report.captured_at_us, line.report.seq) = (now, number);
        }
        self.catch_up(before, now, &mut output);
        self.learn(&line);
        match self.cell(now).report(line.kind, &Arc::new(line.report), now) {
            Ok(fused) => {
                self.summary.late += u64::from(is_late);
                self.heard[line.kind as usize] = true;
                self.pending = fused.is_none();
                self.emit(fused, &mut output);
            }
            Err(reason) => self.reject(number, reason),
        }
        output
    }

    fn cell(&mut self, now: Timestamp) -> &mut Aggregator {
        let ReplayConfig { aggregator, fusion, landmarks, .. } = &self.config;
        self.cell.get_or_insert_with(|| Aggregator::new(aggregator.clone(), 1, fusion.clone(), landmarks.clone(), now))
    }

    /// Closes the rounds that were due before `now`; of a silence since `before`, only those at its beginning. A round
    /// that nobody has reported to waits for a line that comes up to half a period late, and all lines of one time go
    /// into one round: recordings with the period of the rounds would be cut anywhere.
    fn catch_up(&mut self, before: Timestamp, now: Timestamp, output: &mut Vec<FusedLine>) {
        let period = Duration::from_secs_f64(self.config.fusion.round.period_s);
        let silent_from = before + SILENCE.max(3 * period);
        while let Some(deadline) = self.cell.as_ref().map(Aggregator::deadline) {
            let patience = if self.pending { Duration::ZERO } else { period / 2 };
            let due = deadline.max(before);
            if due + patience >= now || deadline > silent_from {
                break;
            }
            self.tick(due, output);
        }
    }

    fn tick(&mut self, now: Timestamp, output: &mut Vec<FusedLine>) {
        let fused = self.cell.as_mut().and_then(|cell| cell.tick(now));
        self.pending = false;
        self.emit(fused, output);
    }

    /// What nobody has reported to yet says nothing; with passes, only the last one speaks.
    fn emit(&mut self, fused: Option<Fused>, output: &mut Vec<FusedLine>) {
        let Some(Fused { map, verdicts, .. }) = fused.filter(|_| self.config.passes.is_none()) else { return };
        let known = output.len();
        output.extend(map.filter(|_| self.heard[ReportKind::Detections as usize]).map(FusedLine::Map));
        output.extend(verdicts.filter(|_| self.heard[ReportKind::VoteDetections as usize]).map(FusedLine::Verdicts));
        self.summary.written += (output.len() - known) as u64;
    }

    /// In an open cell, a location stands where the first object that names it was seen. VOTE needs no place and takes
    /// locations by itself.
    fn learn(&mut self, line: &Line) {
        if !self.config.landmarks.is_empty() || line.kind != ReportKind::Detections {
            return;
        }
        let mut fresh = Vec::new();
        for object in &line.report.objects {
            let Some(id) = &object.landmark else { continue };
            if self.learnt.len() < MAX_LEARNT && self.learnt.insert(id.clone()) {
                let position = nalgebra::Point2::new(object.x_m, object.y_m);
                fresh.push(Landmark {
                    id: id.clone(),
                    position,
                    facing_rad: None,
                    vacancy: None,
                    synonyms: Vec::new(),
                });
            }
        }
        if !fresh.is_empty() {
            self.cell(self.clock.now()).add_landmarks(fresh);
        }
    }
}

/// The report that a line carries and what it is for, for programs that read a recording without replaying it.
///
/// # Errors
/// The reason for which a replay rejects the line by itself.
pub fn read_report(text: &[u8], limits: &Limits) -> Result<(ReportKind, ObjectReport), RejectReason> {
    Line::read(text, limits).map(|line| (line.kind, line.report))
}
