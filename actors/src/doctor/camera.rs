//! Checks of camera, calibration and detector.

use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::model::detection::Detection;
use ecod::model::time::Timestamp;

use super::Finding;
use crate::camera::config::CameraConfig;
use crate::camera::frame::CameraFrame;
use crate::camera::frame_source::{FrameError, SourceConfig, TimeSource};
use crate::camera::image_size::ImageSize;
use crate::camera::lens::Lens;
use crate::camera::perception::Perception;
use crate::node;
use crate::node::config::NodeConfig;

/// Maximum time until the first frame; network cameras take seconds.
const TIMEOUT: Duration = Duration::from_secs(10);

/// All checks of all cameras.
pub(super) async fn examine(config: &NodeConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    for camera in config.all_cameras() {
        let (first, frame) = frame(camera).await;
        let mut of_camera = vec![first, calibration(camera)];
        of_camera.extend(detections(config, camera, frame).await);
        if let Some(name) = &camera.name {
            of_camera
                .iter_mut()
                .for_each(|finding| finding.seen = format!("{name}: {}", finding.seen));
        }
        findings.extend(of_camera);
    }
    findings
}

const SHAPE_FIX: &str = "set `camera.optics` to the size of the frames, or calibrate";

async fn frame(camera: &CameraConfig) -> (Finding, Option<CameraFrame>) {
    let check = "camera";
    let fix = match &camera.source {
        SourceConfig::V4l2 { .. } => {
            "plug it in, add the user to the group `video`, set `camera.source.device`"
        }
        SourceConfig::Gstreamer { .. } => "try `camera.source.pipeline` with gst-launch-1.0",
        SourceConfig::Url { .. } => "try `camera.source.url` with a player",
        _ => "set `camera.source` to an existing source",
    };
    let opened = camera.clone();
    // A camera that blocks forever keeps its thread, but the program ends nevertheless.
    let (sender, answer) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        // The receiver is gone after the timeout.
        let _ = sender.send(opened.open(TIMEOUT).and_then(|mut source| {
            let frame = source.next_frame()?;
            Ok((frame, source.time_source()))
        }));
    });
    let lens = camera.optics.lens().ok();
    match tokio::time::timeout(TIMEOUT, answer).await {
        Ok(Ok(Ok((frame, time_source)))) => {
            let size = ImageSize::of(&frame.image);
            if let Some(Err(mismatch)) = lens.map(|lens| lens.of_frames(size)) {
                let seen = format!("frames of {size}, but optics of {}", mismatch.optics);
                return (Finding::broken(check, seen, SHAPE_FIX), None);
            }
            let mut seen = format!("frames of {size}, dated by {time_source}");
            if !camera.masks.is_empty() {
                seen += &format!(", masks: {}", camera.masks.len());
            }
            let finding = if time_source == TimeSource::WrongStamp {
                Finding::doubtful(check, seen, TroubleKind::CameraClock.remedy())
            } else {
                Finding::fine(check, seen)
            };
            (finding, Some(frame))
        }
        Ok(Ok(Err(error))) => {
            let fix = match &error {
                FrameError::Unusable { .. } if !camera.masks.is_empty() => SHAPE_FIX,
                _ => fix,
            };
            (Finding::broken(check, error.to_string(), fix), None)
        }
        Ok(Err(_)) | Err(_) => (
            Finding::broken(check, format!("no frame within {TIMEOUT:?}"), fix),
            None,
        ),
    }
}

fn calibration(camera: &CameraConfig) -> Finding {
    let check = "calibration";
    match (&camera.optics.calibration, camera.optics.lens()) {
        (Some(path), Ok(_)) => Finding::fine(check, path.display().to_string()),
        (_, Err(error)) => Finding::broken(
            check,
            format!("{:#}", anyhow::Error::from(error)),
            "create one with `ecod-node calibrate`",
        ),
        (None, Ok(_)) => Finding::doubtful(
            check,
            "none: distances are as inaccurate as the field of view from the data sheet",
            "create one with `ecod-node calibrate` and set `camera.optics.calibration`",
        ),
    }
}

/// Loads the detector, runs it on a frame, and places its detections.
async fn detections(
    config: &NodeConfig,
    camera: &CameraConfig,
    frame: Option<CameraFrame>,
) -> Vec<Finding> {
    let check = "detector";
    let detector = camera.detector.clone();
    let lens = camera.optics.lens().ok();
    let perception = node::camera::perception(config, camera).ok();
    let detected = tokio::task::spawn_blocking(move || {
        let mut detector = detector.build()?;
        frame
            .map(|frame| anyhow::Ok((ImageSize::of(&frame.image), detector.detect(&frame)?)))
            .transpose()
    });
    match detected.await {
        Ok(Ok(None)) => vec![Finding::fine(check, "loaded")],
        Ok(Ok(Some((size, found)))) => {
            let loaded = Finding::fine(
                check,
                format!("loaded, finds {} objects in a frame", found.len()),
            );
            let placed = perception
                .zip(lens)
                .and_then(|(perception, lens)| placed(perception, &lens, size, found));
            std::iter::once(loaded).chain(placed).collect()
        }
        Ok(Err(error)) => {
            vec![Finding::broken(
                check,
                format!("{error:#}"),
                "correct `camera.detector` or its files",
            )]
        }
        Err(error) => vec![Finding::broken(
            check,
            error.to_string(),
            "use another model",
        )],
    }
}

/// Places the detections of a frame, if there are any.
fn placed(
    mut perception: Perception,
    lens: &Lens,
    size: ImageSize,
    mut found: Vec<Detection>,
) -> Option<Finding> {
    let check = "places";
    let count = found.len();
    perception.set_lens(&lens.fitted(size, &mut found).ok()?);
    let placed = perception.report(found, Timestamp::default()).objects.len();
    let seen = format!("{placed} of {count} objects have a place");
    match perception.last_discard() {
        Some(reason) => {
            let fix =
                "correct `camera.mount` or `camera.projection`, unless the object does not matter";
            Some(Finding::doubtful(check, format!("{seen}: {reason}"), fix))
        }
        None => (count > 0).then(|| Finding::fine(check, seen)),
    }
}
