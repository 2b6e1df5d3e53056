//! Painting order of objects on the ground, so that nearer objects hide farther ones.

use nalgebra::Point2;

/// Places of the footprints in the list, the farthest from the eye first. Corners are
/// counter-clockwise. Footprints that overlap, and footprints that hide each other in a circle, are
/// ordered by the distance of their middles.
pub(super) fn depth_order(eye: &Point2<f64>, footprints: &[[Point2<f64>; 4]]) -> Vec<usize> {
    let distance = |place: &usize| nalgebra::distance(eye, &middle(&footprints[*place]));
    let mut remaining: Vec<usize> = (0..footprints.len()).collect();
    remaining.sort_by(|a, b| distance(b).total_cmp(&distance(a)));
    let mut order = Vec::with_capacity(remaining.len());
    while !remaining.is_empty() {
        let hides_nothing = |place: &usize| {
            let mut others = remaining.iter().filter(|other| *other != place);
            others
                .all(|other| is_nearer(eye, &footprints[*place], &footprints[*other]) != Some(true))
        };
        let next = remaining.iter().position(hides_nothing).unwrap_or(0);
        order.push(remaining.remove(next));
    }
    order
}

/// True if `a` may hide `b` but not vice versa: a side of one footprint has the other entirely
/// beyond it. `None` if they overlap.
fn is_nearer(eye: &Point2<f64>, a: &[Point2<f64>; 4], b: &[Point2<f64>; 4]) -> Option<bool> {
    let parted_by_a = parting_side(a, b).map(|side| !is_beyond(side, eye));
    parted_by_a.or_else(|| parting_side(b, a).map(|side| is_beyond(side, eye)))
}

/// A side of a footprint, counter-clockwise.
#[derive(Debug, Clone, Copy)]
struct FootprintSide {
    from: Point2<f64>,
    to: Point2<f64>,
}

/// The first side of `a` that has all of `b` beyond it.
fn parting_side(a: &[Point2<f64>; 4], b: &[Point2<f64>; 4]) -> Option<FootprintSide> {
    let mut sides = (0..4).map(|corner| FootprintSide {
        from: a[corner],
        to: a[(corner + 1) % 4],
    });
    sides.find(|side| b.iter().all(|point| is_beyond(*side, point)))
}

/// True if a point is to the right of a side, outside of the footprint.
fn is_beyond(side: FootprintSide, point: &Point2<f64>) -> bool {
    (side.to - side.from).perp(&(point - side.from)) <= 0.0
}

fn middle(corners: &[Point2<f64>; 4]) -> Point2<f64> {
    nalgebra::center(&corners[0], &corners[2])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectangle(x: f64, y: f64, length: f64, width: f64) -> [Point2<f64>; 4] {
        super::super::corners(
            &ecod::model::geometry::Pose::new(x, y, 0.0),
            Point2::origin(),
            length,
            width,
        )
    }

    #[test]
    fn long_van_hides_pedestrian() {
        // Seen along the van: its middle is farther away than the pedestrian behind its tail.
        let eye = Point2::new(-10.0, -1.5);
        let van = rectangle(0.0, 0.0, 12.0, 2.0);
        let pedestrian = rectangle(-3.0, 1.5, 0.5, 0.5);
        assert!((middle(&pedestrian) - eye).norm() < (middle(&van) - eye).norm());
        assert_eq!(depth_order(&eye, &[van, pedestrian]), [1, 0]);
        assert_eq!(
            depth_order(&Point2::new(-10.0, 5.0), &[van, pedestrian]),
            [0, 1],
            "seen from the other side"
        );
    }

    #[test]
    fn row_is_painted_far_to_near() {
        let row: Vec<_> = [5.0, 15.0, 10.0]
            .map(|x| rectangle(x, 0.0, 4.0, 2.0))
            .into();
        assert_eq!(depth_order(&Point2::new(0.0, 0.5), &row), [1, 2, 0]);
    }
}
