//! Spatial index of tracks: square cells, rebuilt every round, so that a query visits only the few cells around it.

use hashbrown::HashMap;
use nalgebra::Vector2;
use smallvec::SmallVec;

use super::handles::TrackIndex;

/// Indexed tracks by the cell they lie in.
#[derive(Debug, Clone, Default)]
pub(super) struct TrackGrid {
    cell_m: f64,
    /// Side of the squares into which crowded cells are divided, metres.
    square_m: f64,
    cells: HashMap<(i64, i64), GridCell>,
}

/// Minimum side of a cell in metres. Trade-off: larger cells return more false candidates; smaller cells cost more
/// look-ups.
const MIN_CELL_M: f64 = 24.0;

/// Number of tracks in a cell above which queries use its squares.
const CROWD: usize = 64;

/// Maximum number of squares of a query; comparing all tracks of a cell is faster than visiting more squares.
const MAX_SQUARES: i64 = 9;

/// Tracks of one cell, in the order in which they were added.
#[derive(Debug, Clone, Default)]
struct GridCell {
    /// Positions at the time of the grid, metres, in a separate list: queries compare many and visit few.
    positions: SmallVec<[Vector2<f64>; 4]>,
    tracks: SmallVec<[(TrackIndex, Vector2<f64>); 4]>,
    /// Places in the lists by square, if the cell is crowded.
    squares: HashMap<(i64, i64), SmallVec<[u32; 16]>>,
}

impl GridCell {
    fn insert(&mut self, track: &IndexedTrack, square_m: f64) {
        self.positions.push(track.position);
        self.tracks.push((track.track, track.velocity));
        let count = self.positions.len();
        if count <= CROWD {
            return;
        }
        // The track that makes the cell a crowd comes with all earlier ones.
        let first = if self.squares.is_empty() {
            0
        } else {
            count - 1
        };
        for place in first..count {
            let square = square(&self.positions[place], square_m);
            self.squares.entry(square).or_default().push(place as u32);
        }
    }

    /// Visits the tracks within `reach_m` of a position.
    fn near(&self, query: &GridQuery, visit: &mut impl FnMut(&IndexedTrack)) {
        let reach_squared = query.reach_m * query.reach_m;
        let is_near =
            |other: &Vector2<f64>| (other - query.position).norm_squared() <= reach_squared;
        if query.is_small && !self.squares.is_empty() {
            let mut places: SmallVec<[u32; 16]> = SmallVec::new();
            for square in query.squares() {
                let here = self.squares.get(&square).into_iter().flatten().copied();
                places.extend(here.filter(|place| is_near(&self.positions[*place as usize])));
            }
            places.sort_unstable();
            places
                .into_iter()
                .for_each(|place| visit(&self.track(place as usize)));
            return;
        }
        for (batch, positions) in self.positions.chunks(BATCH).enumerate() {
            // Without a branch for each track, which a processor mispredicts in a crowd.
            let mut near = 0_u64;
            for (bit, other) in positions.iter().enumerate() {
                near |= u64::from(is_near(other)) << bit;
            }
            while near != 0 {
                visit(&self.track(batch * BATCH + near.trailing_zeros() as usize));
                near &= near - 1;
            }
        }
    }

    fn track(&self, place: usize) -> IndexedTrack {
        let (track, velocity) = self.tracks[place];
        IndexedTrack {
            position: self.positions[place],
            velocity,
            track,
        }
    }
}

/// Number of tracks that are compared at once, one bit each.
const BATCH: usize = u64::BITS as usize;

/// A search around a position.
struct GridQuery {
    position: Vector2<f64>,
    reach_m: f64,
    /// First and last column and row of the squares that it touches.
    columns: (i64, i64),
    rows: (i64, i64),
    is_small: bool,
}

impl GridQuery {
    fn new(position: &Vector2<f64>, reach_m: f64, square_m: f64) -> Self {
        let reach = Vector2::new(reach_m, reach_m);
        let (west, south) = square(&(position - reach), square_m);
        let (east, north) = square(&(position + reach), square_m);
        let count = |first: i64, last: i64| last.saturating_sub(first).saturating_add(1);
        Self {
            position: *position,
            reach_m,
            columns: (west, east),
            rows: (south, north),
            is_small: count(west, east).saturating_mul(count(south, north)) <= MAX_SQUARES,
        }
    }

    fn squares(&self) -> impl Iterator<Item = (i64, i64)> {
        let (south, north) = self.rows;
        (self.columns.0..=self.columns.1)
            .flat_map(move |column| (south..=north).map(move |row| (column, row)))
    }
}

/// A track at the time at which the grid was built.
#[derive(Debug, Clone, Copy)]
pub(super) struct IndexedTrack {
    /// Position at the time of the grid, metres.
    pub(super) position: Vector2<f64>,
    /// Velocity, m/s.
    pub(super) velocity: Vector2<f64>,
    pub(super) track: TrackIndex,
}

impl TrackGrid {
    /// An empty grid with squares of `square_m` metres, and cells of some squares.
    pub(super) fn new(square_m: f64) -> Self {
        Self {
            cell_m: square_m * (MIN_CELL_M / square_m).ceil(),
            square_m,
            cells: HashMap::new(),
        }
    }

    pub(super) fn clear(&mut self) {
        self.cells.clear();
    }

    pub(super) fn insert(&mut self, track: IndexedTrack) {
        self.cells
            .entry(square(&track.position, self.cell_m))
            .or_default()
            .insert(&track, self.square_m);
    }

    /// Tracks in the square around a position.
    pub(super) fn crowd(&self, position: &Vector2<f64>) -> SmallVec<[TrackIndex; 16]> {
        let Some(cell) = self.cells.get(&square(position, self.cell_m)) else {
            return SmallVec::new();
        };
        let here = square(position, self.square_m);
        let track = |place: usize| cell.tracks[place].0;
        if cell.squares.is_empty() {
            let positions = cell.positions.iter().enumerate();
            positions
                .filter(|(_, other)| square(other, self.square_m) == here)
                .map(|(place, _)| track(place))
                .collect()
        } else {
            let places = cell.squares.get(&here).into_iter().flatten();
            places.map(|place| track(*place as usize)).collect()
        }
    }

    /// Visits the tracks that were within `reach_m` of a position.
    pub(super) fn near(
        &self,
        position: &Vector2<f64>,
        reach_m: f64,
        mut visit: impl FnMut(&IndexedTrack),
    ) {
        let query = GridQuery::new(position, reach_m, self.square_m);
        let reach = Vector2::new(reach_m, reach_m);
        let (west, south) = square(&(position - reach), self.cell_m);
        let (east, north) = square(&(position + reach), self.cell_m);
        for column in west..=east {
            for row in south..=north {
                if let Some(cell) = self.cells.get(&(column, row)) {
                    cell.near(&query, &mut visit);
                }
            }
        }
    }
}

/// Column and row of the square with a side of `side_m` that contains a position.
pub(super) fn square(position: &Vector2<f64>, side_m: f64) -> (i64, i64) {
    (floor(position.x / side_m), floor(position.y / side_m))
}

/// The result of `f64::floor`, which is a function call on processors without an instruction for it.
fn floor(number: f64) -> i64 {
    let toward_zero = number as i64;
    toward_zero.saturating_sub(i64::from(toward_zero as f64 > number))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinate_lies_above_square_start() {
        for coordinate_m in [
            -1e12,
            -48.0,
            -24.000_000_1,
            -24.0,
            -23.9,
            -0.5,
            -0.0,
            0.0,
            0.5,
            23.9,
            24.0,
            1e8,
            1e12,
        ] {
            let cells = coordinate_m / 24.0;
            assert_eq!(floor(cells), f64::floor(cells) as i64, "{coordinate_m}");
        }
    }

    /// Squares change the time of a query only.
    #[test]
    fn crowded_cell_returns_same_tracks() {
        let places: Vec<_> = (0..1500_u32)
            .map(|number| {
                let turn = f64::from(number) * 2.4;
                Vector2::new(turn.cos(), turn.sin()) * (20.0 * (f64::from(number) / 1500.0).sqrt())
            })
            .collect();
        let mut grid = TrackGrid::new(4.0);
        for (number, position) in (0..).zip(&places) {
            grid.insert(IndexedTrack {
                position: *position,
                velocity: Vector2::zeros(),
                track: TrackIndex(number),
            });
        }
        assert!(grid.cells.values().all(|cell| !cell.squares.is_empty()));
        for centre in places.iter().step_by(50) {
            for reach_m in [0.5, 2.0, 7.0] {
                let mut found = Vec::new();
                grid.near(centre, reach_m, |track| found.push(track.track.0));
                let cell = |number: u32| square(&places[number as usize], grid.cell_m);
                let is_near = |number: &u32| (places[*number as usize] - centre).norm() <= reach_m;
                let mut expected: Vec<_> = (0..1500).filter(is_near).collect();
                expected.sort_by_key(|number| (cell(*number), *number));
                assert_eq!(found, expected, "{centre} {reach_m}");
            }
            let here = square(centre, 4.0);
            let around = places.iter().filter(|place| square(place, 4.0) == here);
            assert_eq!(grid.crowd(centre).len(), around.count());
        }
    }
}
