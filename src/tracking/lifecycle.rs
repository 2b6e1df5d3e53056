//! Lifecycle of tracks between reports: merging duplicates, pruning, and taking over another aggregator's map.

use std::collections::BTreeSet;
use std::time::Duration;

use nalgebra::Vector2;
use uuid::Uuid;

use super::assignment::UNKNOWN_RATE;
use super::class::ObjectClass;
use super::config::TracksConfig;
use super::existence::{ObservationState, SensorHistory};
use super::handles::TrackIndex;
use super::kinematics::{Measurement, VELOCITY_SIGMA_MPS};
use super::sensors::Sensors;
use super::store::TrackStore;
use super::track::Track;
use crate::model::geometry::Covariance;
use crate::model::time::Timestamp;
use crate::wire::{FusedObject, GlobalMap, ObjectReport};

/// Maximum distance of two tracks of one object, metres.
pub(super) const MERGE_M: f64 = 2.0;

/// Maximum distance of two tracks of one object with different labels, metres: people get in and out of cars, and stand
/// next to each other.
const MERGE_UNLIKE_M: f64 = 1.0;

/// Maximum number of later tracks that are compared with each track.
const MAX_NEAR_EACH: usize = 32;

/// Maximum distance of two tracks of one object in standard deviations.
const MERGE_SIGMAS: f64 = 3.0;

/// Time for which a silent vehicle is kept after its last object.
const REMEMBERED: Duration = Duration::from_secs(10);

/// Maximum existence at which an unconfirmed track ends.
const MIN_EXISTENCE: f64 = 0.005;

/// Merges tracks of one object; the older track remains.
pub(super) fn merge(
    tracks: &mut TrackStore,
    sensors: &Sensors,
    now: Timestamp,
    config: &TracksConfig,
) {
    tracks.reindex(now);
    let mut merged = BTreeSet::new();
    for (older, later) in near_pairs(tracks, now, config) {
        let rate = |history: &SensorHistory| {
            let sensor = sensors.get(history.sensor);
            sensor
                .and_then(|sensor| sensor.coverage.rates_at(&history.position))
                .map_or(UNKNOWN_RATE, |rates| rates.rate(ObservationState::Hit))
        };
        let mut twins = std::mem::take(&mut tracks[older].twins);
        let other = &tracks[later];
        twins.weigh(&tracks[older].history, &other.history, other.id, now, rate);
        let is_twin = twins.is_twin(other.id);
        tracks[older].twins = twins;
        if is_twin && !merged.contains(&older) && merged.insert(later) {
            tracks.merge(older, later);
        }
    }
    tracks.retain(|index, _| !merged.contains(&index));
}

/// Pairs of tracks that may be one object, the older track first.
fn near_pairs(
    tracks: &TrackStore,
    now: Timestamp,
    config: &TracksConfig,
) -> Vec<(TrackIndex, TrackIndex)> {
    let mut pairs = Vec::new();
    for (older, track) in tracks.indexed() {
        let position = track.state.position_at(now);
        let mut others = 0;
        tracks.near(&position, MERGE_M, |indexed| {
            let later = indexed.track;
            if later > older
                && others < MAX_NEAR_EACH
                && may_be_one(track, &tracks[later], now, config)
            {
                others += 1;
                pairs.push((older, later));
            }
        });
    }
    pairs
}

/// True if two tracks are near enough at `now` to be one object. Two vehicles that report their own
/// poses are different objects; tracks with different labels must be nearer.
fn may_be_one(track: &Track, other: &Track, now: Timestamp, config: &TracksConfig) -> bool {
    let distance_m = (other.state.position_at(now) - track.state.position_at(now)).norm();
    let are_vehicles = track.vehicle.is_some() && other.vehicle.is_some();
    if distance_m >= MERGE_M || are_vehicles {
        return false;
    }
    let covariance = track.state.covariance_at(now) + other.state.covariance_at(now);
    let is_close = distance_m * distance_m < MERGE_SIGMAS.powi(2) * covariance.trace() / 2.0;
    is_close && (distance_m < MERGE_UNLIKE_M || track.label(config) == other.label(config))
}

/// Removes tracks of objects that have disappeared, and vehicles that have been silent for longer than a track can
/// last.
pub(super) fn prune(
    tracks: &mut TrackStore,
    sensors: &mut Sensors,
    now: Timestamp,
    config: &TracksConfig,
) {
    let [life, latent] = [config.life_s, config.latent_s].map(Duration::from_secs_f64);
    tracks.retain(|_, track| {
        let unseen = now.since(track.last_seen);
        let is_kept = if track.is_confirmed() {
            unseen <= latent
        } else {
            unseen <= life && track.existence.probability() >= MIN_EXISTENCE
        };
        if !is_kept {
            if !track.is_settled {
                sensors.settle(track.spawned_by, false);
            } else if let Some(sensor) = track.spawned_by.and_then(|id| sensors.get_mut(id)) {
                sensor.population.leave();
            }
        }
        is_kept
    });
    if sensors.drop_silent(now - latent - REMEMBERED) {
        tracks.retain_vehicles(|vehicle| sensors.get(vehicle).is_some());
    }
}

/// Takes over the objects of another aggregator's map, received at `now`: identities for existing tracks, and new
/// tracks, whose existence fades, for the other objects.
pub(super) fn adopt_map(
    tracks: &mut TrackStore,
    map: &GlobalMap,
    now: Timestamp,
    config: &TracksConfig,
) {
    tracks.reindex(now);
    let stated: BTreeSet<Uuid> = map.objects.iter().map(|object| object.id).collect();
    let mut known: BTreeSet<Uuid> = tracks.iter().map(|track| track.id).collect();
    for object in &map.objects {
        if !known.insert(object.id) {
            continue;
        }
        let measurement = measurement(object, config);
        let mut nearest: Option<(TrackIndex, f64)> = None;
        tracks.near(&measurement.position, MERGE_M, |indexed| {
            let track = &tracks[indexed.track];
            let distance_m = (track.state.position_at(now) - measurement.position).norm();
            let is_nearest = nearest.is_none_or(|(_, nearest_m)| distance_m < nearest_m);
            if distance_m < MERGE_M && is_nearest && !stated.contains(&track.id) {
                nearest = Some((indexed.track, distance_m));
            }
        });
        if let Some((track, _)) = nearest {
            tracks[track].id = object.id;
            continue;
        }
        let class = ObjectClass::of(&object.label, config);
        let mut track = Track::new(object.id, now, &measurement, class);
        if let Some([x, y]) = object.velocity_mps {
            track
                .state
                .update_velocity(now, Vector2::new(x, y), VELOCITY_SIGMA_MPS);
        }
        track.state.limit_speed();
        track.inherit(object, now);
        tracks.add(track);
    }
}

pub(super) fn measurement(object: &FusedObject, config: &TracksConfig) -> Measurement {
    let floor = Covariance::isotropic(config.noise_floor_m);
    Measurement {
        position: Vector2::new(object.x_m, object.y_m),
        independent: (object.covariance() + floor).matrix(),
        common_m: ObjectClass::of(&object.label, config).common_m,
    }
}

/// Identity of the track that object `index` of a report spawns: a UUID of version 8, equal on every aggregator.
///
/// It is the 128-bit FNV-1a hash of the object's name (draft-eastlake-fnv). Maps and logs contain it, so the hash must
/// not change.
pub(super) fn track_id(report: &ObjectReport, index: usize) -> Uuid {
    const OFFSET: u128 = 0x6c62_272e_07bb_0142_62b8_2175_6295_c58d;
    const PRIME: u128 = 0x0000_0000_0100_0000_0000_0000_0000_013b;
    let numbers = [report.captured_at_us.micros(), report.seq, index as u64];
    let bytes = report
        .node
        .as_str()
        .bytes()
        .chain([0])
        .chain(numbers.into_iter().flat_map(u64::to_be_bytes));
    let hash = bytes.fold(OFFSET, |hash, byte| {
        (hash ^ u128::from(byte)).wrapping_mul(PRIME)
    });
    Uuid::new_v8(hash.to_be_bytes())
}
