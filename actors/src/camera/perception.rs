//! Processing of one vehicle's detections into a report: undistortion, ranging, placing, field of
//! view.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::detection::Detection;
use ecod::model::geometry::Pose;
use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::perception::camera::Mount;
use ecod::perception::landmark::{LandmarkGate, LandmarkIndex};
use ecod::perception::polygon::Polygon;
use ecod::perception::projection::{
    Cut, MountCheck, Projection, ProjectionConfig, ProjectionError,
};
use ecod::perception::view::{PosedCamera, ViewConfig, landmarks_in_view};
use ecod::wire::{ObjectReport, PerceivedObject};

use crate::camera::corner_pose::locate_target;
use crate::camera::lens::Lens;
use crate::camera::mask::Masks;

/// A vehicle's camera and the landmarks of its cell.
#[derive(Debug, Clone)]
pub struct VehicleCamera {
    /// Name of the vehicle or part that reports.
    pub node: NodeName,
    /// Pose of the vehicle in the cell's frame.
    pub pose: Pose,
    /// Position of the camera on the vehicle.
    pub mount: Mount,
    /// Intrinsics and distortion of the camera.
    pub lens: Lens,
    /// Landmarks of the cell.
    pub landmarks: Arc<LandmarkIndex>,
}

/// Producer of one vehicle's reports.
#[derive(Debug, Clone)]
pub struct Perception {
    vehicle_camera: VehicleCamera,
    camera: Pose,
    projection: Projection,
    view: ViewConfig,
    gate: LandmarkGate,
    seq: u64,
    /// Indices of the detections behind the objects of the last report.
    reported: Vec<usize>,
    discarded: DiscardCounts,
    /// First and last frame with detections since a detection last had a place.
    unplaced: Option<[Timestamp; 2]>,
    mount_check: MountCheck,
    masks: Masks,
    /// The masks without the distortion of the lens.
    straight_masks: Vec<Polygon>,
    /// The angle computed from the last frame, in radians.
    mount_off_rad: Option<f64>,
}

/// Number of discarded detections.
#[derive(Debug, Clone, Default)]
struct DiscardCounts {
    by_reason: BTreeMap<&'static str, u64>,
    /// Detections without a size, by label; at most [`MAX_UNSIZED`] labels.
    without_size: BTreeMap<Label, u64>,
    /// True if the last report had a detection without a size.
    is_size_missing: bool,
    /// The last reason in the last report, as text.
    last_reason: Option<String>,
}

/// Number of straight pieces of a mask's edge in an image without distortion.
const PARTS_OF_EDGE: u16 = 16;

/// Time without any placed detection before this is reported.
const UNPLACED_PATIENCE: Duration = Duration::from_secs(5);

/// Maximum number of labels without a size that are counted: a detector of texts may produce any
/// number.
const MAX_UNSIZED: usize = 8;

impl DiscardCounts {
    /// Counts a detection, and logs the first of each reason. A missing size is reported
    /// separately.
    fn count(&mut self, reason: &'static str, error: &dyn Display) {
        let times = self.by_reason.entry(reason).or_default();
        *times += 1;
        self.last_reason = Some(error.to_string());
        match *times {
            1 => tracing::info!(%error, "detection discarded, first for this reason"),
            _ => tracing::debug!(%error, "detection discarded"),
        }
    }

    /// Counts a detection without a place.
    fn count_unplaced(&mut self, error: &ProjectionError) {
        self.count(error.as_str(), error);
        if let ProjectionError::UnknownSize(label) = error {
            self.is_size_missing = true;
            if self.without_size.len() < MAX_UNSIZED || self.without_size.contains_key(label) {
                *self.without_size.entry(label.clone()).or_default() += 1;
            }
        }
    }
}

impl Perception {
    /// Creates a producer without reports; the configurations must be valid. `gate` limits the
    /// distance between an object and its landmark.
    pub fn new(
        vehicle_camera: VehicleCamera,
        projection: ProjectionConfig,
        view: ViewConfig,
        gate: LandmarkGate,
    ) -> Self {
        let camera = vehicle_camera.mount.camera_pose(&vehicle_camera.pose);
        let projection = Projection::new(
            projection,
            vehicle_camera.lens.intrinsics,
            vehicle_camera.mount,
        );
        Self {
            vehicle_camera,
            camera,
            projection,
            view,
            gate,
            seq: 0,
            reported: Vec::new(),
            discarded: DiscardCounts::default(),
            unplaced: None,
            mount_check: MountCheck::default(),
            masks: Masks::default(),
            straight_masks: Vec::new(),
            mount_off_rad: None,
        }
    }

    /// The producer for a camera with masks. A box that a mask cuts does not show the whole object,
    /// and a masked landmark is not in view.
    #[must_use]
    pub fn with_masks(self, masks: Masks) -> Self {
        let mut masked = Self { masks, ..self };
        masked.fit_masks();
        masked
    }

    /// Sets the masks in pixels of the present lens.
    fn fit_masks(&mut self) {
        if self.masks.is_empty() {
            return;
        }
        let lens = self.vehicle_camera.lens;
        let masks = self.masks.in_pixels_of((&lens.intrinsics).into());
        let straight = |mask: &Polygon| {
            let outline = mask.subdivided(PARTS_OF_EDGE);
            outline.mapped(|corner| lens.undistorted(corner))
        };
        self.straight_masks = masks.iter().map(straight).collect();
        self.projection = self.projection.clone().with_masks(masks);
    }

    /// The same producer with the numbers of reports and the counts of an earlier one.
    #[must_use]
    pub fn continuing(self, earlier: &Self) -> Self {
        Self {
            seq: earlier.seq,
            discarded: earlier.discarded.clone(),
            ..self
        }
    }

    /// Sets the pose of the vehicle.
    pub fn set_pose(&mut self, pose: Pose) {
        self.vehicle_camera.pose = pose;
        self.camera = self.vehicle_camera.mount.camera_pose(&pose);
    }

    /// Sets the lens of the next frames.
    pub fn set_lens(&mut self, lens: &Lens) {
        if self.vehicle_camera.lens != *lens {
            self.vehicle_camera.lens = *lens;
            let config = self.projection.config().clone();
            let mount = self.vehicle_camera.mount;
            self.projection = Projection::new(config, lens.intrinsics, mount);
            self.mount_check = MountCheck::default();
            self.fit_masks();
        }
    }

    /// The report of one frame. Detections without a position are discarded and counted.
    pub fn report(
        &mut self,
        mut detections: Vec<Detection>,
        captured_at: Timestamp,
    ) -> ObjectReport {
        self.discarded.is_size_missing = false;
        self.discarded.last_reason = None;
        let cuts: Vec<Cut> = detections
            .iter()
            .map(|detection| self.projection.cut(detection))
            .collect();
        self.vehicle_camera.lens.undistort(&mut detections);
        let boxes = detections.iter().zip(cuts.iter().copied());
        self.mount_off_rad = self.mount_check.add(boxes, captured_at, &self.projection);
        let all = detections.iter().zip(cuts).enumerate();
        let placed =
            all.filter_map(|(index, (detection, cut))| Some((index, self.place(detection, cut)?)));
        let (reported, objects): (Vec<_>, Vec<_>) = placed.unzip();
        self.reported = reported;
        if !objects.is_empty() {
            self.unplaced = None;
        } else if self.discarded.last_reason.is_some() {
            // An object that was last seen long ago counts as a different object.
            let going_on = self
                .unplaced
                .filter(|[_, last]| captured_at.since(*last) < UNPLACED_PATIENCE);
            self.unplaced = Some([
                going_on.map_or(captured_at, |[since, _]| since),
                captured_at,
            ]);
        }
        let VehicleCamera {
            landmarks,
            mount,
            lens,
            ..
        } = &self.vehicle_camera;
        let camera =
            PosedCamera::new(self.camera, mount, lens.intrinsics).with_masks(&self.straight_masks);
        let sizes = &self.projection.config().sizes;
        let seen = landmarks_in_view(landmarks.landmarks(), &camera, &objects, sizes, &self.view);
        self.seq += 1;
        ObjectReport {
            pose: Some(mount.stated_pose(&self.camera)),
            objects,
            seen: Some(seen),
            ..ObjectReport::new(self.vehicle_camera.node.clone(), self.seq, captured_at)
        }
    }

    /// Indices of the detections that became the objects of the last report, in their order.
    pub fn reported(&self) -> &[usize] {
        &self.reported
    }

    /// Number of detections discarded by reason since the start.
    pub fn discarded(&self) -> &BTreeMap<&'static str, u64> {
        &self.discarded.by_reason
    }

    /// The labels without a size, as text, if one was in the last frame.
    pub fn without_size(&self) -> Option<String> {
        let labels = self
            .discarded
            .without_size
            .iter()
            .map(|(label, times)| format!("{times} of {label}"))
            .collect::<Vec<_>>()
            .join(", ");
        self.discarded
            .is_size_missing
            .then(|| format!("detections have no size and are not reported: {labels}"))
    }

    /// The reason, as text, why the last discarded detection of the last report has no place.
    pub fn last_discard(&self) -> Option<&str> {
        self.discarded.last_reason.as_deref()
    }

    /// The reason as text, if all detections of the last frame lack a place, as in the seconds
    /// before.
    pub fn nothing_placed(&self) -> Option<String> {
        let [since, last] = self.unplaced?;
        let reason = self.last_discard()?;
        let time = last.since(since);
        (time >= UNPLACED_PATIENCE).then(|| {
            format!(
                "no detection has had a place for {} s: {reason}",
                time.as_secs()
            )
        })
    }

    /// The angle between the configured and the observed mount as text, if the last frame has shown
    /// that it is too large.
    pub fn mount_mismatch(&self) -> Option<String> {
        let off_deg = self.mount_off_rad?.to_degrees();
        let side = if off_deg > 0.0 { "higher" } else { "lower" };
        Some(format!(
            "the camera looks {:.0}° {side} than its mount states, judged by objects on the ground",
            off_deg.abs()
        ))
    }

    fn place(&mut self, detection: &Detection, cut: Cut) -> Option<PerceivedObject> {
        let corners = detection
            .corners
            .filter(|_| self.projection.config().ranging.uses_corners());
        let side_m = self
            .projection
            .config()
            .sizes
            .of(&detection.label)
            .map(|size| size.width_m);
        let located = corners
            .zip(side_m)
            .map(|(c, side)| locate_target(&c, side, &self.vehicle_camera.lens.intrinsics));
        let target = match located.transpose() {
            Ok(target) => target,
            Err(error) => {
                tracing::debug!(label = %detection.label, %error, "cannot use corners");
                None
            }
        };
        let placed = self
            .projection
            .place(detection, cut, target.as_ref(), &self.camera)
            .map_err(|error| self.discarded.count_unplaced(&error))
            .ok()?;
        // Receivers reject a report with one invalid object, so this is checked per object.
        placed
            .validate()
            .map_err(|reason| self.discarded.count(reason.as_str(), &reason))
            .ok()?;
        let VehicleCamera { landmarks, .. } = &self.vehicle_camera;
        Some(landmarks.assigned(placed, &self.gate))
    }
}

#[cfg(test)]
mod tests {
    use ecod::model::detection::BoundingBox;
    use ecod::perception::camera::Intrinsics;
    use ecod::perception::landmark::Landmark;
    use ecod::perception::projection::{ObjectSize, ObjectSizes, Ranging};
    use nalgebra::Point2;

    use super::*;
    use crate::camera::config::CameraConfig;

    #[test]
    fn unwanted_object_leaves_others_reported() {
        let camera = Intrinsics::from_field_of_view(640, 480, 1.0, 0.8);
        let vehicle_camera = VehicleCamera {
            node: NodeName::from_static("euclid"),
            pose: Pose::new(0.0, 0.0, 0.0),
            mount: Mount::default(),
            lens: Lens::ideal(camera),
            landmarks: Arc::new(LandmarkIndex::new(Vec::new(), 0.5)),
        };
        let sizes = ObjectSizes {
            default: Some(ObjectSize::square(0.5)),
            ..ObjectSizes::default()
        };
        let projection = ProjectionConfig {
            ranging: Ranging::BoxHeight,
            sizes,
            ..ProjectionConfig::default()
        };
        let gate = LandmarkGate {
            radius_m: 0.5,
            sigmas: 4.0,
            floor_m: 0.05,
        };
        let mut perception =
            Perception::new(vehicle_camera, projection, ViewConfig::default(), gate);
        let seen = |label: &str, confidence: f64, y_max: f64| Detection {
            label: label.into(),
            confidence,
            bounding_box: BoundingBox {
                x_min: 300.0,
                y_min: 200.0,
                x_max: 340.0,
                y_max,
            },
            corners: None,
        };
        let found = vec![
            seen("", 0.9, 240.0),
            seen("cup", f64::NAN, 240.0),
            seen("cup", 0.9, 480.0),
            seen("car", 0.9, 240.0),
        ];
        let report = perception.report(found, Timestamp(1));
        assert_eq!(
            report
                .objects
                .iter()
                .map(|object| &*object.label)
                .collect::<Vec<_>>(),
            ["car"]
        );
        assert_eq!(perception.reported(), [3]);
        let discarded: Vec<_> = perception
            .discarded()
            .iter()
            .map(|(reason, times)| (*reason, *times))
            .collect();
        assert_eq!(
            discarded,
            [("clipped", 1), ("invalid_label", 1), ("not_finite", 1)]
        );
    }

    /// A mask over the left half of the picture, in whatever size a lens has.
    #[test]
    fn masked_landmarks_are_not_seen() {
        let lens = |width, height| Lens {
            distortion: Some([-0.2, 0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
            ..Lens::ideal(Intrinsics::from_field_of_view(width, height, 1.0, 0.8))
        };
        let landmark = |id: &str, y_m: f64| Landmark {
            id: id.into(),
            position: Point2::new(1.0, y_m),
            facing_rad: None,
            vacancy: None,
            synonyms: Vec::new(),
        };
        let landmarks = vec![landmark("left", 0.2), landmark("right", -0.2)];
        let vehicle_camera = VehicleCamera {
            node: NodeName::from_static("cam"),
            pose: Pose::new(0.0, 0.0, 0.0),
            mount: Mount::default(),
            lens: lens(640, 480),
            landmarks: Arc::new(LandmarkIndex::new(landmarks, 0.1)),
        };
        let gate = LandmarkGate {
            radius_m: 0.1,
            sigmas: 4.0,
            floor_m: 0.05,
        };
        let view = ViewConfig {
            min_target_px: 1.0,
            ..ViewConfig::default()
        };
        let whole = Perception::new(vehicle_camera, ProjectionConfig::default(), view, gate);
        let masks: CameraConfig = toml::from_str(
            "source.kind = 'v4l2'\ndetector.kind = 'placard'\n\
             masks = [[[0, 0], [0.5, 0], [0.5, 1], [0, 1]]]",
        )
        .unwrap();
        let mut masked = whole.clone().with_masks(masks.masks);
        let mut whole = whole;
        for lens in [lens(640, 480), lens(1280, 960)] {
            masked.set_lens(&lens);
            whole.set_lens(&lens);
            let seen = |perception: &mut Perception| {
                let seen = perception.report(Vec::new(), Timestamp(1)).seen;
                seen.unwrap()
                    .iter()
                    .map(|id| id.to_string())
                    .collect::<Vec<_>>()
            };
            assert_eq!(seen(&mut whole), ["left", "right"]);
            assert_eq!(seen(&mut masked), ["right"]);
        }
    }

    #[test]
    fn labels_without_size_are_counted() {
        let camera = Intrinsics::from_field_of_view(640, 480, 1.0, 0.8);
        let vehicle_camera = VehicleCamera {
            node: NodeName::from_static("cam"),
            pose: Pose::new(0.0, 0.0, 0.0),
            mount: Mount::default(),
            lens: Lens::ideal(camera),
            landmarks: Arc::new(LandmarkIndex::new(Vec::new(), 0.5)),
        };
        let sizes = ObjectSizes {
            labels: [("car".into(), ObjectSize::square(1.5))].into(),
            default: None,
        };
        let projection = ProjectionConfig {
            ranging: Ranging::BoxHeight,
            sizes,
            ..ProjectionConfig::default()
        };
        let gate = LandmarkGate {
            radius_m: 0.5,
            sigmas: 4.0,
            floor_m: 0.05,
        };
        let mut perception =
            Perception::new(vehicle_camera, projection, ViewConfig::default(), gate);
        let seen = |label: &str| Detection {
            label: label.into(),
            confidence: 0.9,
            bounding_box: BoundingBox {
                x_min: 300.0,
                y_min: 200.0,
                x_max: 340.0,
                y_max: 240.0,
            },
            corners: None,
        };
        for _ in 0..3 {
            perception.report(vec![seen("plate"), seen("car")], Timestamp(1));
        }
        perception.report(vec![seen("cart")], Timestamp(2));
        let words = "detections have no size and are not reported: 1 of cart, 3 of plate";
        assert_eq!(perception.without_size().as_deref(), Some(words));
        perception.report(vec![seen("car")], Timestamp(3));
        assert_eq!(perception.without_size(), None);
        (0..100).for_each(|n| drop(perception.report(vec![seen(&format!("QR{n}"))], Timestamp(4))));
        assert!(
            perception
                .without_size()
                .is_some_and(|words| words.len() < 200)
        );
    }
}
