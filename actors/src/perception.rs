//! One vehicle's way from detections to a report: undistort, range, place, and say what was in view.

use std::collections::BTreeMap;
use std::sync::Arc;

use ecod::camera::Mount;
use ecod::detection::Detection;
use ecod::geometry::Pose;
use ecod::landmark::{Gate, LandmarkIndex};
use ecod::names::NodeName;
use ecod::projection::{Projection, ProjectionConfig, Ranging};
use ecod::time::Timestamp;
use ecod::view::{ViewConfig, landmarks_in_view};
use ecod::wire::{ObjectReport, PerceivedObject};
use nalgebra::Point2;

use crate::corner_pose::locate_target;
use crate::lens::Lens;

/// Where a vehicle's camera is and what it knows of its world.
#[derive(Debug, Clone)]
pub struct Vantage {
    /// The vehicle's name.
    pub node: NodeName,
    /// The vehicle's pose.
    pub pose: Pose,
    /// Where the camera sits on the vehicle.
    pub mount: Mount,
    /// The camera as calibrated.
    pub lens: Lens,
    /// The cell's known locations.
    pub landmarks: Arc<LandmarkIndex>,
}

/// Makes the reports of one vehicle.
#[derive(Debug, Clone)]
pub struct Perception {
    vantage: Vantage,
    camera: Pose,
    projection: Projection,
    view: ViewConfig,
    gate: Gate,
    seq: u64,
    without_position: BTreeMap<&'static str, u64>,
}

impl Perception {
    /// A vehicle that has not reported yet; the configurations are taken as valid. `gate` bounds which known location
    /// an object is taken for.
    pub fn new(vantage: Vantage, projection: ProjectionConfig, view: ViewConfig, gate: Gate) -> Self {
        let camera = vantage.mount.camera_pose(&vantage.pose);
        let projection = Projection::new(projection, vantage.lens.intrinsics);
        Self { vantage, camera, projection, view, gate, seq: 0, without_position: BTreeMap::new() }
    }

    /// The report of one frame. A detection that has no position is left out and counted.
    pub fn report(&mut self, mut detections: Vec<Detection>, captured_at: Timestamp) -> ObjectReport {
        if let Err(error) = self.vantage.lens.undistort(&mut detections) {
            tracing::warn!(%error, "distortion not removed");
        }
        let objects: Vec<_> = detections.iter().filter_map(|detection| self.place(detection)).collect();
        let landmarks = self.vantage.landmarks.landmarks();
        let (lens, sizes) = (&self.vantage.lens, &self.projection.config().sizes);
        let seen = landmarks_in_view(landmarks, &self.camera, &lens.intrinsics, &objects, sizes, &self.view);
        self.seq += 1;
        ObjectReport {
            pose: Some(self.camera.into()),
            objects,
            seen: Some(seen),
            ..ObjectReport::new(self.vantage.node.clone(), self.seq, captured_at)
        }
    }

    /// Detections left out by reason since the start.
    pub fn without_position(&self) -> &BTreeMap<&'static str, u64> {
        &self.without_position
    }

    fn place(&mut self, detection: &Detection) -> Option<PerceivedObject> {
        let corners = detection.corners.filter(|_| self.projection.config().ranging == Ranging::Corners);
        let side_m = self.projection.config().sizes.of(&detection.label).map(|size| size.width_m);
        let target = corners.zip(side_m).map(|(c, side)| locate_target(&c, side, &self.vantage.lens.intrinsics));
        let target = match target.transpose() {
            Ok(target) => target,
            Err(error) => {
                tracing::debug!(label = %detection.label, %error, "corners not used");
                None
            }
        };
        match self.projection.place(detection, target.as_ref(), &self.camera) {
            Ok(object) => Some(self.at_landmark(object)),
            Err(error) => {
                let times = self.without_position.entry(error.as_str()).or_default();
                *times += 1;
                match *times {
                    1 => tracing::warn!(%error, "detection left out, the first for this reason"),
                    _ => tracing::debug!(%error, "detection left out"),
                }
                None
            }
        }
    }

    /// Names the known location that the object is taken for.
    fn at_landmark(&self, object: PerceivedObject) -> PerceivedObject {
        let landmarks = &self.vantage.landmarks;
        let point = Point2::new(object.x_m, object.y_m);
        let best = object.covariance().and_then(|c| landmarks.best(&object.label, &point, &c, &self.gate));
        let landmark = best.map(|best| landmarks.landmarks()[best.landmark].id.clone());
        PerceivedObject { landmark, ..object }
    }
}
