//! Points in square cells: a query looks at the few cells around it, however many points there are elsewhere.

use std::ops::Range;

use hashbrown::HashMap;
use nalgebra::Point2;

/// A point and the landmark it belongs to.
#[derive(Debug, Clone, Copy)]
pub(super) struct GridPoint {
    pub(super) position: Point2<f64>,
    /// Position of the landmark in configuration order.
    pub(super) landmark: usize,
}

/// Points grouped by cell.
#[derive(Debug, Clone)]
pub(super) struct Grid {
    cell_m: f64,
    points: Vec<GridPoint>,
    cells: HashMap<Cell, Range<usize>>,
}

impl Grid {
    /// Groups the points into cells of `cell_m` metres; a query looks at one to four cells for radii up to half of that.
    pub(super) fn new(mut points: Vec<GridPoint>, cell_m: f64) -> Self {
        let cell_of = |point: &GridPoint| cell(line(point.position.x, cell_m), line(point.position.y, cell_m));
        points.sort_by_key(|point| (cell_of(point), point.landmark));
        let mut cells: HashMap<Cell, Range<usize>> = HashMap::new();
        for (index, point) in points.iter().enumerate() {
            cells.entry(cell_of(point)).or_insert(index..index).end = index + 1;
        }
        Self { cell_m, points, cells }
    }

    /// The points within `radius_m` of a point, with the vector to the point from each.
    pub(super) fn within(
        &self,
        point: Point2<f64>,
        radius_m: f64,
    ) -> impl Iterator<Item = (usize, nalgebra::Vector2<f64>)> + '_ {
        let span = |middle: f64| line(middle - radius_m, self.cell_m)..=line(middle + radius_m, self.cell_m);
        let rows = span(point.y);
        span(point.x)
            .flat_map(move |x| rows.clone().map(move |y| cell(x, y)))
            .filter_map(|at| self.cells.get(&at))
            .flat_map(|range| &self.points[range.clone()])
            .map(move |candidate| (candidate.landmark, point - candidate.position))
            .filter(move |(_, offset)| offset.norm_squared() <= radius_m * radius_m)
    }
}

/// Column and row of a cell in one word, which hashes fastest. Cells 2³² apart share a word and their points one range
/// of candidates; the distance tells them apart.
type Cell = u64;

fn cell(column: i64, row: i64) -> Cell {
    (u64::from(column as u32) << 32) | u64::from(row as u32)
}

/// The column or row that a coordinate lies in.
fn line(coordinate_m: f64, cell_m: f64) -> i64 {
    let scaled = coordinate_m / cell_m;
    let truncated = scaled as i64;
    truncated - i64::from(scaled < truncated as f64)
}
