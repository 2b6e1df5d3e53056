//! People and bicycles that go around their blocks.

use std::f64::consts::FRAC_PI_2;

use nalgebra::Point2;

use super::dice::Dice;
use super::roads::{Roads, unit};

/// From the middle of the road to where people and bicycles go, in metres.
const PAVEMENT_M: f64 = 7.6;
const KERB_M: f64 = 3.3;
/// Mean times in seconds between pauses, and of a pause.
const GOING_S: f64 = 25.0;
const PAUSE_S: f64 = 4.0;

#[derive(Debug, Clone)]
pub(super) struct Walker {
    pub(super) is_bicycle: bool,
    speed_mps: f64,
    block: Point2<f64>,
    side_m: f64,
    along_m: f64,
    /// People go either way, bicycles with the traffic.
    is_clockwise: bool,
    pauses_for_s: f64,
}

pub(super) fn walkers(
    roads: &Roads,
    count: usize,
    is_bicycle: bool,
    dice: &mut Dice<'_>,
) -> Vec<Walker> {
    let blocks = roads.blocks();
    let side_m = roads.block_m - 2.0 * if is_bicycle { KERB_M } else { PAVEMENT_M };
    let mut walker = || Walker {
        is_bicycle,
        speed_mps: if is_bicycle {
            dice.between(3.0, 6.0)
        } else {
            dice.between(0.8, 1.8)
        },
        block: blocks[dice.below(blocks.len())],
        side_m,
        along_m: dice.between(0.0, 4.0 * side_m),
        is_clockwise: is_bicycle || dice.chance(0.5),
        pauses_for_s: 0.0,
    };
    (0..count).map(|_| walker()).collect()
}

impl Walker {
    pub(super) fn step(&mut self, step_s: f64, dice: &mut Dice<'_>) {
        if self.pauses_for_s > 0.0 {
            self.pauses_for_s -= step_s;
        } else if dice.chance(step_s / GOING_S) {
            self.pauses_for_s = dice.exponential(PAUSE_S);
        } else {
            self.along_m = (self.along_m + self.speed_mps * step_s) % (4.0 * self.side_m);
        }
    }

    pub(super) fn speed_mps(&self) -> f64 {
        if self.pauses_for_s > 0.0 {
            0.0
        } else {
            self.speed_mps
        }
    }

    /// Position and heading in radians.
    pub(super) fn place(&self) -> (Point2<f64>, f64) {
        let around_m = 4.0 * self.side_m;
        let along_m = if self.is_clockwise {
            (around_m - self.along_m) % around_m
        } else {
            self.along_m
        };
        let side = (along_m / self.side_m) as usize % 4;
        let along = unit(side);
        let out = unit(side + 3);
        let at = self.block
            + out * (self.side_m / 2.0)
            + along * (along_m - (side as f64 + 0.5) * self.side_m);
        let turned = if self.is_clockwise { 2.0 } else { 0.0 };
        (at, (side as f64 + turned) * FRAC_PI_2)
    }
}
