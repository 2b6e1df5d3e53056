//! Objects of neighbouring cells: they provide identities for tracks, and this cell's vehicles verify them.
//!
//! Neighbours' objects do not spawn or maintain tracks. A track that begins at the position of such an object takes
//! over its identity, velocity, heading, size, time of first detection, existence and class. The position of the track
//! is the position of the detection. Two cells that found one object separately use the identity of the older object,
//! or the smaller identity if both objects are about as old.
//!
//! A cell is judged like a vehicle (`trust`): it states that its objects exist.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use nalgebra::Vector2;
use uuid::Uuid;

use super::HandOvers;
use super::class::ObjectClass;
use super::config::TracksConfig;
use super::existence::JUDGED_AFTER;
use super::handles::{SensorId, TrackIndex};
use super::kinematics::{KinematicState, Measurement};
use super::lifecycle::{MERGE_M, measurement};
use super::store::TrackStore;
use super::track::{MIN_LABEL_SIMILARITY, Track};
use super::trust::{DormantCounts, Fleet, Judgement};
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{NeighbourObject, PerceivedObject};

/// Minimum existence of an object that counts as stated by its cell.
const MIN_STATED: f64 = 0.8;

/// Maximum time in seconds since the last detection of an object that counts as stated by its cell.
const MAX_STATED_AGE_S: f64 = 0.5;

/// Standard deviation of a velocity taken over from another cell, because the value may be wrong: in metres per second,
/// and as a share of the speed.
const VELOCITY_SIGMA_MPS: f64 = 2.0;
const VELOCITY_SIGMA_SHARE: f64 = 0.5;

/// Time in seconds for which the clock errors of two cells move their objects apart.
const CLOCK_ERROR_S: f64 = 0.1;

/// Time for which a cell's object and a track agree before the track may take over its identity.
const AGREES_AFTER: Duration = Duration::from_millis(400);

/// Minimum difference in seconds between the first detections of an older and a younger object.
const TIE_S: f64 = 1.0;

/// Time after which the smaller identity is used, if the other cell has not taken over the identity of the older track.
const TIES_AFTER: Duration = Duration::from_secs(4);

/// Maximum number of identities that a track takes over from cells in succession.
const MAX_RENAMES: u8 = 2;

/// Objects of neighbouring cells, and trust in the cells.
#[derive(Debug, Clone, Default)]
pub(super) struct NeighbourTracks {
    objects: Vec<NeighbourTrack>,
    trust: DormantCounts,
    pub(super) hand_overs: HandOvers,
}

/// An object of a neighbouring cell.
#[derive(Debug, Clone)]
pub(super) struct NeighbourTrack {
    cell: NodeName,
    /// The object as a track; its history has the observations of this cell's vehicles.
    pub(super) track: Track,
    stated: NeighbourObject,
    /// Time at which the object's cell fused its map.
    fused_at: Timestamp,
    judged_at: Timestamp,
    /// The track of this cell that matches the object, and since when.
    same: Option<(Uuid, Timestamp)>,
}

impl NeighbourTrack {
    /// A track of an object as its cell stated it, at the time of that cell's fusion.
    fn new(stated: &NeighbourObject, fused_at: Timestamp, config: &TracksConfig) -> Self {
        let NeighbourObject { cell, object, .. } = stated;
        let mut track = Track::new(
            object.id,
            fused_at,
            &measurement(object, config),
            ObjectClass::of(&object.label, config),
        );
        track.inherit(object, fused_at);
        if let Some(velocity) = object.velocity_mps {
            lend_velocity(&mut track.state, fused_at, velocity.into());
        }
        Self {
            cell: cell.clone(),
            track,
            stated: stated.clone(),
            fused_at,
            judged_at: fused_at,
            same: None,
        }
    }

    /// True if the cell states that the object exists.
    pub(super) fn is_stated(&self) -> bool {
        let object = &self.stated.object;
        object.existence.unwrap_or(object.confidence) >= MIN_STATED
            && object.age_s.unwrap_or(0.0) <= MAX_STATED_AGE_S
    }

    /// The object with its errors at `at`, as a measurement.
    fn measured_at(&self, at: Timestamp) -> Measurement {
        let independent = self.track.state.covariance_at(at);
        Measurement {
            position: self.track.state.position_at(at),
            independent,
            common_m: 0.0,
        }
    }

    /// Squared distance from a track in standard deviations, if both can be one object at `at`.
    fn distance_from(&self, track: &Track, at: Timestamp, config: &TracksConfig) -> Option<f64> {
        let innovation = track.state.innovation(at, &self.measured_at(at));
        let velocity = self.track.state.velocity - track.state.velocity;
        let variance = (self.track.state.velocity_covariance() + track.state.velocity_covariance())
            .trace()
            / 2.0;
        let reach_m = MERGE_M + CLOCK_ERROR_S * self.track.state.velocity.norm();
        let is_same = innovation.offset.norm() <= reach_m
            && innovation.distance_squared <= config.gate()
            && velocity.norm_squared() <= config.gate() * variance
            && self.track.label(config) == track.label(config);
        is_same.then_some(innovation.distance_squared)
    }
}

impl NeighbourTracks {
    /// Replaces all objects of neighbouring cells; their ages are relative to `stated_at`. Tracks that match an older
    /// object take over its identity.
    pub(super) fn on_neighbours(
        &mut self,
        stated: &[NeighbourObject],
        stated_at: Timestamp,
        tracks: &mut TrackStore,
        fleet: &Fleet,
        config: &TracksConfig,
    ) {
        let known = std::mem::take(&mut self.objects);
        self.objects = stated
            .iter()
            .map(|stated| {
                let fused_at = stated_at - Duration::from_secs_f64(stated.age_s.clamp(0.0, 60.0));
                let mut object = NeighbourTrack::new(stated, fused_at, config);
                let of_cell = || known.iter().filter(|known| known.cell == stated.cell);
                let by_id = of_cell().find(|known| known.track.id == stated.object.id);
                // An object whose identity changes in every map is judged nevertheless.
                let at_place = || {
                    let position = object.track.state.position;
                    of_cell().find(|known| {
                        (known.track.state.position_at(fused_at) - position).norm() < MERGE_M
                    })
                };
                if let Some(known) = by_id.or_else(at_place) {
                    object.track.history = known.track.history.clone();
                    object.judged_at = known.judged_at;
                    object.same = known.same.filter(|_| known.track.id == object.track.id);
                }
                object
            })
            .collect();
        tracks.reindex(stated_at);
        self.compare(tracks, stated_at, config);
        self.agree(tracks, stated_at, fleet);
    }

    /// Removes objects whose maps were fused before `limit`, and vehicles for which `known` returns false.
    pub(super) fn drop_before(&mut self, limit: Timestamp, known: impl Fn(SensorId) -> bool) {
        self.objects.retain(|object| object.fused_at >= limit);
        self.objects
            .iter_mut()
            .for_each(|object| object.track.history.retain(&known));
    }

    /// Finds the track that matches each object: one to one within a cell, the nearest first.
    fn compare(&mut self, tracks: &TrackStore, now: Timestamp, config: &TracksConfig) {
        let ids: BTreeSet<Uuid> = tracks.iter().map(|track| track.id).collect();
        let mut pairs = Vec::new();
        for (number, object) in self.objects.iter().enumerate() {
            let position = object.track.state.position_at(now);
            let reach_m = MERGE_M + CLOCK_ERROR_S * object.track.state.velocity.norm();
            let is_known = ids.contains(&object.track.id);
            tracks.near(&position, reach_m, |indexed| {
                let track = &tracks[indexed.track];
                if is_known && track.id == object.track.id {
                    pairs.push((0.0, number, indexed.track));
                } else if let Some(distance) = object
                    .distance_from(track, now, config)
                    .filter(|_| !is_known)
                {
                    pairs.push((distance, number, indexed.track));
                }
            });
        }
        pairs.sort_by(|a, b| {
            a.0.total_cmp(&b.0)
                .then_with(|| (a.1, a.2).cmp(&(b.1, b.2)))
        });
        let mut taken: BTreeSet<(&NodeName, TrackIndex)> = BTreeSet::new();
        let mut same: Vec<Option<Uuid>> = vec![None; self.objects.len()];
        for (_, number, track) in pairs {
            if same[number].is_none() && taken.insert((&self.objects[number].cell, track)) {
                same[number] = Some(tracks[track].id);
            }
        }
        for (object, same) in self.objects.iter_mut().zip(same) {
            let since = |id| {
                object
                    .same
                    .filter(|(known, _)| *known == id)
                    .map_or(now, |(_, since)| since)
            };
            object.same = same.map(|id| (id, since(id)));
        }
    }

    /// Lets tracks take over the identities of objects of proven cells.
    fn agree(&mut self, tracks: &mut TrackStore, now: Timestamp, fleet: &Fleet) {
        let mut ids: BTreeSet<Uuid> = tracks.iter().map(|track| track.id).collect();
        for object in &mut self.objects {
            let Some((id, since)) = object.same.filter(|(id, _)| *id != object.track.id) else {
                continue;
            };
            let agreed = now.since(since);
            if agreed < AGREES_AFTER || !self.trust.of(&object.cell).is_proven(fleet.reputation()) {
                continue;
            }
            let Some(track) = tracks.iter_mut().find(|track| track.id == id) else {
                continue;
            };
            let older_s = track.first_seen.micros_from(object.track.first_seen) as f64 * 1e-6;
            let is_tie = older_s.abs() <= TIE_S || agreed >= TIES_AFTER;
            let is_theirs = if is_tie {
                object.track.id < id
            } else {
                older_s > 0.0
            };
            if is_theirs && track.renames < MAX_RENAMES && ids.insert(object.track.id) {
                ids.remove(&id);
                track.id = object.track.id;
                track.renames += 1;
                track.first_seen = track.first_seen.min(object.track.first_seen);
                object.same = Some((track.id, since));
                self.hand_overs.renamed += 1;
            }
        }
    }

    /// True if an object is not published, because it matches a track of this cell or its cell is distrusted.
    pub(super) fn hides(&self, stated: &NeighbourObject, fleet: &Fleet) -> bool {
        let is_this = |object: &&NeighbourTrack| {
            object.track.id == stated.object.id && object.cell == stated.cell
        };
        let is_same = self
            .objects
            .iter()
            .find(is_this)
            .is_some_and(|object| object.same.is_some());
        is_same || !self.is_trusted(&stated.cell, fleet)
    }

    /// Weight of a cell's statements, 0 to 1.
    pub(super) fn trust(&self, cell: &NodeName, fleet: &Fleet) -> f64 {
        self.trust.of(cell).trust(fleet.reputation())
    }

    fn is_trusted(&self, cell: &NodeName, fleet: &Fleet) -> bool {
        self.trust(cell, fleet) > 0.0
    }

    /// The objects that their cells state as existing and whose position at `at` is observed, at most `max_each` per
    /// cell. Their histories have the observations of this cell's vehicles.
    pub(super) fn stated(
        &mut self,
        max_each: usize,
        at: Timestamp,
        is_observed: impl Fn(&Vector2<f64>) -> bool,
    ) -> impl Iterator<Item = &mut Track> {
        let mut left = BTreeMap::new();
        let observed = self.objects.iter_mut().filter(move |object| {
            object.is_stated() && is_observed(&object.track.state.position_at(at)) && {
                let left: &mut usize = left.entry(object.cell.clone()).or_insert(max_each);
                let has_room = *left > 0;
                *left = left.saturating_sub(1);
                has_room
            }
        });
        observed.map(|object| &mut object.track)
    }

    /// True if no neighbouring cell has an object.
    pub(super) fn is_empty(&self) -> bool {
        self.objects.is_empty()
    }

    /// Judges the statements that are due at `at`.
    pub(super) fn judge(&mut self, fleet: &Fleet, at: Timestamp) {
        for object in self
            .objects
            .iter_mut()
            .filter(|object| at.since(object.judged_at) >= JUDGED_AFTER)
        {
            object.judged_at = at;
            let judgement = Some(&object.track.history).filter(|_| object.is_stated());
            if let Some(judgement) = judgement.and_then(|history| fleet.judge_stated(history, at)) {
                let mut counts = self.trust.of(&object.cell);
                counts.count(judgement == Judgement::Correct, fleet.reputation());
                self.trust.keep([(object.cell.clone(), counts)]);
            }
        }
    }

    /// The object of a trusted cell that a new track at `measurement` continues, if no track continues the object yet.
    pub(super) fn find(
        &self,
        at: Timestamp,
        measurement: &Measurement,
        detected: Option<&PerceivedObject>,
        tracks: &TrackStore,
        fleet: &Fleet,
        config: &TracksConfig,
    ) -> Option<&NeighbourTrack> {
        let candidates = self.objects.iter().filter(|object| object.same.is_none());
        let near = candidates.filter_map(|object| {
            let innovation = object.track.state.innovation(at, measurement);
            let is_near = innovation.offset.norm() <= config.gate_m
                && innovation.distance_squared <= config.gate();
            let is_like = |detected| object.track.label_similarity(detected) > MIN_LABEL_SIMILARITY;
            (is_near && detected.is_none_or(is_like))
                .then_some((innovation.distance_squared, object))
        });
        // A distrusted cell, or a cell that copies identities, must not take precedence over other cells. From an unproven
        // cell only objects that this cell can verify are used.
        let usable = near.filter(|(_, object)| {
            let trust = self.trust.of(&object.cell);
            let is_believed = trust.trust(fleet.reputation()) > 0.0;
            is_believed
                && (object.is_stated() || trust.is_proven(fleet.reputation()))
                && tracks.iter().all(|track| track.id != object.track.id)
        });
        usable
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.track.id.cmp(&b.1.track.id)))
            .map(|(_, object)| object)
    }
}

impl NeighbourTrack {
    /// A track that begins with a measurement of this object at `at`.
    pub(super) fn lend(
        &self,
        at: Timestamp,
        measurement: &Measurement,
        config: &TracksConfig,
    ) -> Track {
        let mut track = Track::new(
            self.track.id,
            at,
            measurement,
            ObjectClass::of(&self.stated.object.label, config),
        );
        track.inherit(&self.stated.object, at);
        if let Some(velocity) = self.stated.object.velocity_mps {
            lend_velocity(&mut track.state, at, velocity.into());
        }
        track
    }
}

fn lend_velocity(state: &mut KinematicState, at: Timestamp, velocity: Vector2<f64>) {
    let sigma_mps = VELOCITY_SIGMA_MPS.hypot(VELOCITY_SIGMA_SHARE * velocity.norm());
    state.update_velocity(at, velocity, sigma_mps);
    state.limit_speed();
}
