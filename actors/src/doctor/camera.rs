//! Checks of camera, calibration and detector.

use std::time::Duration;

use super::Finding;
use crate::camera::config::CameraConfig;
use crate::camera::frame_source::SourceConfig;
use crate::camera::image_size::ImageSize;
use crate::node::config::NodeConfig;

/// Maximum time until the first frame; network cameras take seconds.
const TIMEOUT: Duration = Duration::from_secs(10);

/// All checks of all cameras.
pub(super) async fn examine(config: &NodeConfig) -> Vec<Finding> {
    let mut findings = Vec::new();
    for camera in config.all_cameras() {
        let mut of_camera = [frame(camera).await, calibration(camera), detector(camera).await];
        if let Some(name) = &camera.name {
            of_camera.iter_mut().for_each(|finding| finding.seen = format!("{name}: {}", finding.seen));
        }
        findings.extend(of_camera);
    }
    findings
}

async fn frame(camera: &CameraConfig) -> Finding {
    let check = "camera";
    let fix = match &camera.source {
        SourceConfig::V4l2 { .. } => "plug it in, add the user to the group `video`, set `camera.source.device`",
        SourceConfig::Gstreamer { .. } => "try `camera.source.pipeline` with gst-launch-1.0",
        SourceConfig::Url { .. } => "try `camera.source.url` with a player",
        _ => "set `camera.source` to an existing source",
    };
    let source = camera.source.clone();
    // A camera that blocks forever keeps its thread, but the program ends all the same.
    let (sender, answer) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        let size =
            source.open(TIMEOUT).and_then(|mut source| source.next_frame()).map(|frame| ImageSize::of(&frame.image));
        // The receiver is gone after the timeout.
        let _ = sender.send(size);
    });
    let lens = camera.optics.lens().ok();
    match tokio::time::timeout(TIMEOUT, answer).await {
        Ok(Ok(Ok(size))) => match lens.map(|lens| lens.of_frames(size)) {
            Some(Err(mismatch)) => {
                let seen = format!("frames of {size}, but optics of {}", mismatch.optics);
                Finding::broken(check, seen, "set `camera.optics` to the size of the frames, or calibrate")
            }
            _ => Finding::fine(check, format!("frames of {size}")),
        },
        Ok(Ok(Err(error))) => Finding::broken(check, error.to_string(), fix),
        Ok(Err(_)) | Err(_) => Finding::broken(check, format!("no frame within {TIMEOUT:?}"), fix),
    }
}

fn calibration(camera: &CameraConfig) -> Finding {
    let check = "calibration";
    match (&camera.optics.calibration, camera.optics.lens()) {
        (Some(path), Ok(_)) => Finding::fine(check, path.display().to_string()),
        (_, Err(error)) => {
            Finding::broken(check, format!("{:#}", anyhow::Error::from(error)), "create one with `ecod-node calibrate`")
        }
        (None, Ok(_)) => Finding::doubtful(
            check,
            "none: distances are as inaccurate as the field of view from the data sheet",
            "create one with `ecod-node calibrate` and set `camera.optics.calibration`",
        ),
    }
}

async fn detector(camera: &CameraConfig) -> Finding {
    let check = "detector";
    let detector = camera.detector.clone();
    match tokio::task::spawn_blocking(move || detector.build().map(drop)).await {
        Ok(Ok(())) => Finding::fine(check, "loaded"),
        Ok(Err(error)) => Finding::broken(check, format!("{error:#}"), "correct `camera.detector` or its files"),
        Err(error) => Finding::broken(check, error.to_string(), "use another model"),
    }
}
