//! Messages to the projector.

use ecod::aggregator::Algorithms;
use ecod::model::detection::Detection;
use ecod::model::geometry::Pose;
use ecod::model::origin::{GeographicOrigin, StatedPose};
use ecod::model::time::Timestamp;

use crate::camera::frame::CameraFrame;
use crate::camera::lens::Lens;
use crate::camera::perception::Perception;

/// Requests to the projector.
#[derive(Debug)]
pub enum ProjectorMessage {
    /// Place the detections of one frame in the world and report them.
    Report {
        /// Detections of the frame, in pixels.
        detections: Vec<Detection>,
        /// Lens of the frame.
        lens: Lens,
        /// Time of capture by the clock that stamps frames.
        captured_at: Timestamp,
        /// The frame, if browsers are to see it.
        shown: Option<CameraFrame>,
    },
    /// Continue with other settings.
    Configure {
        /// Projection of the camera, and the landmarks of its cell.
        perception: Box<Perception>,
        /// The pose of a vehicle that stands still, if available.
        standing: Option<Pose>,
        /// The place of the cell's frame on Earth.
        origin: Option<GeographicOrigin>,
        /// Algorithms to report for.
        algorithms: Algorithms,
    },
    /// Process a pose of the vehicle.
    HandlePose {
        /// Time of the pose by the clock that stamps frames.
        at: Timestamp,
        /// Pose in the cell's frame or on Earth.
        pose: StatedPose,
    },
}
