//! Share of the vehicles whose reports are usable by their time.

/// Numbers of the vehicles that were heard lately.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Timeliness {
    /// Vehicles whose reports are admitted.
    pub timely: usize,
    /// Vehicles whose reports have been rejected for their time, and nothing else, for a while.
    pub untimely: usize,
}

impl Timeliness {
    /// True if an aggregator can work with these reports. If nearly all vehicles seem wrong, the fault is
    /// the aggregator's. A single vehicle proves nothing: it must not depose a leader.
    pub fn is_usable(self) -> bool {
        self.untimely < 2 || 4 * self.timely >= self.untimely
    }
}
