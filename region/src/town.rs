//! The latest of each cell of a region.

mod bounds;
mod read_tiles;
mod snapshot;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::time::Duration;

pub use bounds::{GeographicBounds, InvalidBounds};
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::{CELL_TILE_DIGITS, Quadkey};
use ecod::model::time::Timestamp;
use ecod::neighbours::{CellMapFilter, CoveredArea, MAX_AGE, MAX_MAP_HZ};
use ecod::wire::{
    CellDescription, CellMap, FusedObject, GlobalMap, Limits, NodeState, NodeStatus, Payload,
    RegionTopic, RegionTopicKind, RejectReason, decode,
};
use ecod_actors::platform::throttle::KeyedThrottle;
pub use read_tiles::ReadTiles;
pub use snapshot::{ObjectView, TileView, TownCellView, TownTotals, TownView};

/// Cells by tile and name, and counts of their messages.
#[derive(Debug)]
pub struct RegionTown {
    cells: BTreeMap<(Quadkey, NodeName), RegionCell>,
    filter: CellMapFilter,
    throttle: KeyedThrottle<RegionTopic>,
    counts: TownCounts,
}

/// The latest of one cell.
#[derive(Debug, Default)]
pub struct RegionCell {
    /// The status of its leader.
    pub status: Option<NodeStatus>,
    /// Time since which its status is not offline.
    pub leads_since: Timestamp,
    /// Version of the settings that its nodes share.
    pub description: Option<u64>,
    /// Its newest accepted map.
    pub map: Option<TownMap>,
    /// Its messages and objects that were not used.
    pub losses: CellLosses,
}

/// Messages and objects of one cell that were not used, so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CellLosses {
    /// Messages beyond the rate of [`MAX_MAP_HZ`].
    pub throttled: u64,
    /// Objects outside of the area that the cell may report.
    pub outside: u64,
    /// Objects beyond the maximum number.
    pub too_many: u64,
}

/// The shown part of an accepted map.
#[derive(Debug)]
pub struct TownMap {
    /// The place on Earth of its frame.
    pub origin: GeographicOrigin,
    /// Name of the leader that fused the map.
    pub aggregator: NodeName,
    /// Term of the leadership.
    pub epoch: u64,
    /// Number of the map in it.
    pub round: u64,
    /// The objects that the cell may report, without contributors and scores.
    pub objects: Vec<FusedObject>,
    /// When it was fused, by the cell's time.
    pub fused_at: Timestamp,
    /// Time of sending by this program's clock: the time of receipt minus the delay.
    pub sent_at: Timestamp,
}

/// Numbers of the messages so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TownCounts {
    /// Number of all messages.
    pub messages: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// Number of accepted maps.
    pub maps: u64,
    /// Refused messages, by reason; maps that are too old are `Stale`.
    pub rejected: BTreeMap<RejectReason, u64>,
    /// Messages and objects of all cells that were not used.
    pub losses: CellLosses,
}

/// The reason why a message is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CellRefusal {
    /// It cannot be used.
    Rejected(RejectReason),
    /// Its cell sends more than [`MAX_MAP_HZ`] of its kind.
    CellThrottled,
}

impl From<RejectReason> for CellRefusal {
    fn from(reason: RejectReason) -> Self {
        Self::Rejected(reason)
    }
}

/// A message that counts.
#[derive(Debug, Clone, PartialEq)]
pub enum Accepted {
    /// A map, and its delay in excess of the least delay of its cell's maps.
    Map(RegionTopic, Duration),
    /// A status or a description.
    Other(RegionTopic),
}

/// State of a cell, as an operator sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CellState {
    /// Its newest map is no older than [`MAX_AGE`].
    Live,
    /// Its status claims a leader, but its maps are not read, or not for long enough for a
    /// conclusion.
    Claimed,
    /// Its status claims a leader, but no map arrives although one is due.
    Silent,
    /// Its status is offline.
    Offline,
}

impl CellState {
    /// All states in order of declaration.
    pub const ALL: [Self; 4] = [Self::Live, Self::Claimed, Self::Silent, Self::Offline];

    /// The state in metrics and on the page.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Live => "live",
            Self::Claimed => "told",
            Self::Silent => "silent",
            Self::Offline => "offline",
        }
    }
}

/// Maximum number of cells.
pub const MAX_CELLS: usize = 100_000;

/// Maximum size of a map in bytes: a cell of two thousand objects.
const MAX_MAP_BYTES: usize = 256 << 10;

/// Maximum size of a status in bytes, as at a cell's broker.
const MAX_STATUS_BYTES: usize = 16 << 10;

/// Maximum number of objects of a cell that are kept: 0.6 MB.
const MAX_OBJECTS: usize = 2048;

/// Time for which maps are read before a cell without any counts as silent. A map is accepted 2 s
/// after the subscription at the latest, because the first maps show the cell's usual delay.
const DUE_AFTER: Duration = Duration::from_secs(3);

impl Default for RegionTown {
    fn default() -> Self {
        let kinds = RegionTopicKind::ALL.len();
        Self {
            cells: BTreeMap::new(),
            filter: CellMapFilter::new(MAX_CELLS),
            throttle: KeyedThrottle::per_second(MAX_MAP_HZ).with_max_sources(kinds * MAX_CELLS),
            counts: TownCounts::default(),
        }
    }
}

impl RegionTown {
    /// Processes a message that was read at `now` by a steady clock.
    ///
    /// # Errors
    /// Returns the reason why the message is refused, which is also counted.
    pub fn accept(
        &mut self,
        path: &str,
        payload: &[u8],
        now: Timestamp,
    ) -> Result<Accepted, CellRefusal> {
        self.counts.messages += 1;
        self.counts.bytes += payload.len() as u64;
        let accepted = self.on_message(path, payload, now);
        if let Err(CellRefusal::Rejected(reason)) = accepted {
            *self.counts.rejected.entry(reason).or_default() += 1;
        }
        accepted
    }

    /// Handles a message of the region's broker: a map, description or status replaces the stored one of
    /// its cell, and an empty status removes the cell. For example, the first status of a leader after
    /// `offline` starts the time for which the cell leads. Refused messages change only counters.
    fn on_message(
        &mut self,
        path: &str,
        payload: &[u8],
        now: Timestamp,
    ) -> Result<Accepted, CellRefusal> {
        let topic = RegionTopic::parse(path)
            .filter(|topic| topic.tile.digits() == CELL_TILE_DIGITS)
            .ok_or(RejectReason::UnknownTopic)?;
        let key = (topic.tile, topic.cell.clone());
        if !self.throttle.allow(&topic, now) {
            self.lose(
                &topic,
                CellLosses {
                    throttled: 1,
                    ..CellLosses::default()
                },
            );
            return Err(CellRefusal::CellThrottled);
        }
        // A cell that clears its retained messages has left for good.
        if payload.is_empty() && topic.kind != RegionTopicKind::Map {
            if topic.kind == RegionTopicKind::Status {
                self.cells.remove(&key);
            } else if let Some(cell) = self.cells.get_mut(&key) {
                cell.description = None;
            }
            return Ok(Accepted::Other(topic));
        }
        if self.cells.len() >= MAX_CELLS && !self.cells.contains_key(&key) {
            return Err(RejectReason::TooManyCells.into());
        }
        match topic.kind {
            RegionTopicKind::Map => {
                let message: CellMap = read(payload)?;
                let age = self.filter.admit(&topic, &message, now)?.age;
                self.counts.maps += 1;
                let (map, losses) = TownMap::new(topic.tile, message, now - age);
                self.cells.entry(key).or_default().map = Some(map);
                self.lose(&topic, losses);
                return Ok(Accepted::Map(topic, age));
            }
            RegionTopicKind::Cell => {
                let CellDescription { version, .. } = read(payload)?;
                self.cells.entry(key).or_default().description = Some(version);
            }
            RegionTopicKind::Status => {
                let status: NodeStatus = read(payload)?;
                let cell = self.cells.entry(key).or_default();
                if !cell.status.as_ref().is_some_and(leads) && leads(&status) {
                    cell.leads_since = now;
                }
                cell.status = Some(status);
            }
        }
        Ok(Accepted::Other(topic))
    }

    /// Counts refused messages and objects, for its cell and for all.
    fn lose(&mut self, topic: &RegionTopic, losses: CellLosses) {
        self.counts.losses.add(losses);
        let key = (topic.tile, topic.cell.clone());
        if let Some(cell) = self.cells.get_mut(&key) {
            cell.losses.add(losses);
        }
    }

    /// All cells, by tile and name.
    pub fn cells(&self) -> &BTreeMap<(Quadkey, NodeName), RegionCell> {
        &self.cells
    }

    /// Numbers of the messages so far.
    pub fn counts(&self) -> &TownCounts {
        &self.counts
    }

    /// Drops outdated maps, for example of tiles that are out of view.
    pub fn drop_old_maps(&mut self, now: Timestamp) {
        self.filter.drop_silent(now);
        for cell in self.cells.values_mut() {
            cell.map = cell
                .map
                .take()
                .filter(|map| now.since(map.sent_at) <= KEPT_FOR);
        }
        self.cells
            .retain(|_, cell| cell.status.is_some() || cell.map.is_some());
    }
}

/// Maximum age of a map that is shown, as an old one.
const KEPT_FOR: Duration = Duration::from_secs(60);

impl TownMap {
    /// The part of a map of a cell in `tile` that is shown, and the number of objects that are not.
    fn new(tile: Quadkey, message: CellMap, sent_at: Timestamp) -> (Self, CellLosses) {
        let CellMap { origin, map, .. } = message;
        let GlobalMap {
            aggregator,
            epoch,
            round,
            fused_at_us: fused_at,
            mut objects,
            ..
        } = map;
        let area = CoveredArea::of(tile);
        let stated = objects.len();
        objects.retain(|object| area.covers(&origin.to_wgs84(object.x_m, object.y_m, 0.0)));
        let covered = objects.len();
        objects.truncate(MAX_OBJECTS);
        let losses = CellLosses {
            throttled: 0,
            outside: (stated - covered) as u64,
            too_many: (covered - objects.len()) as u64,
        };
        for object in &mut objects {
            object.contributors = Vec::new();
            object.scores = BTreeMap::new();
        }
        objects.shrink_to_fit();
        (
            Self {
                origin,
                aggregator,
                epoch,
                round,
                objects,
                fused_at,
                sent_at,
            },
            losses,
        )
    }
}

impl CellLosses {
    fn add(&mut self, more: Self) {
        self.throttled += more.throttled;
        self.outside += more.outside;
        self.too_many += more.too_many;
    }
}

impl RegionCell {
    /// The cell's state at `now`; its maps are read since `read_since`, if they are.
    pub fn state(&self, now: Timestamp, read_since: Option<Timestamp>) -> CellState {
        let age = self.map.as_ref().map(|map| now.since(map.sent_at));
        match age {
            Some(age) if age <= MAX_AGE => CellState::Live,
            _ if self.status.as_ref().is_some_and(|status| !leads(status)) => CellState::Offline,
            _ if read_since
                .is_some_and(|since| now.since(since.max(self.leads_since)) >= DUE_AFTER) =>
            {
                CellState::Silent
            }
            _ => CellState::Claimed,
        }
    }
}

fn leads(status: &NodeStatus) -> bool {
    status.state != NodeState::Offline
}

fn read<T: Payload>(payload: &[u8]) -> Result<T, RejectReason> {
    decode(
        payload,
        &Limits {
            map_bytes: MAX_MAP_BYTES,
            payload_bytes: MAX_STATUS_BYTES,
            ..Limits::default()
        },
    )
}
