//! Detection history of one track: a slot for each vehicle that observed its place.

use std::time::Duration;

use smallvec::SmallVec;

use super::existence::{ObservationState, SensorHistory};
use super::handles::SensorId;
use crate::model::time::Timestamp;

/// Maximum number of vehicles in a track's history.
const MAX_SLOTS: usize = 32;

/// Time after the last observation of a vehicle after which its slot is free. If slots were free earlier, more than
/// [`MAX_SLOTS`] vehicles would replace each other before any of them could be judged.
const SLOT_KEPT: Duration = Duration::from_secs(1);

/// Detections and misses of one track by vehicle.
#[derive(Debug, Clone, Default)]
pub(super) struct DetectionHistory {
    /// Vehicles by slot, in a separate list: every observation searches the vehicles, and a history is some 20 times as
    /// large.
    sensors: SmallVec<[SensorId; 12]>,
    histories: Vec<SensorHistory>,
    /// Time until which no slot becomes free, once all are in use: a lower bound, because later observations extend it.
    occupied_until: Timestamp,
}

impl DetectionHistory {
    /// The histories of all vehicles.
    pub(super) fn iter(&self) -> impl Iterator<Item = &SensorHistory> {
        self.histories.iter()
    }

    pub(super) fn len(&self) -> usize {
        self.histories.len()
    }

    /// The history of a vehicle that has a slot.
    pub(super) fn get(&self, sensor: SensorId) -> Option<&SensorHistory> {
        self.slot_of(sensor).map(|slot| &self.histories[slot])
    }

    /// The history of a vehicle, if it has a slot.
    pub(super) fn get_mut(&mut self, sensor: SensorId) -> Option<&mut SensorHistory> {
        self.slot_of(sensor).map(|slot| &mut self.histories[slot])
    }

    /// State of a vehicle before its next observation.
    pub(super) fn state_of(&self, sensor: SensorId) -> ObservationState {
        self.get(sensor)
            .map_or(ObservationState::First, |history| history.state)
    }

    /// Whether a vehicle without a slot can have one.
    pub(super) fn has_room(&self, at: Timestamp) -> bool {
        self.histories.len() < MAX_SLOTS
            || at > self.occupied_until && self.next_free().is_some_and(|(_, until)| at > until)
    }

    /// The history of a vehicle that observes the place of the object, if there is room for the history.
    pub(super) fn for_observation(
        &mut self,
        sensor: SensorId,
        at: Timestamp,
    ) -> Option<&mut SensorHistory> {
        let slot = self.find_slot(sensor, at)?;
        Some(self.occupy(slot, sensor, at))
    }

    /// The history of a vehicle that detects the object. It may replace the history of a vehicle without detections.
    pub(super) fn for_hit(
        &mut self,
        sensor: SensorId,
        at: Timestamp,
    ) -> Option<&mut SensorHistory> {
        let slot = self.find_slot(sensor, at).or_else(|| {
            self.histories
                .iter()
                .position(|history| history.last_hit.is_none())
        })?;
        Some(self.occupy(slot, sensor, at))
    }

    pub(super) fn clear(&mut self) {
        self.sensors.clear();
        self.histories.clear();
    }

    /// Removes all vehicles for which `known` returns false.
    pub(super) fn retain(&mut self, known: impl Fn(SensorId) -> bool) {
        self.histories.retain(|history| known(history.sensor));
        self.sensors.retain(|sensor| known(*sensor));
    }

    /// Merges the history of a duplicate track. If both tracks have a history of a vehicle, the history with the later
    /// detection remains.
    pub(super) fn merge(&mut self, other: Self) {
        for theirs in other.histories {
            match self.slot_of(theirs.sensor) {
                Some(slot) if self.histories[slot].last_hit < theirs.last_hit => {
                    self.histories[slot] = theirs;
                }
                None if self.histories.len() < MAX_SLOTS => {
                    self.sensors.push(theirs.sensor);
                    self.histories.push(theirs);
                }
                _ => {}
            }
        }
        self.renew_bound();
    }

    fn slot_of(&self, sensor: SensorId) -> Option<usize> {
        self.sensors.iter().position(|occupant| *occupant == sensor)
    }

    /// The slot that a vehicle has or can have; `None` while all are in use.
    fn find_slot(&mut self, sensor: SensorId, at: Timestamp) -> Option<usize> {
        let mut free = Some(self.histories.len()).filter(|count| *count < MAX_SLOTS);
        if free.is_none() && at > self.occupied_until {
            let (slot, until) = self.next_free()?;
            self.occupied_until = until;
            free = (at > until).then_some(slot);
        }
        self.slot_of(sensor).or(free)
    }

    /// The slot that becomes free next, and the time until which it is in use.
    fn next_free(&self) -> Option<(usize, Timestamp)> {
        let observations = self.histories.iter().map(|history| history.observed_at);
        let (slot, observed_at) = observations
            .enumerate()
            .min_by_key(|(_, observed_at)| *observed_at)?;
        Some((slot, observed_at + SLOT_KEPT))
    }

    /// Renews the bound after a slot changes its vehicle.
    fn renew_bound(&mut self) {
        if self.histories.len() == MAX_SLOTS
            && let Some((_, until)) = self.next_free()
        {
            self.occupied_until = until;
        }
    }

    /// The history in a slot; a slot of another vehicle starts anew for `sensor`.
    fn occupy(&mut self, slot: usize, sensor: SensorId, at: Timestamp) -> &mut SensorHistory {
        if slot == self.histories.len() {
            self.sensors.push(sensor);
            self.histories.push(SensorHistory::new(sensor, at));
            self.renew_bound();
        } else if self.sensors[slot] != sensor {
            self.sensors[slot] = sensor;
            self.histories[slot] = SensorHistory::new(sensor, at);
            self.renew_bound();
        }
        &mut self.histories[slot]
    }
}
