//! Messages to the actor of this name.

use ecod::model::detection::Detection;
use ecod::model::geometry::Pose;
use ecod::model::time::Timestamp;

/// What the projector is asked to do.
#[derive(Debug)]
pub enum ProjectorMessage {
    /// Place the detections of one frame and publish them.
    Report {
        /// What the detector found, in pixels.
        detections: Vec<Detection>,
        /// When the frame was captured.
        captured_at: Timestamp,
    },
    /// Note where the vehicle was.
    TakePose {
        /// When it was there, by the clock that stamps frames.
        at: Timestamp,
        /// Its pose in the world frame.
        pose: Pose,
    },
}
