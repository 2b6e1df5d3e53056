//! Vehicles that follow each other, stop at signals and turn.
//!
//! Speeds follow the Intelligent Driver Model (Treiber, Hennecke, Helbing, Phys. Rev. E 62, 2000).
//! A vehicle enters a crossing if its signal is green, its path is free of crossing vehicles, and
//! there is room behind the crossing.

use super::dice::Dice;
use super::roads::{Crossing, Direction, Path, Roads};

/// Acceleration and comfortable braking in m/s².
const ACCELERATION: f64 = 1.8;
const BRAKING: f64 = 2.5;
const HARDEST_BRAKING: f64 = 7.0;
/// Gap to the preceding vehicle, in metres at rest and in seconds.
const GAP_M: f64 = 2.0;
const GAP_S: f64 = 1.2;
/// Speed on a bend in m/s.
const BEND_MPS: f64 = 6.0;
/// Room in metres that the next lane must have.
const ROOM_M: f64 = 8.0;
/// Number of turns that a vehicle plans ahead.
const ROUTE: usize = 64;

#[derive(Debug, Clone)]
pub(super) struct MovingVehicle {
    pub(super) path: Path,
    pub(super) along_m: f64,
    pub(super) speed_mps: f64,
    pub(super) length_m: f64,
    pub(super) width_m: f64,
    desired_mps: f64,
    route: Vec<u8>,
    crossed: usize,
}

/// Vehicles at random places on random routes; in a convoy, the first `convoy` are one behind the
/// other.
pub(super) fn vehicles(
    roads: &Roads,
    count: usize,
    convoy: usize,
    dice: &mut Dice<'_>,
) -> Vec<MovingVehicle> {
    let lanes = roads.lanes();
    let mut vehicles: Vec<MovingVehicle> = Vec::with_capacity(count);
    while vehicles.len() < count {
        let is_van = dice.chance(0.15);
        let mut vehicle = MovingVehicle {
            path: lanes[dice.below(lanes.len())],
            along_m: dice.between(0.0, roads.length_m(lanes[0])),
            speed_mps: 0.0,
            length_m: if is_van {
                dice.between(5.5, 7.0)
            } else {
                dice.between(3.8, 4.9)
            },
            width_m: if is_van { 2.1 } else { 1.8 },
            desired_mps: dice.between(8.0, 14.0),
            route: (0..ROUTE).map(|_| dice.below(4) as u8).collect(),
            crossed: 0,
        };
        if let Some(leader) = vehicles.last().filter(|_| vehicles.len() < convoy) {
            vehicle.path = leader.path;
            vehicle.along_m = leader.along_m - ROOM_M;
            vehicle.route.clone_from(&leader.route);
        } else if convoy > 1 && vehicles.is_empty() {
            vehicle.along_m = roads.length_m(vehicle.path) - 1.0;
        }
        let is_free = |other: &MovingVehicle| {
            other.path != vehicle.path || (other.along_m - vehicle.along_m).abs() > ROOM_M - 0.5
        };
        // If there are no more places, vehicles stand closer, and the model separates them.
        if vehicles.len() < convoy || vehicles.iter().all(is_free) || dice.chance(0.001) {
            vehicles.push(vehicle);
        }
    }
    vehicles
}

/// Moves all vehicles on by `step_s`, one after the other.
pub(super) fn drive(roads: &Roads, vehicles: &mut [MovingVehicle], at_s: f64, step_s: f64) {
    for number in 0..vehicles.len() {
        let ahead = ahead(roads, vehicles, number, at_s);
        let vehicle = &mut vehicles[number];
        vehicle.accelerate(ahead, step_s);
        vehicle.along_m += vehicle.speed_mps * step_s;
        let length_m = roads.length_m(vehicle.path);
        if vehicle.along_m >= length_m {
            vehicle.along_m -= length_m;
            vehicle.path = vehicle.next(roads);
            vehicle.crossed += usize::from(matches!(vehicle.path, Path::Lane { .. }));
        }
    }
}

/// Road conditions ahead of a driver.
#[derive(Debug, Clone, Copy)]
struct Ahead {
    /// Free metres before the next thing to stop behind, and its speed.
    gap_m: f64,
    speed_mps: f64,
    /// Speed that the road allows here.
    limit_mps: f64,
}

fn ahead(roads: &Roads, vehicles: &[MovingVehicle], number: usize, at_s: f64) -> Ahead {
    let me = &vehicles[number];
    let remaining_m = roads.length_m(me.path) - me.along_m;
    let next = me.next(roads);
    let mut ahead = Ahead {
        gap_m: f64::INFINITY,
        speed_mps: 0.0,
        limit_mps: f64::INFINITY,
    };
    let mut mind = |distance_m: f64, other: &MovingVehicle| {
        let gap_m = distance_m - (me.length_m + other.length_m) / 2.0;
        if gap_m < ahead.gap_m {
            ahead.gap_m = gap_m;
            ahead.speed_mps = other.speed_mps;
        }
    };
    let after = match next {
        Path::Turn { at, to, .. } => Path::Lane {
            from: at,
            heading: to,
        },
        lane @ Path::Lane { .. } => lane,
    };
    for (place, other) in vehicles
        .iter()
        .enumerate()
        .filter(|(place, _)| *place != number)
    {
        if other.path == me.path && (other.along_m, place) > (me.along_m, number) {
            mind(other.along_m - me.along_m, other);
        } else if other.path != me.path && me.shares_beginning(other, next) {
            mind(remaining_m + other.along_m, other);
        } else if other.path == after && after != next {
            mind(remaining_m + roads.length_m(next) + other.along_m, other);
        }
    }
    match (me.path, next) {
        (Path::Lane { heading, .. }, Path::Turn { at, to, .. }) => {
            let is_bend = heading != to;
            if is_bend {
                ahead.limit_mps = (BEND_MPS * BEND_MPS + 2.0 * BRAKING * remaining_m).sqrt();
            }
            let can_stop = remaining_m > me.speed_mps * me.speed_mps / (2.0 * HARDEST_BRAKING);
            let may_go = (roads.is_green(at, heading, at_s) || !can_stop)
                && is_free(vehicles, number, at, heading, to);
            let to_line_m = remaining_m - me.length_m / 2.0;
            if !may_go && to_line_m < ahead.gap_m {
                ahead.gap_m = to_line_m;
                ahead.speed_mps = 0.0;
            }
        }
        (Path::Turn { from, to, .. }, _) if from != to => ahead.limit_mps = BEND_MPS,
        _ => {}
    }
    ahead
}

/// True if the crossing is free of vehicles in the way, and there is room behind it.
fn is_free(
    vehicles: &[MovingVehicle],
    number: usize,
    crossing: Crossing,
    heading: Direction,
    to: Direction,
) -> bool {
    let is_left = |from: Direction, to: Direction| (from + 1) % 4 == to % 4;
    vehicles
        .iter()
        .enumerate()
        .filter(|(place, _)| *place != number)
        .all(|(_, other)| match other.path {
            Path::Turn {
                at,
                from,
                to: other_to,
            } if at == crossing => {
                let faces = (from + 2) % 4 == heading % 4;
                from == heading || (faces && !is_left(heading, to) && !is_left(from, other_to))
            }
            Path::Lane {
                from,
                heading: other_heading,
            } if from == crossing && other_heading == to => other.along_m > ROOM_M,
            _ => true,
        })
}

impl MovingVehicle {
    /// Path that it drives on after this.
    #[expect(clippy::expect_used, reason = "the grid of roads has no dead ends")]
    fn next(&self, roads: &Roads) -> Path {
        match self.path {
            Path::Turn { at, to, .. } => Path::Lane {
                from: at,
                heading: to,
            },
            Path::Lane { from, heading } => {
                let at = roads
                    .next(from, heading)
                    .expect("every lane leads to a crossing");
                let straight = heading;
                let left = (heading + 1) % 4;
                let right = (heading + 3) % 4;
                let wishes = match self.route[self.crossed % self.route.len()] {
                    0 | 1 => [straight, right, left],
                    2 => [right, straight, left],
                    _ => [left, straight, right],
                };
                let to = wishes.into_iter().find(|to| roads.next(at, *to).is_some());
                Path::Turn {
                    at,
                    from: heading,
                    to: to.expect("a crossing has two other roads at least"),
                }
            }
        }
    }

    /// True if another vehicle's path begins like this one's: behind the same stop line,
    /// independent of its turn.
    fn shares_beginning(&self, other: &Self, next: Path) -> bool {
        match (next, other.path) {
            (
                Path::Turn { at, from, .. },
                Path::Turn {
                    at: other_at,
                    from: other_from,
                    ..
                },
            ) => (at, from) == (other_at, other_from),
            (next, path) => next == path,
        }
    }

    fn accelerate(&mut self, ahead: Ahead, step_s: f64) {
        let desired = self.desired_mps.min(ahead.limit_mps);
        let closing = self.speed_mps - ahead.speed_mps;
        let wanted_m = GAP_M
            + (self.speed_mps * GAP_S
                + self.speed_mps * closing / (2.0 * (ACCELERATION * BRAKING).sqrt()))
            .max(0.0);
        let gap_m = ahead.gap_m.max(0.1);
        let change =
            ACCELERATION * (1.0 - (self.speed_mps / desired).powi(4) - (wanted_m / gap_m).powi(2));
        self.speed_mps = (self.speed_mps + change.max(-HARDEST_BRAKING) * step_s).max(0.0);
    }
}
