//! Objects of other cells, as they go into this cell's maps.

use std::collections::BTreeSet;
use std::sync::Arc;

use uuid::Uuid;

use super::date_objects;
use crate::model::time::Timestamp;
use crate::neighbours::MAX_AGE;
use crate::tracking::Tracker;
use crate::wire::{FusedObject, NeighbourObject};

/// Distance in metres between two cells' places of one object that stands.
const SAME_PLACE_M: f64 = 4.0;

/// Error in seconds of the ages of maps.
const CLOCK_ERROR_S: f64 = 0.2;

/// The objects of other cells near this cell, as last received.
#[derive(Debug, Clone, Default)]
pub(super) struct NeighbourView {
    objects: Arc<[NeighbourObject]>,
    /// Time at which the objects had the ages that they state.
    stated_at: Timestamp,
}

impl NeighbourView {
    pub(super) fn new(objects: Arc<[NeighbourObject]>, stated_at: Timestamp) -> Self {
        Self { objects, stated_at }
    }

    /// Returns the objects that are recent enough at `now`, credible, and different from this
    /// cell's `own` objects. Several cells that report one object count as one. If cells use one
    /// identity for different places, both objects are kept, so that neither cell can hide the
    /// other's object.
    pub(super) fn shown(
        &self,
        own: &[FusedObject],
        tracks: Option<&Tracker>,
        now: Timestamp,
        cell_offset_us: i64,
    ) -> Vec<NeighbourObject> {
        let passed_s = now.since(self.stated_at).as_secs_f64();
        let known: BTreeSet<Uuid> = own.iter().map(|object| object.id).collect();
        let mut shown: Vec<NeighbourObject> = Vec::new();
        for stated in &*self.objects {
            let age_s = stated.age_s + passed_s;
            let is_hidden =
                age_s > MAX_AGE.as_secs_f64() || tracks.is_some_and(|tracks| tracks.hides(stated));
            let is_stated = || {
                shown.iter().any(|other| {
                    other.object.id == stated.object.id && is_near(other, stated, age_s)
                })
            };
            if !is_hidden && !known.contains(&stated.object.id) && !is_stated() {
                shown.push(NeighbourObject {
                    age_s,
                    ..stated.clone()
                });
            }
        }
        shown.iter_mut().for_each(|stated| {
            date_objects(std::slice::from_mut(&mut stated.object), cell_offset_us);
        });
        shown
    }
}

/// True if two statements can refer to one object, considering the lower speed and their ages;
/// `age_s` is the age of the second statement.
fn is_near(other: &NeighbourObject, stated: &NeighbourObject, age_s: f64) -> bool {
    let a = &other.object;
    let b = &stated.object;
    let speeds = [a, b].map(|object| {
        object
            .velocity_mps
            .map_or(0.0, |[east, north]| east.hypot(north))
    });
    let speed_mps = f64::min(speeds[0], speeds[1]);
    (a.x_m - b.x_m).hypot(a.y_m - b.y_m)
        <= SAME_PLACE_M + speed_mps * ((other.age_s - age_s).abs() + CLOCK_ERROR_S)
}
