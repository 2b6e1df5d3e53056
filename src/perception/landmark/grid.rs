//! A hashed grid of points in square cells: a query visits the few cells around it only.

use nalgebra::{Point2, Vector2};

/// A point and the landmark it belongs to.
#[derive(Debug, Clone, Copy)]
pub(super) struct GridPoint {
    pub(super) position: Point2<f64>,
    /// Position of the landmark in configuration order.
    pub(super) landmark: u32,
    /// True if the landmark has a vacancy sign.
    pub(super) has_sign: bool,
}

/// Points grouped by cell, and cells by bucket. The cells of a row have successive buckets, so that
/// a query reads one contiguous range of memory for each row and successive queries of a vehicle
/// are near each other.
#[derive(Debug, Clone)]
pub(super) struct Grid {
    cell_m: f64,
    /// Ascending by bucket, each with its row.
    points: Vec<(i32, GridPoint)>,
    /// End of the points of each bucket; the number of buckets is a power of two.
    ends: Vec<u32>,
}

/// Multiplier that spreads the rows over the buckets: the fraction of the golden ratio in 64 bits
/// (Knuth, "The Art of Computer Programming", volume 3, section 6.4).
const ROW_STEP: u64 = 0x9e37_79b9_7f4a_7c15;

impl Grid {
    /// Groups the points into cells of `cell_m` metres; a query visits one to four cells for radii
    /// up to half of that.
    pub(super) fn new(points: impl IntoIterator<Item = GridPoint>, cell_m: f64) -> Self {
        let mut points: Vec<_> = points.into_iter().collect();
        let buckets = (2 * points.len()).next_power_of_two();
        let bucket_of =
            |at: Point2<f64>| bucket(cell_index(at.x, cell_m), cell_index(at.y, cell_m), buckets);
        points.sort_by_key(|point| (bucket_of(point.position), point.landmark));
        let mut ends = vec![0; buckets];
        for (index, point) in points.iter().enumerate() {
            ends[bucket_of(point.position)] = index as u32 + 1;
        }
        for bucket in 1..buckets {
            ends[bucket] = ends[bucket].max(ends[bucket - 1]);
        }
        let points = points
            .into_iter()
            .map(|point| (cell_index(point.position.y, cell_m), point))
            .collect();
        Self {
            cell_m,
            points,
            ends,
        }
    }

    /// True if there are no points.
    pub(super) fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The points within `radius_m` of a point, with the vector to the point from each.
    pub(super) fn within(
        &self,
        point: Point2<f64>,
        radius_m: f64,
    ) -> impl Iterator<Item = (&GridPoint, Vector2<f64>)> + '_ {
        let first = cell_index(point.x - radius_m, self.cell_m);
        let columns = cell_index(point.x + radius_m, self.cell_m).abs_diff(first) as usize;
        let rows = cell_index(point.y - radius_m, self.cell_m)
            ..=cell_index(point.y + radius_m, self.cell_m);
        rows.flat_map(move |row| {
            self.row_cells(first, columns, row)
                .filter(move |(at, _)| *at == row)
        })
        .map(move |(_, candidate)| (candidate, point - candidate.position))
        .filter(move |(_, offset)| offset.norm_squared() <= radius_m * radius_m)
    }

    /// The points in the buckets of a cell and of the `more` next cells of its row, including all
    /// other points in these buckets.
    fn row_cells(
        &self,
        first: i32,
        more: usize,
        row: i32,
    ) -> impl Iterator<Item = &(i32, GridPoint)> {
        let buckets = self.ends.len();
        let first = bucket(first, row, buckets);
        let last = first + more.min(buckets - 1);
        let start = |bucket: usize| {
            if bucket == 0 {
                0
            } else {
                self.ends[bucket - 1] as usize
            }
        };
        let straight = &self.points[start(first)..self.ends[last.min(buckets - 1)] as usize];
        // Beyond the last bucket comes the first.
        let around = if last < buckets {
            0
        } else {
            self.ends[last - buckets] as usize
        };
        straight.iter().chain(&self.points[..around])
    }
}

fn bucket(column: i32, row: i32, buckets: usize) -> usize {
    let spread = ((row as u64).wrapping_mul(ROW_STEP) >> 32).wrapping_add(column as u64);
    spread as usize & (buckets - 1)
}

/// The column or row of a coordinate, clamped to 32 bits.
fn cell_index(coordinate_m: f64, cell_m: f64) -> i32 {
    let scaled = coordinate_m / cell_m;
    let truncated = scaled as i32;
    truncated.saturating_sub(i32::from(scaled < f64::from(truncated)))
}
