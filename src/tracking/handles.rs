//! Handles: small numbers that identify a vehicle or a track. Their owner decides how long they are valid.

/// Number of a vehicle that reports. Only `Sensors` creates it, and reuses it after it has removed the vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct SensorId(pub(super) u32);

impl SensorId {
    /// Index into tables by vehicle.
    pub(super) fn number(self) -> usize {
        self.0 as usize
    }
}

/// Position of a track in the store. Only `TrackStore` creates it. `TrackStore::retain` invalidates all handles.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct TrackIndex(pub(super) u32);
