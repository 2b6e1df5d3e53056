//! Camera images in the log, a few a second.

use std::time::Duration;

use ecod::model::detection::Detection;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use tokio::sync::watch;

use super::{CapturedPicture, LogItem, LogSender, RecordConfig};
use crate::camera::config::CameraConfig;
use crate::camera::frame::CameraFrame;
use crate::camera::image_codec;
use crate::camera::image_size::ImageSize;
use crate::camera::lens::Lens;
use crate::platform::cell_clock::CellClock;

/// Quality of recorded pictures, from which detectors are judged later: 1 to 100.
const JPEG_QUALITY: u8 = 95;

/// Records frames as JPEG at a fixed rate.
#[derive(Debug, Clone)]
pub struct ImageRecorder {
    /// The log of the vehicle's present node.
    log: watch::Receiver<LogSender>,
    clock: CellClock,
    camera: Option<String>,
    reporter: NodeName,
    period: Duration,
    due: Timestamp,
}

impl ImageRecorder {
    /// A recorder as configured, for a camera of a vehicle; `None` without a log, or without images
    /// in it.
    pub fn new(
        config: Option<&RecordConfig>,
        vehicle: &NodeName,
        camera: &CameraConfig,
        log: watch::Receiver<LogSender>,
        clock: CellClock,
    ) -> Option<Self> {
        let hz = config
            .map(|record| record.camera_hz)
            .filter(|hz| *hz > 0.0)?;
        let reporter = camera.reporter(vehicle);
        let camera = camera.name.clone();
        Some(Self {
            log,
            clock,
            camera,
            reporter,
            period: Duration::from_secs_f64(1.0 / hz),
            due: Timestamp::default(),
        })
    }

    /// Records the frame with its detections if one is due, which takes some milliseconds.
    pub fn offer(&mut self, frame: &CameraFrame, lens: &Lens, detections: &[Detection]) {
        if frame.captured_at < self.due {
            return;
        }
        // In whole periods, so that frames that arrive unevenly are not lost; restarted after a
        // pause.
        let next = self.due + self.period;
        self.due = if next + self.period <= frame.captured_at {
            frame.captured_at + self.period
        } else {
            next
        };
        match image_codec::encode_jpeg(&frame.image, JPEG_QUALITY) {
            Ok(jpeg) => {
                let size = ImageSize::of(&frame.image);
                let picture = CapturedPicture {
                    camera: self.camera.clone(),
                    reporter: self.reporter.clone(),
                    jpeg,
                    captured_at: self.clock.date(frame.captured_at),
                    height: size.height,
                    optics: lens
                        .in_pixels_of(size)
                        .ok()
                        .map(|lens| (lens.intrinsics, lens.distortion)),
                    detections: detections.to_vec(),
                };
                self.log
                    .borrow()
                    .send(frame.captured_at, LogItem::Picture(Box::new(picture)));
            }
            Err(error) => tracing::debug!(%error, "cannot encode frame as JPEG"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{self, Receiver};

    use ecod::leadership::cell_time::ClockReading;
    use ecod::perception::camera::Intrinsics;
    use opencv::core::{CV_8UC3, Mat, Scalar};

    use super::*;
    use crate::observe::recorder::log_sender::LogEntry;

    fn recorder(clock: CellClock, period: Duration) -> (ImageRecorder, Receiver<LogEntry>) {
        let (sender, recorded) = mpsc::sync_channel(64);
        let log = LogSender::default();
        log.connect(Some(sender));
        let log = watch::channel(log).1;
        let reporter = NodeName::from_static("euclid");
        (
            ImageRecorder {
                log,
                clock,
                camera: None,
                reporter,
                period,
                due: Timestamp::default(),
            },
            recorded,
        )
    }

    fn offer(recorder: &mut ImageRecorder, captured_at: Timestamp) {
        let image = Mat::new_rows_cols_with_default(48, 64, CV_8UC3, Scalar::all(128.0)).unwrap();
        let lens = Lens::ideal(Intrinsics::with_square_pixels(64, 48, 1.0));
        recorder.offer(
            &CameraFrame {
                image,
                captured_at,
                seq: 1,
            },
            &lens,
            &[],
        );
    }

    /// A Pi without a real-time clock starts with a time years ago: viewers look for the vehicle's
    /// pose at the picture's time.
    #[test]
    fn picture_uses_cell_time() {
        let clock = CellClock::default();
        clock.show(ClockReading {
            offset_us: 5_000_000,
            error_us: Some(1_000),
        });
        let (mut recorder, recorded) = recorder(clock, Duration::from_secs(1));
        offer(&mut recorder, Timestamp(1_000));
        let entry = recorded.try_recv().unwrap();
        let LogItem::Picture(picture) = entry.item else {
            panic!("a picture")
        };
        assert_eq!(
            (entry.at, picture.captured_at),
            (Timestamp(1_000), Timestamp(5_001_000))
        );
    }

    #[test]
    fn requested_frame_rate_is_recorded() {
        let (mut recorder, recorded) = recorder(CellClock::default(), Duration::from_millis(200));
        for frame in 1..=20 {
            let jitter_us = [0, 15_000, -15_000][frame as usize % 3];
            offer(&mut recorder, Timestamp(200_000 * frame).shifted(jitter_us));
        }
        assert!(recorded.try_iter().count() >= 19);
        (0..10).for_each(|frame| offer(&mut recorder, Timestamp(60_000_000 + 20_000 * frame)));
        assert_eq!(
            recorded.try_iter().count(),
            1,
            "and no more often, also after a pause"
        );
    }
}
