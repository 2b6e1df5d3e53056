//! Ways through the street.

use ecod::model::geometry::Pose;
use nalgebra::Point2;

/// Half of the chord in metres along which something on a loop is headed, so that it does not turn
/// at once.
const HALF_CHORD_M: f64 = 0.4;

/// Where something is at every time.
#[derive(Debug, Clone)]
pub(super) enum Route {
    Stands(Pose),
    /// Around a closed way at a constant speed.
    Loop {
        /// The corners of the route; the first follows the last.
        corners: Vec<Point2<f64>>,
        /// Metres per second.
        speed_mps: f64,
        /// Metres from the first corner at time zero.
        start_m: f64,
    },
}

impl Route {
    pub(super) fn stands(x_m: f64, y_m: f64, heading_deg: f64) -> Self {
        Self::Stands(Pose::new(x_m, y_m, heading_deg.to_radians()))
    }

    /// Along a lane, around its end, back on the other lane and around: `half_m` is half of a lane,
    /// `radius_m` the distance of a lane from the middle of the road. Counter-clockwise, from the
    /// west end of the south lane.
    pub(super) fn road(half_m: f64, radius_m: f64, speed_mps: f64, start_m: f64) -> Self {
        const TURN: u32 = 16;
        let turn = |x_m: f64, from_rad: f64| {
            (0..=TURN).map(move |step| {
                let (sin, cos) =
                    (from_rad + std::f64::consts::PI * f64::from(step) / f64::from(TURN)).sin_cos();
                Point2::new(x_m + radius_m * cos, radius_m * sin)
            })
        };
        let east = turn(half_m, -std::f64::consts::FRAC_PI_2);
        let corners = east
            .chain(turn(-half_m, std::f64::consts::FRAC_PI_2))
            .collect();
        Self::Loop {
            corners,
            speed_mps,
            start_m: start_m - 2.0 * half_m,
        }
    }

    /// Position and heading at a time in seconds.
    pub(super) fn at(&self, at_s: f64) -> Pose {
        match self {
            Self::Stands(pose) => *pose,
            Self::Loop {
                corners,
                speed_mps,
                start_m,
            } => {
                let along_m = start_m + speed_mps * at_s;
                let chord =
                    point(corners, along_m + HALF_CHORD_M) - point(corners, along_m - HALF_CHORD_M);
                Pose {
                    position: point(corners, along_m),
                    heading_rad: chord.y.atan2(chord.x),
                }
            }
        }
    }
}

/// The point of a closed route at a distance in metres from its first corner.
fn point(corners: &[Point2<f64>], along_m: f64) -> Point2<f64> {
    let sides = || corners.iter().zip(corners.iter().cycle().skip(1));
    let length_m: f64 = sides().map(|(from, to)| nalgebra::distance(from, to)).sum();
    let mut left_m = along_m.rem_euclid(length_m);
    for (from, to) in sides() {
        let side_m = nalgebra::distance(from, to);
        if left_m < side_m {
            return from + (to - from) * (left_m / side_m);
        }
        left_m -= side_m;
    }
    corners.first().copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn route_is_walked_and_repeated() {
        let corners = vec![Point2::new(0.0, 0.0), Point2::new(8.0, 0.0)];
        let route = Route::Loop {
            corners,
            speed_mps: 2.0,
            start_m: 1.0,
        };
        let places = [0.0, 3.0, 5.0, 8.0].map(|at_s| route.at(at_s));
        assert_eq!(places.map(|pose| pose.position.x), [1.0, 7.0, 5.0, 1.0]);
        assert!(places[2].heading_rad.cos() < -0.99, "on the way back");
    }

    #[test]
    fn cars_keep_right_and_turn() {
        let route = Route::road(10.0, 2.5, 4.0, 0.0);
        let [start, end, turned] =
            [0.0, 4.9, 5.0 + 2.5 * std::f64::consts::PI / 4.0 + 1.0].map(|at_s| route.at(at_s));
        assert!(
            (start.position - Point2::new(-10.0, -2.5)).norm() < 0.1,
            "{start:?}"
        );
        assert!(
            (end.position - Point2::new(9.6, -2.5)).norm() < 0.1 && end.heading_rad.abs() < 1e-6,
            "{end:?}"
        );
        assert!(
            (turned.position - Point2::new(6.0, 2.5)).norm() < 0.2,
            "{turned:?}"
        );
        let mut headings = (0..200).map(|step| route.at(f64::from(step) * 0.1).heading_rad);
        let mut last = headings.next().unwrap();
        for heading in headings {
            let turn = ecod::model::geometry::wrap_angle(heading - last);
            assert!(
                turn > -1e-9 && turn < 0.25,
                "turned by {turn} rad in a tenth of a second"
            );
            last = heading;
        }
    }
}
