//! Points in square cells, made anew every round: a query looks at the few cells around it.

use hashbrown::HashMap;
use nalgebra::Vector2;
use smallvec::SmallVec;

/// Numbered points by the cell they lie in.
#[derive(Debug, Clone, Default)]
pub(super) struct Grid {
    cell_m: f64,
    cells: HashMap<(i32, i32), SmallVec<[Point; 2]>>,
}

#[derive(Debug, Clone, Copy)]
struct Point {
    at: Vector2<f64>,
    number: u32,
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
    pub(super) fn insert(&mut self, at: &Vector2<f64>, number: u32) {
        let cell = self.cells.entry((self.line(at.x), self.line(at.y))).or_default();
        cell.push(Point { at: *at, number });
    }

    /// How many points lie in the square of `side_m`, a whole part of a cell's, that `at` lies in.
    pub(super) fn crowd(&self, at: &Vector2<f64>, side_m: f64) -> usize {
        let square = |point: &Vector2<f64>| point.map(|coordinate_m| (coordinate_m / side_m).floor());
        let here = square(at);
        let points = self.cells.get(&(self.line(at.x), self.line(at.y))).into_iter().flatten();
        points.filter(|point| square(&point.at) == here).count()
    }

    /// The points within `reach_m` of `at`.
    pub(super) fn around(&self, at: &Vector2<f64>, reach_m: f64) -> impl Iterator<Item = u32> + '_ {
        let (west, east) = (self.line(at.x - reach_m), self.line(at.x + reach_m));
        let (south, north) = (self.line(at.y - reach_m), self.line(at.y + reach_m));
        let columns = (west..=east).flat_map(move |column| (south..=north).map(move |row| (column, row)));
        let points = columns.filter_map(|cell| self.cells.get(&cell)).flatten();
        let (at, reach_squared) = (*at, reach_m * reach_m);
        points.filter(move |point| (point.at - at).norm_squared() <= reach_squared).map(|point| point.number)
    }

    fn line(&self, coordinate_m: f64) -> i32 {
        (coordinate_m / self.cell_m).floor() as i32
    }
}
