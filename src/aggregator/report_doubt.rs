//! Doubts about reports that are used nevertheless.

use std::fmt;
use std::time::Duration;

use nalgebra::Point2;

use super::orientation::MisreadObserver;
use crate::model::geometry::Pose;
use crate::wire::ObjectReport;

/// Time for which a vehicle's objects must all be without effect before this counts as a doubt: the
/// vehicle may see other things.
pub(super) const MIN_MISPLACED: Duration = Duration::from_secs(10);

/// Distance in metres from the landmarks, in addition to their extent, beyond which a cell tracks
/// no objects.
pub(super) const MAX_AWAY_M: f64 = 200.0;

/// Maximum range in metres at which a camera can recognise an object.
const MAX_SEEN_RANGE_M: f64 = 300.0;

/// A doubt about the reports of a vehicle.
#[derive(Debug, Clone, PartialEq)]
pub enum ReportDoubt {
    /// An object is farther from the camera than a camera can see: positions are in another unit.
    FarObject {
        /// Its range in metres.
        range_m: f64,
    },
    /// For ten seconds all objects have been away from the landmarks or, if objects are tracked,
    /// not even near a landmark: positions are in another unit or frame.
    NoObjectAtLocation,
    /// The vehicle states that it does not move, but its pose changes.
    Moves,
    /// The objects coincide with the objects of others after a turn or a mirror: a heading or a frame
    /// follows another convention.
    Misread(MisreadObserver),
    /// Two senders report under the name: their numbers go back and forth.
    SharedName,
}

impl ReportDoubt {
    /// The doubt about the range of the objects of a report, if there is one.
    pub(super) fn of_ranges(report: &ObjectReport) -> Option<Self> {
        let camera = Pose::from(report.pose?).position;
        let range_m = report
            .objects
            .iter()
            .map(|object| nalgebra::distance(&camera, &Point2::new(object.x_m, object.y_m)))
            .fold(0.0, f64::max);
        (range_m > MAX_SEEN_RANGE_M).then_some(Self::FarObject { range_m })
    }
}

impl fmt::Display for ReportDoubt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::FarObject { range_m } => write!(f, "an object of its report is {range_m:.0} m from its pose"),
            Self::NoObjectAtLocation => f.write_str("none of its objects is at a known location, or near one"),
            Self::Moves => f.write_str("it states `moving` = false, and its pose has moved by more than 25 m"),
            Self::Misread(observer) => observer.fmt(f),
            Self::SharedName => {
                f.write_str("two programs report under this name: the numbers `seq` of its reports go back and forth")
            }
        }
    }
}
