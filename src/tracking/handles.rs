//! Handles: small numbers that stand for a vehicle or a track, for as long as its owner says.

/// Number of a vehicle that is heard. `Sensors` alone creates it, and frees it for another vehicle when it forgets this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct SensorId(pub(super) u32);

impl SensorId {
    /// Index into tables by vehicle.
    pub(super) fn number(self) -> usize {
        self.0 as usize
    }
}

/// Position of a track in the store. `TrackStore` alone creates it. Nothing keeps one across `TrackStore::retain`, which
/// invalidates it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct TrackIndex(pub(super) u32);
