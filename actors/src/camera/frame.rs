//! A camera image with the time it was taken.

use ecod::model::time::Timestamp;
use opencv::core::Mat;

/// One image of one camera.
#[derive(Debug, Clone)]
pub struct Frame {
    /// 8-bit pixels, BGR or gray.
    pub image: Mat,
    /// When it was captured, by the node's own clock.
    pub captured_at: Timestamp,
    /// Counts up by one with every captured frame, also those that nobody looked at.
    pub seq: u64,
}
