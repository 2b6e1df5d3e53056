//! Spatial index of tracks: square cells, rebuilt every round, so that a query visits only the few cells around it.

use hashbrown::HashMap;
use nalgebra::Vector2;
use smallvec::SmallVec;

use super::handles::TrackIndex;

/// Indexed tracks by the cell they lie in.
#[derive(Debug, Clone, Default)]
pub(super) struct TrackGrid {
    cell_m: f64,
    cells: HashMap<(i32, i32), SmallVec<[IndexedTrack; 4]>>,
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
    /// An empty grid with cells of `cell_m` metres.
    pub(super) fn new(cell_m: f64) -> Self {
        Self {
            cell_m,
            cells: HashMap::new(),
        }
    }

    pub(super) fn clear(&mut self) {
        self.cells.clear();
    }

    pub(super) fn insert(&mut self, track: IndexedTrack) {
        self.cells
            .entry((self.line(track.position.x), self.line(track.position.y)))
            .or_default()
            .push(track);
    }

    /// Number of tracks in the square around a position. The grid of squares has sides of `side_m`, which divides the
    /// side of a cell.
    pub(super) fn crowd(&self, position: &Vector2<f64>, side_m: f64) -> usize {
        let square =
            |point: &Vector2<f64>| point.map(|coordinate_m| (coordinate_m / side_m).floor());
        let here = square(position);
        let tracks = self
            .cells
            .get(&(self.line(position.x), self.line(position.y)))
            .into_iter()
            .flatten();
        tracks
            .filter(|track| square(&track.position) == here)
            .count()
    }

    /// Visits the tracks that were within `reach_m` of a position.
    pub(super) fn near(
        &self,
        position: &Vector2<f64>,
        reach_m: f64,
        mut visit: impl FnMut(&IndexedTrack),
    ) {
        let west = self.line(position.x - reach_m);
        let east = self.line(position.x + reach_m);
        let south = self.line(position.y - reach_m);
        let north = self.line(position.y + reach_m);
        for column in west..=east {
            for row in south..=north {
                let tracks = self
                    .cells
                    .get(&(column, row))
                    .map_or(&[][..], SmallVec::as_slice);
                let near = tracks.iter().filter(|track| {
                    (track.position - position).norm_squared() <= reach_m * reach_m
                });
                near.for_each(&mut visit);
            }
        }
    }

    /// Number of the row or column of cells that contains a coordinate.
    fn line(&self, coordinate_m: f64) -> i32 {
        let cells = coordinate_m / self.cell_m;
        // The result of `floor`, which is a function call on processors without an instruction for it.
        let toward_zero = cells as i32;
        toward_zero.saturating_sub(i32::from(f64::from(toward_zero) > cells))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinate_lies_above_cell_start() {
        let grid = TrackGrid::new(24.0);
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
            assert_eq!(
                grid.line(coordinate_m),
                (coordinate_m / 24.0).floor() as i32,
                "{coordinate_m}"
            );
        }
    }
}
