//! Converts a cell's messages to ROS 2, without ROS code on this side.
//!
//! Frames follow REP 103 and REP 105: `map` is the cell's frame, x east and y north unless the
//! cell's origin is rotated. `<node>_camera` is a camera, x along its axis and z up;
//! `<node>_camera_optical` the same camera, z along its axis and x right.

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
#[cfg(all(test, feature = "dds"))]
pub(crate) use camera::RegionOfInterest;
pub(crate) use detections::Detection3DArray;
#[cfg(feature = "dds")]
pub(crate) use detections::{Detection3D, ObjectHypothesis, ObjectHypothesisWithPose};
use markers::MarkerArray;
use transforms::TFMessage;

pub use log::{Conversion, ConversionError, RosLog};
pub(crate) use messages::{Definition, Header};
#[cfg(feature = "dds")]
pub(crate) use messages::{PoseStamped, RosMessage, RosPose, encode};
#[cfg(feature = "dds")]
pub(crate) use pictured::Detection2DArray;

/// Destination of messages: a file, or live topics.
pub(crate) trait RosSink {
    /// Error if a message was not accepted.
    type Error;

    fn put<M: Serialize + Definition>(
        &mut self,
        topic: &str,
        message: &M,
    ) -> Result<(), Self::Error>;
}

/// Puts the messages of a map.
pub(crate) fn put_map<S: RosSink>(map: &GlobalMap, sink: &mut S) -> Result<(), S::Error> {
    sink.put("/ecod/map/detections", &Detection3DArray::of_map(map))?;
    sink.put("/ecod/map/markers", &MarkerArray::of_map(map))
}

/// Puts the messages of a vehicle's report.
pub(crate) fn put_report<S: RosSink>(report: &ObjectReport, sink: &mut S) -> Result<(), S::Error> {
    let node = ros_name(&report.node);
    sink.put(
        &format!("/ecod/{node}/detections"),
        &Detection3DArray::of_report(report),
    )?;
    let Some(pose) = report.pose else {
        return Ok(());
    };
    let transforms = TFMessage::of_pose(
        Header::in_map(report.captured_at_us),
        format!("{node}_camera"),
        pose,
    );
    sink.put("/tf", &transforms)
}

/// A node's name as names in ROS allow it: letters and digits with single `_` between them, no
/// digit first. A `_` in front would hide the topic, and `map` is the cell's.
fn ros_name(node: &NodeName) -> String {
    let words: Vec<_> = node
        .as_str()
        .split(['-', '_'])
        .filter(|word| !word.is_empty())
        .collect();
    let name = words.join("_");
    let is_free = name != "map" && name.starts_with(|first: char| first.is_ascii_alphabetic());
    if is_free {
        name
    } else {
        format!("node_{name}")
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::indexing_slicing)]

    use std::collections::BTreeMap;
    use std::f64::consts::TAU;

    use ecod::model::epoch::Epoch;
    use ecod::model::geometry::Covariance;
    use ecod::model::names::is_label;
    use ecod::model::time::Timestamp;
    use ecod::wire::{FusedObject, LandmarkState, Limits, PerceivedObject, WirePose};
    use proptest::collection::vec;
    use proptest::option;
    use proptest::prelude::*;

    use super::*;
    use crate::ros2::messages::RosTime;

    const NOW: Timestamp = Timestamp(1_795_239_882_123_000);

    #[test]
    fn ghost_is_unlikely_and_landmarks_drawn() {
        let ghost = FusedObject {
            scores: [("car".into(), 0.75), ("truck".into(), 0.25)].into(),
            ..FusedObject::new(
                uuid::Uuid::from_u128(1),
                "car",
                0.04,
                12.0,
                0.0,
                Covariance::isotropic(0.04),
            )
        };
        let place = LandmarkState {
            id: "slot-1".into(),
            label: Some("van".into()),
            confidence: 0.9,
            x_m: 5.0,
            y_m: -2.0,
            contributors: Vec::new(),
            observers: Vec::new(),
            readings: Vec::new(),
        };
        let epoch = Epoch::new(7, NodeName::from_static("edge"));
        let map = GlobalMap {
            landmarks: vec![place],
            objects: vec![ghost],
            ..GlobalMap::new(&epoch, 1, NOW)
        };
        let scores = |detections: Detection3DArray| -> Vec<_> {
            assert_eq!(detections.header.stamp, RosTime::of(NOW));
            let results = detections
                .detections
                .into_iter()
                .flat_map(|detection| detection.results);
            results
                .map(|result| {
                    (
                        result.hypothesis.class_id,
                        (1000.0 * result.hypothesis.score).round(),
                    )
                })
                .collect()
        };
        let of_map = scores(Detection3DArray::of_map(&map));
        assert_eq!(
            of_map,
            [
                ("car".into(), 30.0),
                ("truck".into(), 10.0),
                ("van".into(), 900.0)
            ]
        );
        let seen = PerceivedObject {
            scores: [("car".into(), 0.6), ("truck".into(), 0.3)].into(),
            ..PerceivedObject::new("car", 0.6, 1.0, 2.0)
        };
        let report = ObjectReport {
            objects: vec![seen],
            ..ObjectReport::new(NodeName::from_static("euclid"), 1, NOW)
        };
        let of_report = scores(Detection3DArray::of_report(&report));
        assert_eq!(
            of_report,
            [("car".into(), 600.0), ("truck".into(), 300.0)],
            "a detector's own confidences"
        );
        let drawn = serde_json::to_value(MarkerArray::of_map(&map)).unwrap();
        let opacity: Vec<_> = (1..5)
            .map(|marker| drawn["markers"][marker]["color"]["a"].as_f64().unwrap())
            .collect();
        assert!(
            opacity[..2].iter().all(|a| *a < 0.05) && opacity[2..].iter().all(|a| *a > 0.8),
            "{drawn}"
        );
    }

    /// A number within a bound of the wire format, often at it.
    fn up_to(bound: f64) -> impl Strategy<Value = f64> {
        prop_oneof![-bound..=bound, -10.0..=10.0, Just(bound), Just(-bound)]
    }

    prop_compose! {
        fn extreme_detection()(
            (x_m, y_m, confidence) in (up_to(1e8), up_to(1e8), 0.0..=1.0),
            variance in option::of(up_to(7e19).prop_map(f64::abs)),
            velocity_mps in option::of([up_to(1e4), up_to(1e4)]),
            heading_rad in option::of(-TAU..=TAU),
            size_m in option::of([up_to(102_400.0).prop_map(f64::abs), up_to(102_400.0).prop_map(f64::abs)]),
            label in prop_oneof![Just("car".to_owned()), "\\PC{1,16}".prop_filter("a label", |text| is_label(text))],
            score in 0.0..=1.0,
        ) -> PerceivedObject {
            PerceivedObject {
                covariance_m2: variance.map(|variance| [variance, 0.0, variance]),
                scores: [("truck".into(), score)].into(),
                velocity_mps, heading_rad, size_m,
                ..PerceivedObject::new(label, confidence, x_m, y_m)
            }
        }
    }

    /// Checks every message: it is encoded, and each number in it is finite, because JSON writes
    /// others as null.
    #[derive(Default)]
    struct Checked(BTreeMap<String, Vec<u8>>);

    impl RosSink for Checked {
        type Error = TestCaseError;

        fn put<M: Serialize + Definition>(
            &mut self,
            topic: &str,
            message: &M,
        ) -> Result<(), Self::Error> {
            let json = serde_json::to_string(message).unwrap();
            prop_assert!(!json.contains("null"), "{}: {}", topic, json);
            let bytes = cdr_encoding::to_vec::<M, byteorder::LittleEndian>(message).unwrap();
            self.0.insert(topic.to_owned(), bytes);
            Ok(())
        }
    }

    impl Checked {
        /// Number of detections that a receiver decodes from a topic's message.
        fn detections(&self, topic: &str) -> usize {
            let (message, _) =
                cdr_encoding::from_bytes::<Detection3DArray, byteorder::LittleEndian>(
                    &self.0[topic],
                )
                .unwrap();
            message.detections.len()
        }
    }

    proptest! {
        #[test]
        fn valid_messages_are_decodable(
            seen in vec(extreme_detection(), 0..8),
            pose in option::of((up_to(1e8), up_to(1e8), -TAU..=TAU)),
            at in prop_oneof![Just(NOW.0), 0..(1u64 << 53)],
        ) {
            let edge = NodeName::from_static("edge");
            let at = Timestamp(at);
            let fused = |(number, seen): (usize, &PerceivedObject)| FusedObject {
                velocity_mps: seen.velocity_mps,
                heading_rad: seen.heading_rad,
                size_m: seen.size_m,
                scores: seen.scores.clone(),
                covariance_m2: seen.covariance_m2.unwrap_or([0.04, 0.0, 0.04]),
                ..FusedObject::new(
                    uuid::Uuid::from_u128(number as u128),
                    seen.label.clone(),
                    seen.confidence,
                    seen.x_m,
                    seen.y_m,
                    Covariance::isotropic(0.04),
                )
            };
            let map = GlobalMap {
                objects: seen.iter().enumerate().map(fused).collect(),
                ..GlobalMap::new(&Epoch::new(7, edge.clone()), 1, at)
            };
            let mut sink = Checked::default();
            put_map(&map, &mut sink)?;
            prop_assert_eq!(sink.detections("/ecod/map/detections"), seen.len());
            let pose = pose.map(|(x_m, y_m, heading_rad)| WirePose::new(x_m, y_m, heading_rad));
            let report = ObjectReport { pose, objects: seen.clone(), ..ObjectReport::new(edge, 1, at) };
            prop_assert_eq!(report.validate(&Limits::default()), Ok(()));
            put_report(&report, &mut sink)?;
            prop_assert_eq!(sink.detections("/ecod/edge/detections"), seen.len());
        }
    }

    #[test]
    fn names_follow_ros_rules() {
        for (name, expected) in [
            ("lot-1", "lot_1"),
            ("edge--ros2", "edge_ros2"),
            ("_x-", "x"),
            ("7", "node_7"),
            ("map", "node_map"),
        ] {
            assert_eq!(ros_name(&NodeName::from_static(name)), expected);
        }
    }
}
