//! A camera image with its time of capture.

use ecod::model::time::Timestamp;
use opencv::core::Mat;

/// One image of one camera.
#[derive(Debug, Clone)]
pub struct CameraFrame {
    /// 8-bit pixels, BGR or gray.
    pub image: Mat,
    /// Time of capture by the node's clock.
    pub captured_at: Timestamp,
    /// Number of the frame, counting skipped ones.
    pub seq: u64,
}
