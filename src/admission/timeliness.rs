//! Share of the vehicles whose reports are usable by their time.

/// Numbers of the recently active vehicles.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Timeliness {
    /// Vehicles whose reports are admitted.
    pub timely: usize,
    /// Vehicles whose reports have been rejected because of their time only, for a while.
    pub untimely: usize,
}

impl Timeliness {
    /// True if an aggregator can work with these reports. If nearly all vehicles seem wrong, the
    /// fault is the aggregator's. A single vehicle is not sufficient evidence, because it must not
    /// depose a leader.
    pub fn is_usable(self) -> bool {
        self.untimely < 2 || 4 * self.timely >= self.untimely
    }
}
