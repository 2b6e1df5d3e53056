//! Messages to the receiver of poses.

use ecod::model::origin::StatedPose;
use ecod::model::time::Timestamp;

/// Requests to the receiver of poses.
#[derive(Debug)]
pub enum PoseReceiverMessage {
    /// Process a pose of the vehicle.
    HandlePose {
        /// Time of the pose by the clock that stamps frames.
        at: Timestamp,
        /// Pose of the vehicle at that time.
        pose: StatedPose,
    },
}
