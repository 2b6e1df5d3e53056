//! Objects without a known place: followed across vehicles that move, each once, under one identity.
//!
//! A [`Tracker`] takes admitted reports by [`Tracker::observe`] and makes the objects of a map by [`Tracker::close`].
//! Within a round, reports count in the order of their capture, whatever order they came in. `docs/tracks.md` has the
//! equations.
//!
//! Nothing has to be known of a vehicle beforehand: how noisy its positions are, where it sees and how surely, and by
//! how much its pose is off, are learnt from what it has in common with the others. An object is never founded on a
//! map: maps that are received lend identities, not evidence.

mod assignment;
mod calibration;
mod config;
mod existence;
mod grid;
mod history;
mod joining;
mod kinematics;
mod lifecycle;
mod occlusion;
mod pairs;
mod registration;
mod sensors;
#[cfg(test)]
mod tests;
mod track;
mod trust;
mod update;

use std::collections::BTreeMap;
use std::sync::Arc;

use hashbrown::HashMap;

pub use config::{TracksConfig, TracksMode};

use crate::names::NodeName;
use crate::reputation::{Evidence, ReputationConfig, ReputationLedger};
use crate::time::Timestamp;
use crate::wire::{FusedObject, ObjectReport, PerceivedObject, PoseCorrection};
use grid::Grid;
use pairs::Sightings;
use registration::{Alignment, Spread};
use sensors::Source;
use track::Track;
use trust::{Fleet, Standing, Standings};
use update::Taking;

/// What a round came to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TracksRound {
    /// The objects, where they are when the round is closed, the oldest first.
    pub objects: Vec<FusedObject>,
    /// By vehicle, how its positions were corrected.
    pub pose_corrections: BTreeMap<NodeName, PoseCorrection>,
    /// Capture time of the oldest report of the round.
    pub oldest_capture: Option<Timestamp>,
    /// What has been settled about the vehicles' words.
    pub evidence: Vec<Evidence>,
}

/// Reports that were not used, and objects for which there was no room.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TracksLosses {
    /// Reports that came later than [`TracksConfig::max_lag_s`].
    pub late: u64,
    /// New objects beyond [`TracksConfig::max_tracks`] or [`TracksConfig::max_density`].
    pub refused: u64,
}

/// Follows objects; see the module.
#[derive(Debug, Clone)]
pub struct Tracker {
    config: TracksConfig,
    reputation: ReputationConfig,
    /// By number; numbers of forgotten vehicles are given anew.
    sources: Vec<Option<Box<Source>>>,
    numbers: HashMap<NodeName, u32>,
    standings: Standings,
    fleet: Fleet,
    /// The oldest first.
    tracks: Vec<Track>,
    /// Tracks by place, in cells whose side is a multiple of the gate's.
    grid: Grid,
    /// When they were there, and how fast the fastest of them goes.
    indexed_at: Timestamp,
    fastest_mps: f64,
    /// By a vehicle's number, the track that it is.
    own: HashMap<u32, u32>,
    pending: Vec<(Timestamp, Arc<ObjectReport>)>,
    fused_until: Timestamp,
    late: u64,
    refused: u64,
    evidence: Vec<Evidence>,
    /// What is seen from then on becomes evidence.
    recorded_from: Timestamp,
}

/// Least side of a cell in metres: larger ones hold more that is too far, smaller ones are more to look up.
const LEAST_CELL_M: f64 = 24.0;

impl Tracker {
    /// Knows nothing yet; both are taken as valid.
    pub fn new(config: TracksConfig, reputation: ReputationConfig) -> Self {
        Self {
            reputation,
            grid: Grid::new(config.gate_m * (LEAST_CELL_M / config.gate_m).ceil()),
            config,
            indexed_at: Timestamp(0),
            fastest_mps: 0.0,
            own: HashMap::new(),
            sources: Vec::new(),
            numbers: HashMap::new(),
            standings: Standings::default(),
            fleet: Fleet::default(),
            tracks: Vec::new(),
            pending: Vec::new(),
            fused_until: Timestamp(0),
            late: 0,
            refused: 0,
            evidence: Vec::new(),
            recorded_from: Timestamp::default(),
        }
    }

    /// Takes one admitted report, captured at `captured_at` on the aggregator's clock; false if it came too late.
    pub fn observe(&mut self, report: impl Into<Arc<ObjectReport>>, captured_at: Timestamp) -> bool {
        self.observe_only(report.into(), captured_at, |_| true)
    }

    /// The same with only some of the report's objects: those that are at no known place.
    pub fn observe_only(
        &mut self,
        report: Arc<ObjectReport>,
        captured_at: Timestamp,
        wanted: impl Fn(&PerceivedObject) -> bool,
    ) -> bool {
        if self.fused_until.since(captured_at).as_secs_f64() > self.config.max_lag_s {
            self.late += 1;
            return false;
        }
        let report = if report.objects.iter().all(&wanted) { report } else { only(&report, wanted) };
        self.pending.push((captured_at, report));
        true
    }

    /// Starts from what a ledger knows of the vehicles.
    pub fn adopt(&mut self, ledger: &ReputationLedger) {
        let mut known = Vec::new();
        for (node, (correct, incorrect)) in ledger.totals() {
            let standing = Standing::new(correct, incorrect, &self.reputation);
            match self.heard(&node) {
                Some(source) => source.standing = standing,
                None => known.push((node, standing)),
            }
        }
        self.standings.keep(known);
    }

    /// Takes in what VOTE has settled about vehicles that are heard.
    pub fn learn(&mut self, evidence: &[Evidence]) {
        let config = self.reputation.clone();
        for Evidence { node, correct, .. } in evidence {
            if let Some(source) = self.heard(node) {
                source.standing.count(*correct, &config);
            }
        }
    }

    /// A leadership begins: what was seen before `now` is for whoever led before to settle.
    pub(crate) fn begin_record(&mut self, now: Timestamp) {
        self.recorded_from = now;
        self.evidence.clear();
    }

    fn heard(&mut self, node: &NodeName) -> Option<&mut Source> {
        let number = *self.numbers.get(node)?;
        self.sources.get_mut(number as usize)?.as_deref_mut()
    }

    /// What could not be used so far.
    pub fn losses(&self) -> TracksLosses {
        TracksLosses { late: self.late, refused: self.refused }
    }

    /// Closes a round at `now`.
    pub fn close(&mut self, now: Timestamp) -> TracksRound {
        let pending = std::mem::take(&mut self.pending);
        let oldest_capture = pending.iter().map(|(at, _)| *at).min();
        let mut pending: Vec<_> = pending
            .into_iter()
            .map(|(stamp, report)| {
                let delay_s = self.heard(&report.node).map_or(0.0, |source| source.alignment.delay_s());
                (stamp.shifted((-delay_s * 1e6) as i64), delay_s, report)
            })
            .collect();
        pending.sort_by(|(a, _, x), (b, _, y)| (a, &x.node, x.seq).cmp(&(b, &y.node, y.seq)));
        self.index(pending.first().map_or(now, |(at, ..)| *at));
        let mut sightings: Vec<Sightings> = Vec::new();
        for (at, delay_s, report) in &pending {
            if self.drift_m(*at) > self.config.gate_m / 2.0 {
                self.index(*at);
            }
            let number = self.number_of(&report.node, *at);
            let Some(mut source) = self.sources[number as usize].take() else { continue };
            let mut taking = Taking {
                number,
                trust: source.trust(&self.reputation),
                source: &mut source,
                report,
                at: *at,
                has_jumped: false,
                sightings: Vec::with_capacity(report.objects.len()),
            };
            self.take(&mut taking);
            let Taking { has_jumped, sightings: seen, .. } = taking;
            if has_jumped {
                sightings.retain(|earlier| earlier.number != number);
            }
            sightings.push(Sightings { number, at: *at, delay_s: *delay_s, seen });
            self.sources[number as usize] = Some(source);
            self.fused_until = self.fused_until.max(*at);
        }
        if self.config.align {
            self.align(&sightings);
        }
        self.join(now);
        self.forget(now);
        TracksRound {
            objects: self.objects(now),
            pose_corrections: self.corrections(),
            oldest_capture,
            evidence: std::mem::take(&mut self.evidence),
        }
    }

    fn spread(&self) -> Spread {
        let TracksConfig { align_offset_m, align_heading_rad, align_delay_s, align_memory_s, .. } = self.config;
        Spread {
            offset_m: align_offset_m,
            heading_rad: align_heading_rad,
            delay_s: align_delay_s,
            memory_s: align_memory_s,
        }
    }

    /// The vehicle's number, given now if it has none.
    fn number_of(&mut self, node: &NodeName, at: Timestamp) -> u32 {
        if let Some(number) = self.numbers.get(node) {
            return *number;
        }
        let standing = self.standings.of(node);
        let source = Source::new(node.clone(), at, Alignment::new(at, &self.spread()), standing, &self.config);
        let number = self.sources.iter().position(Option::is_none).unwrap_or(self.sources.len());
        if number == self.sources.len() {
            self.sources.push(None);
        }
        self.sources[number] = Some(Box::new(source));
        self.numbers.insert(node.clone(), number as u32);
        number as u32
    }

    /// Weight of each vehicle's word by its number, 0 to 1; none of numbers that nobody has.
    fn trusts(&self) -> Vec<f64> {
        let trust = |source: &Option<Box<Source>>| source.as_ref().map_or(0.0, |source| source.trust(&self.reputation));
        self.sources.iter().map(trust).collect()
    }

    fn objects(&self, now: Timestamp) -> Vec<FusedObject> {
        let trusts = self.trusts();
        let trust = |number: u32| trusts[number as usize];
        let name = |number: u32| self.sources[number as usize].as_ref().map(|source| source.node.clone());
        let objects = self.tracks.iter().map(|track| track.fused(now, &self.config, trust, name));
        let mut shown = Vec::with_capacity(self.tracks.len());
        shown.extend(objects.filter(|object| object.confidence >= self.config.min_confidence));
        shown
    }

    fn corrections(&self) -> BTreeMap<NodeName, PoseCorrection> {
        if !self.config.align {
            return BTreeMap::new();
        }
        let sources = self.sources.iter().flatten();
        sources.filter_map(|source| Some((source.node.clone(), source.alignment.published()?))).collect()
    }
}

/// The report with only some of its objects.
fn only(report: &ObjectReport, wanted: impl Fn(&PerceivedObject) -> bool) -> Arc<ObjectReport> {
    let objects = report.objects.iter().filter(|object| wanted(object)).cloned().collect();
    let (pose, view) = (report.pose, report.view);
    Arc::new(ObjectReport {
        pose,
        view,
        objects,
        ..ObjectReport::new(report.node.clone(), report.seq, report.captured_at_us)
    })
}
