//! Mistakes of conventions: how they change positions, and their words.

use std::collections::BTreeSet;
use std::f64::consts::{FRAC_PI_2, PI};
use std::fmt;

use nalgebra::Point2;

use super::isometry::Isometry;
use crate::model::geometry::{Pose, wrap_angle};
use crate::model::names::NodeName;
use crate::wire::ObjectReport;

/// A change of an observer's positions after which its objects coincide with the objects of others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Misreading {
    /// A turn about the observer's position.
    Turn {
        /// The angle in radians, counter-clockwise.
        angle_rad: f64,
        /// The heading that the observer states, in radians.
        heading_rad: f64,
    },
    /// A mirror at an axis through the observer's position.
    Mirror {
        /// Twice the angle of the axis in radians.
        angle_rad: f64,
        /// The heading that the observer states, in radians.
        heading_rad: f64,
    },
    /// A turn of the observer's frame about the origin of the cell.
    FrameTurn {
        /// The angle in radians, counter-clockwise.
        angle_rad: f64,
    },
    /// A mirror of the observer's frame at an axis through the origin of the cell.
    FrameMirror {
        /// Twice the angle of the axis in radians.
        angle_rad: f64,
    },
    /// A mistaken heading of this observer and of others.
    Shared(MistakenHeading),
}

/// A change that explains the objects of an observer, and the vehicles whose objects show it.
///
/// A sole vehicle shows only that it and the observer differ: the text then names both.
#[derive(Debug, Clone, PartialEq)]
pub struct MisreadObserver {
    /// The change.
    pub misreading: Misreading,
    /// The vehicles.
    pub witnesses: BTreeSet<NodeName>,
}

/// A mistake that explains the heading which an observer states.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MistakenHeading {
    /// Clockwise from north instead of counter-clockwise from east.
    Compass,
    /// Clockwise from east.
    Clockwise,
    /// In radians where degrees are due.
    Radians,
    /// Right, but the camera's left and right are swapped.
    SwappedSides,
    /// A quarter turn to the right of the camera's axis.
    RightOfAxis,
    /// A quarter turn to the left of the camera's axis.
    LeftOfAxis,
    /// Opposite to the camera's axis.
    Opposite,
}

/// Maximum difference of two angles that have one cause, radians.
const SAME_ANGLE_RAD: f64 = 0.17;

/// Headings in radians, taken as degrees, are between these bounds in magnitude, in radians.
const TINY_HEADING_RAD: [f64; 2] = [0.005, 0.11];

/// The number of degrees in a radian.
const DEGREES: f64 = 180.0 / PI;

impl MistakenHeading {
    /// Mistakes that observers may share.
    pub(super) const SHARED: [Self; 6] = [
        Self::Compass,
        Self::Clockwise,
        Self::SwappedSides,
        Self::RightOfAxis,
        Self::LeftOfAxis,
        Self::Opposite,
    ];

    /// The change that corrects the positions of an observer with this pose.
    fn correction(self, pose: &Pose) -> Isometry {
        let heading_rad = pose.heading_rad;
        if self == Self::SwappedSides {
            Isometry::mirror(pose.position, 2.0 * heading_rad)
        } else {
            Isometry::turn(pose.position, self.turn_rad(heading_rad))
        }
    }

    /// The turn from a stated heading to the right one.
    fn turn_rad(self, heading_rad: f64) -> f64 {
        match self {
            Self::Compass => FRAC_PI_2 - 2.0 * heading_rad,
            Self::Clockwise => -2.0 * heading_rad,
            Self::Radians => heading_rad * (DEGREES - 1.0),
            Self::SwappedSides => 0.0,
            Self::RightOfAxis => FRAC_PI_2,
            Self::LeftOfAxis => -FRAC_PI_2,
            Self::Opposite => PI,
        }
    }

    /// The mistake that explains a turn by an angle at a stated heading.
    fn of_turn(angle_rad: f64, heading_rad: f64) -> Option<Self> {
        let [least, most] = TINY_HEADING_RAD;
        let is_tiny = (least..most).contains(&heading_rad.abs());
        let radians = is_tiny.then_some(Self::Radians);
        radians
            .into_iter()
            .chain([Self::Compass, Self::Clockwise])
            .find(|mistake| is_same(mistake.turn_rad(heading_rad), angle_rad))
    }

    /// Text after “its objects agree with the objects of euclid”, for a mistake of all.
    fn of_all_in_words(self) -> &'static str {
        match self {
            Self::Compass => "as if all headings were clockwise from north",
            Self::Clockwise => "as if all headings were clockwise from east",
            Self::Radians => "as if all headings were radians in place of degrees",
            Self::SwappedSides => "if left and right of all images are swapped",
            Self::RightOfAxis => "after a turn of all headings by 90°",
            Self::LeftOfAxis => "after a turn of all headings by -90°",
            Self::Opposite => "after a turn of all headings by 180°",
        }
    }

    /// Text after “as if its heading were”; empty for mistakes that state their angle.
    fn of_one_in_words(self) -> &'static str {
        match self {
            Self::Compass => "clockwise from north",
            Self::Clockwise => "clockwise from east",
            Self::Radians => "radians in place of degrees",
            _ => "",
        }
    }
}

impl Misreading {
    /// Mistakes without a free angle.
    pub(super) fn without_angle() -> impl Iterator<Item = Self> {
        let quarters = [0.0, FRAC_PI_2, PI, -FRAC_PI_2];
        let turns = quarters.into_iter().skip(1);
        let shared = MistakenHeading::SHARED;
        let turns = turns.map(|angle_rad| Self::FrameTurn { angle_rad });
        let mirrors = quarters.map(|angle_rad| Self::FrameMirror { angle_rad });
        turns.chain(mirrors).chain(shared.map(Self::Shared))
    }

    /// The change of this observer's positions; `None` if it needs a pose.
    pub(super) fn own_change(&self, pose: Option<&Pose>) -> Option<Isometry> {
        let origin = Point2::origin();
        match *self {
            Self::Turn { angle_rad, .. } => Some(Isometry::turn(pose?.position, angle_rad)),
            Self::Mirror { angle_rad, .. } => Some(Isometry::mirror(pose?.position, angle_rad)),
            Self::FrameTurn { angle_rad } => Some(Isometry::turn(origin, angle_rad)),
            Self::FrameMirror { angle_rad } => Some(Isometry::mirror(origin, angle_rad)),
            Self::Shared(mistake) => Some(mistake.correction(pose?)),
        }
    }

    /// The change of another observer's positions; `None` if it needs a pose.
    pub(super) fn change_of_other(&self, pose: Option<&Pose>) -> Option<Isometry> {
        match self {
            Self::Shared(mistake) => Some(mistake.correction(pose?)),
            _ => Some(Isometry::identity()),
        }
    }

    /// True for changes about the origin of the cell, which all observers share.
    pub(super) fn is_of_frame(&self) -> bool {
        matches!(self, Self::FrameTurn { .. } | Self::FrameMirror { .. })
    }

    /// True for a mistake of this observer and of others.
    pub(super) fn is_shared(&self) -> bool {
        matches!(self, Self::Shared(_))
    }

    /// True if two windows show the same mistake, of a vehicle whose heading may have changed.
    pub(super) fn is_like(&self, other: &Self) -> bool {
        match (*self, *other) {
            (
                Self::Turn {
                    angle_rad,
                    heading_rad,
                },
                Self::Turn {
                    angle_rad: other_rad,
                    heading_rad: other_heading_rad,
                },
            ) => {
                let mistake = MistakenHeading::of_turn(angle_rad, heading_rad);
                is_same(angle_rad, other_rad)
                    || mistake.is_some()
                        && mistake == MistakenHeading::of_turn(other_rad, other_heading_rad)
            }
            (
                Self::Mirror {
                    angle_rad,
                    heading_rad,
                },
                Self::Mirror {
                    angle_rad: other_rad,
                    heading_rad: other_heading_rad,
                },
            ) => {
                is_same(angle_rad, other_rad)
                    || is_same(
                        angle_rad - 2.0 * heading_rad,
                        other_rad - 2.0 * other_heading_rad,
                    )
            }
            (one, other) => one == other,
        }
    }
}

fn is_same(one_rad: f64, other_rad: f64) -> bool {
    wrap_angle(one_rad - other_rad).abs() < SAME_ANGLE_RAD
}

/// An angle in degrees as exact as it is estimated, from -175 to 180.
fn about_degrees(angle_rad: f64) -> i32 {
    let degrees = 5 * (angle_rad.to_degrees() / 5.0).round() as i32;
    if degrees == -180 { 180 } else { degrees }
}

/// The exchange of axes that a mirror stands for.
fn axes_in_words(angle_rad: f64) -> Option<&'static str> {
    let named = [
        (0.0, "y is negated"),
        (FRAC_PI_2, "x and y are exchanged"),
        (PI, "x is negated"),
        (-FRAC_PI_2, "x and y are exchanged and negated"),
    ];
    let found = named.iter().find(|(axes, _)| is_same(*axes, angle_rad));
    found.map(|(_, words)| *words)
}

impl fmt::Display for MisreadObserver {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut names = self.witnesses.iter();
        let first = names.next().map_or("others", NodeName::as_str);
        write!(f, "its objects agree with the objects of {first}")?;
        let second = names.next();
        match (second, names.next()) {
            (Some(second), None) => write!(f, " and {second}")?,
            (Some(second), Some(_)) => write!(f, ", {second} and others")?,
            (None, _) => {}
        }
        write!(f, " {}", self.misreading)?;
        if second.is_some() {
            return Ok(());
        }
        match self.misreading {
            Misreading::Turn { .. } | Misreading::Mirror { .. } => {
                write!(f, "; if its pose and camera are right, check {first}")
            }
            Misreading::FrameTurn { .. } | Misreading::FrameMirror { .. } => {
                write!(f, "; if its axes are right, check {first}")
            }
            Misreading::Shared(_) => Ok(()),
        }
    }
}

/// Text after “its objects agree with the objects of euclid”.
impl fmt::Display for Misreading {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Turn {
                angle_rad,
                heading_rad,
            } => {
                let degrees = about_degrees(wrap_angle(angle_rad));
                write!(f, "after a turn by about {degrees}° at its position")?;
                let mistake = MistakenHeading::of_turn(angle_rad, heading_rad);
                mistake.map_or(Ok(()), |mistake| {
                    write!(f, ", as if its heading were {}", mistake.of_one_in_words())
                })
            }
            Self::Mirror {
                angle_rad,
                heading_rad,
            } if is_same(angle_rad, 2.0 * heading_rad) => {
                f.write_str("if left and right of its image are swapped")
            }
            Self::Mirror { angle_rad, .. } => match axes_in_words(angle_rad) {
                Some(words) => write!(f, "if {words} relative to its position"),
                None => write!(
                    f,
                    "after a mirror at an axis of about {}° through its position",
                    about_degrees(wrap_angle(angle_rad) / 2.0)
                ),
            },
            Self::FrameTurn { angle_rad } => write!(
                f,
                "after a turn by {:.0}° about the origin of the cell",
                angle_rad.to_degrees()
            ),
            Self::FrameMirror { angle_rad } => {
                let words = axes_in_words(angle_rad).unwrap_or("its frame is mirrored");
                write!(f, "if {words} in its pose and positions")
            }
            Self::Shared(mistake) => f.write_str(mistake.of_all_in_words()),
        }
    }
}

/// Maximum number of objects of a report that are compared.
const MAX_PLACED: usize = 64;

/// The first positions of a report, with the pose of its camera.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PlacedReport {
    pub(super) pose: Option<Pose>,
    pub(super) objects: Vec<Point2<f64>>,
    /// The bit of another vehicle in a comparison; 0 for the compared one.
    pub(super) witness: u32,
}

impl PlacedReport {
    pub(super) fn of(report: &ObjectReport) -> Self {
        let objects = report.objects.iter().take(MAX_PLACED);
        Self {
            pose: report.pose.map(Pose::from),
            objects: objects
                .map(|object| Point2::new(object.x_m, object.y_m))
                .collect(),
            witness: 0,
        }
    }
}
