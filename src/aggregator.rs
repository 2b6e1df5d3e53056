//! The aggregator of a cell, without sockets and clocks: reports go in, maps and verdicts come out.
//!
//! Call [`Aggregator::report`] with every decoded report and [`Aggregator::tick`] at the latest at
//! [`Aggregator::deadline`]. Either may close a round and return it. A live node and the replay of
//! a log run this same machine.
//!
//! A round closes for PACE and VOTE together: its map and verdicts have the same epoch, number and
//! time. Where both run, the first vote starts verdicts. In VOTE's `paper` mode only rounds that
//! complete a packet of frames have verdicts.
//!
//! A standby processes reports and closes rounds without returning them. After [`Aggregator::lead`]
//! it returns its rounds, which use all evidence that it has gathered.

pub mod round;

mod answer;
mod command;
mod config;
mod expelled;
mod map_share;
mod neighbouring;
mod orientation;
mod report_doubt;
#[cfg(test)]
mod tests;
mod verdict_share;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

pub use command::Command;
pub use config::{Algorithms, FusionConfig};
pub use orientation::{MisreadObserver, Misreading, MistakenHeading};
pub use report_doubt::ReportDoubt;

use expelled::Expelled;
use map_share::limit_shares;
use nalgebra::Point2;
use neighbouring::NeighbourView;
use orientation::OrientationCheck;
use report_doubt::{MAX_AWAY_M, MIN_MISPLACED};
use verdict_share::VerdictShare;

use crate::admission::report_window::{Admitted, ReportWindow};
use crate::admission::timeliness::Timeliness;
use crate::aggregator::round::{FirstRound, RoundTrigger};
use crate::model::epoch::Epoch;
use crate::model::names::{LandmarkId, NodeName};
use crate::model::time::Timestamp;
use crate::pace::{Pace, PaceRound};
use crate::perception::landmark::{Landmark, LandmarkIndex};
use crate::reputation::{Evidence, ReputationLedger};
use crate::tracking::{HandOvers, Tracker, TracksLosses, TracksMode, TracksRound};
use crate::vote::{Vote, VoteMode};
use crate::wire::{
    FusedObject, GlobalMap, InvalidEntry, LandmarkState, NeighbourObject, ObjectReport, Payload,
    PerceivedObject, RejectReason, ReportKind, Reputation, Verdict, Verdicts,
};

/// Result of a closed round: the payloads that the leader publishes, and the evidence for its
/// ledger.
#[derive(Debug, Clone, PartialEq)]
pub struct Fused {
    /// The leadership that closed it.
    pub epoch: Epoch,
    /// Number of the round. A new leader continues the numbers of the leader before it.
    pub round: u64,
    /// The map, if the cell runs PACE.
    pub map: Option<GlobalMap>,
    /// The verdicts, if the cell runs VOTE; in `paper` mode only when a packet of frames is
    /// complete.
    pub verdicts: Option<Verdicts>,
    /// Votes and statements about tracked objects that have turned out to be right or wrong.
    pub evidence: Vec<Evidence>,
    /// The reputations, together with the verdicts of VOTE's `paper` mode, where they do not follow
    /// from the evidence.
    pub reputations: Option<BTreeMap<NodeName, Reputation>>,
    /// Entries that were left out of map and verdicts: entries that receivers would refuse, such as
    /// an object that prediction moves beyond the bounds of the wire format, and entries beyond the
    /// share of one vehicle.
    pub left_out: Vec<InvalidEntry>,
}

/// Counts of the detection reports that were used in a cell with landmarks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Placements {
    /// With an object at a location or, where objects are tracked, near one.
    pub placed: u64,
    /// Reports with objects that are all away from the landmarks.
    pub misplaced: u64,
}

/// Admits reports, fuses them and numbers the rounds.
#[derive(Debug, Clone)]
pub struct Aggregator {
    leads: Option<Epoch>,
    next_round: u64,
    /// The cell's time minus the time of the caller in microseconds.
    cell_offset_us: i64,
    windows: [ReportWindow; ReportKind::COUNT],
    rounds: RoundTrigger,
    pace: Option<Pace>,
    tracks: Option<Tracker>,
    /// True if tracking ends when the first landmark is added.
    tracks_open_cell: bool,
    /// Number of reports that only tracking used, because a later report of their vehicle arrived
    /// first.
    overtaken: u64,
    placements: Placements,
    orientation: OrientationCheck,
    expelled: Expelled,
    neighbours: NeighbourView,
    vote: Option<Vote>,
    verdict_share: VerdictShare,
    by_packets: bool,
    /// True if any vehicle has voted: until then a cell that runs both algorithms sends no empty
    /// verdicts.
    voted: bool,
}

impl Aggregator {
    /// An aggregator without evidence that does not lead; `config` is taken as valid.
    pub fn new_standby(config: FusionConfig, landmarks: Vec<Landmark>, now: Timestamp) -> Self {
        let is_tracking = config.tracks_objects(!landmarks.is_empty());
        let FusionConfig {
            algorithms,
            window,
            round,
            pace,
            tracks,
            vote,
            reputation,
        } = config;
        let by_packets = vote.mode == VoteMode::Paper;
        let vote = algorithms
            .vote()
            .then(|| Vote::new(vote, landmarks.clone()));
        let tracks_open_cell = tracks.mode == TracksMode::Auto;
        let tracks = is_tracking.then(|| Tracker::new(tracks, reputation));
        let gate_m = pace.gate_m;
        let pace = algorithms
            .pace()
            .then(|| Pace::new(pace, Arc::new(LandmarkIndex::new(landmarks, gate_m))));
        Self {
            leads: None,
            next_round: 1,
            cell_offset_us: 0,
            windows: [ReportWindow::new(window.clone()), ReportWindow::new(window)],
            rounds: RoundTrigger::new(round, now),
            pace,
            tracks,
            tracks_open_cell,
            overtaken: 0,
            placements: Placements::default(),
            orientation: OrientationCheck::default(),
            expelled: Expelled::default(),
            neighbours: NeighbourView::default(),
            vote,
            verdict_share: VerdictShare::default(),
            by_packets,
            voted: false,
        }
    }

    /// An aggregator without evidence that leads as `name` in term `epoch`; `config` is taken as
    /// valid.
    pub fn new(
        name: NodeName,
        epoch: u64,
        config: FusionConfig,
        landmarks: Vec<Landmark>,
        now: Timestamp,
    ) -> Self {
        let mut aggregator = Self::new_standby(config, landmarks, now);
        aggregator.lead(Epoch::new(epoch, name), 1, FirstRound::OnTime, now);
        aggregator
    }

    /// Applies new settings, which must be valid. Reports, votes, tracks and trust are kept as far
    /// as they still apply; landmarks are matched by their ids. An algorithm or mode that was not
    /// used before starts empty.
    pub fn configure(&mut self, config: FusionConfig, landmarks: Vec<Landmark>) {
        let is_tracking = config.tracks_objects(!landmarks.is_empty());
        let FusionConfig {
            algorithms,
            window,
            round,
            pace,
            tracks,
            vote,
            reputation,
        } = config;
        self.windows
            .iter_mut()
            .for_each(|known| known.configure(window.clone()));
        self.rounds.configure(round);
        self.by_packets = vote.mode == VoteMode::Paper;
        self.vote = algorithms.vote().then(|| match self.vote.take() {
            Some(known) => known.configured(vote, landmarks.clone()),
            None => Vote::new(vote, landmarks.clone()),
        });
        self.tracks_open_cell = tracks.mode == TracksMode::Auto;
        self.tracks = is_tracking.then(|| match self.tracks.take() {
            Some(known) => known.configured(tracks, reputation),
            None => Tracker::new(tracks, reputation),
        });
        let landmarks = Arc::new(LandmarkIndex::new(landmarks, pace.gate_m));
        self.pace = algorithms.pace().then(|| match self.pace.take() {
            Some(known) => known.configured(pace, landmarks),
            None => Pace::new(pace, landmarks),
        });
    }

    /// Starts leading at `now`: the next round has number `first_round` of `epoch`, and `first`
    /// defines when it is due. Only later reports yield evidence, because earlier reports may have
    /// counted in another lane and every vote must count once.
    pub fn lead(&mut self, epoch: Epoch, first_round: u64, first: FirstRound, now: Timestamp) {
        if self.leads.replace(epoch).is_none() {
            self.vote.iter_mut().for_each(|vote| vote.begin_record(now));
            self.tracks
                .iter_mut()
                .for_each(|tracks| tracks.begin_record(now));
        }
        // Rounds that were closed in the meantime count.
        let min_round = if first == FirstRound::InStep {
            self.next_round
        } else {
            0
        };
        self.next_round = first_round.max(min_round);
        self.rounds.start(first, now);
    }

    /// Lets the current round last its full length, to give another node time to take over.
    pub fn hold(&mut self) {
        self.rounds.hold();
    }

    /// Stops leading and continues as a standby.
    pub fn step_down(&mut self) {
        self.leads = None;
    }

    /// The leadership, if it leads.
    pub fn leads(&self) -> Option<&Epoch> {
        self.leads.as_ref()
    }

    /// Processes a report received at `now`; returns the round if the report closes it. A report
    /// that was overtaken by a later report of its vehicle is used by tracking only.
    ///
    /// # Errors
    /// Returns the reason why the report was not used. In this case only the estimate of its
    /// vehicle's clock may have changed.
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
                if !pace.landmarks().landmarks().is_empty() && !report.objects.is_empty() {
                    let is_tracking = self.tracks.is_some();
                    let is_near = |object: &PerceivedObject| {
                        pace.landmarks()
                            .is_around(&Point2::new(object.x_m, object.y_m), MAX_AWAY_M)
                    };
                    let is_placed = report.objects.iter().any(|object| {
                        pace.is_at_landmark(object) || is_tracking && is_near(object)
                    });
                    window.record_place(&report.node, is_placed, now);
                    let Placements { placed, misplaced } = &mut self.placements;
                    *if is_placed { placed } else { misplaced } += 1;
                }
                let (Admitted::InOrder(captured_at) | Admitted::OutOfOrder(captured_at)) = admitted;
                if let Admitted::InOrder(_) = admitted {
                    self.orientation.observe(report, captured_at);
                }
                let report = &of_vehicle(report);
                let tracks = self.tracks.as_mut();
                let is_tracked = tracks.is_some_and(|tracks| {
                    tracks.observe_only(Arc::clone(report), captured_at, |object| {
                        !pace.is_at_landmark(object)
                    })
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
                let Admitted::InOrder(captured_at) = window.admit(report, now)? else {
                    return Err(RejectReason::OutOfOrder);
                };
                if self.pace.is_none() {
                    self.orientation.observe(report, captured_at);
                }
                vote.observe_part(&of_vehicle(report), &report.node, now)?;
                self.voted = true;
            }
        }
        self.expelled.record_report(&report.node.vehicle(), now);
        Ok(if self.rounds.report(kind, &report.node, now) {
            self.close(now)
        } else {
            None
        })
    }

    /// Closes the round if it is due at `now`.
    pub fn tick(&mut self, now: Timestamp) -> Option<Fused> {
        if self.rounds.tick(now) {
            self.close(now)
        } else {
            None
        }
    }

    /// Closes the round, whether or not it is due.
    pub fn close_early(&mut self, now: Timestamp) -> Option<Fused> {
        self.rounds.close(now);
        self.close(now)
    }

    /// When the round closes without a further report.
    pub fn deadline(&self) -> Timestamp {
        self.rounds.deadline()
    }

    /// Time for which reports of a vehicle or part have been rejected because of their time only.
    pub fn untimely_for(&self, kind: ReportKind, name: &NodeName, now: Timestamp) -> Duration {
        self.windows[kind as usize].untimely_for(name, now)
    }

    /// Doubts about a report that was used, the range of its objects before their place.
    pub fn doubts(
        &self,
        kind: ReportKind,
        report: &ObjectReport,
        now: Timestamp,
    ) -> impl Iterator<Item = ReportDoubt> {
        let sender = self.windows[kind as usize].sender(&report.node, now);
        let is_nowhere = sender.misplaced >= MIN_MISPLACED;
        let place = ReportDoubt::of_ranges(report)
            .or(is_nowhere.then_some(ReportDoubt::NoObjectAtLocation))
            .or(sender.has_moved.then_some(ReportDoubt::Moves));
        let is_compared = kind == ReportKind::Detections || self.pace.is_none();
        let misread = is_compared
            .then(|| self.orientation.misreading(&report.node, now))
            .flatten();
        place
            .into_iter()
            .chain(misread.cloned().map(ReportDoubt::Misread))
            .chain(sender.is_shared.then_some(ReportDoubt::SharedName))
    }

    /// Numbers of reports of detections so far by the places of their objects.
    pub fn placements(&self) -> Placements {
        self.placements
    }

    /// True if there is a landmark with this id; `None` if there are no landmarks at all.
    pub fn has_location(&self, id: &LandmarkId) -> Option<bool> {
        let Some(pace) = &self.pace else {
            return self.vote.as_ref()?.has_location(id);
        };
        let landmarks = pace.landmarks();
        (!landmarks.landmarks().is_empty()).then(|| landmarks.position_of(id).is_some())
    }

    /// Adds landmarks for PACE. Evidence is kept, but tracking in mode `auto` ends. In a cell
    /// without landmarks, VOTE takes the locations from the reports.
    pub fn add_landmarks(&mut self, landmarks: Vec<Landmark>) {
        if self.tracks_open_cell && !landmarks.is_empty() {
            self.tracks = None;
        }
        if let Some(pace) = &mut self.pace {
            pace.add_landmarks(landmarks);
        }
    }

    /// Re-evaluates VOTE's stored votes `passes` times and returns the verdicts as a separate
    /// round; see [`Vote::refine`]. `None` without VOTE or leadership.
    pub fn refine(&mut self, passes: u32, now: Timestamp) -> Option<Verdicts> {
        let epoch = self.leads.clone()?;
        let verdicts = self.vote.as_mut()?.refine(passes).collect();
        Some(self.number_verdicts(&epoch, verdicts, now))
    }

    /// The remaining verdicts as a separate round, at the end of a recording: verdicts that wait for
    /// their vehicle's share, and verdicts of the incomplete packet of VOTE's `paper` mode. `None`
    /// without such verdicts or without leadership.
    pub fn end_recording(&mut self, now: Timestamp) -> Option<Verdicts> {
        let epoch = self.leads.clone()?;
        let vote = self.vote.as_mut()?;
        let is_packet_begun = self.by_packets && vote.is_packet_begun();
        if !is_packet_begun && self.verdict_share.is_empty() {
            return None;
        }
        let verdicts = if is_packet_begun {
            vote.close(now).verdicts
        } else {
            Vec::new()
        };
        let verdicts = self.verdict_share.drain(verdicts, vote);
        Some(self.number_verdicts(&epoch, verdicts, now))
    }

    /// Verdicts outside a closed round, under the next number.
    fn number_verdicts(
        &mut self,
        epoch: &Epoch,
        verdicts: Vec<Verdict>,
        now: Timestamp,
    ) -> Verdicts {
        let round = self.take_round_number();
        Verdicts::new(epoch, round, self.in_cell_time(now), verdicts)
    }

    /// The number of the next round; each number is used once.
    fn take_round_number(&mut self) -> u64 {
        let round = self.next_round;
        self.next_round = round.saturating_add(1);
        round
    }

    /// The share of the recently active vehicles whose reports are usable by their time. A vehicle
    /// that sends reports of both kinds counts once.
    pub fn timeliness(&self, now: Timestamp) -> Timeliness {
        let [detections, votes] = self.windows.each_ref().map(|window| window.timeliness(now));
        Timeliness {
            timely: detections.timely.max(votes.timely),
            untimely: detections.untimely.max(votes.untimely),
        }
    }

    /// VOTE's reputation of each vehicle, from the evidence of this aggregator.
    pub fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        self.vote
            .as_ref()
            .map(Vote::reputations)
            .unwrap_or_default()
    }

    /// Starts from the evidence of a ledger, after a restart or a change of aggregator.
    pub fn adopt(&mut self, ledger: &ReputationLedger) {
        if let Some(vote) = &mut self.vote {
            vote.adopt(ledger);
        }
        if let Some(tracks) = &mut self.tracks {
            tracks.adopt(ledger);
        }
    }

    /// Takes over the identities of the objects in another aggregator's map, received at `now`.
    pub fn adopt_map(&mut self, map: &GlobalMap, now: Timestamp) {
        if let Some(tracks) = &mut self.tracks {
            let mut map = map.clone();
            date_objects(&mut map.objects, self.cell_offset_us.saturating_neg());
            tracks.adopt_map(&map, now);
        }
    }

    /// Sets all objects of other cells near this cell, with the ages that they had at `stated_at`.
    /// Their times are by the clock of `now`. They are included in the next maps until they are too
    /// old, and their identities are given to objects that tracking finds at the same place.
    pub fn on_neighbours(&mut self, objects: &Arc<[NeighbourObject]>, stated_at: Timestamp) {
        if let Some(tracks) = &mut self.tracks {
            tracks.on_neighbours(objects, stated_at);
        }
        self.neighbours = NeighbourView::new(Arc::clone(objects), stated_at);
    }

    /// Removes what a vehicle alone has reported so far, and its votes, because its certificate was
    /// revoked or has expired.
    pub fn expel(&mut self, vehicle: NodeName, now: Timestamp) {
        if let Some(vote) = &mut self.vote {
            vote.expel(&vehicle);
        }
        self.expelled.add(vehicle, now);
    }

    /// Sets the cell's time minus the time given as `now`, in microseconds; initially 0. Reports
    /// and rounds are dated in the cell's time, which may jump; everything else uses `now`, which
    /// does not.
    pub fn set_cell_offset(&mut self, offset_us: i64) {
        self.cell_offset_us = offset_us;
        self.windows
            .iter_mut()
            .for_each(|window| window.set_cell_offset(offset_us));
    }

    /// Numbers of reports and objects so far that tracking could not use.
    pub fn tracks_losses(&self) -> TracksLosses {
        self.tracks
            .as_ref()
            .map(Tracker::losses)
            .unwrap_or_default()
    }

    /// Numbers of identities so far that tracking took over from neighbouring cells.
    pub fn hand_overs(&self) -> HandOvers {
        self.tracks
            .as_ref()
            .map(Tracker::hand_overs)
            .unwrap_or_default()
    }

    /// Number of reports so far that only tracking used, because a later report of their vehicle
    /// arrived first.
    pub fn overtaken(&self) -> u64 {
        self.overtaken
    }

    /// Continues, in VOTE's `paper` mode, from published reputations.
    pub fn resume(&mut self, reputations: &BTreeMap<NodeName, Reputation>) {
        if let Some(vote) = &mut self.vote {
            vote.resume(reputations);
        }
    }

    /// Number of objects so far that did not vote; see [`crate::vote`].
    pub fn ignored_votes(&self) -> u64 {
        self.vote.as_ref().map_or(0, Vote::ignored)
    }

    fn in_cell_time(&self, at: Timestamp) -> Timestamp {
        at.shifted(self.cell_offset_us)
    }

    /// The state of each place, as PACE and VOTE agree on it. Their `paper` modes stay as
    /// published.
    fn agree(
        &self,
        places: Vec<LandmarkState>,
        verdicts: Option<&[Verdict]>,
        now: Timestamp,
    ) -> Vec<LandmarkState> {
        let (Some(vote), Some(pace @ Pace::Bayes(_)), Some(verdicts), false) =
            (&self.vote, &self.pace, verdicts, self.by_packets)
        else {
            return places;
        };
        let known: BTreeMap<_, _> = verdicts
            .iter()
            .map(|verdict| (&verdict.landmark, verdict))
            .collect();
        let landmarks = pace.landmarks().landmarks();
        let sign = |place: usize| Some(&landmarks.get(place)?.vacancy.as_ref()?.label);
        let agreed = places.into_iter().enumerate().map(|(place, state)| {
            let verdict = known.get(&state.id).copied();
            let readings = vote.readings(&state.id, now);
            answer::agree(state, verdict, readings, sign(place))
        });
        agreed.collect()
    }

    /// Closes a round at `now`, in this order: PACE, tracking, VOTE, whose evidence also counts for
    /// tracking. The landmarks of PACE and the verdicts of VOTE are agreed, expelled vehicles and
    /// excess objects are removed, and entries that receivers would refuse are moved to `left_out`.
    ///
    /// Returns `None` on a standby, whose algorithms are kept warm by the same steps, and for a
    /// round without map and verdicts.
    ///
    /// # Example
    /// The leader of a cell with both algorithms closes round 89, with VOTE in mode `weighted`.
    /// Only PACE has had reports so far: the map is published without verdicts. The first report
    /// for VOTE arrives: from round 90 on, each round has a map and verdicts of the same number.
    fn close(&mut self, now: Timestamp) -> Option<Fused> {
        let pace = self.pace.as_mut().map(|pace| pace.close(now));
        let tracks = self
            .tracks
            .as_mut()
            .map(|tracks| tracks.close(now))
            .unwrap_or_default();
        let by_packets = self.by_packets;
        let wanted = self.voted || pace.is_none();
        let is_due = |vote: &&mut Vote| {
            if by_packets {
                vote.is_packet_complete()
            } else {
                wanted
            }
        };
        let verdict_share = &mut self.verdict_share;
        let vote = self.vote.as_mut().filter(is_due).map(|vote| {
            let mut round = vote.close(now);
            if vote.is_open() {
                round.verdicts = verdict_share.limit(round.verdicts, vote);
            } else {
                *verdict_share = VerdictShare::default();
            }
            round
        });
        if let (Some(tracks), Some(vote)) = (&mut self.tracks, &vote) {
            tracks.learn(&vote.evidence);
        }
        let epoch = self.leads.clone()?;
        if pace.is_none() && vote.is_none() {
            return None;
        }
        let round = self.take_round_number();
        let fused_at = self.in_cell_time(now);
        let TracksRound {
            mut objects,
            pose_corrections,
            oldest_capture,
            evidence: seen,
        } = tracks;
        self.expelled.remove_objects(&mut objects, now);
        let mut left_out = limit_shares(&mut objects);
        date_objects(&mut objects, self.cell_offset_us);
        let (verdicts, mut evidence) = vote.map_or((None, Vec::new()), |vote| {
            (Some(vote.verdicts), vote.evidence)
        });
        evidence.extend(seen);
        let oldest = [
            pace.as_ref().and_then(|pace| pace.oldest_capture),
            oldest_capture,
        ]
        .into_iter()
        .flatten()
        .min();
        let pace =
            pace.map(|PaceRound { landmarks, .. }| self.agree(landmarks, verdicts.as_deref(), now));
        let mut map = pace.map(|landmarks| GlobalMap {
            oldest_capture_us: oldest.map(|oldest| self.in_cell_time(oldest)),
            landmarks,
            neighbour_objects: self.neighbours.shown(
                &objects,
                self.tracks.as_ref(),
                now,
                self.cell_offset_us,
            ),
            objects,
            pose_corrections,
            ..GlobalMap::new(&epoch, round, fused_at)
        });
        let mut verdicts =
            verdicts.map(|verdicts| Verdicts::new(&epoch, round, fused_at, verdicts));
        // Every published entry must pass the receivers' check.
        left_out.extend(
            map.as_mut()
                .map(Payload::remove_invalid)
                .unwrap_or_default(),
        );
        left_out.extend(
            verdicts
                .as_mut()
                .map(Payload::remove_invalid)
                .unwrap_or_default(),
        );
        let reputations = verdicts
            .as_ref()
            .filter(|_| by_packets)
            .map(|_| self.reputations());
        Some(Fused {
            epoch,
            round,
            map,
            verdicts,
            evidence,
            reputations,
            left_out,
        })
    }
}

/// The report under the name of its vehicle, so that the parts of a vehicle are one witness with
/// one reputation.
fn of_vehicle(report: &Arc<ObjectReport>) -> Arc<ObjectReport> {
    let vehicle = report.node.vehicle();
    if vehicle == report.node {
        return Arc::clone(report);
    }
    Arc::new(ObjectReport {
        node: vehicle,
        ..ObjectReport::clone(report)
    })
}

/// Moves the dates of objects to another clock.
fn date_objects(objects: &mut [FusedObject], offset_us: i64) {
    for object in objects.iter_mut().filter(|_| offset_us != 0) {
        object.first_seen_us = object
            .first_seen_us
            .map(|first_seen| first_seen.shifted(offset_us));
    }
}
