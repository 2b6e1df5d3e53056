//! The camera of a vehicle as configured: source, optics, detector, projection.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::aggregator::Algorithms;
use ecod::model::geometry::Pose;
use ecod::perception::landmark::LandmarkIndex;

use crate::actors::detector::DetectorArguments;
use crate::camera::perception::{Perception, VehicleCamera};
use crate::messages::actor_slot::ActorSlot;
use crate::messages::projector::ProjectorMessage;
use crate::node::config::NodeConfig;
use crate::observe::dashboard::CameraFeed;
use crate::observe::recorder::ImageRecorder;
use crate::telemetry::counters::Counters;
use crate::telemetry::spans::Spans;

/// A node without a camera was asked for what only a camera gives.
#[derive(Debug, thiserror::Error)]
#[error("this node has no camera")]
pub struct NoCamera;

/// The pose of a vehicle that stands still; none where poses are received.
///
/// # Errors
/// When it is on Earth, and has no place in the cell's frame.
pub fn standing_pose(config: &NodeConfig) -> anyhow::Result<Option<Pose>> {
    let is_used = config.camera.is_some() && config.pose.listen.is_none();
    let pose = is_used.then(|| config.pose.stated().in_map(config.origin.as_ref())).transpose();
    pose.context("key `pose.latitude_deg`")
}

/// The way from detections to reports, as configured. Each frame has its own pose.
///
/// # Errors
/// When there is no camera or its calibration file cannot be used.
pub fn perception(config: &NodeConfig) -> anyhow::Result<Perception> {
    let camera = config.camera.as_ref().ok_or(NoCamera)?;
    let gate = config.fusion.pace.gate();
    let vehicle_camera = VehicleCamera {
        node: config.name.clone().unwrap_or(ecod::model::names::NodeName::from_static("node")),
        pose: Pose::new(0.0, 0.0, 0.0),
        mount: camera.mount.into(),
        lens: camera.optics.lens().context("key `camera.optics.calibration`")?,
        landmarks: Arc::new(LandmarkIndex::new(config.landmarks(), gate.radius_m)),
    };
    Ok(Perception::new(vehicle_camera, camera.projection.clone(), camera.view.clone(), gate))
}

/// The algorithms that the camera's reports are for. Without known locations there is nothing to vote on.
pub fn algorithms(config: &NodeConfig) -> Algorithms {
    let votes = config.camera.as_ref().is_some_and(|camera| camera.votes) && !config.landmarks.is_empty();
    match config.fusion.algorithms {
        Algorithms::Both if !votes => Algorithms::Pace,
        algorithms => algorithms,
    }
}

/// The way from frames to detections, as configured.
///
/// # Errors
/// When there is no camera or the detector's files cannot be used.
pub fn detector(
    config: &NodeConfig,
    projector: ActorSlot<ProjectorMessage>,
    images: Option<ImageRecorder>,
    camera_feed: Option<Arc<CameraFeed>>,
    counters: Arc<Counters>,
    spans: Spans,
) -> anyhow::Result<DetectorArguments> {
    let camera = config.camera.as_ref().ok_or(NoCamera)?;
    let source = camera.source.clone();
    // Less than the stall timeout, so that OpenCV gives up first and no reader is abandoned.
    let timeout = Duration::from_secs_f64(0.8 * camera.capture.stall_timeout_s);
    let lens = camera.optics.lens().context("key `camera.optics.calibration`")?;
    Ok(DetectorArguments {
        open: Arc::new(move || source.open(timeout)),
        capture: camera.capture.clone(),
        detect: camera.detector.build().context("key `camera.detector`")?,
        lens,
        projector,
        images,
        camera_feed,
        counters,
        spans,
    })
}
