//! Points in square cells, made anew every round: a query looks at the few cells around it.

use hashbrown::HashMap;
use nalgebra::Vector2;
use smallvec::SmallVec;

/// Numbered points by the cell they lie in.
#[derive(Debug, Clone, Default)]
pub(super) struct Grid {
    cell_m: f64,
    cells: HashMap<(i32, i32), SmallVec<[Point; 4]>>,
}

/// A point that moves.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point {
    /// Where it was when the grid was made.
    pub(super) at: Vector2<f64>,
    /// m/s.
    pub(super) velocity: Vector2<f64>,
    /// What it is called by whoever made the grid.
    pub(super) number: u32,
}

impl Grid {
    /// No points, in cells of `cell_m` metres.
    pub(super) fn new(cell_m: f64) -> Self {
        Self { cell_m, cells: HashMap::new() }
    }

    /// Forgets all points.
    pub(super) fn clear(&mut self) {
        self.cells.clear();
    }

    /// Adds a point.
    pub(super) fn insert(&mut self, point: Point) {
        self.cells.entry((self.line(point.at.x), self.line(point.at.y))).or_default().push(point);
    }

    /// How many points lie in the square of `side_m`, a whole part of a cell's, that `at` lies in.
    pub(super) fn crowd(&self, at: &Vector2<f64>, side_m: f64) -> usize {
        let square = |point: &Vector2<f64>| point.map(|coordinate_m| (coordinate_m / side_m).floor());
        let here = square(at);
        let points = self.cells.get(&(self.line(at.x), self.line(at.y))).into_iter().flatten();
        points.filter(|point| square(&point.at) == here).count()
    }

    /// Visits the points that were within `reach_m` of `at`.
    pub(super) fn around(&self, at: &Vector2<f64>, reach_m: f64, mut visit: impl FnMut(&Point)) {
        let (west, east) = (self.line(at.x - reach_m), self.line(at.x + reach_m));
        let (south, north) = (self.line(at.y - reach_m), self.line(at.y + reach_m));
        for column in west..=east {
            for row in south..=north {
                let points = self.cells.get(&(column, row)).map_or(&[][..], SmallVec::as_slice);
                let near = points.iter().filter(|point| (point.at - at).norm_squared() <= reach_m * reach_m);
                near.for_each(&mut visit);
            }
        }
    }

    /// Number of the line of cells that a coordinate lies in.
    fn line(&self, coordinate_m: f64) -> i32 {
        let cells = coordinate_m / self.cell_m;
        // What `floor` says, which is a call where the processor may have no instruction for it.
        let toward_zero = cells as i32;
        toward_zero.saturating_sub(i32::from(f64::from(toward_zero) > cells))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coordinate_lies_in_the_cell_that_begins_at_or_below_it() {
        let grid = Grid::new(24.0);
        for coordinate_m in [-1e12, -48.0, -24.000_000_1, -24.0, -23.9, -0.5, -0.0, 0.0, 0.5, 23.9, 24.0, 1e8, 1e12] {
            assert_eq!(grid.line(coordinate_m), (coordinate_m / 24.0).floor() as i32, "{coordinate_m}");
        }
    }
}
