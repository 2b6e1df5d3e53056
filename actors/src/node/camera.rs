//! The cameras of a vehicle as configured: pose, optics, projection.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::aggregator::Algorithms;
use ecod::model::geometry::Pose;
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkIndex;

use crate::camera::config::CameraConfig;
use crate::camera::lens::Lens;
use crate::camera::perception::{Perception, VehicleCamera};
use crate::node::config::NodeConfig;
use crate::observe::dashboard::{CameraSetup, ShownCamera};

/// The pose of a vehicle that stands still; `None` if poses are received.
///
/// # Errors
/// Returns an error if the pose is on Earth and has no place in the cell's frame.
pub fn standing_pose(config: &NodeConfig) -> anyhow::Result<Option<Pose>> {
    let is_used = config.has_camera() && config.pose.listen.is_none();
    let pose = is_used
        .then(|| config.pose.stated().in_map(config.origin.as_ref()))
        .transpose();
    pose.context("key `pose.latitude_deg`")
}

/// The processing from a camera's detections to reports, as configured. Each frame has its own
/// pose.
///
/// # Errors
/// Returns an error if the camera's calibration file cannot be used.
pub fn perception(config: &NodeConfig, camera: &CameraConfig) -> anyhow::Result<Perception> {
    let gate = config.fusion.pace.gate();
    let vehicle_camera = VehicleCamera {
        node: camera.reporter(
            config
                .name
                .as_ref()
                .unwrap_or(&NodeName::from_static("node")),
        ),
        pose: Pose::new(0.0, 0.0, 0.0),
        mount: camera.mount.into(),
        lens: lens(camera)?,
        landmarks: Arc::new(LandmarkIndex::new(config.landmarks(), gate.radius_m)),
    };
    let perception = Perception::new(
        vehicle_camera,
        camera.projection.clone(),
        camera.view.clone(),
        gate,
    );
    Ok(perception.with_masks(camera.masks.clone()))
}

/// A camera's lens.
///
/// # Errors
/// Returns an error if its calibration file cannot be used.
pub fn lens(camera: &CameraConfig) -> anyhow::Result<Lens> {
    camera
        .optics
        .lens()
        .context("key `camera.optics.calibration`")
}

/// The algorithms that a camera's reports are for. Without landmarks there is no location to vote
/// on.
pub fn algorithms(config: &NodeConfig, camera: &CameraConfig) -> Algorithms {
    match config.fusion.algorithms {
        Algorithms::Both if !camera.votes || config.landmarks.is_empty() => Algorithms::Pace,
        algorithms => algorithms,
    }
}

/// Time in which a frame source opens: less than the stall timeout, so that OpenCV gives up first
/// and no reader is abandoned.
pub fn open_timeout(camera: &CameraConfig) -> Duration {
    Duration::from_secs_f64(0.8 * camera.capture.stall_timeout_s)
}

/// The cameras of a node whose pictures browsers may see.
pub(super) fn shown(config: &NodeConfig) -> Vec<ShownCamera> {
    if !(config.dashboard.enabled && config.dashboard.camera) {
        return Vec::new();
    }
    let node = config.name.clone().unwrap_or(NodeName::from_static("node"));
    let shown = |(place, camera): (usize, &CameraConfig)| ShownCamera {
        name: camera.name.clone(),
        feed: Arc::default(),
        reporter: camera.reporter(&node),
        setup: CameraSetup {
            optics: camera.optics.clone(),
            mount: camera.mount,
            is_one_of_several: place > 0 || config.camera.is_none(),
        },
    };
    config.all_cameras().enumerate().map(shown).collect()
}
