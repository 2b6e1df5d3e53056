//! Objects that turn out to be one are joined.

use std::time::Duration;

use smallvec::SmallVec;
use uuid::Uuid;

use super::Tracker;
use super::track::Track;
use crate::time::Timestamp;

/// Two objects are never taken for one beyond this distance in metres.
pub(super) const SAME_M: f64 = 2.0;

/// Nor beyond this one if they bear different labels: people get in and out of cars, and stand beside each other.
const SAME_OF_OTHER_LABEL_M: f64 = 1.0;

/// Nor beyond this distance in standard deviations.
const SAME_SIGMAS: f64 = 3.0;

/// What each look counts in how often two objects are told apart.
const SHARE: f64 = 0.25;

/// How often two objects beside each other have to be told apart to be two: a detector's duplicates are fewer.
const APART: f64 = 0.5;

/// How long it is remembered that they were.
const REMEMBERED: Duration = Duration::from_secs(1);

/// Objects beside one, and how often they were told apart from it of late.
#[derive(Debug, Clone, Default)]
pub(super) struct Neighbours(SmallVec<[Neighbour; 1]>);

#[derive(Debug, Clone)]
struct Neighbour {
    id: Uuid,
    /// Part of the latest looks at either that told them apart.
    share: f64,
    at: Timestamp,
}

impl Neighbours {
    /// Either was detected at `at`, and one vehicle detected both in one frame or none did.
    fn observe(&mut self, id: Uuid, are_apart: bool, at: Timestamp) {
        self.0.retain(|neighbour| at.since(neighbour.at) <= REMEMBERED);
        match self.0.iter_mut().find(|neighbour| neighbour.id == id) {
            Some(neighbour) if neighbour.at < at => {
                neighbour.share += SHARE * (f64::from(u8::from(are_apart)) - neighbour.share);
                neighbour.at = at;
            }
            Some(_) => {}
            None if are_apart => self.0.push(Neighbour { id, share: SHARE, at }),
            None => {}
        }
    }

    /// What was told apart from another that turns out to be `own` was told apart from that.
    pub(super) fn absorb(&mut self, others: Self, own: Uuid) {
        for theirs in others.0.into_iter().filter(|theirs| theirs.id != own) {
            match self.0.iter_mut().find(|mine| mine.id == theirs.id) {
                Some(mine) if mine.share < theirs.share => *mine = theirs,
                Some(_) => {}
                None => self.0.push(theirs),
            }
        }
    }

    /// Whether the other has been told apart often enough to be another.
    fn is_another(&self, id: Uuid, now: Timestamp) -> bool {
        let known = |neighbour: &&Neighbour| neighbour.id == id && now.since(neighbour.at) <= REMEMBERED;
        self.0.iter().find(known).is_some_and(|neighbour| neighbour.share >= APART)
    }
}

/// Two tracks beside each other, by their numbers.
struct Beside {
    older: usize,
    later: usize,
    /// Whether a vehicle tells them apart.
    are_apart: bool,
}

impl Tracker {
    /// Joins objects that are one: near each other, and not told apart by a vehicle. The older stays.
    pub(super) fn join(&mut self, now: Timestamp) {
        self.index(now);
        let besides = self.besides(now);
        for Beside { older, later, are_apart } in &besides {
            let (id, seen) = (self.tracks[*later].id, self.tracks[*later].last_seen);
            let track = &mut self.tracks[*older];
            track.neighbours.observe(id, *are_apart, seen.max(track.last_seen));
        }
        let mut is_joined = vec![false; self.tracks.len()];
        for Beside { older, later, are_apart } in besides {
            // What has taken another in may now be told apart from the third.
            if !are_apart && !is_joined[older] && !is_joined[later] && self.are_one(older, later, now) {
                let absorbed = self.tracks[later].clone();
                self.tracks[older].absorb(absorbed);
                is_joined[later] = true;
            }
        }
        let mut is_joined = is_joined.into_iter();
        self.tracks.retain(|_| is_joined.next() == Some(false));
    }

    fn besides(&self, now: Timestamp) -> Vec<Beside> {
        let mut besides = Vec::new();
        for (older, track) in self.tracks.iter().enumerate() {
            let position = track.motion.position_at(now);
            self.grid.around(&position, SAME_M, |point| {
                let later = point.number as usize;
                let other = &self.tracks[later];
                if later > older && (other.motion.position_at(now) - position).norm() < SAME_M {
                    besides.push(Beside { older, later, are_apart: track.is_told_apart(other) });
                }
            });
        }
        besides
    }

    fn are_one(&self, older: usize, later: usize, now: Timestamp) -> bool {
        let (track, other): (&Track, &Track) = (&self.tracks[older], &self.tracks[later]);
        let distance_m = (other.motion.position_at(now) - track.motion.position_at(now)).norm();
        let are_vehicles = track.vehicle.is_some() && other.vehicle.is_some();
        let are_unlike = track.label(&self.config) != other.label(&self.config) && distance_m >= SAME_OF_OTHER_LABEL_M;
        if are_vehicles || are_unlike || track.is_told_apart(other) || track.neighbours.is_another(other.id, now) {
            return false;
        }
        let density = self.config.density();
        let covariance = track.motion.covariance_at(now, density) + other.motion.covariance_at(now, density);
        distance_m * distance_m < SAME_SIGMAS.powi(2) * covariance.trace() / 2.0
    }
}
