//! Neighbouring cells: admits their maps and selects the objects near this cell.
//!
//! Call [`Neighbours::accept`] with every map of another cell and [`Neighbours::observe_own`] with
//! every map of this cell. When either call changed the state, pass the objects of
//! [`Neighbours::near`] to the aggregator by
//! [`Command::OnNeighbours`](crate::aggregator::Command::OnNeighbours). That command is
//! recorded, so replays are exact.
//!
//! - A cell may report objects in its own tile and within [`COVER_M`] around it. Objects elsewhere
//!   are refused and counted.
//! - Maps must arrive in the order of epoch and round, and be no older than [`MAX_AGE`].
//!   [`CellMapFilter`] determines their age.
//! - Objects are converted to this cell's frame through their place on Earth.
//!

mod area;
mod extent;
mod filter;
mod frame;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use nalgebra::Point2;

pub use area::CoveredArea;
pub use filter::{AdmittedMap, CellMapFilter, MAX_AGE};

use crate::model::names::NodeName;
use crate::model::origin::GeographicOrigin;
use crate::model::quadkey::Quadkey;
use crate::model::time::Timestamp;
use crate::wire::{CellMap, FusedObject, GlobalMap, NeighbourObject, RegionTopic, RejectReason};
use extent::Extent;
use frame::FrameChange;

/// Distance in metres from its tile up to which a cell may report objects. A cell with its origin
/// in the middle may be 600 m across, at any position within the tile.
pub const COVER_M: f64 = 300.0;

/// Maximum maps per second of one cell that a receiver decodes, twice as many as a neighbour sends
/// by default.
pub const MAX_MAP_HZ: u32 = 20;

/// Distance in metres from this cell's own area up to which objects of other cells are used: 7 s at
/// 50 km/h.
const MARGIN_M: f64 = 100.0;

/// Maximum number of neighbouring cells.
const MAX_CELLS: usize = 256;

/// Maximum number of objects of all neighbouring cells together. Each is compared with every
/// earlier object.
const MAX_OBJECTS: usize = 512;

/// Maximum number of objects of one cell, so that it leaves room for others.
const MAX_OBJECTS_EACH: usize = 128;

/// Maximum number of classes with scores per object; of an object with more scores, only the label
/// is used.
const MAX_SCORES: usize = 8;

/// Longest accepted tracking time of an object. The bound stops a cell from claiming an identity
/// with an early first-seen time.
const MAX_SEEN_FOR: Duration = Duration::from_secs(600);

/// Objects of accepted maps that were not used.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NeighbourLosses {
    /// Objects outside of the area that their cell may report.
    pub outside: u64,
    /// Beyond the maximum number.
    pub refused: u64,
}

/// The neighbours of one cell; see the [module](self).
#[derive(Debug, Clone)]
pub struct Neighbours {
    cell: NodeName,
    origin: GeographicOrigin,
    extent: Extent,
    filter: CellMapFilter,
    cells: BTreeMap<NodeName, NeighbourMap>,
    losses: BTreeMap<NodeName, NeighbourLosses>,
}

/// The newest map of a cell.
#[derive(Debug, Clone)]
struct NeighbourMap {
    /// When it was fused, by this node's clock.
    fused_at: Timestamp,
    /// The objects near this cell, in its frame; their times are by this node's clock.
    objects: Vec<FusedObject>,
}

impl Neighbours {
    /// Creates the state of a cell at `origin`, without neighbours.
    pub fn new(cell: NodeName, origin: GeographicOrigin) -> Self {
        Self {
            cell,
            origin,
            extent: Extent::default(),
            filter: CellMapFilter::new(MAX_CELLS),
            cells: BTreeMap::new(),
            losses: BTreeMap::new(),
        }
    }

    /// The tiles whose cells can be neighbours.
    pub fn tiles(&self) -> Vec<Quadkey> {
        Quadkey::of_cell(&self.origin).with_neighbours()
    }

    /// Processes a map of another cell that was received on `topic` and read at `received_at` by
    /// this node's steady clock.
    ///
    /// # Errors
    /// Returns the reason why the map is ignored. In this case only the estimate of that cell's
    /// clock may have changed.
    pub fn accept(
        &mut self,
        topic: &RegionTopic,
        message: CellMap,
        received_at: Timestamp,
    ) -> Result<(), RejectReason> {
        if message.cell == self.cell {
            return Err(RejectReason::NodeMismatch);
        }
        self.drop_silent(received_at);
        let AdmittedMap { age } = self.filter.admit(topic, &message, received_at)?;
        let CellMap {
            cell, origin, map, ..
        } = message;
        let fused_at = received_at - age;
        let clock_us = fused_at.micros_from(map.fused_at_us);
        let change = FrameChange::new(&origin, &self.origin);
        let area = CoveredArea::of(topic.tile);
        let losses = self.losses.entry(cell.clone()).or_default();
        let mut near = Vec::new();
        for mut object in map.objects {
            let place = origin.to_wgs84(object.x_m, object.y_m, 0.0);
            if !area.covers(&place) {
                losses.outside += 1;
                continue;
            }
            change.apply(&place, &mut object);
            let earliest = fused_at - MAX_SEEN_FOR;
            object.first_seen_us = object
                .first_seen_us
                .map(|first_seen| first_seen.shifted(clock_us).clamp(earliest, fused_at));
            object.contributors.clear();
            if object.scores.len() > MAX_SCORES {
                object.scores.clear();
            }
            // Values that are valid in the other cell's frame may be invalid in this one. Receivers
            // refuse a map with one wrong value.
            if object.validate().is_err() {
                losses.refused += 1;
                continue;
            }
            let distance_m = self.extent.distance_m(&Point2::new(object.x_m, object.y_m));
            if distance_m <= MARGIN_M {
                near.push((distance_m, object));
            }
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.id.cmp(&b.1.id)));
        let mut ids = BTreeSet::new();
        near.retain(|(_, object)| ids.insert(object.id));
        self.cells.remove(&cell);
        let held: usize = self.cells.values().map(|map| map.objects.len()).sum();
        let room = MAX_OBJECTS.saturating_sub(held).min(MAX_OBJECTS_EACH);
        losses.refused += near.len().saturating_sub(room) as u64;
        let objects = near
            .into_iter()
            .take(room)
            .map(|(_, object)| object)
            .collect();
        self.cells.insert(cell, NeighbourMap { fused_at, objects });
        Ok(())
    }

    /// Processes a map of this cell, closed at `now`, which shows the cell's area.
    pub fn observe_own(&mut self, map: &GlobalMap, now: Timestamp) {
        let objects = map
            .objects
            .iter()
            .map(|object| Point2::new(object.x_m, object.y_m));
        let places = map
            .landmarks
            .iter()
            .map(|place| Point2::new(place.x_m, place.y_m));
        self.extent.observe(objects.chain(places), now);
    }

    /// The objects of other cells near this cell, each cell's nearest first, as in their maps.
    pub fn near(&mut self, now: Timestamp) -> Vec<NeighbourObject> {
        self.drop_silent(now);
        let of_cell = |(cell, map): (&NodeName, &NeighbourMap)| {
            let cell = cell.clone();
            let age_s = now.since(map.fused_at).as_secs_f64();
            let objects = map.objects.clone().into_iter();
            objects.map(move |object| NeighbourObject {
                cell: cell.clone(),
                age_s,
                object,
            })
        };
        self.cells.iter().flat_map(of_cell).collect()
    }

    /// Number of objects by cell that were not used so far; cells that are silent for long are
    /// dropped.
    pub fn losses(&self) -> &BTreeMap<NodeName, NeighbourLosses> {
        &self.losses
    }

    fn drop_silent(&mut self, now: Timestamp) {
        self.cells
            .retain(|_, map| now.since(map.fused_at) <= MAX_AGE);
        self.filter.drop_silent(now);
        let filter = &self.filter;
        self.losses.retain(|cell, _| filter.has_cell(cell));
    }
}
