//! Polygons in a camera's picture, such as its masked parts.

use nalgebra::Point2;

use crate::model::detection::BoundingBox;

/// A polygon whose edges do not cross or touch; x grows to the right, y downwards.
#[derive(Debug, Clone, PartialEq)]
pub struct Polygon {
    corners: Vec<Point2<f64>>,
}

/// The reason why corners are not a polygon.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PolygonError {
    /// There are fewer than three corners.
    #[error("{0} corners")]
    TooFewCorners(usize),
    /// A corner is NaN or infinite.
    #[error("corner {0} without a finite place")]
    NotFinite(usize),
    /// Two edges cross or touch; each number is of the corner at which the edge begins, from 0.
    #[error("edges from corners {first} and {second} that cross or touch")]
    Crossing {
        /// The earlier edge.
        first: usize,
        /// The later edge.
        second: usize,
    },
    /// All corners are on a line.
    #[error("corners on one line")]
    Flat,
}

/// A straight line between two points.
#[derive(Clone, Copy)]
struct Edge {
    from: Point2<f64>,
    to: Point2<f64>,
}

impl Edge {
    /// Positive if `point` is on the one side of the line through this edge, negative on the other.
    fn side(&self, point: &Point2<f64>) -> f64 {
        (self.to - self.from).perp(&(point - self.from))
    }

    /// True if the edges have one inner point in common.
    fn crosses(&self, other: &Self) -> bool {
        self.side(&other.from) * self.side(&other.to) < 0.0
            && other.side(&self.from) * other.side(&self.to) < 0.0
    }

    /// True if `point` is on this edge.
    fn has(&self, point: &Point2<f64>) -> bool {
        let between = |a: f64, b: f64, value: f64| (a.min(b)..=a.max(b)).contains(&value);
        self.side(point) == 0.0
            && between(self.from.x, self.to.x, point.x)
            && between(self.from.y, self.to.y, point.y)
    }

    /// True if the edges have a point in common.
    fn meets(&self, other: &Self) -> bool {
        self.crosses(other)
            || [other.from, other.to].iter().any(|end| self.has(end))
            || [self.from, self.to].iter().any(|end| other.has(end))
    }
}

impl Polygon {
    /// A polygon with these corners in order, clockwise or counter-clockwise. A corner that repeats
    /// the one before, as at the end of a closed ring, is ignored.
    ///
    /// # Errors
    /// Returns a [`PolygonError`] if the corners enclose no area, or it is unclear which.
    pub fn new(corners: &[Point2<f64>]) -> Result<Self, PolygonError> {
        if corners.len() < 3 {
            return Err(PolygonError::TooFewCorners(corners.len()));
        }
        let is_finite = |corner: &Point2<f64>| corner.iter().all(|value| value.is_finite());
        if let Some(index) = corners.iter().position(|corner| !is_finite(corner)) {
            return Err(PolygonError::NotFinite(index));
        }
        let numbered: Vec<(usize, Edge)> = edges(corners)
            .enumerate()
            .filter(|(_, edge)| edge.from != edge.to)
            .collect();
        let is_flat = numbered.first().is_none_or(|(_, base)| {
            let is_on_line = |corner: &Point2<f64>| base.side(corner) == 0.0;
            corners.iter().all(is_on_line)
        });
        if is_flat {
            return Err(PolygonError::Flat);
        }
        let last = numbered.len() - 1;
        for (place, (first, edge)) in numbered.iter().enumerate() {
            // The next edge begins where this one ends, and the last edge ends where the first begins.
            let others = numbered.iter().enumerate().skip(place + 2);
            let met = others
                .filter(|(other_place, _)| place > 0 || *other_place < last)
                .find(|(_, (_, other))| edge.meets(other));
            if let Some((_, (second, _))) = met {
                return Err(PolygonError::Crossing {
                    first: *first,
                    second: *second,
                });
            }
        }
        let corners = numbered.iter().map(|(_, edge)| edge.from).collect();
        Ok(Self { corners })
    }

    /// The corners in order.
    pub fn corners(&self) -> &[Point2<f64>] {
        &self.corners
    }

    /// The polygon in a picture that is larger by these factors.
    #[must_use]
    pub fn scaled(&self, x: f64, y: f64) -> Self {
        self.mapped(|corner| Point2::new(corner.x * x, corner.y * y))
    }

    /// The polygon with each corner at another place.
    #[must_use]
    pub fn mapped(&self, place: impl Fn(&Point2<f64>) -> Point2<f64>) -> Self {
        Self {
            corners: self.corners.iter().map(place).collect(),
        }
    }

    /// The same outline with `parts` times as many corners, so that [`Self::mapped`] bends its
    /// edges.
    #[must_use]
    pub fn subdivided(&self, parts: u16) -> Self {
        let along = |edge: Edge| {
            let at = move |part| f64::from(part) / f64::from(parts);
            (0..parts).map(move |part| edge.from + (edge.to - edge.from) * at(part))
        };
        Self {
            corners: self.edges().flat_map(along).collect(),
        }
    }

    /// True if the polygon and the box have an area in common.
    pub fn overlaps(&self, area: &BoundingBox) -> bool {
        let BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        } = *area;
        let is_in_area = |corner: &Point2<f64>| {
            (x_min..=x_max).contains(&corner.x) && (y_min..=y_max).contains(&corner.y)
        };
        let corners = [
            [x_min, y_min],
            [x_max, y_min],
            [x_max, y_max],
            [x_min, y_max],
        ]
        .map(Point2::from);
        let is_crossed = |side: Edge| self.edges().any(|edge| edge.crosses(&side));
        self.corners.iter().any(is_in_area)
            || corners.iter().any(|corner| self.contains(corner))
            || self.contains(&area.center())
            || edges(&corners).any(is_crossed)
    }

    /// True if a ray from the point to the right leaves the polygon more often than it enters.
    fn contains(&self, point: &Point2<f64>) -> bool {
        let crossings = self.edges().filter(|Edge { from, to }| {
            let is_level = (from.y > point.y) != (to.y > point.y);
            is_level && point.x < from.x + (point.y - from.y) / (to.y - from.y) * (to.x - from.x)
        });
        crossings.count() % 2 == 1
    }

    fn edges(&self) -> impl Iterator<Item = Edge> {
        edges(&self.corners)
    }
}

/// The edges from each corner to the next, and from the last to the first.
fn edges(corners: &[Point2<f64>]) -> impl Iterator<Item = Edge> {
    let next = corners.iter().cycle().skip(1);
    corners.iter().zip(next).map(|(from, to)| Edge {
        from: *from,
        to: *to,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn polygon(corners: &[[f64; 2]]) -> Result<Polygon, PolygonError> {
        let corners: Vec<_> = corners.iter().copied().map(Point2::from).collect();
        Polygon::new(&corners)
    }

    fn area(x_min: f64, y_min: f64, x_max: f64, y_max: f64) -> BoundingBox {
        BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        }
    }

    #[test]
    fn unclear_corners_are_refused() {
        let refused = |corners: &[[f64; 2]]| polygon(corners).unwrap_err();
        assert_eq!(refused(&[]), PolygonError::TooFewCorners(0));
        assert_eq!(
            refused(&[[0.0, 0.0], [1.0, 0.0]]),
            PolygonError::TooFewCorners(2)
        );
        assert_eq!(
            refused(&[[0.0, 0.0], [f64::NAN, 0.0], [1.0, 1.0]]),
            PolygonError::NotFinite(1)
        );
        assert_eq!(
            refused(&[[0.0, 0.0], [0.5, 0.5], [1.0, 1.0]]),
            PolygonError::Flat
        );
        assert_eq!(refused(&[[0.5, 0.5]; 3]), PolygonError::Flat);
        // Corners row by row instead of around the area.
        assert_eq!(
            refused(&[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
            PolygonError::Crossing {
                first: 1,
                second: 3
            }
        );
    }

    /// Outlines by which a point is inside twice, and would not be covered.
    #[test]
    fn touching_edges_are_refused() {
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let twice = [square, square].concat();
        let through_corner = [[0.0, 0.0], [0.5, 0.5], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]];
        for corners in [&twice[..], &through_corner] {
            let error = polygon(corners).unwrap_err();
            assert!(matches!(error, PolygonError::Crossing { .. }), "{error}");
        }
    }

    #[test]
    fn closed_rings_are_accepted() {
        let ring = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]];
        assert!(polygon(&ring).is_ok());
        assert!(
            polygon(&ring)
                .unwrap()
                .subdivided(4)
                .overlaps(&area(0.4, 0.4, 0.6, 0.6))
        );
    }

    #[test]
    fn overlap_respects_notches() {
        // A U: its notch, x from 1 to 2 and y from 0 to 2, is outside.
        let u = polygon(&[
            [0.0, 0.0],
            [1.0, 0.0],
            [1.0, 2.0],
            [2.0, 2.0],
            [2.0, 0.0],
            [3.0, 0.0],
            [3.0, 3.0],
            [0.0, 3.0],
        ])
        .unwrap();
        assert!(!u.overlaps(&area(1.2, 0.2, 1.8, 1.8)), "in the notch");
        assert!(u.overlaps(&area(1.2, 0.2, 1.8, 2.2)), "its lower edge");
        assert!(u.overlaps(&area(0.2, 0.2, 0.8, 0.8)), "inside");
        assert!(u.overlaps(&area(-1.0, -1.0, 4.0, 4.0)), "around");
        assert!(u.overlaps(&area(-1.0, 0.5, 4.0, 0.6)), "across");
        assert!(!u.overlaps(&area(3.1, 0.0, 4.0, 3.0)), "beside");
        assert!(u.scaled(10.0, 1.0).overlaps(&area(29.0, 0.0, 31.0, 1.0)));
    }
}
