//! Landmarks of an open cell, which reports name: room that vehicles share.

use std::collections::{BTreeMap, VecDeque};

use crate::model::names::{LandmarkId, NodeName};

/// Names of landmarks with the vehicles that named them first.
#[derive(Debug, Clone, Default)]
pub(super) struct NamedLandmarks {
    /// By vehicle, `None` for landmarks of a former list; each vehicle's oldest landmark is first.
    by_vehicle: BTreeMap<Option<NodeName>, VecDeque<LandmarkId>>,
    /// Number of landmarks of all vehicles.
    len: usize,
}

impl NamedLandmarks {
    /// Adds a landmark. If there are `max` already, drops and returns the oldest landmark of the
    /// vehicle with most, so that a vehicle that invents names only replaces its own.
    pub(super) fn add(
        &mut self,
        landmark: &LandmarkId,
        vehicle: Option<&NodeName>,
        max: usize,
    ) -> Option<LandmarkId> {
        let vehicle = vehicle.cloned();
        let mut dropped = None;
        if self.len >= max {
            let most = self.by_vehicle.iter_mut().max_by_key(|(owner, named)| {
                let is_own = **owner == vehicle;
                (named.len() + usize::from(is_own), is_own)
            });
            dropped = most.and_then(|(_, named)| named.pop_front());
            self.by_vehicle.retain(|_, named| !named.is_empty());
        }
        self.len = self.len + 1 - usize::from(dropped.is_some());
        self.by_vehicle
            .entry(vehicle)
            .or_default()
            .push_back(landmark.clone());
        dropped
    }

    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inventive_vehicle_replaces_own_names() {
        let mut named = NamedLandmarks::default();
        let [euclid, gauss] = ["euclid", "gauss"].map(NodeName::from_static);
        let mut add = |vehicle: &NodeName, name: String| named.add(&name.into(), Some(vehicle), 10);
        for number in 0..3 {
            assert_eq!(add(&euclid, format!("e{number}")), None);
        }
        let dropped: Vec<_> = (0..100)
            .filter_map(|number| add(&gauss, format!("g{number}")))
            .collect();
        assert_eq!(dropped.len(), 93);
        assert!(dropped.iter().all(|name| name.as_str().starts_with('g')));
        let dropped: Vec<_> = (3..8)
            .filter_map(|number| add(&euclid, format!("e{number}")))
            .collect();
        let own = dropped.iter().filter(|name| name.as_str().starts_with('e'));
        assert_eq!(
            (dropped.len(), own.count()),
            (5, 3),
            "half of the room each"
        );
    }

    #[test]
    fn room_of_single_names_stays_bounded() {
        let mut named = NamedLandmarks::default();
        for vehicle in 0..10 {
            let vehicle = NodeName::new(format!("a{vehicle}")).unwrap();
            assert_eq!(
                named.add(&vehicle.as_str().into(), Some(&vehicle), 10),
                None
            );
        }
        let last = NodeName::from_static("z");
        let dropped: Vec<_> = (0..100)
            .filter_map(|number| named.add(&format!("z{number}").into(), Some(&last), 10))
            .collect();
        assert_eq!(dropped.len(), 100);
        assert_eq!(dropped[0].as_str(), "a9");
        assert_eq!(dropped[1].as_str(), "z0");
    }
}
