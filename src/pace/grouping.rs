//! Regrouping of items from vehicles to places.

use std::sync::Arc;

use crate::model::names::NodeName;
use crate::perception::landmark::LandmarkIndex;

/// Index of something that vehicles observe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct Place(pub(super) u32);

impl Place {
    fn index(self) -> usize {
        self.0 as usize
    }
}

/// The current number of each place that belongs to a landmark which is still there, of
/// `per_landmark` places each.
pub(super) fn places_after(
    before: Arc<LandmarkIndex>,
    after: Arc<LandmarkIndex>,
    per_landmark: u32,
) -> impl Fn(Place) -> Option<Place> {
    move |Place(place)| {
        let landmark = before.landmarks().get((place / per_landmark) as usize)?;
        let now = u32::try_from(after.position_of(&landmark.id)?).ok()?;
        Some(Place(now * per_landmark + place % per_landmark))
    }
}

/// The items of one vehicle and the place of each. Places are stored separately from items, so that
/// regrouping reads only the places.
#[derive(Debug, Clone)]
pub(super) struct VehicleItems<'a, T> {
    pub(super) node: NodeName,
    pub(super) places: &'a [Place],
    pub(super) items: &'a [T],
}

/// Buffers of a counting sort by place, kept from round to round; its time is linear in items and
/// places.
#[derive(Debug, Clone, Default)]
pub(super) struct Grouping {
    /// (vehicle, item) by place.
    entries: Vec<(u32, u32)>,
    /// End of the entries of each place.
    ends: Vec<u32>,
}

/// Items grouped by place.
pub(super) struct ByPlace<'a, T> {
    vehicles: &'a [VehicleItems<'a, T>],
    grouping: &'a Grouping,
}

impl Grouping {
    /// Groups the vehicles' items for `places` places, keeping the order of vehicles and of their
    /// items within a place.
    pub(super) fn group<'a, T>(
        &'a mut self,
        vehicles: &'a [VehicleItems<'a, T>],
        places: usize,
    ) -> ByPlace<'a, T> {
        self.ends.clear();
        self.ends.resize(places + 1, 0);
        for place in vehicles.iter().flat_map(|vehicle| vehicle.places) {
            self.ends[place.index() + 1] += 1;
        }
        for place in 1..self.ends.len() {
            self.ends[place] += self.ends[place - 1];
        }
        self.entries.resize(self.ends[places] as usize, (0, 0));
        // The start of each place serves as its cursor and thus becomes its end.
        for (v, vehicle) in vehicles.iter().enumerate() {
            for (i, place) in vehicle.places.iter().enumerate() {
                let cursor = &mut self.ends[place.index()];
                self.entries[*cursor as usize] = (v as u32, i as u32);
                *cursor += 1;
            }
        }
        ByPlace {
            vehicles,
            grouping: self,
        }
    }
}

impl<'a, T> ByPlace<'a, T> {
    /// The items at a place with the names of their vehicles.
    pub(super) fn at(
        &self,
        place: Place,
    ) -> impl ExactSizeIterator<Item = (&'a NodeName, &'a T)> + Clone + '_ {
        let Grouping { entries, ends } = self.grouping;
        let start = if place.index() == 0 {
            0
        } else {
            ends[place.index() - 1]
        };
        entries[start as usize..ends[place.index()] as usize]
            .iter()
            .map(|&(vehicle, item)| {
                let vehicle = &self.vehicles[vehicle as usize];
                (&vehicle.node, &vehicle.items[item as usize])
            })
    }
}
