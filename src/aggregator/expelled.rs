//! Vehicles whose certificates were revoked or have expired. Objects that only these vehicles have
//! reported leave the map at once, although tracks outlive their last detection by seconds.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::FusedObject;

/// Time for which an expelled vehicle is kept: objects are published for at most this time after
/// their last detection.
const MEMORY: Duration = Duration::from_secs(60);

/// Time for which reports of an expelled vehicle may still arrive, and by which its stamps may be
/// ahead.
const GRACE: Duration = Duration::from_millis(500);

/// Expelled vehicles, each with the time of its expulsion.
#[derive(Debug, Clone, Default)]
pub(super) struct Expelled(BTreeMap<NodeName, Timestamp>);

impl Expelled {
    /// Adds a vehicle. Reports that it makes after [`GRACE`], with a new certificate, count.
    pub(super) fn add(&mut self, vehicle: NodeName, now: Timestamp) {
        self.0.insert(vehicle, now);
    }

    /// Removes the objects that no other vehicle has detected, unless they were detected more than
    /// [`GRACE`] after the expulsion.
    pub(super) fn remove_objects(&mut self, objects: &mut Vec<FusedObject>, now: Timestamp) {
        self.0.retain(|_, at| now.since(*at) <= MEMORY);
        if self.0.is_empty() {
            return;
        }
        objects.retain(|object| {
            let age = Duration::from_secs_f64(object.age_s.unwrap_or(0.0).max(0.0));
            let is_void = |vehicle| {
                self.0
                    .get(vehicle)
                    .is_some_and(|at| now - age <= *at + GRACE)
            };
            object.contributors.is_empty() || !object.contributors.iter().all(is_void)
        });
    }
}
