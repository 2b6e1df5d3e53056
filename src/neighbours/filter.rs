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

/// Time without a shorter delay from which the least one counts. Delays of a burst of old maps get shorter and shorter.
const SETTLES_AFTER: Duration = Duration::from_secs(1);

/// Difference of delays in microseconds that is no news.
const JITTER_US: i64 = 100_000;

/// Silence after which a cell is forgotten, with its epoch.
const FORGOTTEN_AFTER: Duration = Duration::from_secs(60);

/// Span over which delays are remembered, to tell a backlog that lasts from clocks.
const BACKLOG_SPAN: Duration = Duration::from_secs(120);

/// Time between two looks for a backlog.
const BACKLOG_PERIOD: Duration = Duration::from_secs(1);

/// Minimum number of cells that show a backlog.
const MIN_BACKLOG_CELLS: usize = 3;

/// Admits maps of cells: each newer than the one before by epoch and round, and none older than [`MAX_AGE`].
///
/// The clocks of cells differ. A map's age is therefore its delay beyond the least that maps of this cell take. It goes by
/// the sender's clock or by the cell's time, whichever makes it younger: the one may be new, the other may jump. While
/// neither is known, no map counts: for a second from the first map of a cell on.
///
/// A backlog that lasts looks like a clock that is as much behind. But clocks of cells do not change together. So a delay is a
/// backlog if three quarters of the cells, and three at least, have it. It adds to the age of each map that is as late, for two
/// to four minutes.
#[derive(Debug, Clone)]
pub struct CellMapFilter {
    max_cells: usize,
    backlog: Duration,
    looked_at: Timestamp,
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
    /// The least one of the last minutes.
    least_long: MinimumDelay,
    /// A delay in microseconds of late, and since when none was much shorter.
    usual_us: i64,
    since: Timestamp,
}

impl CellMapFilter {
    /// A filter for so many cells at most.
    pub fn new(max_cells: usize) -> Self {
        Self {
            max_cells,
            backlog: Duration::ZERO,
            looked_at: Timestamp::default(),
            cells: BTreeMap::new(),
        }
    }

    /// Admits a map that came on `topic` and was read at `received_at` by this node's steady clock.
    ///
    /// # Errors
    /// The reason why it does not count; at most the estimate of that cell's clock has changed.
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
            self.forget_silent(received_at);
            if self.cells.len() >= self.max_cells {
                return Err(RejectReason::TooManyCells);
            }
        }
        if received_at.since(self.looked_at) >= BACKLOG_PERIOD {
            (self.backlog, self.looked_at) = (self.find_backlog(received_at), received_at);
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
        (order.epoch, order.round, order.received_at) = (epoch, map.round, received_at);
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

    /// The delay beyond that of the last minutes that three quarters of the cells share.
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

    /// Forgets cells that have been silent for a minute.
    pub fn forget_silent(&mut self, now: Timestamp) {
        self.cells
            .retain(|_, order| now.since(order.received_at) <= FORGOTTEN_AFTER);
    }

    /// True if a map of the cell came lately.
    pub fn knows(&self, cell: &NodeName) -> bool {
        self.cells.contains_key(cell)
    }
}

impl CellOrder {
    fn new(epoch: Epoch, now: Timestamp) -> Self {
        let (by_sender, by_cell) = (DelayEstimate::new(now), DelayEstimate::new(now));
        // Rounds begin with 1.
        Self {
            epoch,
            round: 0,
            by_sender,
            by_cell,
            received_at: now,
        }
    }

    /// The least delay of late beyond that of the last minutes, by the clock that makes it shorter; none for jitter.
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

    /// Takes a delay; returns what it is beyond the least one, if that is known.
    fn observe(&mut self, delay_us: i64, now: Timestamp) -> Option<Duration> {
        self.least.observe(delay_us, now);
        self.least_long.observe(delay_us, now);
        let least_us = self.least.least();
        if least_us < self.usual_us.saturating_sub(JITTER_US) {
            (self.usual_us, self.since) = (least_us, now);
        }
        self.usual_us = self.usual_us.max(least_us);
        let beyond_us = delay_us.saturating_sub(least_us);
        (now.since(self.since) >= SETTLES_AFTER)
            .then(|| Duration::from_micros(beyond_us.unsigned_abs()))
    }

    /// The least delay of late beyond that of the last minutes, in microseconds.
    fn lag_us(&self) -> i64 {
        self.least.least().saturating_sub(self.least_long.least())
    }
}
