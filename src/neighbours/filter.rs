//! The order and the age of cells' maps.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::admission::minimum_delay::MinimumDelay;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::quadkey::Quadkey;
use crate::model::time::Timestamp;
use crate::wire::{CellMap, RegionTopic, RegionTopicKind, RejectReason};

/// Maximum age of a map, and of the objects in it. At 2 Hz it outlives the loss of one map.
pub const MAX_AGE: Duration = Duration::from_millis(1500);

/// Time without a shorter delay from which the least one counts. Delays of a burst of old maps get
/// shorter and shorter.
const SETTLES_AFTER: Duration = Duration::from_secs(1);

/// Differences of delays below this value, in microseconds, count as jitter.
const JITTER_US: i64 = 100_000;

/// Silence after which a cell and its epoch are dropped.
const DROPPED_AFTER: Duration = Duration::from_secs(60);

/// Time span for which delays are stored, to distinguish a lasting backlog from a clock offset.
const BACKLOG_SPAN: Duration = Duration::from_secs(120);

/// Time between two checks for a backlog.
const BACKLOG_PERIOD: Duration = Duration::from_secs(1);

/// Minimum number of cells that show a backlog.
const MIN_BACKLOG_CELLS: usize = 3;

/// Admits maps of cells: each must be newer than the previous map by epoch and round, and no older
/// than [`MAX_AGE`].
///
/// The clocks of cells differ. A map's age is therefore its delay in excess of the least delay of
/// this cell's maps. The delay is measured by the sender's clock and by the cell's time, and the
/// lower age is used: the sender may be new, and the cell's time may jump. Until one of the two
/// least delays is established, about a second after a cell's first map, its maps are ignored.
///
/// A lasting backlog looks like a clock that is behind by the same time. However, the clocks of
/// different cells do not change together. A delay is therefore a backlog if three quarters of the
/// cells, and at least three cells, have it. The backlog is added to the age of each map with that
/// delay, for two to four minutes.
#[derive(Debug, Clone)]
pub struct CellMapFilter {
    max_cells: usize,
    backlog: Duration,
    checked_at: Timestamp,
    cells: BTreeMap<NodeName, CellOrder>,
}

/// A map that counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AdmittedMap {
    /// Its age when it was received, beyond the least time that a map takes.
    pub age: Duration,
}

/// Order and delays of a cell's maps.
#[derive(Debug, Clone)]
struct CellOrder {
    epoch: Epoch,
    round: u64,
    /// Delays by the clock of the epoch's sender.
    by_sender: DelayEstimate,
    /// Delays by the cell's time, which outlives leaders.
    by_cell: DelayEstimate,
    received_at: Timestamp,
}

/// The least delay by one clock.
#[derive(Debug, Clone)]
struct DelayEstimate {
    least: MinimumDelay,
    /// The least delay of the last minutes.
    least_long: MinimumDelay,
    /// A recent delay in microseconds, and the time since which no delay was much shorter.
    usual_us: i64,
    since: Timestamp,
}

impl CellMapFilter {
    /// Creates a filter for at most `max_cells` cells.
    pub fn new(max_cells: usize) -> Self {
        Self {
            max_cells,
            backlog: Duration::ZERO,
            checked_at: Timestamp::default(),
            cells: BTreeMap::new(),
        }
    }

    /// Admits a map that was received on `topic` and read at `received_at` by this node's steady
    /// clock.
    ///
    /// # Errors
    /// Returns the reason why the map is ignored. In this case only the estimate of that cell's
    /// clock may have changed.
    pub fn admit(
        &mut self,
        topic: &RegionTopic,
        message: &CellMap,
        received_at: Timestamp,
    ) -> Result<AdmittedMap, RejectReason> {
        let CellMap {
            cell,
            sent_at_us,
            origin,
            map,
            ..
        } = message;
        // A cell is in one tile, and its broker lets it write there only.
        let is_own = topic.cell == *cell
            && topic.tile == Quadkey::of_cell(origin)
            && topic.kind == RegionTopicKind::Map;
        if !is_own {
            return Err(RejectReason::NodeMismatch);
        }
        if self.cells.len() >= self.max_cells && !self.cells.contains_key(cell) {
            self.drop_silent(received_at);
            if self.cells.len() >= self.max_cells {
                return Err(RejectReason::TooManyCells);
            }
        }
        if received_at.since(self.checked_at) >= BACKLOG_PERIOD {
            self.backlog = self.find_backlog(received_at);
            self.checked_at = received_at;
        }
        let epoch = Epoch::new(map.epoch, map.aggregator.clone());
        let first = || CellOrder::new(epoch.clone(), received_at);
        let order = self.cells.entry(cell.clone()).or_insert_with(first);
        if epoch < order.epoch {
            return Err(RejectReason::Superseded);
        }
        if epoch == order.epoch && map.round <= order.round {
            return Err(RejectReason::OutOfOrder);
        }
        if epoch != order.epoch {
            order.by_sender = DelayEstimate::new(received_at);
        }
        order.epoch = epoch;
        order.round = map.round;
        order.received_at = received_at;
        let ages = [
            (&mut order.by_sender, *sent_at_us),
            (&mut order.by_cell, map.fused_at_us),
        ]
        .map(|(delay, stamp)| delay.observe(received_at.micros_from(stamp), received_at));
        let backlog = self.backlog.min(order.lag());
        let age = ages
            .into_iter()
            .flatten()
            .min()
            .ok_or(RejectReason::Stale)?
            + backlog;
        if age > MAX_AGE {
            Err(RejectReason::Stale)
        } else {
            Ok(AdmittedMap { age })
        }
    }

    /// The recent additional delay, compared to the last minutes, that three quarters of the cells
    /// share.
    fn find_backlog(&self, now: Timestamp) -> Duration {
        let heard = self
            .cells
            .values()
            .filter(|order| now.since(order.received_at) <= MAX_AGE);
        let mut lags: Vec<_> = heard.map(CellOrder::lag).collect();
        lags.sort_unstable();
        let common = lags
            .get(lags.len() / 4)
            .filter(|_| lags.len() >= MIN_BACKLOG_CELLS);
        common.copied().unwrap_or_default()
    }

    /// Drops cells that have been silent for a minute.
    pub fn drop_silent(&mut self, now: Timestamp) {
        self.cells
            .retain(|_, order| now.since(order.received_at) <= DROPPED_AFTER);
    }

    /// True if a map of the cell arrived recently.
    pub fn has_cell(&self, cell: &NodeName) -> bool {
        self.cells.contains_key(cell)
    }
}

impl CellOrder {
    fn new(epoch: Epoch, now: Timestamp) -> Self {
        let by_sender = DelayEstimate::new(now);
        let by_cell = DelayEstimate::new(now);
        // Rounds begin with 1.
        Self {
            epoch,
            round: 0,
            by_sender,
            by_cell,
            received_at: now,
        }
    }

    /// The recent least delay in excess of the least delay of the last minutes, by the clock for
    /// which it is smaller; zero for jitter.
    fn lag(&self) -> Duration {
        let lag_us = self.by_sender.lag_us().min(self.by_cell.lag_us());
        Duration::from_micros(if lag_us > JITTER_US {
            lag_us.unsigned_abs()
        } else {
            0
        })
    }
}

impl DelayEstimate {
    fn new(now: Timestamp) -> Self {
        let least_long = MinimumDelay::over(BACKLOG_SPAN, now);
        Self {
            least: MinimumDelay::new(now),
            least_long,
            usual_us: i64::MAX,
            since: now,
        }
    }

    /// Records a delay; returns its excess over the least delay, once the least delay is
    /// established.
    fn observe(&mut self, delay_us: i64, now: Timestamp) -> Option<Duration> {
        self.least.observe(delay_us, now);
        self.least_long.observe(delay_us, now);
        let least_us = self.least.least();
        if least_us < self.usual_us.saturating_sub(JITTER_US) {
            self.usual_us = least_us;
            self.since = now;
        }
        self.usual_us = self.usual_us.max(least_us);
        let beyond_us = delay_us.saturating_sub(least_us);
        (now.since(self.since) >= SETTLES_AFTER)
            .then(|| Duration::from_micros(beyond_us.unsigned_abs()))
    }

    /// The recent least delay in excess of the least delay of the last minutes, in microseconds.
    fn lag_us(&self) -> i64 {
        self.least.least().saturating_sub(self.least_long.least())
    }
}
