//! Detections of ROS, placed in the cell.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime};

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::model::time::Timestamp;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::pose_history::PoseHistory;
use ecod::perception::projection::{Projection, ProjectionConfig, ProjectionError};
use ecod::wire::PerceivedObject;
use ecod_client::{Frame, Label};
use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

use crate::ros2::{
    CameraInfo, Detection2DArray, Detection3D, Detection3DArray, Header, ObjectHypothesis, ObjectHypothesisWithPose,
    PoseStamped, RosPose,
};

/// A detector's camera.
#[derive(Debug, Clone)]
pub struct RosCamera {
    /// Pose of a camera that stands, in the cell's frame; `None` if it is not known.
    pub pose: Option<Pose>,
    /// Height and attitude of the camera.
    pub mount: Mount,
    /// Projection of boxes in pictures.
    pub projection: ProjectionConfig,
    /// Labels for the detector's classes; classes that are not listed are labels.
    pub labels: BTreeMap<String, String>,
}

impl Default for RosCamera {
    /// A camera without a pose, and the pixel noise of neural detectors.
    fn default() -> Self {
        let projection = ProjectionConfig { pixel_sigma_px: 3.0, ..ProjectionConfig::default() };
        Self { pose: None, mount: Mount::default(), projection, labels: BTreeMap::new() }
    }
}

/// The reason why a message or an object of it is not reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum InputRefusal {
    /// Not a message of the topic's type.
    #[error("a message that cannot be decoded")]
    Malformed,
    /// Positions relative to a camera whose pose at that time is not known.
    #[error("a frame other than `map`, and no --pose of the camera, or none near the stamp on the --pose-topic")]
    NoPose,
    /// A pose of the camera that is none in the cell's frame.
    #[error("a pose of the camera that is not in the frame `map`, or has no orientation")]
    BadPose,
    /// A pose of the camera with the stamp of another time, or out of order.
    #[error("a pose of the camera that is not later than the one before, or more than 10 s from this machine's time")]
    BadPoseTime,
    /// Boxes in pictures whose optics are not known.
    #[error("boxes before a CameraInfo, or one without focal lengths")]
    NoOptics,
    /// A stamp before 1970, or far from this machine's time, as simulated ones are.
    #[error("a stamp more than 10 s from this machine's time, as with `use_sim_time`")]
    BadTime,
    /// An object without a class.
    #[error("an object without a hypothesis")]
    NoClass,
    /// A box that gives no position.
    #[error("a box that gives no position: {0}")]
    NoPosition(&'static str),
    /// Values that no report may have.
    #[error("values that no report may have")]
    Report,
}

/// A frame to be reported, and reasons why objects are missing in it.
type Placed = (Frame, Vec<InputRefusal>);

impl RosCamera {
    /// Places detections in space: in the frame `map`, in that of the camera, or in its optical one (REP 103).
    /// A camera that moves is where `poses` have it.
    pub(super) fn place(
        &self,
        detections: &Detection3DArray,
        poses: Option<&PoseHistory>,
    ) -> Result<Placed, InputRefusal> {
        let (captured_at, pose) = self.at(&detections.header, poses)?;
        let to_map = self.to_map(&detections.header, pose)?;
        let objects = detections.detections.iter().map(|detection| self.object(detection, &to_map));
        Ok(self.frame(captured_at, pose, objects))
    }

    /// The time of a header, and the camera's pose then.
    fn at(&self, header: &Header, poses: Option<&PoseHistory>) -> Result<(Timestamp, Option<Pose>), InputRefusal> {
        let captured_at = header.time().ok_or(InputRefusal::BadTime)?;
        Ok((captured_at, poses.map_or(self.pose, |poses| poses.at(captured_at))))
    }

    fn object(&self, detection: &Detection3D, to_map: &ToMap) -> Result<PerceivedObject, InputRefusal> {
        let unplaced = self.unplaced(&detection.results)?;
        let RosPose { position, orientation } = detection.bbox.center;
        let [x_m, y_m] = to_map.position(&Vector3::new(position.x, position.y, position.z));
        let covariance = detection.results.first().map(|result| &result.pose.covariance);
        let covariance_m2 = covariance.and_then(|covariance| to_map.covariance(covariance));
        let size = detection.bbox.size;
        // An optical frame's boxes are not upright ones, and a box that is not turned may mean that nothing is known.
        let has_size = !to_map.is_optical && size.x > 0.0 && size.y > 0.0;
        let turn = orientation.rotation().filter(|turn| has_size && turn.angle() > 0.0);
        Ok(PerceivedObject {
            x_m,
            y_m,
            covariance_m2,
            size_m: has_size.then_some([size.x, size.y]),
            heading_rad: turn.map(|turn| to_map.heading(&(turn * Vector3::x()))),
            ..unplaced
        })
    }

    /// Reports objects that are fit for it.
    fn frame(
        &self,
        captured_at: Timestamp,
        pose: Option<Pose>,
        objects: impl Iterator<Item = Result<PerceivedObject, InputRefusal>>,
    ) -> Placed {
        let captured_at = SystemTime::UNIX_EPOCH + Duration::from_micros(captured_at.micros());
        let (mut placed, mut refused) = (Vec::new(), Vec::new());
        for object in objects {
            match object {
                Ok(object) if object.validate().is_ok() => placed.push(object),
                Ok(_) => refused.push(InputRefusal::Report),
                Err(refusal) => refused.push(refusal),
            }
        }
        let pose = pose.map(|pose| self.mount.stated_pose(&pose));
        (Frame { captured_at, pose, ..Frame::new(placed) }, refused)
    }

    /// An object without a place: label and confidence of the best hypothesis, and those of all if there are several.
    fn unplaced(&self, results: &[ObjectHypothesisWithPose]) -> Result<PerceivedObject, InputRefusal> {
        let mut scores = BTreeMap::new();
        for ObjectHypothesis { class_id, score } in results.iter().map(|result| &result.hypothesis) {
            // Several classes may have one label, and independent scores a sum above one.
            let label = self.labels.get(class_id).unwrap_or(class_id).as_str();
            let sum = scores.entry(Label::from(label)).or_insert(0.0);
            *sum = if results.len() == 1 { *score } else { (*sum + score).min(1.0) };
        }
        let best = scores.iter().max_by(|a, b| a.1.total_cmp(b.1));
        let (label, confidence) = best.map(|(label, score)| (label.clone(), *score)).ok_or(InputRefusal::NoClass)?;
        if results.len() == 1 {
            scores.clear();
        }
        Ok(PerceivedObject { label, confidence, scores, ..PerceivedObject::default() })
    }

    fn to_map(&self, header: &Header, pose: Option<Pose>) -> Result<ToMap, InputRefusal> {
        if header.frame_id == "map" {
            return Ok(ToMap { origin: Pose::new(0.0, 0.0, 0.0), turn: Matrix3::identity(), is_optical: false });
        }
        let origin = pose.ok_or(InputRefusal::NoPose)?;
        let is_optical = ["_optical", "_optical_frame"].iter().any(|suffix| header.frame_id.ends_with(suffix));
        // From x ahead, y left, z up to x right, y down, z ahead.
        let body_to_optical = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
        let to_optical = if is_optical { Matrix3::identity() } else { body_to_optical };
        let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), origin.heading_rad);
        Ok(ToMap { origin, turn: heading * self.mount.to_level() * to_optical, is_optical })
    }
}

/// Time and pose of a camera, whose x axis is its own (REP 103).
pub(super) fn pose_in_map(stamped: &PoseStamped) -> Result<(Timestamp, Pose), InputRefusal> {
    let at = stamped.header.time().ok_or(InputRefusal::BadPoseTime)?;
    let RosPose { position, orientation } = stamped.pose;
    let ahead = orientation.rotation().map(|turn| turn * Vector3::x());
    let ahead = ahead.filter(|_| stamped.header.frame_id == "map").ok_or(InputRefusal::BadPose)?;
    let pose = Pose::new(position.x, position.y, ahead.y.atan2(ahead.x));
    let is_finite = [position.x, position.y, pose.heading_rad].into_iter().all(f64::is_finite);
    if is_finite { Ok((at, pose)) } else { Err(InputRefusal::BadPose) }
}

/// Places boxes in pictures of which the distortion has been removed, by the rules of [`RosCamera::place`].
pub(super) fn place_in_pictures(
    camera: &RosCamera,
    detections: &Detection2DArray,
    optics: Option<&CameraInfo>,
    poses: Option<&PoseHistory>,
) -> Result<Placed, InputRefusal> {
    let (captured_at, pose) = camera.at(&detections.header, poses)?;
    let pose = pose.ok_or(InputRefusal::NoPose)?;
    let intrinsics = optics.and_then(CameraInfo::intrinsics).ok_or(InputRefusal::NoOptics)?;
    let projection = Projection::new(camera.projection.clone(), intrinsics, camera.mount);
    let objects = detections.detections.iter().map(|detection| {
        let PerceivedObject { label, confidence, scores, .. } = camera.unplaced(&detection.results)?;
        let bounds = &detection.bbox;
        let (x, y) = (bounds.center.position.x, bounds.center.position.y);
        // The upright box about one that is turned.
        let (sin, cos) = bounds.center.theta.sin_cos();
        let half_width = ((bounds.size_x * cos).abs() + (bounds.size_y * sin).abs()) / 2.0;
        let half_height = ((bounds.size_x * sin).abs() + (bounds.size_y * cos).abs()) / 2.0;
        let (x_min, x_max, y_min, y_max) = (x - half_width, x + half_width, y - half_height, y + half_height);
        let bounding_box = BoundingBox { x_min, y_min, x_max, y_max };
        let detection = Detection { label, confidence, bounding_box, corners: None };
        let placed = projection.place(&detection, projection.cut(&detection), None::<&Point3<f64>>, &pose);
        let placed = placed.map_err(|error: ProjectionError| InputRefusal::NoPosition(error.as_str()))?;
        Ok(PerceivedObject { scores, ..placed })
    });
    Ok(camera.frame(captured_at, Some(pose), objects))
}

impl CameraInfo {
    /// The camera of pictures without distortion; `None` without focal lengths.
    fn intrinsics(&self) -> Option<Intrinsics> {
        let [fx, _, cx, _, _, fy, cy, ..] = self.p;
        let [raw_fx, _, raw_cx, _, raw_fy, raw_cy, ..] = self.k;
        let (fx, fy, cx, cy) = if fx > 0.0 { (fx, fy, cx, cy) } else { (raw_fx, raw_fy, raw_cx, raw_cy) };
        let (columns, rows) = (self.binning_x.max(1), self.binning_y.max(1));
        let of_region = |part: u32, whole: u32| if part > 0 { part } else { whole };
        let (width, height) =
            (of_region(self.roi.width, self.width) / columns, of_region(self.roi.height, self.height) / rows);
        let (fx, cx) = (fx / f64::from(columns), (cx - f64::from(self.roi.x_offset)) / f64::from(columns));
        let (fy, cy) = (fy / f64::from(rows), (cy - f64::from(self.roi.y_offset)) / f64::from(rows));
        let is_usable = fx > 0.0 && fy > 0.0 && cx.is_finite() && cy.is_finite() && width > 0 && height > 0;
        is_usable.then_some(Intrinsics { width, height, fx, fy, cx, cy })
    }
}

/// The way from a message's frame to the cell's.
struct ToMap {
    origin: Pose,
    turn: Matrix3<f64>,
    is_optical: bool,
}

impl ToMap {
    fn position(&self, point: &Vector3<f64>) -> [f64; 2] {
        let turned = self.turn * point;
        [self.origin.position.x + turned.x, self.origin.position.y + turned.y]
    }

    fn heading(&self, direction: &Vector3<f64>) -> f64 {
        let turned = self.turn * direction;
        turned.y.atan2(turned.x)
    }

    /// `[xx, xy, yy]` in m²; `None` if nothing is stated: all zeros, or a negative variance.
    fn covariance(&self, [x, y, z, ..]: &[[f64; 6]; 6]) -> Option<[f64; 3]> {
        let rows = [x, y, z].map(|[a, b, c, ..]| [*a, *b, *c]);
        let stated =
            Matrix3::from_fn(|row, column| rows.get(row).and_then(|row| row.get(column)).copied().unwrap_or(0.0));
        let turned = self.turn * stated * self.turn.transpose();
        let [xx, xy, yy] = [turned.m11, turned.m12, turned.m22];
        (xx > 0.0 && yy > 0.0).then_some([xx, xy, yy])
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use crate::ros2::RegionOfInterest;

    /// One object in a frame, with its variances along the frame's axes.
    fn message(frame: &str, at: [f64; 3], variances: [f64; 3], yaw_rad: f64) -> Detection3DArray {
        let mut covariance = vec![0.0; 36];
        variances.iter().zip([0, 7, 14]).for_each(|(variance, place)| covariance[place] = *variance);
        let [x, y, z] = at;
        let (sin, cos) = (yaw_rad / 2.0).sin_cos();
        let header = r#"{"stamp": {"sec": 1000, "nanosec": 5000}, "frame_id": "FRAME"}"#.replace("FRAME", frame);
        let pose = |x: f64, y: f64, z: f64| {
            format!(
                r#"{{"position": {{"x": {x}, "y": {y}, "z": {z}}}, "orientation": {{"x": 0, "y": 0, "z": {sin}, "w": {cos}}}}}"#
            )
        };
        let rows: Vec<_> = covariance.chunks(6).collect();
        let text = format!(
            r#"{{"header": {header}, "detections": [{{"header": {header}, "id": "",
                "results": [{{"hypothesis": {{"class_id": "2", "score": 0.9}},
                    "pose": {{"pose": {}, "covariance": {rows:?}}}}}],
                "bbox": {{"center": {}, "size": {{"x": 4.2, "y": 1.8, "z": 1.5}}}}}}]}}"#,
            pose(0.0, 0.0, 0.0),
            pose(x, y, z)
        );
        serde_json::from_str(&text).unwrap()
    }

    fn camera() -> RosCamera {
        let pose = Some(Pose::new(5.0, 1.0, FRAC_PI_2));
        RosCamera { pose, labels: [("2".to_owned(), "car".to_owned())].into(), ..RosCamera::default() }
    }

    fn only(camera: &RosCamera, message: &Detection3DArray) -> PerceivedObject {
        let (frame, refused) = camera.place(message, None).unwrap();
        assert_eq!(refused, []);
        assert_eq!(frame.captured_at, SystemTime::UNIX_EPOCH + Duration::from_micros(1_000_000_005));
        frame.objects.into_iter().next().unwrap()
    }

    #[test]
    fn an_object_is_at_one_place_in_whichever_frame_it_is_stated() {
        // 10 m ahead of a camera that looks north, 2 m to its right; least certain along the view.
        let stated = [
            message("map", [7.0, 11.0, 0.5], [0.1, 2.0, 0.1], FRAC_PI_2),
            message("front", [10.0, -2.0, 0.5], [2.0, 0.1, 0.1], 0.0),
            message("front_camera_optical_frame", [2.0, -0.5, 10.0], [0.1, 0.1, 2.0], 0.0),
        ];
        for message in &stated {
            let object = only(&camera(), message);
            assert!((object.x_m - 7.0).abs() < 1e-9 && (object.y_m - 11.0).abs() < 1e-9, "{object:?}");
            let [xx, xy, yy] = object.covariance_m2.unwrap();
            assert!((xx - 0.1).abs() < 1e-9 && xy.abs() < 1e-9 && (yy - 2.0).abs() < 1e-9, "{object:?}");
            assert_eq!((object.label.as_str(), object.confidence), ("car", 0.9));
        }
        let [in_map, before, optical] = stated.map(|message| only(&camera(), &message));
        assert!((in_map.heading_rad.unwrap() - FRAC_PI_2).abs() < 1e-9 && in_map.size_m == Some([4.2, 1.8]));
        assert_eq!((before.heading_rad, before.size_m), (None, Some([4.2, 1.8])), "not turned: nothing is known");
        assert_eq!((optical.heading_rad, optical.size_m), (None, None));
    }

    #[test]
    fn classes_of_one_label_count_together() {
        let labels = [("2".to_owned(), "car".to_owned()), ("7".to_owned(), "car".to_owned())].into();
        let mut message = message("map", [1.0, 0.0, 0.0], [0.1; 3], 0.0);
        let results = &mut message.detections[0].results;
        results.extend([results[0].clone(), results[0].clone()]);
        for (result, (class, score)) in results.iter_mut().zip([("2", 0.35), ("0", 0.4), ("7", 0.25)]) {
            result.hypothesis = ObjectHypothesis { class_id: class.to_owned(), score };
        }
        let camera = RosCamera { labels, ..camera() };
        let object = only(&camera, &message);
        assert_eq!((object.label.as_str(), object.confidence), ("car", 0.6));
        assert_eq!(object.scores, [("0".into(), 0.4), ("car".into(), 0.6)].into());
        message.detections[0].results.iter_mut().for_each(|result| result.hypothesis.score = 0.8);
        assert_eq!(only(&camera, &message).confidence, 1.0, "of independent scores");
    }

    #[test]
    fn a_camera_that_looks_down_places_what_is_before_it_nearer() {
        let mount = Mount { height_m: Some(3.0), pitch_rad: 0.5, ..Mount::default() };
        let tilted = RosCamera { mount, ..camera() };
        let object = only(&tilted, &message("front_optical", [0.0, 0.0, 10.0], [0.0; 3], 0.0));
        assert!((object.y_m - 1.0 - 10.0 * 0.5f64.cos()).abs() < 1e-9 && (object.x_m - 5.0).abs() < 1e-9, "{object:?}");
        assert_eq!(object.covariance_m2, None, "zeros state nothing");
    }

    #[test]
    fn boxes_are_placed_alike_in_a_whole_picture_and_in_a_binned_part_of_it() {
        let boxes = |x: f64, y: f64, size_x: f64, size_y: f64, theta: f64| -> Detection2DArray {
            let header = r#"{"stamp": {"sec": 1000, "nanosec": 5000}, "frame_id": "front"}"#;
            let results =
                serde_json::to_value(message("map", [0.0; 3], [0.0; 3], 0.0).detections.remove(0).results).unwrap();
            let bbox = format!(
                r#"{{"center": {{"position": {{"x": {x}, "y": {y}}}, "theta": {theta}}}, "size_x": {size_x}, "size_y": {size_y}}}"#
            );
            let detection = format!(r#"{{"header": {header}, "results": {results}, "bbox": {bbox}, "id": ""}}"#);
            serde_json::from_str(&format!(r#"{{"header": {header}, "detections": [{detection}]}}"#)).unwrap()
        };
        let (fx, cx, cy) = (900.0, 640.0, 480.0);
        let k = [fx, 0.0, cx, 0.0, fx, cy, 0.0, 0.0, 1.0];
        let whole = CameraInfo { width: 1280, height: 960, k, ..CameraInfo::default() };
        let roi =
            RegionOfInterest { x_offset: 200, y_offset: 100, width: 800, height: 600, ..RegionOfInterest::default() };
        let part = CameraInfo { binning_x: 2, binning_y: 2, roi, ..whole.clone() };
        let mount = Mount { height_m: Some(1.5), ..Mount::default() };
        let camera = RosCamera { mount, ..camera() };
        let place = |boxes: &Detection2DArray, optics| {
            let (frame, refused) = place_in_pictures(&camera, boxes, Some(optics), None).unwrap();
            assert_eq!(refused, []);
            (frame.objects[0].x_m, frame.objects[0].y_m)
        };
        let (x, y) = place(&boxes(700.0, 520.0, 120.0, 100.0, 0.0), &whole);
        let turned = place(&boxes(700.0, 520.0, 100.0, 120.0, FRAC_PI_2), &whole);
        let binned = place(&boxes(250.0, 210.0, 60.0, 50.0, 0.0), &part);
        // A pixel's noise is twice as large there.
        for ((other_x, other_y), within_m) in [(turned, 1e-6), (binned, 0.1)] {
            let error_m = (x - other_x).hypot(y - other_y);
            assert!(error_m < within_m, "{x} {y}, {other_x} {other_y}");
        }
    }

    fn pose_at(frame: &str, seconds: u32, x: f64, yaw_rad: f64) -> PoseStamped {
        let (sin, cos) = (yaw_rad / 2.0).sin_cos();
        let text = format!(
            r#"{{"header": {{"stamp": {{"sec": {seconds}, "nanosec": 0}}, "frame_id": "{frame}"}},
                "pose": {{"position": {{"x": {x}, "y": 1, "z": 0.7}}, "orientation": {{"x": 0, "y": 0, "z": {sin}, "w": {cos}}}}}}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    #[test]
    fn a_camera_that_moves_is_where_it_was_at_the_stamp() {
        let mut poses = PoseHistory::default();
        for (seconds, x, yaw_rad) in [(999, 4.0, FRAC_PI_2), (1000, 5.0, FRAC_PI_2), (1001, 205.0, FRAC_PI_2)] {
            let (at, pose) = pose_in_map(&pose_at("map", seconds, x, yaw_rad)).unwrap();
            assert!(poses.push(at, pose));
        }
        // 5 µs after the second pose, at 200 m/s; the pose of the settings is that of no camera that moves.
        let moving = RosCamera { pose: Some(Pose::new(99.0, 99.0, 0.0)), ..camera() };
        let (frame, refused) = moving.place(&message("front", [10.0, -2.0, 0.5], [0.0; 3], 0.0), Some(&poses)).unwrap();
        assert_eq!(refused, []);
        let (stated, object) = (frame.pose.unwrap(), &frame.objects[0]);
        let all = [stated.x_m, stated.y_m, stated.heading_rad, object.x_m, object.y_m];
        let expected = [5.001, 1.0, FRAC_PI_2, 7.001, 11.0];
        assert!(all.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-6), "{all:?}");
        let mut late = message("front", [10.0, -2.0, 0.5], [0.0; 3], 0.0);
        late.header = pose_at("front", 1002, 0.0, 0.0).header;
        assert_eq!(moving.place(&late, Some(&poses)).err(), Some(InputRefusal::NoPose));
        let boxes = Detection2DArray { header: late.header, detections: Vec::new() };
        let optics = CameraInfo::default();
        assert_eq!(place_in_pictures(&moving, &boxes, Some(&optics), Some(&poses)).err(), Some(InputRefusal::NoPose));
        late.header = Header { frame_id: "map".to_owned(), ..boxes.header };
        assert_eq!(moving.place(&late, Some(&poses)).unwrap().0.pose, None, "no place is relative to the camera");
    }

    #[test]
    fn a_pose_is_one_in_the_map_with_a_direction() {
        let refusal = |stamped: &PoseStamped| pose_in_map(stamped).err();
        assert_eq!(refusal(&pose_at("odom", 1000, 1.0, 0.0)), Some(InputRefusal::BadPose));
        let mut unset = pose_at("map", 1000, 1.0, 0.0);
        unset.pose.orientation.w = 0.0;
        assert_eq!(refusal(&unset), Some(InputRefusal::BadPose));
        let mut nowhere = pose_at("map", 1000, 1.0, 0.0);
        nowhere.pose.position.x = f64::NAN;
        assert_eq!(refusal(&nowhere), Some(InputRefusal::BadPose));
    }

    #[test]
    fn what_cannot_be_placed_is_refused_by_reason() {
        let nowhere = RosCamera { pose: None, ..camera() };
        let refusal = |message: &Detection3DArray| nowhere.place(message, None).map(|(_, refused)| refused);
        assert_eq!(refusal(&message("front", [1.0, 0.0, 0.0], [0.1; 3], 0.0)), Err(InputRefusal::NoPose));
        assert_eq!(refusal(&message("map", [1e300, 0.0, 0.0], [0.1; 3], 0.0)), Ok(vec![InputRefusal::Report]));
        let mut unknown = message("map", [1.0, 0.0, 0.0], [0.1; 3], 0.0);
        unknown.detections[0].results.clear();
        assert_eq!(refusal(&unknown), Ok(vec![InputRefusal::NoClass]));
        let boxes = Detection2DArray { header: unknown.header, detections: Vec::new() };
        assert_eq!(place_in_pictures(&camera(), &boxes, None, None).err(), Some(InputRefusal::NoOptics));
        assert_eq!(
            place_in_pictures(&camera(), &boxes, Some(&CameraInfo::default()), None).err(),
            Some(InputRefusal::NoOptics)
        );
    }
}
