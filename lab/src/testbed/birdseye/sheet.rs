//! From metres of the world to pixels of the picture.

use nalgebra::{Point2, Vector2};
use svg::node::element::{Group, Rectangle};

use super::{FAINT, line, text};
use crate::drawing::round;
use crate::testbed::Scene;

/// Scene files and axes are in inches.
pub(super) const METRES_PER_INCH: f64 = 0.0254;

/// The mapping of the world to the picture: east to the right, north up.
#[derive(Debug)]
pub(super) struct Sheet {
    /// South-western corner in metres.
    low: Point2<f64>,
    /// North-eastern corner in metres.
    high: Point2<f64>,
    px_per_m: f64,
}

impl Sheet {
    pub(super) const MARGIN_PX: f64 = 24.0;
    /// Next to the frame: the table to the left, the legend to the right.
    const LEFT_PX: f64 = 300.0;
    const RIGHT_PX: f64 = 260.0;
    const TOP_PX: f64 = 96.0;
    const BOTTOM_PX: f64 = 52.0;
    /// Length of the frame's longer side.
    const FRAME_PX: f64 = 600.0;
    /// Padding around the scene, for placards and names.
    const PADDING_M: f64 = 3.0 * METRES_PER_INCH;
    /// Least side of the frame.
    const MIN_M: f64 = 24.0 * METRES_PER_INCH;

    /// Room to the right of that, for the names of vehicles.
    const NAMES_M: f64 = 3.0 * METRES_PER_INCH;

    /// A sheet that holds every placard and vehicle of a scene.
    pub(super) fn around(scene: &Scene) -> Self {
        let spots = scene
            .spots
            .iter()
            .flat_map(|spot| spot.empty.into_iter().chain([spot.occupied]));
        let places: Vec<Point2<f64>> = spots
            .chain(scene.cavs.iter().map(|cav| cav.pose.position))
            .collect();
        let first = places.first().copied().unwrap_or_default();
        let (low, high) = places.iter().fold((first, first), |(low, high), place| {
            (low.inf(place), high.sup(place))
        });
        let lacking =
            (high - low).map(|side| (Self::MIN_M / 2.0 - Self::PADDING_M - side / 2.0).max(0.0));
        let room = lacking.add_scalar(Self::PADDING_M);
        let low = low - room;
        let high = high + room + Vector2::new(Self::NAMES_M, 0.0);
        Self {
            low,
            high,
            px_per_m: Self::FRAME_PX / (high - low).max(),
        }
    }

    /// Width and height of the picture in pixels.
    pub(super) fn size(&self) -> (f64, f64) {
        (
            self.right() + Self::RIGHT_PX,
            self.bottom() + Self::BOTTOM_PX,
        )
    }

    /// A place of the world in pixels.
    pub(super) fn at(&self, place: &Point2<f64>) -> (f64, f64) {
        (
            self.left() + self.length(place.x - self.low.x),
            self.top() + self.length(self.high.y - place.y),
        )
    }

    /// A length in pixels, from metres.
    pub(super) fn length(&self, metres: f64) -> f64 {
        metres * self.px_per_m
    }

    /// True if a place lies inside the frame.
    pub(super) fn holds(&self, place: &Point2<f64>) -> bool {
        (self.low.x..=self.high.x).contains(&place.x)
            && (self.low.y..=self.high.y).contains(&place.y)
    }

    pub(super) fn left(&self) -> f64 {
        Self::LEFT_PX
    }

    pub(super) fn right(&self) -> f64 {
        self.left() + self.length(self.high.x - self.low.x)
    }

    pub(super) fn top(&self) -> f64 {
        Self::TOP_PX
    }

    fn bottom(&self) -> f64 {
        self.top() + self.length(self.high.y - self.low.y)
    }

    /// The outline of the shown part of the world.
    pub(super) fn frame(&self) -> Rectangle {
        Rectangle::new()
            .set("x", round(self.left()))
            .set("y", round(self.top()))
            .set("width", round(self.right() - self.left()))
            .set("height", round(self.bottom() - self.top()))
    }

    /// Grid and numbers along the lower and the right side of the frame.
    pub(super) fn axes(&self) -> Group {
        let left = self.left();
        let right = self.right();
        let top = self.top();
        let bottom = self.bottom();
        let mut grid = Group::new().set("stroke", "#ededed");
        let mut numbers = Group::new().set("fill", FAINT).set("font-size", 11);
        let step = self.tick_in();
        for inches in ticks(self.low.x, self.high.x, step) {
            let x = left + self.length(inches * METRES_PER_INCH - self.low.x);
            grid = grid.add(line(x, top, x, bottom));
            numbers = numbers
                .add(text(x, bottom + 16.0, &inches.to_string()).set("text-anchor", "middle"));
        }
        for inches in ticks(self.low.y, self.high.y, step) {
            let y = bottom - self.length(inches * METRES_PER_INCH - self.low.y);
            grid = grid.add(line(left, y, right, y));
            numbers = numbers.add(text(right + 5.0, y + 4.0, &inches.to_string()));
        }
        let unit = text((left + right) / 2.0, bottom + 36.0, "inches").set("text-anchor", "middle");
        Group::new().add(grid).add(numbers.add(unit))
    }

    /// Inches between numbers: 1, 2 or 5 times a power of ten, at least 40 pixels.
    fn tick_in(&self) -> f64 {
        let least = 40.0 / self.length(METRES_PER_INCH);
        let power = 10f64.powf(least.log10().floor());
        [1.0, 2.0, 5.0, 10.0]
            .map(|factor| factor * power)
            .into_iter()
            .find(|step| *step >= least)
            .unwrap_or(least)
    }
}

/// Multiples of `step` inches between two places in metres.
fn ticks(low_m: f64, high_m: f64, step: f64) -> impl Iterator<Item = f64> {
    let first = (low_m / METRES_PER_INCH / step).ceil();
    let last = (high_m / METRES_PER_INCH / step).floor();
    (first as i64..=last as i64).map(move |index| index as f64 * step)
}
