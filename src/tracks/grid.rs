//! Points in square cells, made anew every round: a query looks at the few cells around it.

use hashbrown::HashMap;
use nalgebra::Vector2;
use smallvec::SmallVec;

/// Numbered points by the cell they lie in.
#[derive(Debug, Clone, Default)]
pub(super) struct Grid {
    cell_m: f64,
    cells: HashMap<(i32, i32), SmallVec<[u32; 6]>>,
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

    /// Adds a point and says how many its cell holds now.
    pub(super) fn insert(&mut self, at: &Vector2<f64>, number: u32) -> usize {
        let cell = self.cells.entry((self.line(at.x), self.line(at.y))).or_default();
        cell.push(number);
        cell.len()
    }

    /// How many points lie in the cell of `at`.
    pub(super) fn crowd(&self, at: &Vector2<f64>) -> usize {
        self.cells.get(&(self.line(at.x), self.line(at.y))).map_or(0, SmallVec::len)
    }

    /// The points in all cells that a square of half the side `reach_m` around `at` touches.
    pub(super) fn around(&self, at: &Vector2<f64>, reach_m: f64) -> impl Iterator<Item = u32> + '_ {
        let (west, east) = (self.line(at.x - reach_m), self.line(at.x + reach_m));
        let (south, north) = (self.line(at.y - reach_m), self.line(at.y + reach_m));
        let columns = (west..=east).flat_map(move |column| (south..=north).map(move |row| (column, row)));
        columns.filter_map(|cell| self.cells.get(&cell)).flatten().copied()
    }

    fn line(&self, coordinate_m: f64) -> i32 {
        (coordinate_m / self.cell_m).floor() as i32
    }
}
