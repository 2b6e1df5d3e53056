//! The aggregator of a cell, without its sockets and clocks: reports go in, maps and verdicts come out.
//!
//! Call [`Aggregator::report`] with every decoded report and [`Aggregator::tick`] at the latest at
//! [`Aggregator::deadline`]; either may close a round and return what it made. The live node and the replay of a log
//! run this same machine.
//!
//! A round is closed for PACE and VOTE together: map and verdicts of a round have the same epoch, number and time.
//! Where both run, verdicts come from the first vote on. In VOTE's `paper` mode verdicts come with the rounds in which
//! a packet of frames is complete, and only with them.
//!
//! A standby runs the machine without leading: it takes reports and closes rounds, but nothing comes out. From
//! [`Aggregator::lead`] on its rounds count, with all the evidence it has gathered.

mod command;
mod config;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::sync::Arc;

pub use command::Command;
pub use config::{Algorithms, FusionConfig};

use crate::epoch::Epoch;
use crate::landmark::{Landmark, LandmarkIndex};
use crate::names::NodeName;
use crate::pace::Pace;
use crate::reputation::{Evidence, ReputationLedger};
use crate::round::{FirstRound, RoundTrigger};
use crate::time::Timestamp;
use crate::tracking::{Tracker, TracksLosses, TracksMode, TracksRound};
use crate::vote::{Vote, VoteMode};
use crate::window::{Admitted, ReportWindow};
use crate::wire::{GlobalMap, ObjectReport, RejectReason, ReportKind, Reputation, SCHEMA_VERSION, Verdict, Verdicts};

/// What a round came to.
#[derive(Debug, Clone, PartialEq)]
pub struct Fused {
    /// The leadership in which it was closed.
    pub epoch: Epoch,
    /// Its number.
    pub round: u64,
    /// What PACE made of it, if the cell runs PACE.
    pub map: Option<GlobalMap>,
    /// What VOTE made of it, if the cell runs VOTE; in `paper` mode only when a packet of frames is complete.
    pub verdicts: Option<Verdicts>,
    /// Votes, and words about tracked objects, of which it has been settled whether they were right.
    pub evidence: Vec<Evidence>,
    /// In VOTE's `paper` mode, with the verdicts, how far each vehicle is trusted: no function of the evidence there.
    pub reputations: Option<BTreeMap<NodeName, Reputation>>,
}

/// Admits reports, fuses them and numbers the rounds.
#[derive(Debug, Clone)]
pub struct Aggregator {
    leads: Option<Epoch>,
    next_round: u64,
    windows: [ReportWindow; ReportKind::COUNT],
    rounds: RoundTrigger,
    pace: Option<Pace>,
    tracks: Option<Tracker>,
    /// Whether tracking ends with the first known location.
    tracks_open_cell: bool,
    /// Reports of which only tracking made use, because later ones of their vehicles came before.
    overtaken: u64,
    vote: Option<Vote>,
    by_packets: bool,
    /// Whether anyone has voted: a cell that runs both algorithms spares its network verdicts about nothing until then.
    voted: bool,
}

impl Aggregator {
    /// An aggregator without evidence that does not lead; `config` is taken as valid.
    pub fn standby(config: FusionConfig, landmarks: Vec<Landmark>, now: Timestamp) -> Self {
        let is_tracking = config.tracks_objects(!landmarks.is_empty());
        let FusionConfig { algorithms, window, round, pace, tracks, vote, reputation } = config;
        let by_packets = vote.mode == VoteMode::Paper;
        let vote = algorithms.vote().then(|| Vote::new(vote, landmarks.clone()));
        let tracks_open_cell = tracks.mode == TracksMode::Auto;
        let tracks = is_tracking.then(|| Tracker::new(tracks, reputation));
        let gate_m = pace.gate_m;
        let pace = algorithms.pace().then(|| Pace::new(pace, Arc::new(LandmarkIndex::new(landmarks, gate_m))));
        Self {
            leads: None,
            next_round: 1,
            windows: [ReportWindow::new(window.clone()), ReportWindow::new(window)],
            rounds: RoundTrigger::new(round, now),
            pace,
            tracks,
            tracks_open_cell,
            overtaken: 0,
            vote,
            by_packets,
            voted: false,
        }
    }

    /// An aggregator without evidence that leads as `name` in term `epoch`; `config` is taken as valid.
    pub fn new(name: NodeName, epoch: u64, config: FusionConfig, landmarks: Vec<Landmark>, now: Timestamp) -> Self {
        let mut aggregator = Self::standby(config, landmarks, now);
        aggregator.lead(Epoch::new(epoch, name), 1, FirstRound::OnTime, now);
        aggregator
    }

    /// Leads from `now` on: the next round is number `first_round` of `epoch` and due as `first` says. Evidence comes of
    /// what vehicles say from then on: what they said before may have counted in another's lane, on the other side of a
    /// split perhaps, and is never counted twice.
    pub fn lead(&mut self, epoch: Epoch, first_round: u64, first: FirstRound, now: Timestamp) {
        if self.leads.replace(epoch).is_none() {
            self.vote.iter_mut().for_each(|vote| vote.begin_record(now));
            self.tracks.iter_mut().for_each(|tracks| tracks.begin_record(now));
        }
        // Rounds that were closed meanwhile count.
        let least = if first == FirstRound::InStep { self.next_round } else { 0 };
        self.next_round = first_round.max(least);
        self.rounds.start(first, now);
    }

    /// Lets the present round last its whole length: whoever takes the lead over has that long to say so.
    pub fn hold(&mut self) {
        self.rounds.hold();
    }

    /// Goes on as a standby.
    pub fn stand_by(&mut self) {
        self.leads = None;
    }

    /// The leadership, if it leads.
    pub fn leads(&self) -> Option<&Epoch> {
        self.leads.as_ref()
    }

    /// Takes a report received at `now`; returns what came of the round if it closes with it. One that a later report
    /// of its vehicle overtook is of use to tracking only.
    ///
    /// # Errors
    /// The reason for which the report was not used; nothing is fused of it, at most the estimate of its vehicle's
    /// clock changes.
    pub fn report(
        &mut self,
        kind: ReportKind,
        report: &Arc<ObjectReport>,
        now: Timestamp,
    ) -> Result<Option<Fused>, RejectReason> {
        let window = &mut self.windows[kind as usize];
        match kind {
            ReportKind::Detections => {
                let pace = self.pace.as_mut().ok_or(RejectReason::NotFused)?;
                let admitted = window.admit(report, now)?;
                let (Admitted::InOrder(captured_at) | Admitted::OutOfOrder(captured_at)) = admitted;
                let tracks = self.tracks.as_mut();
                let is_tracked = tracks.is_some_and(|tracks| {
                    tracks.observe_only(Arc::clone(report), captured_at, |object| !pace.is_at_landmark(object))
                });
                match admitted {
                    Admitted::InOrder(_) => pace.observe(report, captured_at),
                    Admitted::OutOfOrder(_) if is_tracked => {
                        self.overtaken += 1;
                        return Ok(None);
                    }
                    Admitted::OutOfOrder(_) => return Err(RejectReason::OutOfOrder),
                }
            }
            ReportKind::VoteDetections => {
                let vote = self.vote.as_mut().ok_or(RejectReason::NotFused)?;
                if let Admitted::OutOfOrder(_) = window.admit(report, now)? {
                    return Err(RejectReason::OutOfOrder);
                }
                vote.observe(report, now)?;
                self.voted = true;
            }
        }
        Ok(if self.rounds.report(kind, &report.node, now) { self.close(now) } else { None })
    }

    /// Closes the round if it is due at `now`.
    pub fn tick(&mut self, now: Timestamp) -> Option<Fused> {
        if self.rounds.tick(now) { self.close(now) } else { None }
    }

    /// When the round closes without a further report.
    pub fn deadline(&self) -> Timestamp {
        self.rounds.deadline()
    }

    /// Adds known locations for PACE; evidence stays, but tracks of `auto` end. VOTE takes locations from reports by
    /// itself where none are known.
    pub fn add_landmarks(&mut self, landmarks: Vec<Landmark>) {
        if self.tracks_open_cell && !landmarks.is_empty() {
            self.tracks = None;
        }
        if let Some(pace) = &mut self.pace {
            pace.add_landmarks(landmarks);
        }
    }

    /// Goes over VOTE's stored votes `passes` times and says what came of it, in a round of its own; see
    /// [`Vote::refine`]. `None` without VOTE or leadership.
    pub fn refine(&mut self, passes: u32, now: Timestamp) -> Option<Verdicts> {
        let epoch = self.leads.clone()?;
        let verdicts = self.vote.as_mut()?.refine(passes);
        Some(self.in_a_round_of_its_own(epoch, verdicts, now))
    }

    /// Judges the packet that was begun in VOTE's `paper` mode, in a round of its own, as no frame will complete it;
    /// for the end of a recording. `None` if no packet was begun, or without leadership.
    pub fn end_packet(&mut self, now: Timestamp) -> Option<Verdicts> {
        let epoch = self.leads.clone()?;
        let by_packets = self.by_packets;
        let vote = self.vote.as_mut().filter(|vote| by_packets && vote.is_packet_begun())?;
        let verdicts = vote.close(now).verdicts;
        Some(self.in_a_round_of_its_own(epoch, verdicts, now))
    }

    fn in_a_round_of_its_own(&mut self, epoch: Epoch, verdicts: Vec<Verdict>, now: Timestamp) -> Verdicts {
        let round = self.next_round;
        self.next_round = round.saturating_add(1);
        Verdicts {
            schema: SCHEMA_VERSION,
            aggregator: epoch.leader,
            epoch: epoch.term,
            round,
            fused_at_us: now,
            verdicts,
        }
    }

    /// How far VOTE trusts each vehicle by what it has seen itself.
    pub fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        self.vote.as_ref().map(Vote::reputations).unwrap_or_default()
    }

    /// Starts from what a ledger knows, after a restart or a change of aggregator.
    pub fn adopt(&mut self, ledger: &ReputationLedger) {
        if let Some(vote) = &mut self.vote {
            vote.adopt(ledger);
        }
        if let Some(tracks) = &mut self.tracks {
            tracks.adopt(ledger);
        }
    }

    /// Goes on with the identities of the objects in another aggregator's map, received at `now`.
    pub fn adopt_map(&mut self, map: &GlobalMap, now: Timestamp) {
        if let Some(tracks) = &mut self.tracks {
            tracks.adopt_map(map, now);
        }
    }

    /// What tracking could not use so far.
    pub fn tracks_losses(&self) -> TracksLosses {
        self.tracks.as_ref().map(Tracker::losses).unwrap_or_default()
    }

    /// Reports so far that tracking used and PACE did not: later ones of their vehicles came before.
    pub fn overtaken(&self) -> u64 {
        self.overtaken
    }

    /// Goes on, in VOTE's `paper` mode, from reputations that were published.
    pub fn resume(&mut self, reputations: &BTreeMap<NodeName, Reputation>) {
        if let Some(vote) = &mut self.vote {
            vote.resume(reputations);
        }
    }

    /// Objects that voted for nothing so far; see [`crate::vote`].
    pub fn ignored_votes(&self) -> u64 {
        self.vote.as_ref().map_or(0, Vote::ignored)
    }

    fn close(&mut self, now: Timestamp) -> Option<Fused> {
        let pace = self.pace.as_mut().map(|pace| pace.close(now));
        let tracks = self.tracks.as_mut().map(|tracks| tracks.close(now)).unwrap_or_default();
        let by_packets = self.by_packets;
        let wanted = self.voted || pace.is_none();
        let is_due = |vote: &&mut Vote| if by_packets { vote.is_packet_complete() } else { wanted };
        let vote = self.vote.as_mut().filter(is_due).map(|vote| vote.close(now));
        if let (Some(tracks), Some(vote)) = (&mut self.tracks, &vote) {
            tracks.learn(&vote.evidence);
        }
        let epoch = self.leads.clone()?;
        if pace.is_none() && vote.is_none() {
            return None;
        }
        let round = self.next_round;
        self.next_round = round.saturating_add(1);
        let TracksRound { objects, pose_corrections, oldest_capture, evidence: seen } = tracks;
        let (verdicts, mut evidence) = vote.map_or((None, Vec::new()), |vote| (Some(vote.verdicts), vote.evidence));
        evidence.extend(seen);
        let map = pace.map(|pace| GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: epoch.leader.clone(),
            epoch: epoch.term,
            round,
            fused_at_us: now,
            oldest_capture_us: [pace.oldest_capture, oldest_capture].into_iter().flatten().min(),
            landmarks: pace.landmarks,
            objects,
            pose_corrections,
        });
        let verdicts = verdicts.map(|verdicts: Vec<Verdict>| Verdicts {
            schema: SCHEMA_VERSION,
            aggregator: epoch.leader.clone(),
            epoch: epoch.term,
            round,
            fused_at_us: now,
            verdicts,
        });
        let reputations = verdicts.as_ref().filter(|_| by_packets).map(|_| self.reputations());
        Some(Fused { epoch, round, map, verdicts, evidence, reputations })
    }
}
