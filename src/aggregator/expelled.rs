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

#[derive(Debug, Clone, Default)]
pub(super) struct Expelled(BTreeMap<NodeName, Expulsion>);

#[derive(Debug, Clone, Copy)]
struct Expulsion {
    at: Timestamp,
    /// True if the vehicle reports again, with a new certificate.
    is_back: bool,
}

impl Expelled {
    /// Adds a vehicle. Reports that it makes after [`GRACE`], with a new certificate, count.
    pub(super) fn add(&mut self, vehicle: NodeName, now: Timestamp) {
        let expulsion = Expulsion {
            at: now,
            is_back: false,
        };
        self.0.insert(vehicle, expulsion);
    }

    /// Records that a report of a vehicle has been used.
    pub(super) fn record_report(&mut self, vehicle: &NodeName, now: Timestamp) {
        if let Some(expulsion) = self.0.get_mut(vehicle) {
            expulsion.is_back |= now > expulsion.at + GRACE;
        }
    }

    /// Removes the expelled vehicles from the contributors, and the objects that no other vehicle
    /// has detected. Objects of a vehicle that is back stay if they were detected more than
    /// [`GRACE`] after its expulsion.
    pub(super) fn remove_objects(&mut self, objects: &mut Vec<FusedObject>, now: Timestamp) {
        self.0
            .retain(|_, expulsion| now.since(expulsion.at) <= MEMORY);
        if self.0.is_empty() {
            return;
        }
        objects.retain_mut(|object| {
            if object.contributors.is_empty() {
                return true;
            }
            let age = Duration::from_secs_f64(object.age_s.unwrap_or(0.0).max(0.0));
            let is_void = |vehicle: &NodeName| {
                self.0
                    .get(vehicle)
                    .is_some_and(|expulsion| now - age <= expulsion.at + GRACE)
            };
            if object.contributors.iter().all(is_void) {
                return false;
            }
            let is_out =
                |vehicle: &NodeName| self.0.get(vehicle).is_some_and(|known| !known.is_back);
            object.contributors.retain(|vehicle| !is_out(vehicle));
            !object.contributors.is_empty()
        });
    }
}
