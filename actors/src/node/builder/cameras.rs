//! Arguments and settings of the actors of the cameras.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;

use super::NodeBuilder;
use crate::actors::detector::DetectorArguments;
use crate::actors::projector::ProjectorArguments;
use crate::camera::config::CameraConfig;
use crate::messages::projector::ProjectorMessage;
use crate::node::camera;
use crate::node::presence::Presence;
use crate::observe::dashboard::CameraFeed;
use crate::observe::recorder::ImageRecorder;
use crate::telemetry::camera_troubles::CameraTroubles;

impl NodeBuilder {
    /// Arguments of the projector of a camera, by its place.
    pub(super) fn projector_arguments(&self, place: usize) -> anyhow::Result<ProjectorArguments> {
        let camera = self.camera(place)?;
        Ok(ProjectorArguments {
            perception: camera::perception(&self.config, camera)?,
            standing: self.standing_pose(),
            origin: self.config.origin,
            is_moving: self.config.pose.listen.is_some(),
            recent_poses: self.vehicle.poses.borrow().clone(),
            is_fixed: self.config.pose.is_fixed(),
            algorithms: camera::algorithms(&self.config, camera),
            clock: self.clock.clone(),
            gateway: self.slots.gateway.clone(),
            camera_feed: self.camera_feed(place),
            troubles: self.camera_troubles(camera),
            counters: self.counters(),
        })
    }

    /// Arguments of the detector of a camera, by its place.
    pub(super) fn detector_arguments(&self, place: usize) -> anyhow::Result<DetectorArguments> {
        let camera = self.camera(place)?;
        let record = self.config.record.as_ref();
        let log = self.vehicle.log.subscribe();
        if !camera.masks.is_empty() {
            let reporter = camera.reporter(&self.name);
            tracing::info!(camera = %reporter, masks = camera.masks.len(), "masked parts of the picture are black");
        }
        Ok(DetectorArguments {
            open: camera.opener(camera::open_timeout(camera)),
            capture: camera.capture.clone(),
            detect: camera.detector.build().context("key `camera.detector`")?,
            lens: camera::lens(camera)?,
            projector: self
                .slots
                .projectors
                .get(place)
                .cloned()
                .unwrap_or_default(),
            images: ImageRecorder::new(record, &self.name, camera, log, self.clock.clone()),
            camera_feed: self.camera_feed(place),
            troubles: self.camera_troubles(camera),
            counters: self.counters(),
            spans: self.vehicle.spans.subscribe(),
            max_age: Duration::from_secs_f64(self.config.fusion.window.max_age_s),
        })
    }

    /// Sends changed settings to the projectors, unless the projectors belong to the vehicle's
    /// present node in another cell.
    pub(super) fn configure_cameras(&self) {
        if self.presence < Presence::Reporting {
            return;
        }
        let standing = self.standing_pose();
        let origin = self.config.origin;
        for (camera, projector) in self.config.all_cameras().zip(&self.slots.projectors) {
            match camera::perception(&self.config, camera) {
                Ok(perception) => {
                    let perception = Box::new(perception);
                    let algorithms = camera::algorithms(&self.config, camera);
                    projector.send(ProjectorMessage::Configure {
                        perception,
                        standing,
                        origin,
                        algorithms,
                    });
                }
                Err(error) => {
                    tracing::error!(
                        error = format!("{error:#}"),
                        "the camera goes on with the settings before"
                    );
                }
            }
        }
    }

    fn camera(&self, place: usize) -> anyhow::Result<&CameraConfig> {
        self.config
            .all_cameras()
            .nth(place)
            .context("this node has no such camera")
    }

    fn camera_feed(&self, place: usize) -> Option<Arc<CameraFeed>> {
        self.vehicle
            .shown_cameras
            .get(place)
            .map(|camera| Arc::clone(&camera.feed))
    }

    fn camera_troubles(&self, camera: &CameraConfig) -> CameraTroubles {
        let part = camera.name.as_ref().map(|_| camera.reporter(&self.name));
        CameraTroubles::new(self.counters(), part)
    }

    /// The pose of a vehicle that stands still, if it has a place in the cell's frame. Otherwise
    /// the log contains the reason.
    fn standing_pose(&self) -> Option<ecod::model::geometry::Pose> {
        camera::standing_pose(&self.config).unwrap_or_else(|error| {
            tracing::error!(
                error = format!("{error:#}"),
                "the cameras' frames are not reported"
            );
            None
        })
    }
}
