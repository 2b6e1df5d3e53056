//! A cell as messages of ROS 2, without ROS code on this side.
//!
//! Frames are those of REP 103 and REP 105: `map` is the cell's frame, x east and y north unless the cell's origin is rotated.
//! `<node>_camera` is a camera, x along its axis and z up; `<node>_camera_optical` the same camera, z along its axis and x right.

mod camera;
mod detections;
mod log;
mod markers;
mod messages;
#[cfg(feature = "dds")]
mod pictured;
mod transforms;

use ecod::model::names::NodeName;
use ecod::wire::{GlobalMap, ObjectReport};
use serde::Serialize;

#[cfg(feature = "dds")]
pub(crate) use camera::CameraInfo;
pub(crate) use detections::Detection3DArray;
#[cfg(feature = "dds")]
pub(crate) use detections::{Detection3D, ObjectHypothesisWithPose};
use markers::MarkerArray;
use transforms::TFMessage;

pub use log::{Conversion, ConversionError, convert};
pub(crate) use messages::{Definition, Header};
#[cfg(feature = "dds")]
pub(crate) use messages::{RosPose, encode};
#[cfg(feature = "dds")]
pub(crate) use pictured::Detection2DArray;

/// Destination of messages: a file, or live topics.
pub(crate) trait RosSink {
    /// The reason why a message was not taken.
    type Error;

    /// Takes a message.
    fn put<M: Serialize + Definition>(&mut self, topic: &str, message: &M) -> Result<(), Self::Error>;
}

/// Puts the messages of a map.
pub(crate) fn put_map<S: RosSink>(map: &GlobalMap, sink: &mut S) -> Result<(), S::Error> {
    sink.put("/ecod/map/detections", &Detection3DArray::of_map(map))?;
    sink.put("/ecod/map/markers", &MarkerArray::of_map(map))
}

/// Puts the messages of a vehicle's report.
pub(crate) fn put_report<S: RosSink>(report: &ObjectReport, sink: &mut S) -> Result<(), S::Error> {
    let node = ros_name(&report.node);
    sink.put(&format!("/ecod/{node}/detections"), &Detection3DArray::of_report(report))?;
    let Some(pose) = report.pose else { return Ok(()) };
    let transforms = TFMessage::of_pose(Header::in_map(report.captured_at_us), format!("{node}_camera"), pose);
    sink.put("/tf", &transforms)
}

/// A node's name as names in ROS allow it: letters, digits and `_`, no digit first.
fn ros_name(node: &NodeName) -> String {
    let name = node.as_str().replace('-', "_");
    if name.starts_with(|first: char| first.is_ascii_digit()) { format!("_{name}") } else { name }
}
