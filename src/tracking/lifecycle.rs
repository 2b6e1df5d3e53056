//! Lifecycle of tracks between reports: merging duplicates, pruning, and taking over another aggregator's map.

use std::collections::BTreeSet;
use std::time::Duration;

use nalgebra::Vector2;
use uuid::Uuid;

use super::config::TracksConfig;
use super::handles::TrackIndex;
use super::kinematics::Measurement;
use super::sensors::Sensors;
use super::store::TrackStore;
use super::track::Track;
use crate::model::geometry::Covariance;
use crate::model::time::Timestamp;
use crate::wire::{FusedObject, GlobalMap, ObjectReport};

/// Maximum distance of two tracks of one object, metres.
pub(super) const MERGE_M: f64 = 2.0;

/// The same in metres if their labels differ: people get in and out of cars, and stand beside each other.
const MERGE_UNLIKE_M: f64 = 1.0;

/// The same in standard deviations.
const MERGE_SIGMAS: f64 = 3.0;

/// Time for which a silent vehicle is remembered after its last object.
const REMEMBERED: Duration = Duration::from_secs(10);

/// Minimum survival probability of a track.
const MIN_SURVIVAL: f64 = 0.02;

/// Two tracks near each other.
struct Neighbouring {
    older: TrackIndex,
    later: TrackIndex,
    /// Whether a vehicle resolves them as two objects.
    is_resolved: bool,
}

/// Merges tracks of one object: near each other, and not resolved by a vehicle. The older one stays.
pub(super) fn merge(tracks: &mut TrackStore, now: Timestamp, config: &TracksConfig) {
    tracks.reindex(now);
    let neighbouring = neighbouring(tracks, now);
    for Neighbouring {
        older,
        later,
        is_resolved,
    } in &neighbouring
    {
        let (id, seen) = (tracks[*later].id, tracks[*later].last_seen);
        let track = &mut tracks[*older];
        track
            .neighbours
            .observe(id, *is_resolved, seen.max(track.last_seen));
    }
    let mut merged = BTreeSet::new();
    for Neighbouring {
        older,
        later,
        is_resolved,
    } in neighbouring
    {
        // A merge before may have separated the older track from this one.
        let is_candidate = !is_resolved && !merged.contains(&older) && !merged.contains(&later);
        if is_candidate && is_same(&tracks[older], &tracks[later], now, config) {
            tracks.merge(older, later);
            merged.insert(later);
        }
    }
    tracks.retain(|index, _| !merged.contains(&index));
}

fn neighbouring(tracks: &TrackStore, now: Timestamp) -> Vec<Neighbouring> {
    let mut neighbouring = Vec::new();
    for (older, track) in tracks.indexed() {
        let position = track.state.position_at(now);
        tracks.near(&position, MERGE_M, |indexed| {
            let (later, other) = (indexed.track, &tracks[indexed.track]);
            if later > older && (other.state.position_at(now) - position).norm() < MERGE_M {
                neighbouring.push(Neighbouring {
                    older,
                    later,
                    is_resolved: track.is_resolved_from(other),
                });
            }
        });
    }
    neighbouring
}

fn is_same(track: &Track, other: &Track, now: Timestamp, config: &TracksConfig) -> bool {
    let distance_m = (other.state.position_at(now) - track.state.position_at(now)).norm();
    let are_vehicles = track.vehicle.is_some() && other.vehicle.is_some();
    let are_unlike = track.label(config) != other.label(config) && distance_m >= MERGE_UNLIKE_M;
    if are_vehicles
        || are_unlike
        || track.is_resolved_from(other)
        || track.neighbours.is_separate(other.id, now)
    {
        return false;
    }
    let density = config.density();
    let covariance =
        track.state.covariance_at(now, density) + other.state.covariance_at(now, density);
    distance_m * distance_m < MERGE_SIGMAS.powi(2) * covariance.trace() / 2.0
}

/// Removes tracks of objects that have disappeared, and vehicles that have been silent for longer than any track lives.
pub(super) fn prune(
    tracks: &mut TrackStore,
    sensors: &mut Sensors,
    now: Timestamp,
    config: &TracksConfig,
) {
    let life = Duration::from_secs_f64(config.life_s);
    tracks.retain(|_, track| {
        now.since(track.last_seen) <= life && track.survival(now) > MIN_SURVIVAL
    });
    if sensors.forget_silent(now - life - REMEMBERED) {
        tracks.retain_vehicles(|vehicle| sensors.get(vehicle).is_some());
    }
}

/// Takes over the objects of another aggregator's map, received at `now`: the identities of known objects, and unknown
/// objects as tracks whose existence fades.
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
        let mut track = Track::new(object.id, now, &measurement, config);
        if let Some([x, y]) = object.velocity_mps {
            track
                .state
                .update_velocity(now, Vector2::new(x, y), 1.0, config.density());
        }
        track.state.limit_speed(config.max_speed_mps);
        track.inherit(object, now);
        tracks.add(track);
    }
}

pub(super) fn measurement(object: &FusedObject, config: &TracksConfig) -> Measurement {
    let floor = Covariance::isotropic(config.noise_floor_m);
    Measurement {
        position: Vector2::new(object.x_m, object.y_m),
        independent: (object.covariance() + floor).matrix(),
        common_m: config.common_m,
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
