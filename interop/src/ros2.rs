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
pub(crate) use messages::{RosMessage, RosPose, encode};
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

/// A node's name as names in ROS allow it: letters and digits with single `_` between them, no digit first. A `_` in front would
/// hide the topic, and `map` is the cell's.
fn ros_name(node: &NodeName) -> String {
    let words: Vec<_> = node.as_str().split(['-', '_']).filter(|word| !word.is_empty()).collect();
    let name = words.join("_");
    let is_free = name != "map" && name.starts_with(|first: char| first.is_ascii_alphabetic());
    if is_free { name } else { format!("node_{name}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_as_ros_allows_them() {
        for (name, expected) in
            [("lot-1", "lot_1"), ("edge--ros2", "edge_ros2"), ("_x-", "x"), ("7", "node_7"), ("map", "node_map")]
        {
            assert_eq!(ros_name(&NodeName::from_static(name)), expected);
        }
    }
}
