//! Owner of the tracks: the only module that creates a [`TrackIndex`].

use std::ops::{Index, IndexMut};

use hashbrown::HashMap;
use nalgebra::Vector2;

use super::config::TracksConfig;
use super::grid::{IndexedTrack, TrackGrid};
use super::handles::{SensorId, TrackIndex};
use super::track::Track;
use crate::model::time::Timestamp;

/// The tracks, the oldest first, with indexes by position and by vehicle.
#[derive(Debug, Clone)]
pub(super) struct TrackStore {
    tracks: Vec<Track>,
    grid: TrackGrid,
    /// Time of the grid's positions.
    indexed_at: Timestamp,
    /// Speed of the fastest track since the time of the grid, m/s.
    fastest_mps: f64,
    /// The track of each vehicle that reports its pose.
    of_vehicle: HashMap<SensorId, TrackIndex>,
    /// Number of sole tracks by the vehicle that began them: unconfirmed tracks, and tracks that only it has detected.
    sole: HashMap<SensorId, usize>,
    max_tracks: usize,
    max_density: usize,
    gate_m: f64,
    /// Number of tracks that were refused because the store was full.
    pub(super) refused: u64,
}

/// The store has this many shares. The sole tracks of one vehicle use at most one share.
const SHARES: usize = 8;

/// A square has room for this many times `max_density`, which limits the sole tracks of one vehicle.
const SQUARE_SHARES: usize = 2;

impl TrackStore {
    pub(super) fn new(config: &TracksConfig) -> Self {
        let TracksConfig {
            max_tracks,
            max_density,
            gate_m,
            ..
        } = *config;
        Self {
            tracks: Vec::new(),
            grid: TrackGrid::new(gate_m),
            indexed_at: Timestamp(0),
            fastest_mps: 0.0,
            of_vehicle: HashMap::new(),
            sole: HashMap::new(),
            max_tracks,
            max_density,
            gate_m,
            refused: 0,
        }
    }

    /// Changes the limits. Tracks above a lower limit are kept.
    pub(super) fn configure(&mut self, config: &TracksConfig) {
        let Self {
            max_tracks,
            max_density,
            gate_m,
            grid,
            ..
        } = Self::new(config);
        self.max_tracks = max_tracks;
        self.max_density = max_density;
        self.gate_m = gate_m;
        self.grid = grid;
        self.reindex(self.indexed_at);
    }

    pub(super) fn len(&self) -> usize {
        self.tracks.len()
    }

    /// All tracks, the oldest first.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Track> {
        self.tracks.iter()
    }

    /// All tracks, mutable. Their indices remain valid.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut Track> {
        self.tracks.iter_mut()
    }

    /// All tracks with their indices, the oldest first.
    pub(super) fn indexed(&self) -> impl Iterator<Item = (TrackIndex, &Track)> {
        self.tracks
            .iter()
            .enumerate()
            .map(|(index, track)| (TrackIndex(index as u32), track))
    }

    /// Adds a track unless the store, the place or the share of the vehicle that alone has detected
    /// the object is full.
    pub(super) fn add(&mut self, track: Track) -> Option<TrackIndex> {
        let of_spawner = track.spawned_by.and_then(|vehicle| self.sole.get(&vehicle));
        let has_share = of_spawner.is_none_or(|tracks| *tracks < self.max_tracks.div_ceil(SHARES));
        if self.tracks.len() >= self.max_tracks || !has_share || self.is_crowded_for(&track) {
            self.refused += 1;
            return None;
        }
        if let Some(vehicle) = track.spawned_by {
            *self.sole.entry(vehicle).or_default() += 1;
        }
        let index = TrackIndex(self.tracks.len() as u32);
        self.grid.insert(track.indexed(index, self.indexed_at));
        self.tracks.push(track);
        self.record_speed(index);
        Some(index)
    }

    /// True if the square around a new track is full, or full of sole tracks of the vehicle that began
    /// the new one.
    fn is_crowded_for(&self, track: &Track) -> bool {
        let crowd = self.grid.crowd(&track.state.position);
        let is_sole_of_spawner = |other: &&TrackIndex| {
            let other = &self[**other];
            track.spawned_by.is_some() && other.spawned_by == track.spawned_by && other.is_sole()
        };
        crowd.len() >= self.max_density
            && (crowd.len() >= SQUARE_SHARES * self.max_density
                || crowd.iter().filter(is_sole_of_spawner).count() >= self.max_density)
    }

    /// Indexes all tracks by their positions at `at`.
    pub(super) fn reindex(&mut self, at: Timestamp) {
        self.indexed_at = at;
        self.fastest_mps = self
            .tracks
            .iter()
            .map(|track| track.state.velocity.norm())
            .fold(0.0, f64::max);
        self.clear_indexes();
        for (number, track) in self.tracks.iter().enumerate() {
            let index = TrackIndex(number as u32);
            self.of_vehicle
                .extend(track.vehicle.map(|vehicle| (vehicle, index)));
            self.grid.insert(track.indexed(index, at));
            if let Some(vehicle) = track.spawned_by.filter(|_| track.is_sole()) {
                *self.sole.entry(vehicle).or_default() += 1;
            }
        }
    }

    /// Indexes all tracks again if a track may be too far from its indexed position at `at`.
    pub(super) fn reindex_if_stale(&mut self, at: Timestamp) {
        if self.drift_m(at) > self.gate_m / 2.0 {
            self.reindex(at);
        }
    }

    /// Maximum distance of a track at `at` from its indexed position.
    fn drift_m(&self, at: Timestamp) -> f64 {
        self.fastest_mps * self.seconds_since_indexed(at).abs()
    }

    /// Seconds from the time of the grid to `at`, negative before it.
    pub(super) fn seconds_since_indexed(&self, at: Timestamp) -> f64 {
        at.micros_from(self.indexed_at) as f64 * 1e-6
    }

    /// Maximum distance of most tracks at `at` from their indexed positions, metres.
    ///
    /// Updates of the round may have moved a track by half a gate. A new track may have moved farther; the next index
    /// contains it.
    pub(super) fn slack_m(&self, at: Timestamp) -> f64 {
        self.drift_m(at) + self.gate_m / 2.0
    }

    /// Visits the tracks whose indexed position is within `reach_m` of a position.
    pub(super) fn near(
        &self,
        position: &Vector2<f64>,
        reach_m: f64,
        visit: impl FnMut(&IndexedTrack),
    ) {
        self.grid.near(position, reach_m, visit);
    }

    /// Records that a track's velocity has changed.
    pub(super) fn record_speed(&mut self, index: TrackIndex) {
        self.fastest_mps = self.fastest_mps.max(self[index].state.velocity.norm());
    }

    /// The track of a vehicle that reports its pose.
    pub(super) fn of_vehicle(&self, vehicle: SensorId) -> Option<TrackIndex> {
        self.of_vehicle.get(&vehicle).copied()
    }

    /// Records the vehicle to which a track belongs.
    pub(super) fn set_vehicle(&mut self, index: TrackIndex, vehicle: SensorId) {
        self.of_vehicle.insert(vehicle, index);
        self[index].vehicle = Some(vehicle);
    }

    /// Merges the later track into the older track. The later track is removed by the next [`Self::retain`].
    pub(super) fn merge(&mut self, older: TrackIndex, later: TrackIndex) {
        let merged = self[later].clone();
        self[older].merge(merged);
    }

    /// Removes the tracks that do not match and clears the indexes; every [`TrackIndex`] is invalid afterwards.
    pub(super) fn retain(&mut self, mut keep: impl FnMut(TrackIndex, &Track) -> bool) {
        let mut number = 0;
        self.tracks.retain(|track| {
            number += 1;
            keep(TrackIndex(number - 1), track)
        });
        self.clear_indexes();
    }

    /// Removes the vehicles for which `known` returns false.
    pub(super) fn retain_vehicles(&mut self, known: impl Fn(SensorId) -> bool) {
        for track in &mut self.tracks {
            track.history.retain(&known);
            track.vehicle = track.vehicle.filter(|vehicle| known(*vehicle));
            track.spawned_by = track.spawned_by.filter(|vehicle| known(*vehicle));
        }
        self.of_vehicle.clear();
    }

    fn clear_indexes(&mut self) {
        self.grid.clear();
        self.sole.clear();
        self.of_vehicle.clear();
    }
}

impl Index<TrackIndex> for TrackStore {
    type Output = Track;

    fn index(&self, index: TrackIndex) -> &Track {
        &self.tracks[index.0 as usize]
    }
}

impl IndexMut<TrackIndex> for TrackStore {
    fn index_mut(&mut self, index: TrackIndex) -> &mut Track {
        &mut self.tracks[index.0 as usize]
    }
}
