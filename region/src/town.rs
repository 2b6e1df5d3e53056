//! The latest of each cell of a region.

mod bounds;
mod snapshot;

use std::collections::BTreeMap;
use std::time::Duration;

pub use bounds::{GeographicBounds, InvalidBounds};
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::{CELL_TILE_DIGITS, Quadkey};
use ecod::model::time::Timestamp;
use ecod::neighbours::{CellMapFilter, MAX_AGE};
use ecod::wire::{
    CellDescription, CellMap, GlobalMap, Limits, NodeState, NodeStatus, Payload, RegionTopic, RegionTopicKind,
    RejectReason, decode,
};
pub use snapshot::{ObjectView, TileView, TownCellView, TownTotals, TownView};

/// Cells by tile and name, and what came of them.
#[derive(Debug)]
pub struct RegionTown {
    cells: BTreeMap<(Quadkey, NodeName), RegionCell>,
    filter: CellMapFilter,
    counts: TownCounts,
}

/// The latest of one cell.
#[derive(Debug, Default)]
pub struct RegionCell {
    /// The status of its leader.
    pub status: Option<NodeStatus>,
    /// The settings that its nodes share.
    pub description: Option<CellDescription>,
    /// Its newest map that counts.
    pub map: Option<TownMap>,
}

/// A map that counts.
#[derive(Debug)]
pub struct TownMap {
    /// The place on Earth of its frame.
    pub origin: GeographicOrigin,
    /// The map itself.
    pub map: GlobalMap,
    /// When it was sent, by this program's clock: the time of receipt less what delayed it.
    pub sent_at: Timestamp,
}

/// Messages so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TownCounts {
    /// All messages.
    pub messages: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// Maps that count.
    pub maps: u64,
    /// Messages that do not count, by reason; maps that are too old are `Stale`.
    pub rejected: BTreeMap<RejectReason, u64>,
}

/// A message that counts.
#[derive(Debug, Clone, PartialEq)]
pub enum Accepted {
    /// A map, and its delay beyond the least that maps of its cell take.
    Map(RegionTopic, Duration),
    /// A status or a description.
    Other(RegionTopic),
}

/// State of a cell, as an operator sees it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CellState {
    /// Its newest map is no older than [`MAX_AGE`].
    Live,
    /// It says that it leads, and its maps are not asked for.
    Told,
    /// It says that it leads, and no map comes.
    Silent,
    /// It says that it is offline.
    Offline,
}

impl CellState {
    /// All states.
    pub const ALL: [Self; 4] = [Self::Live, Self::Told, Self::Silent, Self::Offline];

    /// The state in metrics and on the page.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Live => "live",
            Self::Told => "told",
            Self::Silent => "silent",
            Self::Offline => "offline",
        }
    }
}

/// Maximum number of cells.
pub const MAX_CELLS: usize = 100_000;

/// Maximum size of a map in bytes: a cell of some thousand objects.
const MAX_MAP_BYTES: usize = 1 << 20;

impl Default for RegionTown {
    fn default() -> Self {
        Self { cells: BTreeMap::new(), filter: CellMapFilter::new(MAX_CELLS), counts: TownCounts::default() }
    }
}

impl RegionTown {
    /// Takes a message that was read at `now` by a steady clock.
    ///
    /// # Errors
    /// The reason why it does not count; it is counted.
    pub fn accept(&mut self, path: &str, payload: &[u8], now: Timestamp) -> Result<Accepted, RejectReason> {
        self.counts.messages += 1;
        self.counts.bytes += payload.len() as u64;
        let accepted = self.take(path, payload, now);
        if let Err(reason) = accepted {
            *self.counts.rejected.entry(reason).or_default() += 1;
        }
        accepted
    }

    fn take(&mut self, path: &str, payload: &[u8], now: Timestamp) -> Result<Accepted, RejectReason> {
        let topic = RegionTopic::parse(path).filter(|topic| topic.tile.digits() == CELL_TILE_DIGITS);
        let topic = topic.ok_or(RejectReason::UnknownTopic)?;
        let key = (topic.tile, topic.cell.clone());
        // A cell that clears what it retained has left for good.
        if payload.is_empty() && topic.kind != RegionTopicKind::Map {
            if topic.kind == RegionTopicKind::Status {
                self.cells.remove(&key);
            } else if let Some(cell) = self.cells.get_mut(&key) {
                cell.description = None;
            }
            return Ok(Accepted::Other(topic));
        }
        if self.cells.len() >= MAX_CELLS && !self.cells.contains_key(&key) {
            return Err(RejectReason::TooManyCells);
        }
        match topic.kind {
            RegionTopicKind::Map => {
                let message: CellMap = read(payload)?;
                let age = self.filter.admit(&topic, &message, now)?.age;
                self.counts.maps += 1;
                let CellMap { origin, map, .. } = message;
                self.cells.entry(key).or_default().map = Some(TownMap { origin, map, sent_at: now - age });
                return Ok(Accepted::Map(topic, age));
            }
            RegionTopicKind::Cell => self.cells.entry(key).or_default().description = Some(read(payload)?),
            RegionTopicKind::Status => self.cells.entry(key).or_default().status = Some(read(payload)?),
        }
        Ok(Accepted::Other(topic))
    }

    /// All cells, by tile and name.
    pub fn cells(&self) -> &BTreeMap<(Quadkey, NodeName), RegionCell> {
        &self.cells
    }

    /// Messages so far.
    pub fn counts(&self) -> &TownCounts {
        &self.counts
    }

    /// Drops maps that are old, as those of tiles that nobody looks at any more.
    pub fn forget_old_maps(&mut self, now: Timestamp) {
        self.filter.forget_silent(now);
        for cell in self.cells.values_mut() {
            cell.map = cell.map.take().filter(|map| now.since(map.sent_at) <= KEPT_FOR);
        }
        self.cells.retain(|_, cell| cell.status.is_some() || cell.map.is_some());
    }
}

/// Maximum age of a map that is shown, as an old one.
const KEPT_FOR: Duration = Duration::from_secs(60);

impl RegionCell {
    /// The cell's state at `now`; `is_asked` if its maps are asked for.
    pub fn state(&self, now: Timestamp, is_asked: bool) -> CellState {
        let age = self.map.as_ref().map(|map| now.since(map.sent_at));
        let is_offline = self.status.as_ref().is_some_and(|status| status.state == NodeState::Offline);
        match age {
            Some(age) if age <= MAX_AGE => CellState::Live,
            _ if is_offline => CellState::Offline,
            _ if is_asked => CellState::Silent,
            _ => CellState::Told,
        }
    }
}

fn read<T: Payload>(payload: &[u8]) -> Result<T, RejectReason> {
    decode(payload, &Limits { map_bytes: MAX_MAP_BYTES, ..Limits::default() })
}
