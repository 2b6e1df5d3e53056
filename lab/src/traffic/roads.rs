//! A square grid of roads with a lane each way, crossings with signals, and a building on every
//! block.

use nalgebra::{Point2, Vector2};

/// Distance from the middle of a road to the middle of a lane, in metres.
const LANE_M: f64 = 1.75;
/// Distance from the middle of a road to a parked vehicle.
const PARKED_M: f64 = 5.2;
/// From the middles of both roads to a post.
const POST_M: f64 = 9.0;
/// From the middle of a road to the buildings.
const BUILDING_M: f64 = 10.0;
/// From the middle of a crossing to its stop lines.
const CROSSING_M: f64 = 10.0;
/// Times for which a signal is green, and red for all, in seconds.
const GREEN_S: f64 = 9.0;
const CLEARING_S: f64 = 2.0;

/// East, north, west or south, as quarter turns counter-clockwise from east.
pub(super) type Direction = usize;

/// A crossing, by its place in the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Crossing {
    column: usize,
    row: usize,
}

/// A stretch that vehicles drive on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Path {
    /// From a crossing to the next.
    Lane { from: Crossing, heading: Direction },
    /// Over a crossing.
    Turn {
        at: Crossing,
        from: Direction,
        to: Direction,
    },
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Roads {
    pub(super) count: usize,
    pub(super) block_m: f64,
}

/// A building, with its sides along the axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Building {
    center: Point2<f64>,
    half_m: f64,
}

pub(super) fn unit(direction: Direction) -> Vector2<f64> {
    [Vector2::x(), Vector2::y(), -Vector2::x(), -Vector2::y()][direction % 4]
}

fn right_of(direction: Direction) -> Vector2<f64> {
    unit(direction + 3)
}

impl Roads {
    /// The crossing that a lane leads to, `None` off the grid.
    pub(super) fn next(&self, from: Crossing, heading: Direction) -> Option<Crossing> {
        let Crossing { column, row } = from;
        let step = |at: usize, forward: bool| {
            if forward {
                Some(at + 1).filter(|at| *at < self.count)
            } else {
                at.checked_sub(1)
            }
        };
        let (column, row) = match heading % 4 {
            0 => (step(column, true)?, row),
            1 => (column, step(row, true)?),
            2 => (step(column, false)?, row),
            _ => (column, step(row, false)?),
        };
        Some(Crossing { column, row })
    }

    pub(super) fn lanes(&self) -> Vec<Path> {
        let crossings = (0..self.count)
            .flat_map(|column| (0..self.count).map(move |row| Crossing { column, row }));
        let lanes = crossings.flat_map(|from| (0..4).map(move |heading| (from, heading)));
        lanes
            .filter(|(from, heading)| self.next(*from, *heading).is_some())
            .map(|(from, heading)| Path::Lane { from, heading })
            .collect()
    }

    fn center(&self, crossing: Crossing) -> Point2<f64> {
        Point2::new(
            crossing.column as f64 * self.block_m,
            crossing.row as f64 * self.block_m,
        )
    }

    /// Length in metres.
    pub(super) fn length_m(&self, path: Path) -> f64 {
        match path {
            Path::Lane { .. } => self.block_m - 2.0 * CROSSING_M,
            Path::Turn { at, from, to } => {
                const PARTS: usize = 8;
                let curve = self.curve(at, from, to);
                let point = |part: usize| bezier(&curve, part as f64 / PARTS as f64).0;
                (0..PARTS)
                    .map(|part| (point(part + 1) - point(part)).norm())
                    .sum()
            }
        }
    }

    /// Position and heading in radians, `along_m` from the beginning.
    pub(super) fn place(&self, path: Path, along_m: f64) -> (Point2<f64>, f64) {
        match path {
            Path::Lane { from, heading } => {
                let along = unit(heading);
                let right = right_of(heading);
                let at = self.center(from) + along * (CROSSING_M + along_m) + right * LANE_M;
                (at, along.y.atan2(along.x))
            }
            Path::Turn { at, from, to } => {
                let (at, along) = bezier(&self.curve(at, from, to), along_m / self.length_m(path));
                (at, along.y.atan2(along.x))
            }
        }
    }

    /// Position and heading of a vehicle parked next to a lane.
    pub(super) fn parking(&self, path: Path, along_m: f64) -> (Point2<f64>, f64) {
        let (at, heading_rad) = self.place(path, along_m);
        let right = Vector2::new(heading_rad.sin(), -heading_rad.cos());
        (at + right * (PARKED_M - LANE_M), heading_rad)
    }

    /// Beginning, control point and end.
    fn curve(&self, at: Crossing, from: Direction, to: Direction) -> [Point2<f64>; 3] {
        let center = self.center(at);
        let begin = center - unit(from) * CROSSING_M + right_of(from) * LANE_M;
        let end = center + unit(to) * CROSSING_M + right_of(to) * LANE_M;
        let corner = begin + unit(from) * (end - begin).dot(&unit(from));
        [
            begin,
            if from % 4 == to % 4 {
                nalgebra::center(&begin, &end)
            } else {
                corner
            },
            end,
        ]
    }

    /// Position and heading in radians of a camera on a post: four face each crossing, the middle
    /// crossing first.
    pub(super) fn post(&self, number: usize) -> (Point2<f64>, f64) {
        let crossings = self.count * self.count;
        let place = (number / 4 + crossings / 2 + self.count / 2) % crossings;
        let crossing = Crossing {
            column: place % self.count,
            row: place / self.count,
        };
        let corner = number % 4;
        let out = (unit(corner) + unit(corner + 1)) * POST_M;
        (self.center(crossing) + out, (-out.y).atan2(-out.x))
    }

    /// True if the signal lets this direction go.
    pub(super) fn is_green(&self, crossing: Crossing, heading: Direction, at_s: f64) -> bool {
        let cycle_s = 2.0 * (GREEN_S + CLEARING_S);
        let offset_s = (crossing.column * 7 + crossing.row * 5) as f64;
        let phase_s = (at_s + offset_s + (heading % 2) as f64 * cycle_s / 2.0) % cycle_s;
        phase_s < GREEN_S
    }

    /// The buildings, one a block.
    pub(super) fn buildings(&self) -> Vec<Building> {
        let half_m = self.block_m / 2.0 - BUILDING_M;
        self.blocks()
            .into_iter()
            .map(|center| Building { center, half_m })
            .collect()
    }

    /// The middles of all blocks.
    pub(super) fn blocks(&self) -> Vec<Point2<f64>> {
        let of = |number: usize| (number as f64 + 0.5) * self.block_m;
        let blocks = self.count - 1;
        (0..blocks)
            .flat_map(|column| (0..blocks).map(move |row| Point2::new(of(column), of(row))))
            .collect()
    }
}

fn bezier([begin, control, end]: &[Point2<f64>; 3], share: f64) -> (Point2<f64>, Vector2<f64>) {
    let first = begin + (control - begin) * share;
    let second = control + (end - control) * share;
    (first + (second - first) * share, second - first)
}

impl Building {
    /// True if it stands between two points: the segment crosses it (slab test).
    pub(super) fn hides(&self, from: &Point2<f64>, to: &Point2<f64>) -> bool {
        let mut enter = 0.0f64;
        let mut leave = 1.0f64;
        for axis in 0..2 {
            let start = from[axis] - self.center[axis];
            let step = to[axis] - from[axis];
            if step.abs() < 1e-9 {
                if start.abs() > self.half_m {
                    return false;
                }
                continue;
            }
            let a = (-self.half_m - start) / step;
            let b = (self.half_m - start) / step;
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        enter < leave
    }
}
