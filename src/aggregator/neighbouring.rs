//! Objects of other cells, as they go into this cell's maps.

use std::collections::BTreeSet;
use std::sync::Arc;

use uuid::Uuid;

use super::date_objects;
use crate::model::time::Timestamp;
use crate::neighbours::MAX_AGE;
use crate::tracking::Tracker;
use crate::wire::{FusedObject, NeighbourObject};

/// The objects of other cells near this one, as last told.
#[derive(Debug, Clone, Default)]
pub(super) struct NeighbourView {
    objects: Arc<[NeighbourObject]>,
    /// When they were of the age that they state.
    stated_at: Timestamp,
}

impl NeighbourView {
    pub(super) fn new(objects: Arc<[NeighbourObject]>, stated_at: Timestamp) -> Self {
        Self { objects, stated_at }
    }

    /// Those that are not too old at `now`, believed, and none of this cell's `own` objects, each identity once.
    pub(super) fn shown(
        &self,
        own: &[FusedObject],
        tracks: Option<&Tracker>,
        now: Timestamp,
        cell_offset_us: i64,
    ) -> Vec<NeighbourObject> {
        let passed_s = now.since(self.stated_at).as_secs_f64();
        let mut known: BTreeSet<Uuid> = own.iter().map(|object| object.id).collect();
        let mut shown = Vec::new();
        for stated in &*self.objects {
            let age_s = stated.age_s + passed_s;
            let is_hidden = age_s > MAX_AGE.as_secs_f64() || tracks.is_some_and(|tracks| tracks.hides(stated));
            if !is_hidden && known.insert(stated.object.id) {
                shown.push(NeighbourObject { age_s, ..stated.clone() });
            }
        }
        shown.iter_mut().for_each(|stated| date_objects(std::slice::from_mut(&mut stated.object), cell_offset_us));
        shown
    }
}
