//! The town within a view, as the page and programs get it.

use std::collections::BTreeMap;

use ecod::model::names::{Label, NodeName};
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::wire::{FusedObject, Trouble};
use serde::Serialize;
use uuid::Uuid;

use super::{CellState, GeographicBounds, ReadTiles, RegionCell, RegionTown, TownMap};

/// The town within a view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TownView {
    /// Bounds of the tiles of all cells.
    pub known: Option<GeographicBounds>,
    /// Numbers of the whole region.
    pub region: TownTotals,
    /// Numbers of the view.
    pub view: TownTotals,
    /// True if the maps of all cells in the view are read.
    pub has_maps: bool,
    /// Tiles with cells in the view, in one size.
    pub tiles: Vec<TileView>,
    /// Cells in the view; empty if there are more than `MAX_CELLS_SHOWN`.
    pub cells: Vec<TownCellView>,
    /// Objects of live cells in the view; empty if there are more than `MAX_OBJECTS_SHOWN`.
    pub objects: Vec<ObjectView>,
}

/// Numbers of cells and of the objects of their maps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct TownTotals {
    /// Number of all cells.
    pub cells: usize,
    /// Cells whose newest map is not old.
    pub live: usize,
    /// Cells with a leader whose maps are not read for long enough for a conclusion.
    pub told: usize,
    /// Cells with a leader but without arriving maps.
    pub silent: usize,
    /// Cells with the status offline.
    pub offline: usize,
    /// Cells whose leader reports troubles.
    pub troubled: usize,
    /// Objects of live cells.
    pub objects: usize,
    /// Objects that are vehicles of their cell.
    pub vehicles: usize,
}

/// A tile and its contents.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TileView {
    /// Quadkey of the tile.
    pub key: String,
    /// Bounds of the tile.
    pub bounds: GeographicBounds,
    /// The cells in it.
    pub totals: TownTotals,
    /// Age in seconds of the oldest of the newest maps of cells in it that are read.
    pub oldest_s: Option<f64>,
}

/// A cell in the form for the page.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TownCellView {
    /// Name of the cell.
    pub cell: NodeName,
    /// The quadkey of its tile.
    pub tile: String,
    /// Latitude of its origin in degrees; before a map has arrived, of the middle of its tile.
    pub latitude_deg: f64,
    /// Longitude of the same place in degrees.
    pub longitude_deg: f64,
    /// Its state: `live`, `told`, `silent` or `offline`.
    pub state: &'static str,
    /// Name of the leader; `None` if map and status name no leader.
    pub leader: Option<NodeName>,
    /// Term of the leadership.
    pub epoch: Option<u64>,
    /// Round of its newest map.
    pub round: Option<u64>,
    /// Age of that map in seconds.
    pub age_s: Option<f64>,
    /// Objects of the map.
    pub objects: usize,
    /// Vehicles in the map.
    pub vehicles: usize,
    /// Troubles that its leader reports.
    pub troubles: Vec<Trouble>,
    /// Version of its leader's software.
    pub version: Option<String>,
    /// Version of its description.
    pub description: Option<u64>,
    /// Address of its leader's page.
    pub page: Option<String>,
    /// Messages beyond the rate, so far.
    pub messages_refused: u64,
    /// Objects outside of its area or beyond the maximum number, so far.
    pub objects_refused: u64,
}

/// An object of a cell's map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ObjectView {
    /// Identity of the object in the map of its cell.
    pub id: Uuid,
    /// The cell whose map contains the object.
    pub cell: NodeName,
    /// Label of the object.
    pub label: Label,
    /// The probability that the object exists.
    pub confidence: f64,
    /// Latitude in degrees.
    pub latitude_deg: f64,
    /// Longitude in degrees.
    pub longitude_deg: f64,
    /// Velocity over ground in metres per second, to the east and to the north.
    pub velocity_mps: Option<[f64; 2]>,
    /// The vehicle that it is.
    pub vehicle: Option<NodeName>,
}

/// Maximum number of tiles of a view that are listed individually.
const MAX_TILES_SHOWN: usize = 1024;

/// Maximum number of cells of a view that are listed individually.
pub(super) const MAX_CELLS_SHOWN: usize = 512;

/// Maximum number of objects of a view that are listed individually.
pub(super) const MAX_OBJECTS_SHOWN: usize = 4096;

impl RegionTown {
    /// Number of cells in each state.
    pub fn states(&self, tiles: &ReadTiles, now: Timestamp) -> BTreeMap<CellState, usize> {
        let mut states: BTreeMap<_, _> =
            CellState::ALL.into_iter().map(|state| (state, 0)).collect();
        for ((tile, _), cell) in self.cells() {
            *states
                .entry(cell.state(now, tiles.since(*tile)))
                .or_default() += 1;
        }
        states
    }

    /// Number of cells within tiles.
    pub fn count_within(&self, tiles: &[Quadkey]) -> usize {
        self.cells()
            .keys()
            .filter(|(tile, _)| tiles.iter().any(|outer| outer.contains(*tile)))
            .count()
    }

    /// The town within bounds.
    pub fn view(&self, bounds: &GeographicBounds, tiles: &ReadTiles, now: Timestamp) -> TownView {
        self.view_up_to([MAX_CELLS_SHOWN, MAX_OBJECTS_SHOWN], bounds, tiles, now)
    }

    /// The town within bounds with all its cells and objects. All maps were read.
    pub fn view_whole(&self, bounds: &GeographicBounds, now: Timestamp) -> TownView {
        let tiles = ReadTiles::one(Quadkey::default(), Timestamp(0));
        self.view_up_to([usize::MAX; 2], bounds, &tiles, now)
    }

    fn view_up_to(
        &self,
        [max_cells, max_objects]: [usize; 2],
        bounds: &GeographicBounds,
        read: &ReadTiles,
        now: Timestamp,
    ) -> TownView {
        let mut region = TownTotals::default();
        let mut known = None::<GeographicBounds>;
        let mut shown = Vec::new();
        let mut has_maps = true;
        for ((tile, name), cell) in self.cells() {
            let read_since = read.since(*tile);
            let at = GeographicBounds::of(*tile);
            let state = cell.state(now, read_since);
            region.add(cell, state);
            known = Some(known.map_or(at, |known| known.with(at)));
            if at.intersects(bounds) {
                has_maps &= read_since.is_some();
                shown.push((*tile, name, cell, state));
            }
        }
        let mut view = TownTotals::default();
        shown
            .iter()
            .for_each(|(_, _, cell, state)| view.add(cell, *state));
        let cells = if shown.len() > max_cells {
            &[]
        } else {
            &*shown
        };
        let objects = if view.objects > max_objects {
            &[]
        } else {
            &*shown
        };
        TownView {
            known,
            region,
            view,
            has_maps: has_maps && !shown.is_empty(),
            tiles: tiles(bounds, &shown, now),
            cells: cells
                .iter()
                .map(|(tile, name, cell, state)| TownCellView::new(*tile, name, cell, *state, now))
                .collect(),
            objects: objects
                .iter()
                .filter(|(.., state)| *state == CellState::Live)
                .flat_map(|(_, name, cell, _)| cell.objects(name))
                .collect(),
        }
    }
}

type Shown<'a> = (Quadkey, &'a NodeName, &'a RegionCell, CellState);

/// Tiles of one size with the cells in them.
fn tiles(bounds: &GeographicBounds, shown: &[Shown<'_>], now: Timestamp) -> Vec<TileView> {
    let digits = bounds
        .tiles(MAX_TILES_SHOWN)
        .first()
        .map_or(0, |tile| tile.digits());
    let mut tiles = BTreeMap::<Quadkey, (TownTotals, Option<f64>)>::new();
    for (tile, _, cell, state) in shown {
        let (totals, oldest_s) = tiles.entry(tile.outer(digits)).or_default();
        totals.add(cell, *state);
        let is_read = [CellState::Live, CellState::Silent].contains(state);
        let age_s = cell
            .map
            .as_ref()
            .filter(|_| is_read)
            .map(|map| map.age_s(now));
        *oldest_s = [*oldest_s, age_s].into_iter().flatten().reduce(f64::max);
    }
    let view = |(tile, (totals, oldest_s)): (Quadkey, (TownTotals, Option<f64>))| TileView {
        key: tile.to_string(),
        bounds: GeographicBounds::of(tile),
        totals,
        oldest_s,
    };
    tiles.into_iter().map(view).collect()
}

impl TownTotals {
    fn add(&mut self, cell: &RegionCell, state: CellState) {
        self.cells += 1;
        let number = match state {
            CellState::Live => &mut self.live,
            CellState::Claimed => &mut self.told,
            CellState::Silent => &mut self.silent,
            CellState::Offline => &mut self.offline,
        };
        *number += 1;
        self.troubled += usize::from(
            cell.status
                .as_ref()
                .is_some_and(|status| !status.troubles.is_empty()),
        );
        // Objects of an old map may be gone.
        if let (CellState::Live, Some(TownMap { objects, .. })) = (state, &cell.map) {
            self.objects += objects.len();
            self.vehicles += vehicles(objects);
        }
    }
}

fn vehicles(objects: &[FusedObject]) -> usize {
    objects
        .iter()
        .filter(|object| object.vehicle.is_some())
        .count()
}

impl TownMap {
    /// Age of the map in seconds, from its sending to `now`.
    pub fn age_s(&self, now: Timestamp) -> f64 {
        now.since(self.sent_at).as_secs_f64()
    }
}

impl RegionCell {
    /// The objects of its newest map, on Earth.
    pub fn objects<'a>(&'a self, name: &'a NodeName) -> impl Iterator<Item = ObjectView> + 'a {
        let placed = self
            .map
            .iter()
            .flat_map(|map| map.objects.iter().map(|object| (&map.origin, object)));
        placed.map(move |(origin, object)| ObjectView::new(name, origin, object))
    }
}

impl ObjectView {
    fn new(cell: &NodeName, origin: &GeographicOrigin, object: &FusedObject) -> Self {
        let at = origin.to_wgs84(object.x_m, object.y_m, 0.0);
        let (sin, cos) = origin.rotation_deg.to_radians().sin_cos();
        Self {
            id: object.id,
            cell: cell.clone(),
            label: object.label.clone(),
            confidence: object.confidence,
            latitude_deg: at.latitude_deg,
            longitude_deg: at.longitude_deg,
            velocity_mps: object
                .velocity_mps
                .map(|[x, y]| [x * cos - y * sin, x * sin + y * cos]),
            vehicle: object.vehicle.clone(),
        }
    }
}

impl TownCellView {
    fn new(
        tile: Quadkey,
        name: &NodeName,
        cell: &RegionCell,
        state: CellState,
        now: Timestamp,
    ) -> Self {
        let map = cell.map.as_ref();
        let status = cell.status.as_ref();
        let [[north, west], [south, east]] = tile.corners_deg();
        let middle = [(north + south) / 2.0, (west + east) / 2.0];
        let [latitude_deg, longitude_deg] = map.map_or(middle, |map| {
            [map.origin.latitude_deg, map.origin.longitude_deg]
        });
        let led = status.and_then(|status| status.aggregator.clone());
        Self {
            cell: name.clone(),
            tile: tile.to_string(),
            latitude_deg,
            longitude_deg,
            state: state.as_str(),
            leader: map.map(|map| map.aggregator.clone()).or(led),
            epoch: map
                .map(|map| map.epoch)
                .or(status.map(|status| status.epoch)),
            round: map.map(|map| map.round),
            age_s: map.map(|map| map.age_s(now)),
            objects: map.map_or(0, |map| map.objects.len()),
            vehicles: map.map_or(0, |map| vehicles(&map.objects)),
            troubles: status
                .map(|status| status.troubles.clone())
                .unwrap_or_default(),
            version: status.map(|status| status.version.clone()),
            description: cell.description,
            page: status
                .and_then(|status| status.page.clone())
                .filter(|page| is_reachable(page)),
            messages_refused: cell.losses.throttled,
            objects_refused: cell.losses.outside + cell.losses.too_many,
        }
    }
}

/// True if browsers on other machines can open an announced address.
fn is_reachable(page: &str) -> bool {
    let ip = page
        .parse::<std::net::SocketAddr>()
        .map(|address| address.ip());
    ip.is_ok_and(|ip| !ip.is_unspecified() && !ip.is_loopback())
}
