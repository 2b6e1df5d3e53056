use std::collections::VecDeque;
use std::sync::Mutex;

use ecod::model::time::Timestamp;
use opencv::core::Mat;

use super::*;
use crate::camera::frame_source::TimeSource;

/// Action of a scripted source on one call.
enum Step {
    CameraFrame,
    Fail,
    Spoil,
    /// Blocks until the test drops the other end.
    Block(Receiver<()>),
}

struct Script(VecDeque<Step>);

impl FrameSource for Script {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        match self.0.pop_front() {
            Some(Step::CameraFrame) => Ok(CameraFrame {
                image: Mat::default(),
                captured_at: Timestamp(0),
                seq: 0,
            }),
            Some(Step::Fail) => Err(FrameError::Lost {
                origin: "script".into(),
                reason: "unplugged".into(),
            }),
            Some(Step::Spoil) => Err(FrameError::Unusable {
                origin: "script".into(),
                reason: "torn".into(),
            }),
            Some(Step::Block(until)) => {
                let _ = until.recv();
                Err(FrameError::Lost {
                    origin: "script".into(),
                    reason: "came back late".into(),
                })
            }
            None => Err(FrameError::Ended {
                origin: "script".into(),
            }),
        }
    }

    fn time_source(&self) -> TimeSource {
        TimeSource::Playback
    }
}

/// A source that follows one script per opening; `None` fails to open.
fn scripted(openings: Vec<Option<Vec<Step>>>) -> Opener {
    let openings = Mutex::new(VecDeque::from(openings));
    Arc::new(
        move || match openings.lock().unwrap().pop_front().flatten() {
            Some(steps) => Ok(Box::new(Script(steps.into())) as Box<dyn FrameSource>),
            None => Err(FrameError::Open {
                origin: "script".into(),
                reason: "not there".into(),
            }),
        },
    )
}

fn hasty() -> CaptureConfig {
    CaptureConfig {
        stall_timeout_s: 20.0,
        retry_min_s: 0.001,
        retry_max_s: 0.01,
    }
}

async fn wait_for(capture: &Capture, wanted: impl Fn(&CaptureStatus) -> bool) {
    let mut status = capture.status();
    let waiting = status.wait_for(|status| wanted(status));
    tokio::time::timeout(Duration::from_secs(20), waiting)
        .await
        .expect("in time")
        .expect("capture is there");
}

#[tokio::test]
async fn source_recovers_after_two_failures() {
    let capture = Capture::start(
        scripted(vec![
            None,
            Some(vec![Step::Fail]),
            Some(vec![Step::CameraFrame]),
        ]),
        hasty(),
    )
    .unwrap();
    assert_eq!(capture.next_frame().await.map(|frame| frame.seq), Some(0));
    assert!(capture.next_frame().await.is_none(), "it ended");
    assert_eq!(*capture.status().borrow(), CaptureStatus::Ended);
}

#[tokio::test]
async fn unusable_frame_causes_no_reopening() {
    let openings = vec![Some(vec![Step::Spoil, Step::CameraFrame, Step::Spoil])];
    let capture = Capture::start(scripted(openings), hasty()).unwrap();
    assert_eq!(capture.next_frame().await.map(|frame| frame.seq), Some(0));
    assert!(
        capture.next_frame().await.is_none(),
        "it ended and was not opened again"
    );
    assert_eq!(capture.unusable(), 2);
}

#[tokio::test]
async fn failure_is_reported_with_reason() {
    let config = CaptureConfig {
        retry_min_s: 60.0,
        retry_max_s: 60.0,
        ..hasty()
    };
    let capture = Capture::start(scripted(vec![]), config).unwrap();
    wait_for(&capture, |status| match status {
        CaptureStatus::Failed {
            error,
            failures: 1,
            retry_after,
        } => {
            error.to_string() == "cannot open script: not there"
                && *retry_after == Duration::from_secs(60)
        }
        _ => false,
    })
    .await;
}

#[tokio::test]
async fn blocked_source_is_reopened() {
    let (release, blocked) = mpsc::channel();
    let config = CaptureConfig {
        stall_timeout_s: 1.0,
        retry_min_s: 0.2,
        retry_max_s: 0.2,
    };
    let openings = vec![
        Some(vec![Step::CameraFrame, Step::Block(blocked)]),
        Some(vec![Step::CameraFrame]),
    ];
    let capture = Capture::start(scripted(openings), config).unwrap();
    assert_eq!(capture.next_frame().await.map(|frame| frame.seq), Some(0));
    wait_for(&capture, |status| {
        matches!(
            status,
            CaptureStatus::Failed {
                error: FrameError::Stalled(_),
                ..
            }
        )
    })
    .await;
    assert_eq!(
        capture.next_frame().await.map(|frame| frame.seq),
        Some(1),
        "numbered on across openings"
    );
    drop(release);
}

#[tokio::test]
async fn untaken_frames_are_counted() {
    let openings = vec![Some(vec![
        Step::CameraFrame,
        Step::CameraFrame,
        Step::CameraFrame,
        Step::CameraFrame,
        Step::CameraFrame,
    ])];
    let capture = Capture::start(scripted(openings), hasty()).unwrap();
    wait_for(&capture, |status| *status == CaptureStatus::Ended).await;
    assert_eq!(
        capture.next_frame().await.map(|frame| frame.seq),
        Some(4),
        "the latest"
    );
    assert_eq!(capture.skipped(), 4);
}

#[tokio::test]
async fn dropped_capture_releases_source() {
    let held = Arc::new(());
    let opener: Opener = {
        let held = Arc::clone(&held);
        Arc::new(move || {
            let _held = &held;
            Err(FrameError::Open {
                origin: "script".into(),
                reason: "not there".into(),
            })
        })
    };
    let capture = Capture::start(
        opener,
        CaptureConfig {
            retry_min_s: 60.0,
            retry_max_s: 60.0,
            ..hasty()
        },
    )
    .unwrap();
    wait_for(&capture, |status| {
        matches!(status, CaptureStatus::Failed { .. })
    })
    .await;
    let mut status = capture.status();
    drop(capture);
    let gone = async { while status.changed().await.is_ok() {} };
    tokio::time::timeout(Duration::from_secs(20), gone)
        .await
        .expect("the keeper ends although it was waiting");
}

#[test]
fn retry_wait_doubles_to_bound() {
    let config = CaptureConfig {
        retry_min_s: 0.5,
        retry_max_s: 3.0,
        ..hasty()
    };
    let waits = [1, 2, 3, 4, 1000].map(|failures| config.retry_after(failures).as_secs_f64());
    assert_eq!(waits, [0.5, 1.0, 2.0, 3.0, 3.0]);
}
