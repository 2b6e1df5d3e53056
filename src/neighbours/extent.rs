//! The area that a cell's own maps cover.

use std::time::Duration;

use nalgebra::Point2;

use crate::model::time::Timestamp;

/// The rectangle around all places in the cell's maps of the last one to two spans of 30 s;
/// initially the origin.
#[derive(Debug, Clone, Default)]
pub(super) struct Extent {
    span_start: Timestamp,
    current: Option<Rectangle>,
    previous: Option<Rectangle>,
}

/// A rectangle along the axes, in metres.
#[derive(Debug, Clone, Copy)]
struct Rectangle {
    least: Point2<f64>,
    greatest: Point2<f64>,
}

impl Extent {
    const SPAN: Duration = Duration::from_secs(30);

    /// Processes the places in a map at `now`.
    pub(super) fn observe(&mut self, places: impl Iterator<Item = Point2<f64>>, now: Timestamp) {
        if now.since(self.span_start) >= Self::SPAN {
            self.previous = self.current.take();
            self.current = None;
            self.span_start = now;
        }
        for place in places {
            let known = self.current.unwrap_or(Rectangle {
                least: place,
                greatest: place,
            });
            self.current = Some(Rectangle {
                least: known.least.inf(&place),
                greatest: known.greatest.sup(&place),
            });
        }
    }

    /// Distance in metres of a place from the area, 0 in it.
    pub(super) fn distance_m(&self, place: &Point2<f64>) -> f64 {
        let parts = [self.current, self.previous];
        let distances = parts.iter().flatten().map(|part| part.distance_m(place));
        distances
            .min_by(f64::total_cmp)
            .unwrap_or(place.coords.norm())
    }
}

impl Rectangle {
    fn distance_m(&self, place: &Point2<f64>) -> f64 {
        let nearest = Point2::new(
            place.x.clamp(self.least.x, self.greatest.x),
            place.y.clamp(self.least.y, self.greatest.y),
        );
        (place - nearest).norm()
    }
}
