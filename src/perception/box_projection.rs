//! Projection of the boxes that a program reports, by the methods of a node's own camera.

use std::sync::Arc;

use super::camera::{Intrinsics, Mount};
use super::distortion::{self, undistort};
use super::landmark::{LandmarkGate, LandmarkIndex};
use super::projection::{NEURAL_PIXEL_SIGMA_PX, ObjectSizes, Projection, ProjectionConfig};
use super::view::{PosedCamera, ViewConfig, landmarks_in_view};
use crate::model::detection::Detection;
use crate::wire::{BoxCamera, BoxReport, ObjectReport};

/// Projects boxes with the settings of a cell.
#[derive(Debug, Clone)]
pub struct BoxProjector {
    /// True sizes of objects.
    pub sizes: ObjectSizes,
    /// Landmarks of the cell.
    pub landmarks: Arc<LandmarkIndex>,
    /// Limit of the distance between an object and its landmark.
    pub gate: LandmarkGate,
}

/// The outcome for one image.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectedBoxes {
    /// The objects with their positions, covariances and landmarks, and the landmarks in view.
    pub report: ObjectReport,
    /// Boxes without a position: index and reason of each.
    pub unplaced: Vec<UnplacedBox>,
}

/// A box without a position.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("boxes[{index}]: {cause}")]
pub struct UnplacedBox {
    /// Index in the report.
    pub index: usize,
    /// The reason, and the remedy if there is one.
    pub cause: String,
}

impl BoxProjector {
    /// Projects the boxes of a valid report.
    pub fn project(&self, report: &BoxReport) -> ProjectedBoxes {
        let BoxReport { camera, pose, .. } = report;
        let mount = Mount {
            height_m: pose.height_m,
            pitch_rad: pose.pitch_rad.unwrap_or(0.0),
            roll_rad: pose.roll_rad.unwrap_or(0.0),
            ..Mount::default()
        };
        let intrinsics = intrinsics_of(camera);
        let distortion = distortion::from_first(&camera.distortion);
        let projection = Projection::new(self.config_of(camera), intrinsics, mount);
        let camera_pose = (*pose).into();
        let mut objects = Vec::new();
        let mut unplaced = Vec::new();
        for (index, found) in report.boxes.iter().enumerate() {
            let mut detection = Detection {
                label: found.label.clone(),
                confidence: found.confidence,
                bounding_box: found.bounding_box(),
                corners: None,
            };
            let cut = projection.cut(&detection);
            if let Some(distortion) = &distortion {
                undistort(&mut detection, &intrinsics, distortion);
            }
            let placed = projection
                .place(&detection, cut, None, &camera_pose)
                .map_err(|error| error.to_string())
                .and_then(|object| match object.validate() {
                    Ok(()) => Ok(object),
                    Err(reason) => Err(format!("its position is {}", reason.in_words())),
                });
            match placed {
                Ok(object) => objects.push(self.landmarks.assigned(object, &self.gate)),
                Err(cause) => unplaced.push(UnplacedBox { index, cause }),
            }
        }
        let seen = landmarks_in_view(
            self.landmarks.landmarks(),
            &PosedCamera::new(camera_pose, &mount, intrinsics),
            &objects,
            &self.sizes,
            &ViewConfig::default(),
        );
        let empty = ObjectReport::new(report.node.clone(), report.seq, report.captured_at_us);
        let report = ObjectReport {
            pose: Some(*pose),
            objects,
            seen: Some(seen),
            moving: report.moving,
            ..empty
        };
        ProjectedBoxes { report, unplaced }
    }

    fn config_of(&self, camera: &BoxCamera) -> ProjectionConfig {
        let default = ProjectionConfig::default();
        ProjectionConfig {
            sizes: self.sizes.clone(),
            pixel_sigma_px: camera.pixel_sigma_px.unwrap_or(NEURAL_PIXEL_SIGMA_PX),
            heading_sigma_rad: camera
                .heading_sigma_rad
                .unwrap_or(default.heading_sigma_rad),
            tilt_sigma_rad: camera.tilt_sigma_rad.unwrap_or(default.tilt_sigma_rad),
            height_sigma_m: camera.height_sigma_m.unwrap_or(default.height_sigma_m),
            position_sigma_m: camera.position_sigma_m.unwrap_or(default.position_sigma_m),
            ..default
        }
    }
}

/// The intrinsics of a calibration, or else of the field of view.
fn intrinsics_of(camera: &BoxCamera) -> Intrinsics {
    let width = camera.width_px;
    let height = camera.height_px;
    if let (Some(fx), Some(fy), Some(cx), Some(cy)) = (camera.fx, camera.fy, camera.cx, camera.cy) {
        return Intrinsics {
            width,
            height,
            fx,
            fy,
            cx,
            cy,
        };
    }
    let horizontal_rad = camera.horizontal_fov_deg.unwrap_or_default().to_radians();
    match camera.vertical_fov_deg {
        Some(angle_deg) => {
            Intrinsics::from_field_of_view(width, height, horizontal_rad, angle_deg.to_radians())
        }
        None => Intrinsics::with_square_pixels(width, height, horizontal_rad),
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point2, Point3};
    use proptest::prelude::*;
    use proptest::{collection, option};

    use super::*;
    use crate::model::geometry::Pose;
    use crate::model::names::NodeName;
    use crate::model::time::Timestamp;
    use crate::perception::landmark::LandmarkConfig;
    use crate::wire::{Limits, PixelBox, WirePose};

    fn projector() -> BoxProjector {
        let slot = LandmarkConfig::at("slot-0", 0.0, 0.0);
        BoxProjector {
            sizes: ObjectSizes::default(),
            landmarks: Arc::new(LandmarkIndex::new(vec![(&slot).into()], 0.5)),
            gate: LandmarkGate {
                radius_m: 0.5,
                sigmas: 4.0,
                floor_m: 0.05,
            },
        }
    }

    /// A camera at (1, 6) that looks south, 1.3 m above the ground and 6° down.
    fn report(boxes: Vec<PixelBox>) -> BoxReport {
        BoxReport {
            schema: 1,
            node: NodeName::from_static("euclid--yolo"),
            seq: 7,
            captured_at_us: Timestamp(5),
            pose: WirePose {
                height_m: Some(1.3),
                pitch_rad: Some(6f64.to_radians()),
                ..WirePose::new(1.0, 6.0, -std::f64::consts::FRAC_PI_2)
            },
            camera: BoxCamera {
                width_px: 1280,
                height_px: 720,
                horizontal_fov_deg: Some(62.2),
                ..BoxCamera::default()
            },
            boxes,
            moving: None,
        }
    }

    fn found(label: &str, [x_min, y_min, x_max, y_max]: [f64; 4]) -> PixelBox {
        PixelBox {
            label: label.into(),
            confidence: 0.9,
            x_min,
            y_min,
            x_max,
            y_max,
        }
    }

    /// The pixel at which the camera of [`report`] shows a point `up_m` above the ground.
    fn pixel(report: &BoxReport, x_m: f64, y_m: f64, up_m: f64) -> Point2<f64> {
        let pose = Pose::from(report.pose);
        let mount = Mount {
            pitch_rad: report.pose.pitch_rad.unwrap(),
            ..Mount::default()
        };
        let level = pose
            .ahead_left(&Point2::new(x_m, y_m))
            .push(up_m - report.pose.height_m.unwrap());
        intrinsics_of(&report.camera)
            .project(&Point3::from(mount.to_level().transpose() * level))
            .unwrap()
    }

    /// The box of a person of usual size who stands at a place south of the camera.
    fn person(x_m: f64, y_m: f64) -> PixelBox {
        let camera = report(Vec::new());
        let foot = pixel(&camera, x_m + 0.25, y_m, 0.0);
        let head = pixel(&camera, x_m - 0.25, y_m, 1.7);
        found("person", [foot.x, head.y, head.x, foot.y])
    }

    #[test]
    fn box_has_position_and_landmark() {
        let boxes = report(vec![person(0.2, 0.1)]);
        assert!(boxes.check(&Limits::default()).is_ok());
        let ProjectedBoxes { report, unplaced } = projector().project(&boxes);
        assert_eq!(unplaced, []);
        let object = &report.objects[0];
        let off_m = nalgebra::Vector2::new(object.x_m - 0.2, object.y_m - 0.1);
        let covariance = object.covariance().unwrap();
        assert!(off_m.norm() < 0.4, "{object:?}");
        assert!(
            covariance.mahalanobis_squared(&off_m, 0.0) < 9.0,
            "{object:?}"
        );
        assert_eq!(object.landmark.as_deref(), Some("slot-0"));
        assert_eq!(report.votes().objects.len(), 1);
        assert_eq!((report.seq, report.pose), (7, Some(boxes.pose)));
    }

    #[test]
    fn box_matches_node_camera() {
        let boxes = report(vec![found("person", [600.0, 300.0, 660.0, 480.0])]);
        let mount = Mount {
            height_m: Some(1.3),
            pitch_rad: 6f64.to_radians(),
            ..Mount::default()
        };
        let config = ProjectionConfig {
            pixel_sigma_px: 3.0,
            ..ProjectionConfig::default()
        };
        let camera = Intrinsics::with_square_pixels(1280, 720, 62.2f64.to_radians());
        let own = Projection::new(config, camera, mount);
        let detection = Detection {
            label: "person".into(),
            confidence: 0.9,
            bounding_box: boxes.boxes[0].bounding_box(),
            corners: None,
        };
        let pose = Pose::from(boxes.pose);
        let expected = own.place(&detection, own.cut(&detection), None, &pose);
        let projected = projector().project(&boxes);
        assert_eq!(projected.report.objects, [expected.unwrap()]);
    }

    #[test]
    fn stated_accuracy_widens_the_covariance() {
        let precise = report(vec![person(0.2, 0.1)]);
        let mut rough = precise.clone();
        rough.camera.tilt_sigma_rad = Some(0.05);
        rough.camera.heading_sigma_rad = Some(0.05);
        let spread = |report: &BoxReport| {
            let covariance = projector().project(report).report.objects[0].covariance();
            covariance.map(|covariance| covariance.xx + covariance.yy)
        };
        assert!(spread(&rough) > spread(&precise));
    }

    #[test]
    fn unplaceable_box_names_reason() {
        let boxes = report(vec![
            found("car", [600.0, 300.0, 660.0, 480.0]),
            found("gadget", [600.0, 20.0, 660.0, 60.0]),
        ]);
        let ProjectedBoxes { report, unplaced } = projector().project(&boxes);
        assert_eq!(report.objects.len(), 1);
        assert_eq!(unplaced.len(), 1);
        let text = unplaced[0].to_string();
        assert!(
            text.starts_with("boxes[1]: ") && text.contains("gadget"),
            "{text}"
        );
    }

    proptest! {
        #[test]
        fn valid_boxes_make_acceptable_report(
            (heading_rad, pitch_rad, roll_rad) in (-6.0..6.0f64, -1.5..1.5f64, -3.0..3.0f64),
            height_m in option::of(0.01..1000.0f64),
            optics in [16.0..500_000.0f64, 16.0..300_000.0f64, 0.0..1280.0f64, 0.0..720.0f64],
            distortion in collection::vec(-10.0..10.0f64, 8),
            edges in [-20.0..1290.0f64, -10.0..725.0f64, -20.0..1290.0f64, -10.0..725.0f64],
        ) {
            let [x_min, y_min, x_max, y_max] = edges;
            let mut boxes = report(vec![
                found("person", [x_min.min(x_max), y_min.min(y_max), x_min.max(x_max), y_min.max(y_max)]),
            ]);
            boxes.pose = WirePose {
                height_m,
                pitch_rad: Some(pitch_rad),
                roll_rad: Some(roll_rad),
                ..WirePose::new(1e8, -1e8, heading_rad)
            };
            let [fx, fy, cx, cy] = optics.map(Some);
            boxes.camera = BoxCamera { width_px: 1280, height_px: 720, fx, fy, cx, cy, distortion, ..BoxCamera::default() };
            if boxes.check(&Limits::default()).is_ok() {
                let ProjectedBoxes { report, unplaced } = projector().project(&boxes);
                prop_assert_eq!(report.validate(&Limits::default()), Ok(()));
                prop_assert_eq!(report.objects.len() + unplaced.len(), 1);
            }
        }
    }

    #[test]
    fn lens_distortion_is_removed() {
        let ideal = report(vec![person(-1.5, 0.1)]);
        let mut bent = ideal.clone();
        let Intrinsics { fx, fy, cx, cy, .. } = intrinsics_of(&ideal.camera);
        bent.camera = BoxCamera {
            width_px: 1280,
            height_px: 720,
            fx: Some(fx),
            fy: Some(fy),
            cx: Some(cx),
            cy: Some(cy),
            distortion: vec![-0.3, 0.1, 0.0, 0.0],
            ..BoxCamera::default()
        };
        assert!(bent.check(&Limits::default()).is_ok());
        let x_m = |report: &BoxReport| projector().project(report).report.objects[0].x_m;
        // The lens draws objects nearer to the middle than they are; west is to the right.
        assert!(x_m(&bent) < x_m(&ideal) - 0.02);
    }
}
