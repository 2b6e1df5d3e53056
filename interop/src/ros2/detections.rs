//! Messages of vision_msgs 4: detections in space and in pictures.

use ecod::wire::{GlobalMap, ObjectReport};
use serde::{Deserialize, Serialize};

use super::messages::{
    Definition, HEADER, Header, POINT, POSE, QUATERNION, RosMessage, RosPose, RosQuaternion,
    RosVector, TIME, VECTOR,
};
use crate::object::CellObject;

/// Default length and width of an object without a size, in metres.
const UNKNOWN_SIZE_M: f64 = 1.0;
/// Height of every object in metres.
pub(super) const HEIGHT_M: f64 = 1.5;

/// Variance of unavailable values, as in `robot_localization`: large, and harmless to a filter.
const UNKNOWN_VARIANCE: f64 = 1e6;

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct PoseWithCovariance {
    pub(crate) pose: RosPose,
    pub(crate) covariance: [[f64; 6]; 6],
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct ObjectHypothesis {
    pub(crate) class_id: String,
    pub(crate) score: f64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct ObjectHypothesisWithPose {
    pub(crate) hypothesis: ObjectHypothesis,
    pub(crate) pose: PoseWithCovariance,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct BoundingBox3D {
    pub(crate) center: RosPose,
    pub(crate) size: RosVector,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Detection3D {
    pub(crate) header: Header,
    pub(crate) results: Vec<ObjectHypothesisWithPose>,
    pub(crate) bbox: BoundingBox3D,
    pub(crate) id: String,
}

pub(super) fn pose(object: &CellObject<'_>) -> RosPose {
    let [x, y] = object.position_m;
    let orientation = RosQuaternion::of(0.0, 0.0, object.heading_rad.unwrap_or(0.0));
    RosPose {
        position: RosVector {
            x,
            y,
            z: HEIGHT_M / 2.0,
        },
        orientation,
    }
}

pub(super) fn size(object: &CellObject<'_>) -> RosVector {
    let [x, y] = object.size_m.unwrap_or([UNKNOWN_SIZE_M; 2]);
    RosVector { x, y, z: HEIGHT_M }
}

/// A detection. Scores of classes are weighted by `existence`, the probability that there is an
/// object at all.
fn detection(object: &CellObject<'_>, existence: f64, header: &Header, id: String) -> Detection3D {
    let mut covariance = [[0.0; 6]; 6];
    for (index, row) in covariance.iter_mut().enumerate() {
        row.iter_mut()
            .skip(index)
            .take(1)
            .for_each(|variance| *variance = UNKNOWN_VARIANCE);
    }
    if let (Some([xx, xy, yy]), [[a, b, ..], [c, d, ..], ..]) =
        (object.covariance_m2, &mut covariance)
    {
        *a = xx;
        *b = xy;
        *c = xy;
        *d = yy;
    }
    let weighted = object
        .scores
        .iter()
        .map(|(label, score)| (label, score * existence));
    let scores: Vec<_> = if object.scores.is_empty() {
        vec![(object.label, object.confidence)]
    } else {
        weighted.collect()
    };
    let results = scores
        .into_iter()
        .map(|(label, score)| ObjectHypothesisWithPose {
            hypothesis: ObjectHypothesis {
                class_id: label.to_string(),
                score,
            },
            pose: PoseWithCovariance {
                pose: pose(object),
                covariance,
            },
        });
    let bbox = BoundingBox3D {
        center: pose(object),
        size: size(object),
    };
    Detection3D {
        header: header.clone(),
        results: results.collect(),
        bbox,
        id,
    }
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Detection3DArray {
    pub(crate) header: Header,
    pub(crate) detections: Vec<Detection3D>,
}

impl Detection3DArray {
    pub(super) fn of_map(map: &GlobalMap) -> Self {
        let header = Header::in_map(map.fused_at_us);
        let detections = CellObject::all_of(map)
            .map(|(object, id)| detection(&object, object.confidence, &header, id))
            .collect();
        Self { header, detections }
    }

    pub(super) fn of_report(report: &ObjectReport) -> Self {
        let header = Header::in_map(report.captured_at_us);
        let detections = report.objects.iter().map(|object| {
            let id = object
                .landmark
                .as_ref()
                .map(ToString::to_string)
                .unwrap_or_default();
            // The scores of a detector are used as confidences without weighting.
            detection(&object.into(), 1.0, &header, id)
        });
        Self {
            detections: detections.collect(),
            header,
        }
    }
}

impl RosMessage for Detection3DArray {
    const NAME: &'static str = "vision_msgs/msg/Detection3DArray";
}

impl Definition for Detection3DArray {
    const FIELDS: &'static str = "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n";
    const INSIDE: &'static [(&'static str, &'static str)] = &[
        HEADER,
        TIME,
        (
            "vision_msgs/Detection3D",
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\nstring id\n",
        ),
        (
            "vision_msgs/ObjectHypothesisWithPose",
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
        ),
        (
            "vision_msgs/ObjectHypothesis",
            "string class_id\nfloat64 score\n",
        ),
        (
            "vision_msgs/BoundingBox3D",
            "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        ),
        (
            "geometry_msgs/PoseWithCovariance",
            "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
        ),
        POSE,
        POINT,
        QUATERNION,
        VECTOR,
    ];
}
