//! What happens to the objects between reports: they are indexed, those that are gone are forgotten, and those of
//! another aggregator's map taken over.

use std::collections::BTreeSet;
use std::time::Duration;

use nalgebra::Vector2;
use uuid::Uuid;

use super::Tracker;
use super::grid::Point;
use super::joining::SAME_M;
use super::kinematics::Measurement;
use super::sensors::Source;
use super::track::Track;
use crate::geometry::Covariance;
use crate::time::Timestamp;
use crate::wire::{FusedObject, GlobalMap};

/// How long a silent vehicle is remembered after its last object.
const REMEMBERED: Duration = Duration::from_secs(10);

/// Probability of being there below which an unseen object is forgotten.
const LEAST_PRESENCE: f64 = 0.02;

impl Tracker {
    /// Adds an object unless there is no room for it; says where.
    pub(super) fn add(&mut self, track: Track) -> Option<usize> {
        let position = track.motion.position;
        let crowd = self.grid.crowd(&position, self.config.gate_m);
        if self.tracks.len() >= self.config.max_tracks || crowd >= self.config.max_density {
            self.refused += 1;
            return None;
        }
        let index = self.tracks.len();
        self.fastest_mps = self.fastest_mps.max(track.motion.velocity.norm());
        let (at, velocity) = (track.motion.position_at(self.indexed_at), track.motion.velocity);
        self.grid.insert(Point { at, velocity, number: index as u32 });
        self.tracks.push(track);
        Some(index)
    }

    /// Indexes the objects where they are at `at`.
    pub(super) fn index(&mut self, at: Timestamp) {
        self.indexed_at = at;
        self.fastest_mps = self.tracks.iter().map(|track| track.motion.velocity.norm()).fold(0.0, f64::max);
        self.grid.clear();
        self.own.clear();
        for (index, track) in self.tracks.iter().enumerate() {
            self.own.extend(track.vehicle.map(|number| (number, index as u32)));
            let (at, velocity) = (track.motion.position_at(at), track.motion.velocity);
            self.grid.insert(Point { at, velocity, number: index as u32 });
        }
    }

    /// How far any object may have gone at `at` from where it is indexed.
    pub(super) fn drift_m(&self, at: Timestamp) -> f64 {
        self.fastest_mps * (at.micros_from(self.indexed_at) as f64 * 1e-6).abs()
    }

    /// The same with what the round's reports move an object by as a rule; a new one may be moved farther, and is found
    /// there from the next round on.
    pub(super) fn slack_m(&self, at: Timestamp) -> f64 {
        self.drift_m(at) + self.config.gate_m / 2.0
    }

    /// Forgets objects that are gone, and vehicles that have been silent for longer than any object lives,
    /// save what their word is worth.
    pub(super) fn forget(&mut self, now: Timestamp) {
        let life = Duration::from_secs_f64(self.config.life_s);
        self.tracks.retain(|track| now.since(track.last_seen) <= life && track.presence(now) > LEAST_PRESENCE);
        let limit = now - life - REMEMBERED;
        let silent = |slot: &Option<Box<Source>>| slot.as_ref().is_some_and(|source| source.last_report < limit);
        if !self.sources.iter().any(silent) {
            return;
        }
        let mut forgotten = Vec::new();
        for slot in self.sources.iter_mut().filter(|slot| silent(slot)) {
            if let Some(source) = slot.take() {
                self.numbers.remove(&source.node);
                forgotten.push((source.node, source.standing));
            }
        }
        self.standings.keep(forgotten);
        for track in &mut self.tracks {
            track.witnesses.keep(|number| self.sources[number as usize].is_some());
            track.vehicle = track.vehicle.filter(|number| self.sources[*number as usize].is_some());
        }
    }

    /// Takes over the objects of another aggregator's map, received at `now`: its identities for those known by
    /// another, and those unknown, on its word, which fades.
    pub fn adopt_map(&mut self, map: &GlobalMap, now: Timestamp) {
        self.index(now);
        let stated: BTreeSet<Uuid> = map.objects.iter().map(|object| object.id).collect();
        let mut known: BTreeSet<Uuid> = self.tracks.iter().map(|track| track.id).collect();
        for object in &map.objects {
            if !known.insert(object.id) {
                continue;
            }
            let seen = self.inherited(object);
            let mut nearest: Option<(usize, f64)> = None;
            self.grid.around(&seen.position, SAME_M, |point| {
                let track = &self.tracks[point.number as usize];
                let distance_m = (track.motion.position_at(now) - seen.position).norm();
                let is_nearest = nearest.is_none_or(|(_, least_m)| distance_m < least_m);
                if distance_m < SAME_M && is_nearest && !stated.contains(&track.id) {
                    nearest = Some((point.number as usize, distance_m));
                }
            });
            match nearest {
                Some((track, _)) => self.tracks[track].id = object.id,
                None => {
                    let mut track = Track::new(object.id, now, &seen, &self.config);
                    if let Some([x, y]) = object.velocity_mps {
                        track.motion.update_velocity(now, Vector2::new(x, y), 1.0, self.config.density());
                    }
                    track.motion.limit_speed(self.config.max_speed_mps);
                    track.inherit(object, now);
                    self.add(track);
                }
            }
        }
    }

    fn inherited(&self, object: &FusedObject) -> Measurement {
        let floor = Covariance::isotropic(self.config.noise_floor_m);
        Measurement {
            position: Vector2::new(object.x_m, object.y_m),
            independent: (object.covariance() + floor).matrix(),
            common_m: self.config.common_m,
        }
    }
}
