//! Messages to the projector.

use ecod::model::detection::Detection;
use ecod::model::geometry::Pose;
use ecod::model::time::Timestamp;

/// Requests to the projector.
#[derive(Debug)]
pub enum ProjectorMessage {
    /// Place the detections of one frame in the world and report them.
    Report {
        /// Detections in pixels.
        detections: Vec<Detection>,
        /// Time of capture.
        captured_at: Timestamp,
    },
    /// Take a pose of the vehicle.
    TakePose {
        /// Time of the pose by the clock that stamps frames.
        at: Timestamp,
        /// Pose in the world frame.
        pose: Pose,
    },
}
