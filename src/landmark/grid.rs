//! Points in square cells: a query looks at the few cells around it, however many points there are elsewhere.

use nalgebra::{Point2, Vector2};

/// A point and the landmark it belongs to.
#[derive(Debug, Clone, Copy)]
pub(super) struct GridPoint {
    pub(super) position: Point2<f64>,
    /// Position of the landmark in configuration order.
    pub(super) landmark: u32,
    /// Whether the landmark has a vacancy sign.
    pub(super) has_sign: bool,
}

/// Points grouped by cell, and cells by bucket. Neighbouring cells of a row lie side by side in memory: what one vehicle
/// asks for is near what it asked for before.
#[derive(Debug, Clone)]
pub(super) struct Grid {
    cell_m: f64,
    /// Ascending by bucket, then by cell.
    points: Vec<(Cell, GridPoint)>,
    /// Where the points of each bucket end; as many as a power of two.
    ends: Vec<u32>,
}

/// Column and row.
type Cell = (i32, i32);

/// Keeps the rows of a grid apart: the fraction of the golden ratio in 64 bits (Knuth, "The Art of Computer Programming",
/// volume 3, section 6.4).
const ROW_STEP: u64 = 0x9e37_79b9_7f4a_7c15;

impl Grid {
    /// Groups the points into cells of `cell_m` metres; a query looks at one to four cells for radii up to half of that.
    pub(super) fn new(points: impl IntoIterator<Item = GridPoint>, cell_m: f64) -> Self {
        let with_cell = |point: GridPoint| ((line(point.position.x, cell_m), line(point.position.y, cell_m)), point);
        let mut points: Vec<(Cell, GridPoint)> = points.into_iter().map(with_cell).collect();
        let buckets = (2 * points.len()).next_power_of_two();
        points.sort_by_key(|(cell, point)| (bucket(*cell, buckets), *cell, point.landmark));
        let mut ends = vec![0; buckets];
        for (index, (cell, _)) in points.iter().enumerate() {
            ends[bucket(*cell, buckets)] = index as u32 + 1;
        }
        for bucket in 1..ends.len() {
            ends[bucket] = ends[bucket].max(ends[bucket - 1]);
        }
        Self { cell_m, points, ends }
    }

    /// The points within `radius_m` of a point, with the vector to the point from each.
    pub(super) fn within(
        &self,
        point: Point2<f64>,
        radius_m: f64,
    ) -> impl Iterator<Item = (GridPoint, Vector2<f64>)> + '_ {
        let span = |middle: f64| line(middle - radius_m, self.cell_m)..=line(middle + radius_m, self.cell_m);
        let columns = span(point.x);
        // A grid of no points is asked nothing.
        let rows = span(point.y).filter(|_| !self.points.is_empty());
        rows.flat_map(move |row| columns.clone().map(move |column| (column, row)))
            .flat_map(|cell| self.bucket(cell).iter().filter(move |(at, _)| *at == cell))
            .map(move |(_, candidate)| (*candidate, point - candidate.position))
            .filter(move |(_, offset)| offset.norm_squared() <= radius_m * radius_m)
    }

    /// The points of all cells that share the cell's bucket.
    fn bucket(&self, cell: Cell) -> &[(Cell, GridPoint)] {
        let bucket = bucket(cell, self.ends.len());
        let start = if bucket == 0 { 0 } else { self.ends[bucket - 1] };
        &self.points[start as usize..self.ends[bucket] as usize]
    }
}

fn bucket((column, row): Cell, buckets: usize) -> usize {
    let spread = ((row as u64).wrapping_mul(ROW_STEP) >> 32).wrapping_add(column as u64);
    spread as usize & (buckets - 1)
}

/// The column or row that a coordinate lies in; those beyond 32 bits share the outermost.
fn line(coordinate_m: f64, cell_m: f64) -> i32 {
    let scaled = coordinate_m / cell_m;
    let truncated = scaled as i32;
    truncated.saturating_sub(i32::from(scaled < f64::from(truncated)))
}
