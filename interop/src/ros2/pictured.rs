//! Messages of vision_msgs 4 about detections in pictures.

use serde::{Deserialize, Serialize};

use super::detections::ObjectHypothesisWithPose;
use super::messages::{Header, RosMessage};

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Point2D {
    pub(crate) x: f64,
    pub(crate) y: f64,
}

#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub(crate) struct Pose2D {
    pub(crate) position: Point2D,
    pub(crate) theta: f64,
}

/// A box in pixels, turned by `theta` in radians.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct BoundingBox2D {
    pub(crate) center: Pose2D,
    pub(crate) size_x: f64,
    pub(crate) size_y: f64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Detection2D {
    header: Header,
    pub(crate) results: Vec<ObjectHypothesisWithPose>,
    pub(crate) bbox: BoundingBox2D,
    id: String,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Detection2DArray {
    pub(crate) header: Header,
    pub(crate) detections: Vec<Detection2D>,
}

impl RosMessage for Detection2DArray {
    const NAME: &'static str = "vision_msgs/msg/Detection2DArray";
}
