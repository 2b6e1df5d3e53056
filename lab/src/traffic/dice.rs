//! Draws from distributions, based on a source of uniform numbers.

use std::f64::consts::TAU;

/// A source of numbers drawn evenly from [0, 1).
pub(super) struct Dice<'a>(pub(super) &'a mut dyn FnMut() -> f64);

impl Dice<'_> {
    /// From `low` up to `high`.
    pub(super) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.0)()
    }

    /// A random number from 0 to `count` − 1.
    pub(super) fn below(&mut self, count: usize) -> usize {
        ((self.0)() * count as f64) as usize
    }

    /// True with this probability.
    pub(super) fn chance(&mut self, probability: f64) -> bool {
        (self.0)() < probability
    }

    /// Standard normal (Box and Muller 1958).
    pub(super) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - (self.0)()).ln()).sqrt();
        radius * (TAU * (self.0)()).cos()
    }

    /// Exponential with this mean.
    pub(super) fn exponential(&mut self, mean: f64) -> f64 {
        -mean * (1.0 - (self.0)()).ln()
    }

    /// Number of independent events at this mean: arrivals at exponential intervals.
    pub(super) fn poisson(&mut self, mean: f64) -> usize {
        let mut count = 0;
        let mut at = self.exponential(1.0);
        while at < mean {
            count += 1;
            at += self.exponential(1.0);
        }
        count
    }
}

/// A standard normal value that changes slowly: a stationary autoregressive process of first order.
#[derive(Debug, Clone, Copy)]
pub(super) struct Drift(pub(super) f64);

impl Drift {
    pub(super) fn new(dice: &mut Dice<'_>) -> Self {
        Self(dice.normal())
    }

    /// The value after `passed_s`, with a correlation of 1/e after `time_s`.
    pub(super) fn step(&mut self, passed_s: f64, time_s: f64, dice: &mut Dice<'_>) -> f64 {
        let kept = (-passed_s / time_s).exp();
        self.0 = kept * self.0 + (1.0 - kept * kept).sqrt() * dice.normal();
        self.0
    }
}
