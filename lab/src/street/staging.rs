//! The street of the demo: a road with a lane each way, parked vans that hide the pavement behind
//! them, and four cameras.
//!
//! ```text
//!   houses ==================================================
//!   pavement      o ->   <- o        o              [ car ]
//!   parked       [ van ] [ van ]     [galileo <]
//!   road     ( <- - - - - - - gauss - - - - - car - - - - )
//!            ( - - - euclid - - - - - - - - - - - - - - -> )
//!   pavement  mast (kepler)   o ->   [kiosk]   <- o
//!   houses ==================================================
//! ```

use ecod::model::geometry::Pose;
use ecod::model::names::{Label, NodeName};
use ecod::perception::camera::Mount;
use nalgebra::Point2;

use super::route::Route;
use super::{Carrier, Solid, Street, StreetBody, StreetCamera};

/// Half of a lane's length and its distance from the middle of the road, in metres.
const LANE_M: [f64; 2] = [11.0, 2.5];
const CAR_MPS: f64 = 3.0;
const WALK_MPS: f64 = 1.2;
/// Height of a camera on a car in metres.
const CAR_CAMERA_M: f64 = 1.6;
/// Side of the placards of cars and of people in metres.
const CAR_PLACARD_M: f64 = 1.6;
const PERSON_PLACARD_M: f64 = 0.85;

impl Default for Street {
    fn default() -> Self {
        let driving =
            |start_m, color| car(Route::road(LANE_M[0], LANE_M[1], CAR_MPS, start_m), color);
        let parked = |x_m, color| van(Route::stands(x_m, 4.9, 0.0), color);
        let walk = |corners: &[[f64; 2]], start_m| Route::Loop {
            corners: corners
                .iter()
                .map(|[x_m, y_m]| Point2::new(*x_m, *y_m))
                .collect(),
            speed_mps: WALK_MPS,
            start_m,
        };
        let mut bodies = vec![
            driving(8.0, [180.0, 90.0, 30.0]),
            driving(38.0, [40.0, 130.0, 230.0]),
            car(Route::stands(9.8, 7.2, 180.0), [90.0, 150.0, 60.0]),
            driving(22.0, [70.0, 60.0, 200.0]),
            parked(-7.0, [200.0, 200.0, 205.0]),
            parked(-1.0, [120.0, 110.0, 70.0]),
            van(Route::stands(5.0, 4.9, 180.0), [60.0, 60.0, 65.0]),
            // Behind the vans.
            person(
                walk(&[[-5.0, 6.7], [5.5, 6.7], [5.5, 7.6], [-5.0, 7.6]], 4.0),
                [160.0, 90.0, 140.0],
            ),
            person(
                walk(&[[3.0, 7.6], [-8.0, 7.6], [-8.0, 6.7], [3.0, 6.7]], 2.0),
                [60.0, 150.0, 190.0],
            ),
            // Out from between two vans to the edge of the road, and back.
            person(
                walk(&[[2.0, 4.2], [2.0, 7.1], [-1.0, 7.1], [2.0, 7.1]], 1.0),
                [80.0, 80.0, 190.0],
            ),
            // On the other side, where a kiosk hides them from some.
            person(
                walk(
                    &[[-2.0, -5.0], [10.0, -5.0], [10.0, -5.8], [-2.0, -5.8]],
                    9.0,
                ),
                [150.0, 130.0, 60.0],
            ),
            person(
                walk(&[[9.0, -7.6], [-2.0, -7.6], [-2.0, -6.9], [9.0, -6.9]], 1.0),
                [70.0, 120.0, 90.0],
            ),
            // Around the ends of the road.
            person(
                walk(&[[16.4, -4.5], [16.4, 4.5], [17.2, 4.5], [17.2, -4.5]], 3.0),
                [120.0, 70.0, 70.0],
            ),
            person(
                walk(
                    &[[-16.4, 4.5], [-16.4, -4.5], [-17.2, -4.5], [-17.2, 4.5]],
                    5.0,
                ),
                [60.0, 70.0, 160.0],
            ),
        ];
        bodies.push(plain(1.5, -6.3, [2.4, 1.0, 2.6], [70.0, 110.0, 60.0]));
        let houses = [
            [90.0, 130.0, 170.0],
            [150.0, 160.0, 175.0],
            [100.0, 105.0, 150.0],
            [140.0, 170.0, 185.0],
        ];
        for (number, color) in (0..).zip(houses) {
            let x_m = -13.5 + 9.0 * f64::from(number);
            let height_m = [7.0, 9.0, 6.5, 8.0][number as usize];
            bodies.push(plain(x_m, 11.0, [9.0, 4.0, height_m], color));
            bodies.push(plain(-x_m, -11.0, [9.0, 4.0, 15.0 - height_m], color));
        }
        bodies.push(plain(20.0, 0.0, [2.0, 18.0, 5.0], [95.0, 120.0, 125.0]));
        bodies.push(plain(-20.0, 0.0, [2.0, 18.0, 5.0], [95.0, 120.0, 125.0]));
        let on_car = |name, body| StreetCamera {
            name: NodeName::from_static(name),
            carrier: Carrier::Body(body),
            mount: Mount {
                height_m: Some(CAR_CAMERA_M),
                ..Mount::default()
            },
        };
        let mast = StreetCamera {
            name: NodeName::from_static("kepler"),
            carrier: Carrier::Mast(Pose::new(-7.0, -8.2, 0.6)),
            mount: Mount {
                height_m: Some(4.5),
                pitch_rad: 14f64.to_radians(),
                ..Mount::default()
            },
        };
        Self {
            bodies,
            cameras: vec![
                on_car("euclid", 0),
                on_car("gauss", 1),
                on_car("galileo", 6),
                mast,
            ],
        }
    }
}

fn car(route: Route, color: [f64; 3]) -> StreetBody {
    let glass = [90.0, 80.0, 70.0];
    let solids = vec![
        solid([0.0, 4.4, 1.8], [0.25, 0.85], color),
        solid([-0.2, 2.4, 1.6], [0.85, 1.45], glass),
        placard(CAR_PLACARD_M, 1.45),
    ];
    StreetBody {
        label: Some(Label::new_static("car")),
        route,
        solids,
    }
}

fn van(route: Route, color: [f64; 3]) -> StreetBody {
    let solids = vec![
        solid([0.0, 5.0, 2.0], [0.25, 2.3], color),
        placard(CAR_PLACARD_M, 2.3),
    ];
    StreetBody {
        label: Some(Label::new_static("car")),
        route,
        solids,
    }
}

fn person(route: Route, color: [f64; 3]) -> StreetBody {
    let trousers = [80.0, 60.0, 50.0];
    let skin = [140.0, 170.0, 215.0];
    let shoulders_m = 0.75 + PERSON_PLACARD_M;
    let solids = vec![
        solid([0.0, 0.3, 0.42], [0.0, 0.62], trousers),
        solid([0.0, 0.42, 0.6], [0.62, 0.75], color),
        placard(PERSON_PLACARD_M, 0.75),
        solid([0.0, 0.24, 0.24], [shoulders_m, shoulders_m + 0.28], skin),
    ];
    StreetBody {
        label: Some(Label::new_static("person")),
        route,
        solids,
    }
}

/// A house or the like: its middle; length, width and height.
fn plain(
    x_m: f64,
    y_m: f64,
    [length_m, width_m, height_m]: [f64; 3],
    color: [f64; 3],
) -> StreetBody {
    let solids = vec![solid([0.0, length_m, width_m], [0.0, height_m], color)];
    StreetBody {
        label: None,
        route: Route::stands(x_m, y_m, 0.0),
        solids,
    }
}

fn solid([forward_m, length_m, width_m]: [f64; 3], heights_m: [f64; 2], color: [f64; 3]) -> Solid {
    Solid {
        forward_m,
        left_m: 0.0,
        length_m,
        width_m,
        heights_m,
        color,
        is_placard: false,
    }
}

/// A cube of placards.
fn placard(side_m: f64, bottom_m: f64) -> Solid {
    let white = [235.0, 238.0, 240.0];
    Solid {
        is_placard: true,
        ..solid([0.0, side_m, side_m], [bottom_m, bottom_m + side_m], white)
    }
}
