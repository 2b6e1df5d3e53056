//! A generated street: cars drive around its two ends, people walk, and cars, vans and houses hide
//! objects behind them.
//!
//! Cars and people wear placards on four sides, so that a real detector can read rendered pictures.
//! A placard states the kind of its wearer, `car` or `person`, but not which one: distinguishing
//! individuals is the cell's task. The motion is a function of time alone, so that the truth is
//! available for every moment.

mod depth_order;
pub mod network_camera;
mod route;
mod staging;
pub(crate) mod video;
pub(crate) mod view;

use ecod::model::geometry::Pose;
use ecod::model::names::{Label, NodeName};
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::projection::{ObjectSize, ObjectSizes};
use nalgebra::Point2;

use crate::eval::tracks::TrueObject;
use route::Route;

/// Quiet zone on each side of a code and side of the code, in modules.
const QUIET_MODULES: usize = 2;
const CODE_MODULES: usize = 21;

/// All bodies in the street, and its cameras.
#[derive(Debug, Clone)]
pub struct Street {
    /// People, cars, and bodies without a label: houses and a kiosk.
    pub bodies: Vec<StreetBody>,
    /// All cameras, each with its node.
    pub cameras: Vec<StreetCamera>,
}

/// Something that stands or moves on the ground.
#[derive(Debug, Clone)]
pub struct StreetBody {
    /// Text of its placards, if it wears any.
    pub label: Option<Label>,
    route: Route,
    solids: Vec<Solid>,
}

/// An upright box, a part of a body; lengths in metres, in the frame of the body.
#[derive(Debug, Clone, Copy)]
struct Solid {
    forward_m: f64,
    left_m: f64,
    length_m: f64,
    width_m: f64,
    /// Lower and upper end above the ground.
    heights_m: [f64; 2],
    /// Blue, green and red, 0 to 255.
    color: [f64; 3],
    /// True if its four sides are placards; they are square then.
    is_placard: bool,
}

/// One camera of the street.
#[derive(Debug, Clone)]
pub struct StreetCamera {
    /// Name of its node.
    pub name: NodeName,
    /// Body or mast on which the camera is mounted.
    pub carrier: Carrier,
    /// Its height and angles.
    pub mount: Mount,
}

/// The place of a camera.
#[derive(Debug, Clone, Copy)]
pub enum Carrier {
    /// On the middle of this body, which it does not see.
    Body(usize),
    /// On a mast with this pose.
    Mast(Pose),
}

impl Street {
    /// The optics of every camera.
    pub fn optics() -> Intrinsics {
        Intrinsics::with_square_pixels(1024, 768, 80f64.to_radians())
    }

    /// Pose of a camera's carrier at a time in seconds.
    pub fn pose(&self, camera: &StreetCamera, at_s: f64) -> Pose {
        match camera.carrier {
            Carrier::Body(body) => self.bodies[body].route.at(at_s),
            Carrier::Mast(pose) => pose,
        }
    }

    /// True if the carrier of a camera drives.
    pub fn drives(&self, camera: &StreetCamera) -> bool {
        matches!(camera.carrier, Carrier::Body(body) if matches!(self.bodies[body].route, Route::Loop { .. }))
    }

    /// All cars and people at a time in seconds.
    pub fn truth(&self, at_s: f64) -> Vec<TrueObject> {
        let labelled = (0u32..)
            .zip(&self.bodies)
            .filter_map(|(id, body)| Some((id, body, body.label.clone()?)));
        labelled
            .map(|(id, body, label)| TrueObject {
                id,
                label,
                position: body.route.at(at_s).position,
            })
            .collect()
    }

    /// Sides of the codes by label.
    pub fn code_sizes(&self) -> ObjectSizes {
        let sizes = self.bodies.iter().filter_map(|body| {
            let placard = body.solids.iter().find(|solid| solid.is_placard)?;
            let all = (CODE_MODULES + 2 * QUIET_MODULES) as f64;
            Some((
                body.label.clone()?,
                ObjectSize::square(placard.width_m * CODE_MODULES as f64 / all),
            ))
        });
        ObjectSizes {
            default: None,
            labels: sizes.collect(),
        }
    }
}

impl StreetBody {
    /// Length and width around all parts, and the middle of this rectangle in the frame of the
    /// body.
    fn extent(&self) -> (Point2<f64>, [f64; 2]) {
        let ends = |middle: fn(&Solid) -> f64, size: fn(&Solid) -> f64| {
            let low = self
                .solids
                .iter()
                .map(|solid| middle(solid) - size(solid) / 2.0)
                .fold(f64::INFINITY, f64::min);
            let high = self
                .solids
                .iter()
                .map(|solid| middle(solid) + size(solid) / 2.0);
            (low, high.fold(f64::NEG_INFINITY, f64::max))
        };
        let (back, front) = ends(|solid| solid.forward_m, |solid| solid.length_m);
        let (right, left) = ends(|solid| solid.left_m, |solid| solid.width_m);
        (
            Point2::new((back + front) / 2.0, (right + left) / 2.0),
            [front - back, left - right],
        )
    }

    /// Corners of its extent on the ground, counter-clockwise.
    fn footprint(&self, pose: &Pose) -> [Point2<f64>; 4] {
        let (middle, [length_m, width_m]) = self.extent();
        corners(pose, middle, length_m, width_m)
    }
}

/// Corners of a rectangle in the frame of a body, counter-clockwise from the front right one.
fn corners(pose: &Pose, middle: Point2<f64>, length_m: f64, width_m: f64) -> [Point2<f64>; 4] {
    [(0.5, -0.5), (0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5)].map(|(ahead, aside)| {
        pose.transform(middle.x + ahead * length_m, middle.y + aside * width_m)
    })
}
