//! VOTE: the right label of a landmark where vehicles disagree.
//!
//! [`Vote`] is a state machine without clocks. Call [`Vote::observe`] with every report and
//! [`Vote::close`] at the end of a round. [`Vote::refine`] re-evaluates the stored votes. Equal
//! calls give equal results.
//!
//! [`Vote::ignored`] counts the objects that do not vote, which is not an error:
//! - objects without a landmark, or at a landmark that is missing in a closed cell;
//! - objects of zero confidence or beyond the maximum range;
//! - in `weighted` mode, all but the most confident object of a report at a landmark (the paper's
//!   sum takes them all);
//! - votes for a label that was evicted for another.
//!
//! A report is rejected unless its `seq` or its capture time is newer than the last of its vehicle, or
//! the vehicle's clock was set back.

mod calibration;
mod config;
mod configured_method;
mod confusion;
mod dawid_skene;
mod dependence;
mod index_map;
mod label_bias;
mod label_table;
mod landmark_table;
mod landmark_votes;
mod likelihood;
mod method;
mod named_landmarks;
mod paper;
mod parameters;
mod visibility;
mod weighted;

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use hashbrown::HashMap;
use nalgebra::Point2;

pub use config::{MAX_LABELS, PaperConfig, VoteConfig, VoteMode, WeightedConfig};
pub use paper::REPUTATION_RANGE;
pub use visibility::{paper as paper_visibility, weighted as weighted_visibility};

use crate::admission::report_window::MAX_PARTS;
use crate::model::geometry::Pose;
use crate::model::names::{Label, LandmarkId, NodeName};
use crate::model::time::Timestamp;
use crate::perception::landmark::Landmark;
use crate::reputation::{Evidence, ReputationLedger};
use crate::wire::{
    LabelReading, Limits, ObjectReport, PerceivedObject, RejectReason, Reputation, Verdict,
};
use configured_method::ConfiguredMethod;
use method::NewVote;
use named_landmarks::NamedLandmarks;

/// The result of one round.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VoteRound {
    /// One verdict for every landmark of a closed cell; in an open cell, for every landmark with
    /// news.
    pub verdicts: Vec<Verdict>,
    /// Votes that have turned out to be right or wrong, for the ledger.
    pub evidence: Vec<Evidence>,
}

/// The last report of a vehicle.
#[derive(Debug, Clone)]
struct LastReport {
    received_at: Timestamp,
    /// The last report of each part, such as a camera: their reports overtake one another. At most
    /// [`MAX_PARTS`].
    parts: BTreeMap<NodeName, PartReport>,
    /// Number of reports since the last verdict.
    frames: u32,
}

/// Largest step back in time of an overtaken report; a larger one means that the vehicle's clock
/// was set back. [`crate::admission::report_window::ReportWindow`] admits reports for as long by
/// default.
const MAX_OVERTAKEN: Duration = Duration::from_secs(3);
/// Silence after which a vehicle may be replaced by another: unproven vehicles, proven vehicles.
const RETENTION: [Duration; 2] = [Duration::from_secs(10), Duration::from_secs(600)];
/// Inverse share of the vehicles that is evicted at once, so that the cost per newcomer stays
/// small.
const EVICTION_DIVISOR: usize = 8;

/// The last report of a part of a vehicle, or of the vehicle itself.
#[derive(Debug, Clone, Copy)]
struct PartReport {
    seq: u64,
    captured_at: Timestamp,
}

impl PartReport {
    /// Whether `report` was made later. A restarted node counts `seq` from the start again, but its
    /// time continues. A corrected clock may go back, but `seq` continues. If both happen, only the
    /// size of the step distinguishes them.
    fn is_before(&self, report: &ObjectReport) -> bool {
        report.captured_at_us > self.captured_at
            || report.seq > self.seq
            || self.captured_at.since(report.captured_at_us) > MAX_OVERTAKEN
    }
}

/// The voting machine of a cell.
#[derive(Debug, Clone)]
pub struct Vote {
    config: VoteConfig,
    /// Whether landmarks are taken from the reports.
    open: bool,
    /// Listed landmarks; empty in an open cell.
    landmarks: BTreeMap<LandmarkId, Landmark>,
    /// Landmarks of an open cell.
    named: NamedLandmarks,
    /// Hashed, because the order is irrelevant.
    last_reports: HashMap<NodeName, LastReport>,
    method: ConfiguredMethod,
    /// Vacancy signs that were recently read, with the time, by vehicle.
    signs: BTreeMap<LandmarkId, BTreeMap<NodeName, Timestamp>>,
    ignored: u64,
}

impl Vote {
    /// A machine for `landmarks`; without any, the cell is open and takes landmarks from the
    /// reports as they appear.
    pub fn new(config: VoteConfig, landmarks: Vec<Landmark>) -> Self {
        let mut method = ConfiguredMethod::new(&config);
        for landmark in &landmarks {
            method.get_mut().add_landmark(landmark.id.clone());
        }
        Self {
            config,
            open: landmarks.is_empty(),
            landmarks: landmarks.into_iter().map(|l| (l.id.clone(), l)).collect(),
            named: NamedLandmarks::default(),
            last_reports: HashMap::new(),
            method,
            signs: BTreeMap::new(),
            ignored: 0,
        }
    }

    /// The same votes and reputations under other settings and for other landmarks. A different
    /// mode starts without votes.
    #[must_use]
    pub(crate) fn configured(mut self, config: VoteConfig, landmarks: Vec<Landmark>) -> Self {
        if config.mode != self.config.mode {
            return Self {
                last_reports: self.last_reports,
                ..Self::new(config, landmarks)
            };
        }
        let method = self.method.get_mut();
        method.configure(&config);
        let is_open = landmarks.is_empty();
        let listed: BTreeMap<_, _> = landmarks.into_iter().map(|l| (l.id.clone(), l)).collect();
        if is_open {
            for id in self.landmarks.keys() {
                self.named.add(id, None, usize::MAX);
            }
        } else {
            self.named.clear();
            listed.keys().for_each(|id| method.add_landmark(id.clone()));
            for id in method.landmarks() {
                if !listed.contains_key(&id) {
                    method.remove_landmark(&id);
                }
            }
        }
        Self {
            config,
            open: is_open,
            landmarks: listed,
            ..self
        }
    }

    /// True if a location of this id is listed; `None` without a list, where reports name the
    /// locations.
    pub fn has_location(&self, id: &LandmarkId) -> Option<bool> {
        (!self.open).then(|| self.landmarks.contains_key(id))
    }

    /// Counts the votes of a report that was received at `received_at`.
    ///
    /// # Errors
    /// Returns the reason why the report was not used. The state is unchanged in this case.
    pub fn observe(
        &mut self,
        report: &ObjectReport,
        received_at: Timestamp,
    ) -> Result<(), RejectReason> {
        self.observe_part(report, &report.node, received_at)
    }

    /// As [`Self::observe`], for a report made by a part of the vehicle.
    ///
    /// # Errors
    /// Returns the errors of [`Self::observe`].
    pub fn observe_part(
        &mut self,
        report: &ObjectReport,
        part: &NodeName,
        received_at: Timestamp,
    ) -> Result<(), RejectReason> {
        report.validate(&Limits {
            objects: usize::MAX,
            ..Limits::default()
        })?;
        if !self.last_reports.contains_key(&report.node) {
            self.evict_silent_vehicles(received_at)?;
        }
        let new = || LastReport {
            received_at,
            parts: BTreeMap::new(),
            frames: 0,
        };
        let last = self
            .last_reports
            .entry(report.node.clone())
            .or_insert_with(new);
        if last
            .parts
            .get(part)
            .is_some_and(|last| !last.is_before(report))
        {
            return Err(RejectReason::OutOfOrder);
        }
        if last.parts.len() >= MAX_PARTS && !last.parts.contains_key(part) {
            last.parts.clear();
        }
        last.parts.insert(
            part.clone(),
            PartReport {
                seq: report.seq,
                captured_at: report.captured_at_us,
            },
        );
        last.received_at = received_at;
        last.frames = last.frames.saturating_add(1);
        let objects = match self.config.mode {
            VoteMode::Weighted => self.one_per_landmark(&report.objects),
            VoteMode::Paper => report.objects.iter().collect(),
        };
        let pose = report.pose.map(Pose::from);
        for object in objects {
            if !self.add_vote(report, object, pose, received_at) {
                self.ignored += 1;
            }
        }
        Ok(())
    }

    /// Makes room for a vehicle: evicts silent vehicles if the maximum is reached. Unproven
    /// vehicles and vehicles that were mostly wrong are evicted before proven ones, the longest
    /// silent first.
    fn evict_silent_vehicles(&mut self, now: Timestamp) -> Result<(), RejectReason> {
        if self.last_reports.len() < self.config.max_vehicles {
            return Ok(());
        }
        let rank = |(node, last): (&NodeName, &LastReport)| {
            (
                self.method.get().is_proven(node),
                last.received_at,
                node.clone(),
            )
        };
        let mut silent: Vec<_> = self.last_reports.iter().map(rank).collect();
        silent
            .retain(|(is_proven, last, _)| now.since(*last) >= RETENTION[usize::from(*is_proven)]);
        silent.sort();
        silent.truncate(self.config.max_vehicles.div_ceil(EVICTION_DIVISOR));
        let nodes: BTreeSet<NodeName> = silent.into_iter().map(|(.., node)| node).collect();
        if nodes.is_empty() {
            return Err(RejectReason::TooManyVehicles);
        }
        self.last_reports.retain(|node, _| !nodes.contains(node));
        self.method.get_mut().remove_vehicles(&nodes);
        Ok(())
    }

    /// The most confident object at each landmark (the first on a tie), by landmark. The landmark's
    /// vacancy sign counts only if there is no object in front of it.
    fn one_per_landmark<'a>(&mut self, objects: &'a [PerceivedObject]) -> Vec<&'a PerceivedObject> {
        let mut best: BTreeMap<Option<&LandmarkId>, &PerceivedObject> = BTreeMap::new();
        for object in objects {
            match best.entry(object.landmark.as_ref()) {
                Entry::Vacant(free) => *free.insert(object),
                Entry::Occupied(mut kept) => {
                    let landmark = object
                        .landmark
                        .as_ref()
                        .and_then(|id| self.landmarks.get(id));
                    let rank = |object: &PerceivedObject| {
                        (
                            !self.is_sign(landmark, self.voted_label(landmark, &object.label)),
                            object.confidence,
                        )
                    };
                    if rank(object) > rank(kept.get()) {
                        kept.insert(object);
                    }
                    continue;
                }
            };
        }
        self.ignored += (objects.len() - best.len()) as u64;
        best.into_values().collect()
    }

    /// Counts one object as a vote; returns false if it is not a vote.
    fn add_vote(
        &mut self,
        report: &ObjectReport,
        object: &PerceivedObject,
        pose: Option<Pose>,
        at: Timestamp,
    ) -> bool {
        let Some(id) = object.landmark.as_ref().filter(|_| object.confidence > 0.0) else {
            return false;
        };
        let landmark = self.landmarks.get(id);
        if landmark.is_none() && !self.open {
            return false;
        }
        let position = landmark.map_or(Point2::new(object.x_m, object.y_m), |l| l.position);
        let label = self.voted_label(landmark, &object.label).clone();
        let is_sign = self.is_sign(landmark, &label);
        let range_bearing = pose.map(|p| p.range_bearing(&position));
        let max_range_m = match self.config.mode {
            VoteMode::Paper => self.config.paper.max_range_m,
            VoteMode::Weighted => self.config.weighted.max_range_m,
        };
        if range_bearing.is_some_and(|(distance_m, _)| distance_m > max_range_m) {
            return false;
        }
        if is_sign && self.is_behind_object(id, &label, &report.node, at) {
            return true;
        }
        let vote = NewVote {
            landmark: id,
            node: &report.node,
            label: &label,
            confidence: object.confidence,
            range_bearing,
            at,
        };
        let Some(dropped) = self
            .method
            .get_mut()
            .make_room_for(&vote, self.config.max_labels)
        else {
            return false;
        };
        self.ignored += dropped as u64;
        if self.open && !self.method.get().has_landmark(id) {
            self.open_landmark(id, &report.node);
        }
        self.method.get_mut().add_vote(&vote);
        true
    }

    /// The label as which a stated label counts.
    fn voted_label<'a>(&'a self, landmark: Option<&'a Landmark>, stated: &'a Label) -> &'a Label {
        let synonym = landmark.and_then(|landmark| landmark.synonym(stated));
        synonym
            .or_else(|| self.config.synonyms.get(stated))
            .unwrap_or(stated)
    }

    /// True if a voted label is the label of the landmark's vacancy sign.
    fn is_sign(&self, landmark: Option<&Landmark>, voted: &Label) -> bool {
        let sign = landmark.and_then(|landmark| landmark.vacancy.as_ref());
        sign.is_some_and(|sign| self.voted_label(landmark, &sign.label) == voted)
    }

    /// Records that a vehicle read a landmark's vacancy sign. Returns true if the sign is behind an
    /// object, so that reading it is not a vote against the object: at least as many other vehicles
    /// read an object there as read the sign. Vehicles that were mostly wrong are not counted.
    fn is_behind_object(
        &mut self,
        landmark: &LandmarkId,
        sign: &Label,
        node: &NodeName,
        at: Timestamp,
    ) -> bool {
        let freshness = Duration::from_secs_f64(self.config.weighted.freshness_s);
        let signs = self.signs.entry(landmark.clone()).or_default();
        signs.insert(node.clone(), at);
        signs.retain(|_, read_at| at.since(*read_at) < freshness);
        let readings = self.method.get().readings(landmark);
        let objects = readings
            .iter()
            .filter(|(label, _)| *label != sign)
            .flat_map(|(_, nodes)| nodes)
            .filter(|other| *other != node && self.method.get().is_trusted(other))
            .count();
        objects > 0 && objects >= signs.len()
    }

    /// Labels that vehicles recently read at a landmark, including labels that are not votes, and
    /// the vehicles.
    pub fn readings(&self, landmark: &LandmarkId, now: Timestamp) -> Vec<LabelReading> {
        let mut readings = self.method.get().readings(landmark);
        let freshness = Duration::from_secs_f64(self.config.weighted.freshness_s);
        let known = self.landmarks.get(landmark);
        if let (Some(sign), Some(signs)) = (
            known.and_then(|l| l.vacancy.as_ref()),
            self.signs.get(landmark),
        ) {
            let votes: BTreeSet<NodeName> = readings.values().flatten().cloned().collect();
            let fresh: Vec<_> = signs
                .iter()
                .filter(|(node, at)| now.since(**at) < freshness && !votes.contains(*node))
                .map(|(node, _)| node.clone())
                .collect();
            if !fresh.is_empty() {
                readings
                    .entry(self.voted_label(known, &sign.label).clone())
                    .or_default()
                    .extend(fresh);
            }
        }
        let sorted = readings.into_iter().map(|(label, mut nodes)| {
            nodes.sort();
            LabelReading { label, nodes }
        });
        sorted.collect()
    }

    /// Adds a landmark that a vehicle has named in an open cell. At the maximum, the oldest
    /// landmark of the vehicle with most landmarks is dropped with its votes.
    fn open_landmark(&mut self, landmark: &LandmarkId, vehicle: &NodeName) {
        let max = self.config.max_landmarks;
        if let Some(dropped) = self.named.add(landmark, Some(vehicle), max) {
            self.method.get_mut().remove_landmark(&dropped);
        }
    }

    /// Whether a vehicle has sent a full packet of frames since the last verdict (`paper` mode).
    pub fn is_packet_complete(&self) -> bool {
        self.last_reports
            .values()
            .any(|last| last.frames >= self.config.paper.frames_per_verdict)
    }

    /// Whether any vehicle has sent a frame since the last verdict (`paper` mode).
    pub fn is_packet_begun(&self) -> bool {
        self.last_reports.values().any(|last| last.frames > 0)
    }

    /// Ends the round: evaluates the landmarks that changed.
    ///
    /// In `paper` mode the counts of frames start again for the next packet. A cell with a list of
    /// landmarks gets all verdicts, an open cell the changed ones.
    ///
    /// # Example
    /// Three vehicles vote `car` at `slot-3`, one votes `van`. Closing judges the landmark: the
    /// verdict is `car`. Once one of the votes is older than `freshness_s`, all four are settled,
    /// and the round that closes then returns four pieces of evidence, of which three are correct.
    pub fn close(&mut self, now: Timestamp) -> VoteRound {
        if self.config.mode == VoteMode::Paper {
            self.last_reports
                .values_mut()
                .for_each(|last| last.frames = 0);
        }
        let (changed, evidence) = self.method.get_mut().close(now);
        let verdicts = if self.open {
            changed
                .iter()
                .filter_map(|landmark| self.method.get().verdict(landmark))
                .collect()
        } else {
            self.verdicts().collect()
        };
        VoteRound { verdicts, evidence }
    }

    /// Begins a leadership: earlier votes still contribute to verdicts but yield no evidence,
    /// because the previous leader settles them.
    pub(crate) fn begin_record(&mut self, now: Timestamp) {
        self.method.get_mut().begin_record(now);
    }

    /// True if reports name the landmarks themselves.
    pub(crate) fn is_open(&self) -> bool {
        self.open
    }

    /// The verdict of a landmark as of the last round; `None` for an unknown landmark.
    pub(crate) fn verdict(&self, landmark: &LandmarkId) -> Option<Verdict> {
        self.method.get().verdict(landmark)
    }

    /// The verdict of every landmark as of the last round, by landmark.
    pub fn verdicts(&self) -> impl Iterator<Item = Verdict> {
        let landmarks = self.method.get().landmarks().into_iter();
        landmarks.filter_map(|landmark| self.method.get().verdict(&landmark))
    }

    /// Re-evaluates the stored votes `passes` times, starting from equal trust; returns the verdict
    /// of every landmark.
    ///
    /// This is Dawid & Skene (1979) with the priors of the online machine. It does not depend on
    /// the order of arrival. It has no effect in `paper` mode.
    pub fn refine(&mut self, passes: u32) -> impl Iterator<Item = Verdict> {
        self.method.get_mut().refine(passes);
        self.verdicts()
    }

    /// Removes the votes of a vehicle and of its parts, and the evidence about it. If it votes again,
    /// it starts as a new vehicle.
    pub fn expel(&mut self, vehicle: &NodeName) {
        let gone: BTreeSet<NodeName> = self
            .last_reports
            .keys()
            .filter(|node| node.vehicle() == *vehicle)
            .cloned()
            .chain([vehicle.clone()])
            .collect();
        self.last_reports.retain(|node, _| !gone.contains(node));
        self.method.get_mut().remove_vehicles(&gone);
    }

    /// The reputation of each vehicle.
    pub fn reputations(&self) -> BTreeMap<NodeName, Reputation> {
        self.method.get().reputations()
    }

    /// Starts from a ledger, after a restart or a change of aggregator; has no effect in `paper`
    /// mode.
    pub fn adopt(&mut self, ledger: &ReputationLedger) {
        self.method.get_mut().adopt(ledger, &self.config);
    }

    /// Continues from published reputations, after a restart or a change of aggregator; has no
    /// effect in `weighted` mode, which uses evidence instead.
    pub fn resume(&mut self, reputations: &BTreeMap<NodeName, Reputation>) {
        self.method.get_mut().resume(reputations);
    }

    /// Number of objects so far that did not vote or whose votes were dropped with their labels;
    /// see the module's documentation.
    pub fn ignored(&self) -> u64 {
        self.ignored
    }
}
