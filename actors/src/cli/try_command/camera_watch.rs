//! The camera of a vehicle of `try`, found from the people whom its own detector detects.

use std::ops::RangeInclusive;
use std::sync::{Arc, Mutex, PoisonError};

use ecod::model::detection::Detection;
use ecod::model::names::Label;
use ecod::perception::projection::{MIN_BOXES, MountEstimate, ProjectionConfig};

use crate::camera::config::{CameraConfig, MountConfig};
use crate::camera::detect::{CustomDetector, Detect, DetectError, DetectorConfig};
use crate::camera::frame::CameraFrame;
use crate::camera::image_size::ImageSize;
use crate::camera::mount_calibration::people::PeopleWatch;
use crate::node;

const PERSON: &str = "person";

/// Boxes after which the collection begins anew: a fit uses fewer.
const MAX_BOXES: usize = 5000;

/// Growth of the number of boxes after which a fit is tried again.
const RETRY_GROWTH: f64 = 1.3;

/// Heights of cameras that people can determine; others come from boxes that show no people.
const PLAUSIBLE_HEIGHT_M: RangeInclusive<f64> = 0.2..=60.0;

/// Collects people until they determine height and tilt of the camera.
pub(super) struct CameraWatch {
    people: Arc<Mutex<PeopleWatch>>,
    /// Number of boxes for the next fit.
    next_fit: usize,
}

/// A detector whose detections are collected as well.
struct CollectingDetector {
    detector: Box<dyn Detect>,
    people: Arc<Mutex<PeopleWatch>>,
}

impl Detect for CollectingDetector {
    fn detect(&mut self, frame: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
        let detections = self.detector.detect(frame)?;
        let mut people = self.people.lock().unwrap_or_else(PoisonError::into_inner);
        if people.boxes() < MAX_BOXES
            && let Err(error) = people.add(detections.clone(), ImageSize::of(&frame.image))
        {
            tracing::debug!(%error, "a frame does not serve to find the camera");
        }
        Ok(detections)
    }
}

impl CameraWatch {
    /// A watch of a camera, and the camera with a detector that collects people.
    ///
    /// # Errors
    /// Returns an error if a file of the optics cannot be used.
    pub(super) fn new(mut camera: CameraConfig) -> anyhow::Result<(Self, CameraConfig)> {
        let lens = node::camera::lens(&camera)?;
        let size = camera.projection.sizes.of(PERSON).copied();
        let Some(size) = size else {
            anyhow::bail!("no size of {PERSON:?}: set camera.projection.sizes");
        };
        let watch = PeopleWatch::new(camera.clone(), lens, Label::new_static(PERSON), size);
        let people = Arc::new(Mutex::new(watch));
        let detector = camera.detector.clone();
        let collected = Arc::clone(&people);
        camera.detector = DetectorConfig::Custom(CustomDetector::new(move || {
            Ok(Box::new(CollectingDetector {
                detector: detector.build()?,
                people: Arc::clone(&collected),
            }))
        }));
        let watch = Self {
            people,
            next_fit: MIN_BOXES,
        };
        Ok((watch, camera))
    }

    /// Height and tilt of the camera, as soon as the collected people determine them; blocks for up
    /// to seconds when enough people have been added since the last fit.
    pub(super) fn find(&mut self) -> Option<MountEstimate> {
        let mut people = self.people.lock().unwrap_or_else(PoisonError::into_inner);
        if people.boxes() < self.next_fit {
            return None;
        }
        self.next_fit = MAX_BOXES.min((people.boxes() as f64 * RETRY_GROWTH) as usize);
        let snapshot = people.clone();
        if people.boxes() >= MAX_BOXES {
            people.clear();
            self.next_fit = MIN_BOXES;
        }
        drop(people);
        match snapshot.fit() {
            Ok(estimate) => Some(estimate).filter(|estimate| {
                let height_m = estimate.mount.height_m;
                height_m.is_some_and(|height_m| PLAUSIBLE_HEIGHT_M.contains(&height_m))
            }),
            Err(error) => {
                tracing::debug!(%error, "people do not determine the camera yet");
                None
            }
        }
    }
}

/// Sets the mount of a camera to an estimate. The errors are at least the usual ones, because the
/// ground is not level everywhere and the camera may sway.
pub(super) fn apply(estimate: &MountEstimate, camera: &mut CameraConfig) {
    let usual = ProjectionConfig::default();
    let tilt_sigma_rad = estimate.pitch_sigma_rad.max(estimate.roll_sigma_rad);
    camera.mount = MountConfig::rounded(&estimate.mount);
    camera.projection.tilt_sigma_rad = tilt_sigma_rad.max(usual.tilt_sigma_rad);
    camera.projection.height_sigma_m = estimate.height_sigma_m.max(usual.height_sigma_m);
}
