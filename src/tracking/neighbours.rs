//! Neighbours of a track, and how often vehicles resolve them as two objects.

use std::time::Duration;

use smallvec::SmallVec;
use uuid::Uuid;

use crate::model::time::Timestamp;

/// Weight of one look in the resolved share.
const LOOK_WEIGHT: f64 = 0.25;

/// Minimum resolved share of two separate objects. A detector's duplicates have less.
const MIN_RESOLVED: f64 = 0.5;

/// Time for which a neighbour is remembered.
const REMEMBERED: Duration = Duration::from_secs(1);

/// Neighbours of one track.
#[derive(Debug, Clone, Default)]
pub(super) struct TrackNeighbours(SmallVec<[Neighbour; 1]>);

#[derive(Debug, Clone)]
struct Neighbour {
    id: Uuid,
    /// Share of the latest looks at either that resolved both, 0 to 1.
    resolved: f64,
    at: Timestamp,
}

impl TrackNeighbours {
    /// Records a detection of either at `at`, and whether one vehicle resolved both in one frame.
    pub(super) fn observe(&mut self, id: Uuid, is_resolved: bool, at: Timestamp) {
        self.0
            .retain(|neighbour| at.since(neighbour.at) <= REMEMBERED);
        match self.0.iter_mut().find(|neighbour| neighbour.id == id) {
            Some(neighbour) if neighbour.at < at => {
                neighbour.resolved +=
                    LOOK_WEIGHT * (f64::from(u8::from(is_resolved)) - neighbour.resolved);
                neighbour.at = at;
            }
            Some(_) => {}
            None if is_resolved => self.0.push(Neighbour {
                id,
                resolved: LOOK_WEIGHT,
                at,
            }),
            None => {}
        }
    }

    /// Merges the neighbours of another track of the same object, whose identity is `own`.
    pub(super) fn merge(&mut self, others: Self, own: Uuid) {
        for theirs in others.0.into_iter().filter(|theirs| theirs.id != own) {
            match self
                .0
                .iter_mut()
                .find(|neighbour| neighbour.id == theirs.id)
            {
                Some(neighbour) if neighbour.resolved < theirs.resolved => *neighbour = theirs,
                Some(_) => {}
                None => self.0.push(theirs),
            }
        }
    }

    /// Whether a neighbour was resolved often enough to be a separate object.
    pub(super) fn is_separate(&self, id: Uuid, now: Timestamp) -> bool {
        let known =
            |neighbour: &&Neighbour| neighbour.id == id && now.since(neighbour.at) <= REMEMBERED;
        self.0
            .iter()
            .find(known)
            .is_some_and(|neighbour| neighbour.resolved >= MIN_RESOLVED)
    }
}
