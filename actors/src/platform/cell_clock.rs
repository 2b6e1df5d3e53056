//! The cell's time relative to the node's steady clock, for all parts that date messages.

use std::sync::{Arc, Mutex, PoisonError};

use ecod::leadership::cell_time::{ClockReading, EARLIEST};
use ecod::model::time::Timestamp;

/// The node's current reading of the cell's time, shared by all clones.
#[derive(Debug, Clone, Default)]
pub struct CellClock(Arc<Mutex<ClockReading>>);

impl CellClock {
    /// The current offset to the cell's time, and its error.
    pub fn reading(&self) -> ClockReading {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the reading. A change of less than a millisecond is noise and is ignored.
    pub fn show(&self, reading: ClockReading) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let moved_us = reading
            .offset_us
            .saturating_sub(shown.offset_us)
            .saturating_abs();
        let offset_us = if moved_us >= NOISE_US {
            reading.offset_us
        } else {
            shown.offset_us
        };
        *shown = ClockReading {
            offset_us,
            ..reading
        };
    }

    /// A time of [`clock::now`](super::clock::now) in the cell's time.
    pub fn date(&self, at: Timestamp) -> Timestamp {
        at.shifted(self.reading().offset_us)
    }

    /// A date by the steady clock: the opposite of [`Self::date`].
    pub fn undate(&self, date: Timestamp) -> Timestamp {
        date.shifted(self.reading().offset_us.saturating_neg())
    }

    /// A time of the steady clock in the cell's time; `None` if that time comes from a clock that
    /// was not set.
    pub fn date_if_set(&self, at: Timestamp) -> Option<Timestamp> {
        Some(self.date(at)).filter(|date| *date >= EARLIEST)
    }
}

const NOISE_US: i64 = 1_000;
