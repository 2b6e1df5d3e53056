//! Pictures of the node's cameras on their way to browsers.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::model::time::Timestamp;
use tokio::sync::watch;

/// Latest picture of a camera as a server-sent event, made only while a browser shows it.
#[derive(Debug, Default)]
pub struct CameraFeed {
    pictures: watch::Sender<Bytes>,
    due: Mutex<Timestamp>,
}

/// Minimum time between two pictures.
const PERIOD: Duration = Duration::from_millis(200);

impl CameraFeed {
    /// Pictures from now on, made while any such receiver exists.
    pub(crate) fn pictures(&self) -> watch::Receiver<Bytes> {
        self.pictures.subscribe()
    }

    /// Number of browsers that show the pictures.
    fn viewers(&self) -> usize {
        self.pictures.receiver_count()
    }

    /// True if the frame captured at this time should be shown: a browser waits, and the last
    /// picture is old enough.
    pub fn takes(&self, captured_at: Timestamp) -> bool {
        let mut due = self.due.lock().unwrap_or_else(PoisonError::into_inner);
        let takes = self.viewers() > 0 && captured_at >= *due;
        if takes {
            *due = captured_at + PERIOD;
        }
        takes
    }

    /// Sends a picture to the browsers.
    pub fn show(&self, picture: Bytes) {
        self.pictures.send_replace(picture);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn viewers_get_five_frames_per_second() {
        let feed = CameraFeed::default();
        let taken = || {
            let frames = (0..30).map(|frame| Timestamp(1_000_000 + frame * 1_000_000 / 30));
            frames
                .filter(|captured_at| feed.takes(*captured_at))
                .count()
        };
        assert_eq!(taken(), 0);
        let viewer = feed.pictures();
        assert_eq!(taken(), 5);
        drop(viewer);
        assert!(!feed.takes(Timestamp(9_000_000)));
    }
}
