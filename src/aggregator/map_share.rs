//! The share of one vehicle in the map: objects that no other vehicle sees take a bounded part of
//! it.

use std::collections::BTreeMap;

use crate::model::names::NodeName;
use crate::wire::{FusedObject, InvalidEntry, RejectReason};

/// Maximum number of objects in a map that only one vehicle has reported, including its parts: as
/// many as one report may have. Without this bound, one member's reports could make the map too
/// large for the links to carry once per round.
pub const MAX_SOLE_OBJECTS: usize = 1024;

/// Removes the objects beyond each vehicle's share, the least certain first, and returns the
/// removed entries.
pub(super) fn limit_shares(objects: &mut Vec<FusedObject>) -> Vec<InvalidEntry> {
    if objects.len() <= MAX_SOLE_OBJECTS {
        return Vec::new();
    }
    let mut confidences: BTreeMap<NodeName, Vec<f64>> = BTreeMap::new();
    for object in &*objects {
        if let [vehicle] = &object.contributors[..] {
            confidences
                .entry(vehicle.clone())
                .or_default()
                .push(object.confidence);
        }
    }
    // The confidence that objects of a vehicle must exceed, and the number of objects with exactly
    // this confidence that are kept.
    let mut bounds: BTreeMap<NodeName, (f64, usize)> = BTreeMap::new();
    for (vehicle, mut of_vehicle) in confidences {
        if of_vehicle.len() > MAX_SOLE_OBJECTS {
            of_vehicle.sort_by(|a, b| b.total_cmp(a));
            let bound = of_vehicle[MAX_SOLE_OBJECTS - 1];
            let above = of_vehicle
                .iter()
                .filter(|confidence| **confidence > bound)
                .count();
            bounds.insert(vehicle, (bound, MAX_SOLE_OBJECTS - above));
        }
    }
    let mut removed = Vec::new();
    objects.retain(|object| {
        let [vehicle] = &object.contributors[..] else {
            return true;
        };
        let Some((bound, room)) = bounds.get_mut(vehicle) else {
            return true;
        };
        if object.confidence > *bound {
            return true;
        }
        if object.confidence == *bound && *room > 0 {
            *room -= 1;
            return true;
        }
        removed.push(InvalidEntry {
            reason: RejectReason::TooManyObjects,
            contributors: vec![vehicle.clone()],
        });
        false
    });
    removed
}

#[cfg(test)]
mod tests {
    use uuid::Uuid;

    use super::*;
    use crate::model::geometry::Covariance;

    fn object(number: usize, confidence: f64, contributors: &[&'static str]) -> FusedObject {
        let covariance = Covariance::isotropic(0.3);
        let contributors = contributors
            .iter()
            .map(|name| NodeName::from_static(name))
            .collect();
        FusedObject {
            contributors,
            ..FusedObject::new(
                Uuid::from_u128(number as u128),
                "car",
                confidence,
                number as f64,
                0.0,
                covariance,
            )
        }
    }

    #[test]
    fn one_vehicle_fills_its_share_and_the_objects_of_others_stay() {
        let invented =
            (0..5000).map(|number| object(number, 0.2 + 0.0001 * number as f64, &["mallory"]));
        let honest = (5000..5100).map(|number| object(number, 0.01, &["euclid"]));
        let shared = (5100..9000).map(|number| object(number, 0.01, &["euclid", "mallory"]));
        let mut objects: Vec<_> = invented.chain(honest).chain(shared).collect();
        let removed = limit_shares(&mut objects);
        assert_eq!(removed.len(), 5000 - MAX_SOLE_OBJECTS);
        assert!(
            removed
                .iter()
                .all(|entry| entry.contributors == [NodeName::from_static("mallory")])
        );
        let of = |names: &[&'static str]| {
            let names: Vec<_> = names
                .iter()
                .map(|name| NodeName::from_static(name))
                .collect();
            objects
                .iter()
                .filter(|object| object.contributors == names)
                .count()
        };
        assert_eq!(
            [
                of(&["mallory"]),
                of(&["euclid"]),
                of(&["euclid", "mallory"])
            ],
            [MAX_SOLE_OBJECTS, 100, 3900]
        );
        let least_certain = objects
            .iter()
            .filter(|object| object.contributors.len() == 1);
        let least_certain =
            least_certain.filter(|object| object.contributors[0].as_str() == "mallory");
        assert!(
            least_certain
                .map(|object| object.confidence)
                .fold(1.0, f64::min)
                > 0.59
        );
    }

    #[test]
    fn of_equally_certain_objects_the_first_stay() {
        let mut objects: Vec<_> = (0..2000)
            .map(|number| object(number, 0.5, &["mallory"]))
            .collect();
        assert_eq!(limit_shares(&mut objects).len(), 2000 - MAX_SOLE_OBJECTS);
        assert_eq!(objects.last().unwrap().x_m, (MAX_SOLE_OBJECTS - 1) as f64);
    }
}
