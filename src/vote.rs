//! VOTE: which label is right at a known location when vehicles disagree.
//!
//! [`Vote`] is a machine without clocks. Call [`Vote::observe`] with every report and [`Vote::close`] at the end of a
//! round; [`Vote::refine`] goes over the stored votes again. Equal calls give equal results.
//!
//! What is not counted, without error: objects at unknown landmarks of a closed cell, without a landmark, of zero
//! confidence, or beyond the maximum range; they show in [`Vote::ignored`], as do votes for a label that had to make room
//! for others. A report of which neither `seq` nor capture time is newer than the last of its vehicle is rejected, unless
//! the vehicle's clock was set back. Of several objects that one report has at one landmark, the most confident votes in
//! `weighted` mode; in `paper` mode all do, as in the paper's sum.

mod ballot;
mod calibration;
mod config;
mod confusion;
mod dependence;
mod labels;
mod model;
mod paper;
mod visibility;
mod weighted;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

pub use config::{MAX_LABELS, PaperConfig, VoteConfig, VoteMode, WeightedConfig};
pub use paper::{PaperTally, REPUTATION_RANGE};
pub use visibility::{falling as falling_visibility, paper as paper_visibility};

use crate::geometry::Pose;
use crate::landmark::Landmark;
use crate::names::{Label, LandmarkId, NodeName};
use crate::reputation::{Evidence, ReputationLedger};
use crate::time::Timestamp;
use crate::wire::{Limits, ObjectReport, PerceivedObject, RejectReason, Reputation, Verdict};

use nalgebra::Point2;
use weighted::WeightedTally;

#[derive(Debug, Clone)]
enum Tally {
    Paper(PaperTally),
    Weighted(Box<WeightedTally>),
}

/// What a round came to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Round {
    /// One verdict for every landmark of a closed cell; in an open cell, for every landmark with news.
    pub verdicts: Vec<Verdict>,
    /// Votes of which it has been settled whether they were right, for the ledger.
    pub evidence: Vec<Evidence>,
}

#[derive(Debug, Clone, Copy)]
struct Heard {
    seq: u64,
    captured_at: Timestamp,
    received_at: Timestamp,
    frames: u32,
}

/// How much older than the last a report can be for having been overtaken; what is older yet is from a clock that was
/// set back. As long as [`crate::window::ReportWindow`] admits reports by default.
const MOST_OVERTAKEN: Duration = Duration::from_secs(3);
/// How long a vehicle must have been silent to be forgotten for another, unproven or proven.
const RETENTION: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(600)];
/// Part of the vehicles that is forgotten at once when room is short, so that the cost per newcomer stays small.
const FORGOTTEN_AT_ONCE: usize = 8;

impl Heard {
    /// Whether `report` was made later. A restarted node counts from the start again, but time goes on; a clock that is
    /// set right may go back, but counting goes on; if both happen, only the size of the step tells.
    fn is_before(&self, report: &ObjectReport) -> bool {
        report.captured_at_us > self.captured_at
            || report.seq > self.seq
            || self.captured_at.since(report.captured_at_us) > MOST_OVERTAKEN
    }
}

/// The voting machine of a cell.
#[derive(Debug, Clone)]
pub struct Vote {
    config: VoteConfig,
    open: bool,
    landmarks: BTreeMap<LandmarkId, Option<Landmark>>,
    arrivals: std::collections::VecDeque<LandmarkId>,
    heard: BTreeMap<NodeName, Heard>,
    tally: Tally,
    ignored: u64,
}

impl Vote {
    /// A machine for `landmarks`; without any, the cell is open and takes landmarks from the reports as they appear.
    pub fn new(config: VoteConfig, landmarks: Vec<Landmark>) -> Self {
        let mut tally = match config.mode {
            VoteMode::Paper => Tally::Paper(PaperTally::new(config.paper.clone())),
            VoteMode::Weighted => Tally::Weighted(Box::new(WeightedTally::new(config.weighted.clone()))),
        };
        for landmark in &landmarks {
            match &mut tally {
                Tally::Paper(tally) => tally.expect(landmark.id.clone()),
                Tally::Weighted(tally) => tally.expect(landmark.id.clone()),
            }
        }
        let open = landmarks.is_empty();
        let landmarks = landmarks.into_iter().map(|l| (l.id.clone(), Some(l))).collect();
        let arrivals = std::collections::VecDeque::new();
        Self { config, open, landmarks, arrivals, heard: BTreeMap::new(), tally, ignored: 0 }
    }

    /// Counts the votes of a report that was received at `received_at`.
    ///
    /// # Errors
    /// The reason why the report was not used; nothing has changed then.
    pub fn observe(&mut self, report: &ObjectReport, received_at: Timestamp) -> Result<(), RejectReason> {
        report.validate(&Limits { objects: usize::MAX, ..Limits::default() })?;
        let frames = match self.heard.get(&report.node) {
            Some(last) if last.is_before(report) => last.frames,
            Some(_) => return Err(RejectReason::OutOfOrder),
            None => {
                self.make_room(received_at)?;
                0
            }
        };
        let heard = Heard {
            seq: report.seq,
            captured_at: report.captured_at_us,
            received_at,
            frames: frames.saturating_add(1),
        };
        self.heard.insert(report.node.clone(), heard);
        let mut objects: Vec<&PerceivedObject> = report.objects.iter().collect();
        if matches!(self.tally, Tally::Weighted(_)) {
            objects = self.one_per_landmark(objects);
        }
        let pose = report.pose.map(Pose::from);
        for object in objects {
            if !self.count(report, object, pose, received_at) {
                self.ignored += 1;
            }
        }
        Ok(())
    }

    /// Forgets vehicles that have been silent if there are as many as there may be: unproven ones and those that were
    /// mostly wrong before proven ones, the longest silent first.
    fn make_room(&mut self, now: Timestamp) -> Result<(), RejectReason> {
        if self.heard.len() < self.config.max_vehicles {
            return Ok(());
        }
        let standing = |(node, last): (&NodeName, &Heard)| {
            let is_proven = matches!(&self.tally, Tally::Weighted(tally) if tally.is_proven(node));
            (is_proven, last.received_at, node.clone())
        };
        let mut silent: Vec<_> = self.heard.iter().map(standing).collect();
        silent.retain(|(is_proven, last, _)| now.since(*last) >= RETENTION[usize::from(*is_proven)]);
        silent.sort();
        silent.truncate(self.config.max_vehicles.div_ceil(FORGOTTEN_AT_ONCE));
        let nodes: BTreeSet<NodeName> = silent.into_iter().map(|(.., node)| node).collect();
        if nodes.is_empty() {
            return Err(RejectReason::TooManyVehicles);
        }
        self.heard.retain(|node, _| !nodes.contains(node));
        match &mut self.tally {
            Tally::Paper(tally) => tally.forget_vehicles(&nodes),
            Tally::Weighted(tally) => tally.forget_vehicles(&nodes),
        }
        Ok(())
    }

    /// The most confident object at each landmark, the first on a tie, by landmark.
    fn one_per_landmark<'a>(&mut self, objects: Vec<&'a PerceivedObject>) -> Vec<&'a PerceivedObject> {
        let mut best: BTreeMap<Option<&LandmarkId>, &PerceivedObject> = BTreeMap::new();
        let all = objects.len();
        for object in objects {
            let place = best.entry(object.landmark.as_ref()).or_insert(object);
            if object.confidence > place.confidence {
                *place = object;
            }
        }
        self.ignored += (all - best.len()) as u64;
        best.into_values().collect()
    }

    fn count(&mut self, report: &ObjectReport, object: &PerceivedObject, pose: Option<Pose>, at: Timestamp) -> bool {
        let Some(landmark) = object.landmark.as_ref().filter(|_| object.confidence > 0.0) else { return false };
        let known = self.landmarks.get(landmark);
        if known.is_none() && !self.open {
            return false;
        }
        let place = known.and_then(Option::as_ref);
        let position = place.map_or(Point2::new(object.x_m, object.y_m), |l| l.position);
        let synonym = place.and_then(|place| place.synonym(&object.label));
        let label = synonym.or_else(|| self.config.synonyms.get(&object.label)).unwrap_or(&object.label).clone();
        let geometry = pose.map(|p| p.range_bearing(&position));
        if geometry.is_some_and(|(distance, _)| distance > self.max_range_m()) {
            return false;
        }
        match &mut self.tally {
            Tally::Paper(tally) if !tally.has_room_for(landmark, &label, self.config.max_labels) => return false,
            Tally::Paper(_) => {}
            Tally::Weighted(tally) => self.ignored += tally.make_room_for(&label, self.config.max_labels) as u64,
        }
        if known.is_none() {
            self.open_landmark(landmark);
        }
        match &mut self.tally {
            Tally::Paper(tally) => {
                let k = geometry.map_or(1.0, |(d, a)| visibility::paper(&self.config.paper, d, a));
                tally.add(landmark, &report.node, &label, object.confidence, k);
            }
            Tally::Weighted(tally) => {
                let k = geometry.map_or(1.0, |(d, a)| visibility::falling(&self.config.weighted, d, a));
                tally.cast(landmark, &report.node, (&label, object.confidence, k), at);
            }
        }
        true
    }

    fn max_range_m(&self) -> f64 {
        match self.config.mode {
            VoteMode::Paper => self.config.paper.max_range_m,
            VoteMode::Weighted => self.config.weighted.max_range_m,
        }
    }

    fn open_landmark(&mut self, landmark: &LandmarkId) {
        if self.arrivals.len() >= self.config.max_landmarks
            && let Some(oldest) = self.arrivals.pop_front()
        {
            self.landmarks.remove(&oldest);
            match &mut self.tally {
                Tally::Paper(tally) => tally.forget(&oldest),
                Tally::Weighted(tally) => tally.forget(&oldest),
            }
        }
        self.arrivals.push_back(landmark.clone());
        self.landmarks.insert(landmark.clone(), None);
    }

    /// Whether a vehicle has sent a packet's worth of frames since the last verdict (`paper` mode).
    pub fn is_packet_complete(&self) -> bool {
        self.heard.values().any(|h| h.frames >= self.config.paper.frames_per_verdict)
    }

    /// Whether any vehicle has sent a frame since the last verdict (`paper` mode).
    pub fn is_packet_begun(&self) -> bool {
        self.heard.values().any(|h| h.frames > 0)
    }

    /// Ends the round: judges what changed.
    pub fn close(&mut self, now: Timestamp) -> Round {
        self.heard.values_mut().for_each(|h| h.frames = 0);
        let (changed, evidence) = match &mut self.tally {
            Tally::Paper(tally) => (tally.close(), Vec::new()),
            Tally::Weighted(tally) => (tally.close(now), tally.take_evidence()),
        };
        let verdicts = if self.open {
            changed.iter().filter_map(|landmark| self.verdict(landmark)).collect()
        } else {
            self.verdicts()
        };
        Round { verdicts, evidence }
    }

    /// A leadership begins: what was said before `now` is no evidence that this aggregator settles, as whoever led before
    /// does or has done so. It goes on deciding verdicts.
    pub(crate) fn begin_record(&mut self, now: Timestamp) {
        if let Tally::Weighted(tally) = &mut self.tally {
            tally.begin_record(now);
        }
    }

    fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        match &self.tally {
            Tally::Paper(tally) => tally.verdict(landmark),
            Tally::Weighted(tally) => tally.verdict(landmark),
        }
    }

    /// The verdict of every landmark as of the last round, by landmark.
    pub fn verdicts(&self) -> Vec<Verdict> {
        self.landmarks.keys().filter_map(|landmark| self.verdict(landmark)).collect()
    }

    /// Goes over the stored votes `passes` times, from equal trust, and returns the verdict of every landmark.
    ///
    /// Dawid & Skene (1979) with the priors of the online machine; it does not depend on the order of arrival. In
    /// `paper` mode there is nothing to refine.
    pub fn refine(&mut self, passes: u32) -> Vec<Verdict> {
        if let Tally::Weighted(tally) = &mut self.tally {
            tally.refine(passes);
        }
        self.verdicts()
    }

    /// How far each vehicle is trusted.
    pub fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        match &self.tally {
            Tally::Paper(tally) => tally.reputations(),
            Tally::Weighted(tally) => tally.reputations(),
        }
    }

    /// Starts from what a ledger knows, after a restart or a change of aggregator; without effect in `paper` mode.
    pub fn adopt(&mut self, ledger: &ReputationLedger) {
        if let Tally::Weighted(tally) = &mut self.tally {
            tally.adopt(ledger, (self.config.max_vehicles, self.config.max_labels));
        }
    }

    /// Goes on from reputations that were published, after a restart or a change of aggregator; without effect in
    /// `weighted` mode, which rests on evidence.
    pub fn resume(&mut self, reputations: &BTreeMap<NodeName, Reputation>) {
        if let Tally::Paper(tally) = &mut self.tally {
            tally.resume(reputations);
        }
    }

    /// Objects that voted for nothing so far, or whose votes were forgotten with their labels; see the module's
    /// documentation.
    pub fn ignored(&self) -> u64 {
        self.ignored
    }
}

/// A verdict with `shown` or else the label of the highest score, the first in alphabetical order on a tie.
///
/// With hysteresis the shown label may for a while not be the highest; its margin is negative then.
fn verdict(
    landmark: LandmarkId,
    votes: BTreeMap<Label, f64>,
    shown: Option<Label>,
    contributors: Vec<NodeName>,
) -> Verdict {
    let label = shown.or_else(|| best(&votes).cloned());
    let score = label.as_ref().and_then(|l| votes.get(l)).copied().unwrap_or(0.0);
    let others = votes.iter().filter(|(l, _)| Some(*l) != label.as_ref()).map(|(_, s)| *s);
    let margin = score - others.fold(0.0, f64::max);
    Verdict { landmark, label, score, margin, votes, contributors }
}

/// The label of the highest score, the first in alphabetical order on a tie.
fn best(votes: &BTreeMap<Label, f64>) -> Option<&Label> {
    let mut best: Option<(&Label, f64)> = None;
    for (label, &score) in votes {
        if best.is_none_or(|(_, most)| score > most) {
            best = Some((label, score));
        }
    }
    best.map(|(label, _)| label)
}
