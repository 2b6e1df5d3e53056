//! The tracker: predict, associate, update, manage.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use super::config::TracksConfig;
use super::lifecycle::{adopt_map, merge, prune};
use super::neighbour_tracks::NeighbourTracks;
use super::registration::{RegistrationFrame, register};
use super::sensors::Sensors;
use super::store::TrackStore;
use super::turning::TurningFrame;
use super::update::InstantUpdate;
use super::{HandOvers, TracksLosses, TracksRound};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::neighbours::MAX_AGE;
use crate::reputation::{Evidence, ReputationConfig, ReputationLedger};
use crate::wire::{
    FusedObject, GlobalMap, NeighbourObject, ObjectReport, PerceivedObject, PoseCorrection,
};

/// Tracks objects; see the [module](super).
#[derive(Debug, Clone)]
pub struct Tracker {
    config: TracksConfig,
    pub(super) sensors: Sensors,
    tracks: TrackStore,
    neighbours: NeighbourTracks,
    /// Reports of the open round with their times of capture.
    pending: Vec<(Timestamp, Arc<ObjectReport>)>,
    frame: TurningFrame,
    /// Time of the latest fused report.
    fused_until: Timestamp,
    late: u64,
    /// Time of the last round.
    closed_at: Timestamp,
    /// Time from which judgements become evidence.
    recorded_from: Timestamp,
}

impl Tracker {
    /// A tracker without tracks. Both configurations must be valid.
    pub fn new(config: TracksConfig, reputation: ReputationConfig) -> Self {
        Self {
            sensors: Sensors::new(reputation),
            tracks: TrackStore::new(&config),
            neighbours: NeighbourTracks::default(),
            config,
            pending: Vec::new(),
            frame: TurningFrame::default(),
            fused_until: Timestamp(0),
            late: 0,
            closed_at: Timestamp::default(),
            recorded_from: Timestamp::default(),
        }
    }

    /// Returns the tracker with new settings and unchanged tracks and trust. The settings must be valid.
    #[must_use]
    pub(crate) fn configured(mut self, config: TracksConfig, reputation: ReputationConfig) -> Self {
        self.tracks.configure(&config);
        self.sensors.fleet.configure(reputation);
        if self.config.align && !config.align {
            self.sensors.reset_pose_biases(self.closed_at, &config);
        }
        Self { config, ..self }
    }

    /// Adds an admitted report, captured at `captured_at` on the aggregator's clock; false if the report is too late.
    pub fn observe(
        &mut self,
        report: impl Into<Arc<ObjectReport>>,
        captured_at: Timestamp,
    ) -> bool {
        self.observe_only(report.into(), captured_at, |_| true)
    }

    /// Adds the `wanted` objects of a report: objects away from landmarks.
    pub fn observe_only(
        &mut self,
        mut report: Arc<ObjectReport>,
        captured_at: Timestamp,
        wanted: impl Fn(&PerceivedObject) -> bool,
    ) -> bool {
        if self.fused_until.since(captured_at).as_secs_f64() > self.config.max_lag_s {
            self.late += 1;
            return false;
        }
        if !report.objects.iter().all(&wanted) {
            Arc::make_mut(&mut report).objects.retain(wanted);
        }
        self.pending.push((captured_at, report));
        true
    }

    /// Sets the trust in all vehicles by the counts of a ledger.
    pub fn adopt(&mut self, ledger: &ReputationLedger) {
        self.sensors.adopt(ledger);
    }

    /// Adds evidence of VOTE about reporting vehicles.
    pub fn learn(&mut self, evidence: &[Evidence]) {
        self.sensors.learn(evidence);
    }

    /// Takes over identities, and objects without a track here, from another aggregator's map, received at `now`.
    pub fn adopt_map(&mut self, map: &GlobalMap, now: Timestamp) {
        let steady = self.frame.steady_map(map, now);
        adopt_map(
            &mut self.tracks,
            steady.as_ref().unwrap_or(map),
            now,
            &self.config,
        );
    }

    /// Replaces all objects of neighbouring cells; their ages are relative to `stated_at`, and their times use its
    /// clock. A turning frame has no position on Earth and no neighbours.
    pub fn on_neighbours(&mut self, objects: &[NeighbourObject], stated_at: Timestamp) {
        self.neighbours.on_neighbours(
            objects,
            stated_at,
            &mut self.tracks,
            &self.sensors.fleet,
            &self.config,
        );
    }

    /// True if an object of a neighbouring cell is not published, because it matches a track or its cell is distrusted.
    pub fn hides(&self, object: &NeighbourObject) -> bool {
        self.neighbours.hides(object, &self.sensors.fleet)
    }

    /// Weight of a neighbouring cell's statements, 0 to 1: 1 for a newcomer, 0 for a cell with proven false statements.
    pub fn trust_in_cell(&self, cell: &NodeName) -> f64 {
        self.neighbours.trust(cell, &self.sensors.fleet)
    }

    /// Identities that tracks took over from neighbouring cells so far.
    pub fn hand_overs(&self) -> HandOvers {
        self.neighbours.hand_overs
    }

    /// Begins a leadership: the previous leader judges earlier observations.
    pub(crate) fn begin_record(&mut self, now: Timestamp) {
        self.recorded_from = now;
    }

    /// Reports and objects that were not used so far.
    pub fn losses(&self) -> TracksLosses {
        TracksLosses {
            late: self.late,
            refused: self.tracks.refused,
        }
    }

    /// Closes the round at `now`.
    ///
    /// Order: the frame of the round's reports is advanced, the reports update the tracks in order
    /// of capture, poses are aligned, duplicates are merged, and lost objects are removed.
    /// Confirmed tracks are kept after the end of their publication, so that an object that is
    /// detected again keeps its identity.
    ///
    /// # Example
    /// A car is detected in round 10: a track begins, and the map contains an object of low
    /// confidence. Detections of a second vehicle confirm the track. Both vehicles lose the car:
    /// the object is published for `life_s` after the last detection, and a detection within
    /// `latent_s` continues its track.
    pub fn close(&mut self, now: Timestamp) -> TracksRound {
        let pending = std::mem::take(&mut self.pending);
        let oldest_capture = pending.iter().map(|(captured_at, _)| *captured_at).min();
        for (at, report) in &pending {
            self.frame.record(report, *at);
        }
        let trust = |node: &NodeName| {
            self.sensors
                .by_name(node)
                .map_or(1.0, |sensor| self.sensors.fleet.trust(sensor.id))
        };
        self.frame.advance(now, |node| trust(node) > 0.0);
        let (frames, evidence) = self.update(&self.in_order(pending), now);
        if self.config.align {
            register(frames, &self.tracks, &mut self.sensors, &self.config);
        }
        merge(&mut self.tracks, &self.sensors, now, &self.config);
        let passed_s = now
            .since(self.closed_at)
            .as_secs_f64()
            .min(self.config.life_s);
        let leaving = self.sensors.leaving(self.config.life_s);
        for sensor in self.sensors.iter_mut() {
            sensor.population.begin_round();
        }
        for track in self.tracks.iter().filter(|track| track.is_settled) {
            let spawner = track.spawned_by.and_then(|id| self.sensors.get_mut(id));
            if let Some(sensor) = spawner {
                let present = track.presence_at(now, leaving);
                sensor.population.count(present, passed_s);
            }
        }
        self.closed_at = self.closed_at.max(now);
        prune(&mut self.tracks, &mut self.sensors, now, &self.config);
        self.neighbours
            .drop_before(now - MAX_AGE, |vehicle| self.sensors.get(vehicle).is_some());
        let mut objects = self.objects(now);
        let mut pose_corrections = self.corrections();
        self.frame
            .restore(now, &mut objects, pose_corrections.values_mut());
        TracksRound {
            objects,
            pose_corrections,
            oldest_capture,
            evidence,
        }
    }

    /// The reports of a round in the order of capture, independently of their order of arrival.
    fn in_order(&self, pending: Vec<(Timestamp, Arc<ObjectReport>)>) -> Vec<Captured> {
        let prior = self.config.bias_prior();
        let mut reports: Vec<Captured> = pending
            .into_iter()
            .map(|(stamp, report)| {
                let sensor = self.sensors.by_name(&report.node);
                let delay_s = sensor.map_or(0.0, |sensor| sensor.pose_bias.delay_s(&prior));
                let at = stamp.shifted((-delay_s * 1e6) as i64);
                Captured {
                    at,
                    delay_s,
                    report: self.frame.steady(report, at),
                }
            })
            .collect();
        reports.sort_by(|a, b| {
            (a.at, &a.report.node, a.report.seq).cmp(&(b.at, &b.report.node, b.report.seq))
        });
        reports
    }

    /// Updates the tracks, instant by instant; returns the frames for registration, and judgements of the vehicles.
    fn update(
        &mut self,
        reports: &[Captured],
        now: Timestamp,
    ) -> (Vec<RegistrationFrame>, Vec<Evidence>) {
        let mut frames: Vec<RegistrationFrame> = Vec::new();
        let mut evidence = Vec::new();
        self.tracks
            .reindex(reports.first().map_or(now, |report| report.at));
        let leaving = self.sensors.leaving(self.config.life_s);
        for instant in reports.chunk_by(|a, b| a.at == b.at && a.report.node != b.report.node) {
            let at = instant[0].at;
            self.tracks.reindex_if_stale(at);
            let update = InstantUpdate {
                config: &self.config,
                tracks: &mut self.tracks,
                sensors: &mut self.sensors,
                neighbours: &mut self.neighbours,
                leaving,
                at,
            };
            let reports = instant
                .iter()
                .map(|captured| (&*captured.report, captured.delay_s));
            let outcome = update.run(reports);
            for frame in outcome.frames {
                if frame.has_jumped {
                    frames.retain(|earlier| earlier.sensor != frame.sensor);
                }
                frames.push(frame);
            }
            if at >= self.recorded_from {
                evidence.extend(outcome.evidence);
            }
            self.fused_until = self.fused_until.max(at);
        }
        (frames, evidence)
    }

    /// The objects of the map at `now`: tracks that were detected within `life_s` and are certain
    /// enough to be published.
    fn objects(&mut self, now: Timestamp) -> Vec<FusedObject> {
        let fleet = &self.sensors.fleet;
        let name = |id| self.sensors.get(id).map(|sensor| sensor.node.clone());
        let leaving = self.sensors.leaving(self.config.life_s);
        let mut published = Vec::with_capacity(self.tracks.len());
        let seen_since = now - Duration::from_secs_f64(self.config.life_s);
        for track in self
            .tracks
            .iter()
            .filter(|track| track.last_seen >= seen_since)
        {
            let existence = track.existence_at(now, leaving, |id| fleet.trust(id));
            let object = track.object(now, &self.config, existence, name);
            if object.confidence >= self.config.min_confidence {
                published.push(object);
            }
        }
        published
    }

    /// The corrections of the vehicles' poses for the map; empty if alignment is switched off.
    fn corrections(&self) -> BTreeMap<NodeName, PoseCorrection> {
        if !self.config.align {
            return BTreeMap::new();
        }
        let corrections = self.sensors.iter();
        corrections
            .filter_map(|sensor| Some((sensor.node.clone(), sensor.pose_bias.correction()?)))
            .collect()
    }
}

/// A report of the round.
struct Captured {
    /// Time of capture: the stamp less the vehicle's delay.
    at: Timestamp,
    delay_s: f64,
    report: Arc<ObjectReport>,
}
