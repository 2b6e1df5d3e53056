//! Offset between two steady clocks from exchanged stamps: NTP's clock filter (RFC 5905, section
//! 10).

use std::collections::VecDeque;
use std::time::Duration;

use crate::model::time::Timestamp;

/// The latest exchanges with one node. The exchange with the smallest error is used.
#[derive(Debug, Clone, Default)]
pub struct OffsetFilter(VecDeque<OffsetSample>);

/// The four stamps of an exchange: this node sends, the other receives, the other sends, this node
/// receives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Exchange {
    pub(super) t1: Timestamp,
    pub(super) t2: Timestamp,
    pub(super) t3: Timestamp,
    pub(super) t4: Timestamp,
}

/// The other node's steady clock minus this node's steady clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Offset {
    pub(super) offset_us: i64,
    /// Maximum error in microseconds: half the round-trip delay plus the drift since the exchange.
    pub(super) error_us: u32,
}

#[derive(Debug, Clone)]
struct OffsetSample {
    offset_us: i64,
    /// Round-trip delay in microseconds.
    delay_us: u64,
    at: Timestamp,
}

impl OffsetFilter {
    /// Adds an exchange. Exchanges with impossible stamps are ignored.
    pub(super) fn observe(&mut self, Exchange { t1, t2, t3, t4 }: Exchange) {
        let delay_us = t4.micros_from(t1).saturating_sub(t3.micros_from(t2));
        let (Ok(delay_us), true) = (u64::try_from(delay_us), t3 >= t2) else {
            return;
        };
        let offset_us = t2.micros_from(t1).saturating_add(t3.micros_from(t4)) / 2;
        if self.0.len() >= SAMPLES {
            self.0.pop_front();
        }
        self.0.push_back(OffsetSample {
            offset_us,
            delay_us,
            at: t4,
        });
    }

    /// The offset by the best exchange, including the drift since then.
    pub(super) fn best(&self, now: Timestamp) -> Option<Offset> {
        let error = |sample: &OffsetSample| {
            sample.delay_us / 2 + now.since(sample.at).as_micros() as u64 * DRIFT / 1_000_000
        };
        let best = self.0.iter().min_by_key(|sample| error(sample))?;
        let error_us = u32::try_from(error(best)).unwrap_or(u32::MAX);
        (Duration::from_micros(error_us.into()) <= MAX_ERROR).then_some(Offset {
            offset_us: best.offset_us,
            error_us,
        })
    }
}

/// Number of exchanges kept (RFC 5905, figure 17: `NSTAGE`).
const SAMPLES: usize = 8;

/// Largest drift between two clocks in parts per million; cheap quartz at the ends of its
/// temperature range.
const DRIFT: u64 = 100;

/// Maximum error of an offset that is used.
const MAX_ERROR: Duration = Duration::from_secs(1);
