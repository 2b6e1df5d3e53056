//! Lines of sight: vehicles and buildings hide objects behind them.

use ecod::model::geometry::wrap_angle;
use nalgebra::{Point2, Vector2};

use super::roads::Building;

/// Something that stands or moves on the ground.
#[derive(Debug, Clone)]
pub(super) struct TrafficBody {
    pub(super) label: &'static str,
    pub(super) center: Point2<f64>,
    pub(super) heading_rad: f64,
    pub(super) speed_mps: f64,
    pub(super) length_m: f64,
    pub(super) width_m: f64,
    /// True if it hides objects behind it.
    pub(super) is_opaque: bool,
}

/// Visible part of a body, seen from somewhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sight {
    /// Its place among the bodies.
    pub(super) body: usize,
    pub(super) range_m: f64,
    /// World direction towards it.
    pub(super) bearing_rad: f64,
    /// Unhidden share of its apparent width, 0 to 1.
    pub(super) share: f64,
    /// Half its apparent width as an angle.
    half_rad: f64,
}

/// Bodies within `range_m` of a place, and the visible share of each from there; the body at the
/// place itself is left out.
pub(super) fn sights(
    from: Point2<f64>,
    bodies: &[TrafficBody],
    buildings: &[Building],
    range_m: f64,
) -> Vec<Sight> {
    let mut sights: Vec<Sight> = (0..bodies.len())
        .filter_map(|body| Sight::towards(from, body, &bodies[body], range_m))
        .collect();
    sights.sort_by(|a, b| a.range_m.total_cmp(&b.range_m));
    for place in 0..sights.len() {
        let (nearer, rest) = sights.split_at_mut(place);
        let sight = &mut rest[0];
        let opaque = nearer.iter().filter(|other| bodies[other.body].is_opaque);
        sight.share = sight.uncovered(opaque) * past_buildings(from, sight, buildings);
    }
    sights
}

impl Sight {
    fn towards(from: Point2<f64>, body: usize, of: &TrafficBody, limit_m: f64) -> Option<Self> {
        let offset = of.center - from;
        let range_m = offset.norm();
        if range_m > limit_m || range_m == 0.0 {
            return None;
        }
        let bearing_rad = offset.y.atan2(offset.x);
        let (sin, cos) = (of.heading_rad - bearing_rad).sin_cos();
        let half_m = (of.length_m * sin.abs() + of.width_m * cos.abs()) / 2.0;
        Some(Self {
            body,
            range_m,
            bearing_rad,
            share: 1.0,
            half_rad: half_m.atan2(range_m),
        })
    }

    /// Share of the angle that the others leave uncovered.
    fn uncovered<'a>(&self, others: impl Iterator<Item = &'a Self>) -> f64 {
        let mut covers: Vec<(f64, f64)> = others
            .filter_map(|other| {
                let middle = wrap_angle(other.bearing_rad - self.bearing_rad);
                let low = middle - other.half_rad;
                let high = middle + other.half_rad;
                (low < self.half_rad && high > -self.half_rad)
                    .then_some((low.max(-self.half_rad), high.min(self.half_rad)))
            })
            .collect();
        covers.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut covered = 0.0;
        let mut reached = -self.half_rad;
        for (low, high) in covers {
            covered += (high - low.max(reached)).max(0.0);
            reached = reached.max(high);
        }
        (1.0 - covered / (2.0 * self.half_rad)).max(0.0)
    }
}

/// Share of three points across a body that buildings leave visible.
fn past_buildings(from: Point2<f64>, sight: &Sight, buildings: &[Building]) -> f64 {
    let points = [-0.8, 0.0, 0.8].map(|share| {
        let (sin, cos) = (sight.bearing_rad + share * sight.half_rad).sin_cos();
        from + Vector2::new(cos, sin) * sight.range_m
    });
    points
        .iter()
        .filter(|to| !buildings.iter().any(|building| building.hides(&from, to)))
        .count() as f64
        / 3.0
}

#[cfg(test)]
mod tests {
    use super::super::roads::Roads;
    use super::*;

    fn car(x: f64, y: f64) -> TrafficBody {
        let center = Point2::new(x, y);
        TrafficBody {
            label: "car",
            center,
            heading_rad: 0.0,
            speed_mps: 0.0,
            length_m: 4.0,
            width_m: 2.0,
            is_opaque: true,
        }
    }

    fn share(bodies: &[TrafficBody], body: usize) -> f64 {
        let buildings = Roads {
            count: 2,
            block_m: 80.0,
        }
        .buildings();
        sights(bodies[0].center, bodies, &buildings, 100.0)
            .into_iter()
            .find(|sight| sight.body == body)
            .unwrap()
            .share
    }

    #[test]
    fn vehicle_hides_only_objects_behind() {
        let queue = [
            car(0.0, -2.0),
            car(10.0, -2.0),
            car(20.0, -2.0),
            car(20.0, 2.0),
        ];
        assert_eq!([1, 2].map(|body| share(&queue, body)), [1.0, 0.0]);
        assert!(share(&queue, 3) > 0.9, "the next lane is seen past it");
        let mut seen_over = queue.clone();
        seen_over[1].is_opaque = false;
        assert_eq!(share(&seen_over, 2), 1.0);
        let half = [car(0.0, 0.0), car(10.0, 0.9), car(20.0, 0.0)];
        assert!((0.2..0.8).contains(&share(&half, 2)), "{}", share(&half, 2));
    }

    #[test]
    fn building_hides_next_road() {
        // The building stands between 10 and 70 m on both axes.
        let corner = [car(0.0, 40.0), car(40.0, 0.0), car(5.0, 80.0)];
        assert_eq!([1, 2].map(|body| share(&corner, body)), [0.0, 1.0]);
        assert!(
            sights(corner[0].center, &corner, &[], 30.0).is_empty(),
            "too far"
        );
    }
}
