//! Detections of ROS, placed in the cell.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::time::{Duration, SystemTime};

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::geometry::Pose;
use ecod::model::time::Timestamp;
use ecod::perception::camera::{Intrinsics, Mount};
use ecod::perception::pose_history::PoseHistory;
use ecod::perception::projection::{Projection, ProjectionConfig};
use ecod::wire::PerceivedObject;
use ecod_client::{Frame, Label};
use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

use crate::ros2::{
    CameraInfo, Detection2DArray, Detection3D, Detection3DArray, Header, ObjectHypothesis,
    ObjectHypothesisWithPose, PoseStamped, RosPose,
};

/// Camera of a detector in ROS, and the meaning of its classes.
#[derive(Debug, Clone)]
pub struct RosCamera {
    /// Pose of a standing camera in the cell's frame; `None` if it is not given.
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
        let projection = ProjectionConfig {
            pixel_sigma_px: 3.0,
            ..ProjectionConfig::default()
        };
        Self {
            pose: None,
            mount: Mount::default(),
            projection,
            labels: BTreeMap::new(),
        }
    }
}

/// The reason why a message or an object of it is not reported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum InputRefusal {
    /// Not a message of the topic's type.
    #[error("a message that cannot be decoded")]
    Malformed,
    /// Positions relative to a camera without a pose for that time.
    #[error(
        "a frame other than `map` without --pose of its camera, or a stamp far from those on --pose-topic"
    )]
    NoPose,
    /// A pose of the camera that is invalid in the cell's frame.
    #[error("a pose of the camera that is not in the frame `map`, or has no orientation")]
    BadPose,
    /// A pose of the camera with a wrong stamp, or out of order.
    #[error(
        "a pose of the camera that is not later than the one before, or more than 10 s from this machine's time"
    )]
    BadPoseTime,
    /// Boxes in pictures before their optics have arrived.
    #[error("boxes before the first message on --camera-info")]
    NoOptics,
    /// Optics without size or focal lengths.
    #[error("a CameraInfo that is not calibrated")]
    BadOptics,
    /// A stamp before 1970, or far from this machine's time, as simulated ones are.
    #[error("a stamp more than 10 s from this machine's time, as with `use_sim_time`")]
    BadTime,
    /// An object without a class.
    #[error("an object without a hypothesis")]
    NoClass,
    /// A hypothesis with a score that is not a probability, such as log-odds.
    #[error("a score that is not within 0 to 1")]
    Score,
    /// A box that gives no position.
    #[error("a box that gives no position: {0}")]
    NoPosition(&'static str),
    /// Values that are not allowed in a report.
    #[error("values that no report may have")]
    Report,
}

/// A message or an object that is not reported, and the refused value.
#[derive(Debug)]
pub(super) struct RefusedInput {
    pub(super) refusal: InputRefusal,
    /// Begins with a colon, or is empty.
    pub(super) detail: String,
}

impl InputRefusal {
    pub(super) fn with(self, detail: impl Display) -> RefusedInput {
        RefusedInput {
            refusal: self,
            detail: format!(": {detail}"),
        }
    }
}

impl From<InputRefusal> for RefusedInput {
    fn from(refusal: InputRefusal) -> Self {
        Self {
            refusal,
            detail: String::new(),
        }
    }
}

/// A frame to be reported, and reasons why objects are missing in it.
type Placed = (Frame, Vec<RefusedInput>);

impl RosCamera {
    /// Places detections in space: in the frame `map`, in the camera's frame, or in its optical
    /// frame (REP 103). The pose of a moving camera is taken from `poses`.
    pub(super) fn place(
        &self,
        detections: &Detection3DArray,
        poses: Option<&PoseHistory>,
    ) -> Result<Placed, RefusedInput> {
        let (captured_at, pose) = self.at(&detections.header, poses)?;
        let to_map = self.to_map(&detections.header, pose)?;
        let objects = detections
            .detections
            .iter()
            .map(|detection| self.object(detection, &to_map));
        Ok(self.frame(captured_at, pose, objects))
    }

    /// The time of a header, and the camera's pose then.
    fn at(
        &self,
        header: &Header,
        poses: Option<&PoseHistory>,
    ) -> Result<(Timestamp, Option<Pose>), RefusedInput> {
        let captured_at = header.time().ok_or(InputRefusal::BadTime)?;
        Ok((
            captured_at,
            poses.map_or(self.pose, |poses| poses.at(captured_at)),
        ))
    }

    fn object(
        &self,
        detection: &Detection3D,
        to_map: &ToMap,
    ) -> Result<PerceivedObject, RefusedInput> {
        let unplaced = self.unplaced(&detection.results)?;
        let RosPose {
            position,
            orientation,
        } = detection.bbox.center;
        let [x_m, y_m] = to_map.position(&Vector3::new(position.x, position.y, position.z));
        let covariance = detection
            .results
            .first()
            .map(|result| &result.pose.covariance);
        let covariance_m2 = covariance.and_then(|covariance| to_map.covariance(covariance));
        let size = detection.bbox.size;
        // The axes of an optical frame's boxes are not upright, and a box without rotation may have
        // an unknown orientation.
        let has_size = !to_map.is_optical && size.x > 0.0 && size.y > 0.0;
        let turn = orientation
            .rotation()
            .filter(|turn| has_size && turn.angle() > 0.0);
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
        objects: impl Iterator<Item = Result<PerceivedObject, RefusedInput>>,
    ) -> Placed {
        let captured_at = SystemTime::UNIX_EPOCH + Duration::from_micros(captured_at.micros());
        let mut placed = Vec::new();
        let mut refused = Vec::new();
        for object in objects {
            match object {
                Ok(object) => match object.check_fields() {
                    Ok(_) => placed.push(object),
                    Err((field, flaw)) => {
                        refused.push(InputRefusal::Report.with(format!("{field}: {flaw}")));
                    }
                },
                Err(refused_input) => refused.push(refused_input),
            }
        }
        let pose = pose.map(|pose| self.mount.stated_pose(&pose));
        (
            Frame {
                captured_at,
                pose,
                ..Frame::new(placed)
            },
            refused,
        )
    }

    /// An object without a place: label and confidence of the best hypothesis, and the scores of
    /// all if there are several.
    fn unplaced(
        &self,
        results: &[ObjectHypothesisWithPose],
    ) -> Result<PerceivedObject, RefusedInput> {
        let mut scores = BTreeMap::new();
        for ObjectHypothesis { class_id, score } in results.iter().map(|result| &result.hypothesis)
        {
            if !(0.0..=1.0).contains(score) {
                return Err(InputRefusal::Score.with(format!("{score} of {class_id:?}")));
            }
            // Several classes may have one label, and independent scores a sum above one.
            let label = self.labels.get(class_id).unwrap_or(class_id).as_str();
            let sum = scores.entry(Label::from(label)).or_insert(0.0);
            *sum = if results.len() == 1 {
                *score
            } else {
                (*sum + score).min(1.0)
            };
        }
        let best = scores.iter().max_by(|a, b| a.1.total_cmp(b.1));
        let (label, confidence) = best
            .map(|(label, score)| (label.clone(), *score))
            .ok_or(InputRefusal::NoClass)?;
        if results.len() == 1 {
            scores.clear();
        }
        Ok(PerceivedObject {
            label,
            confidence,
            scores,
            ..PerceivedObject::default()
        })
    }

    fn to_map(&self, header: &Header, pose: Option<Pose>) -> Result<ToMap, RefusedInput> {
        if header.frame_id == "map" {
            return Ok(ToMap {
                origin: Pose::new(0.0, 0.0, 0.0),
                turn: Matrix3::identity(),
                is_optical: false,
            });
        }
        let origin =
            pose.ok_or_else(|| InputRefusal::NoPose.with(format!("{:?}", header.frame_id)))?;
        let is_optical = ["_optical", "_optical_frame"]
            .iter()
            .any(|suffix| header.frame_id.ends_with(suffix));
        // From x ahead, y left, z up to x right, y down, z ahead.
        let body_to_optical = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
        let to_optical = if is_optical {
            Matrix3::identity()
        } else {
            body_to_optical
        };
        let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), origin.heading_rad);
        Ok(ToMap {
            origin,
            turn: heading * self.mount.to_level() * to_optical,
            is_optical,
        })
    }
}

/// Time and pose of a camera, whose x axis is its own (REP 103).
pub(super) fn pose_in_map(stamped: &PoseStamped) -> Result<(Timestamp, Pose), RefusedInput> {
    let at = stamped.header.time().ok_or(InputRefusal::BadPoseTime)?;
    let RosPose {
        position,
        orientation,
    } = stamped.pose;
    let turned = orientation.rotation().map(|turn| turn * Vector3::x());
    let bad = || InputRefusal::BadPose.with(format!("{stamped:?}"));
    let ahead = turned
        .filter(|_| stamped.header.frame_id == "map")
        .ok_or_else(bad)?;
    let pose = Pose::new(position.x, position.y, ahead.y.atan2(ahead.x));
    let is_finite = [position.x, position.y, pose.heading_rad]
        .into_iter()
        .all(f64::is_finite);
    if is_finite {
        Ok((at, pose))
    } else {
        Err(bad())
    }
}

/// Places boxes in pictures of which the distortion has been removed, by the rules of
/// [`RosCamera::place`].
pub(super) fn place_in_pictures(
    camera: &RosCamera,
    detections: &Detection2DArray,
    optics: Option<&CameraInfo>,
    poses: Option<&PoseHistory>,
) -> Result<Placed, RefusedInput> {
    let (captured_at, pose) = camera.at(&detections.header, poses)?;
    let pose =
        pose.ok_or_else(|| InputRefusal::NoPose.with(format!("{:?}", detections.header.frame_id)))?;
    let intrinsics = optics.ok_or(InputRefusal::NoOptics)?.intrinsics()?;
    let projection = Projection::new(camera.projection.clone(), intrinsics, camera.mount);
    let objects = detections.detections.iter().map(|detection| {
        let PerceivedObject { label, confidence, scores, .. } = camera.unplaced(&detection.results)?;
        let bounds = &detection.bbox;
        let x = bounds.center.position.x;
        let y = bounds.center.position.y;
        // The upright box around a rotated one.
        let (sin, cos) = bounds.center.theta.sin_cos();
        let half_width = ((bounds.size_x * cos).abs() + (bounds.size_y * sin).abs()) / 2.0;
        let half_height = ((bounds.size_x * sin).abs() + (bounds.size_y * cos).abs()) / 2.0;
        let x_min = x - half_width;
        let x_max = x + half_width;
        let y_min = y - half_height;
        let y_max = y + half_height;
        let bounding_box = BoundingBox { x_min, y_min, x_max, y_max };
        let detection = Detection { label, confidence, bounding_box, corners: None };
        let of_box = |what: &dyn Display| {
            let width = intrinsics.width;
            let height = intrinsics.height;
            format!("{what}, ({x_min:.1}, {y_min:.1}) to ({x_max:.1}, {y_max:.1}) in {width}x{height} pixels")
        };
        if !(0.0..=f64::from(intrinsics.width)).contains(&x) || !(0.0..=f64::from(intrinsics.height)).contains(&y) {
            return Err(InputRefusal::NoPosition("outside").with(of_box(&"of pictures of another size?")));
        }
        let placed = projection
            .place(&detection, projection.cut(&detection), None::<&Point3<f64>>, &pose)
            .map_err(|error| InputRefusal::NoPosition(error.as_str()).with(of_box(&error)))?;
        Ok(PerceivedObject { scores, ..placed })
    });
    Ok(camera.frame(captured_at, Some(pose), objects))
}

impl CameraInfo {
    /// The camera of pictures without distortion.
    fn intrinsics(&self) -> Result<Intrinsics, RefusedInput> {
        let [fx, _, cx, _, _, fy, cy, ..] = self.p;
        let [raw_fx, _, raw_cx, _, raw_fy, raw_cy, ..] = self.k;
        let (fx, fy, cx, cy) = if fx > 0.0 {
            (fx, fy, cx, cy)
        } else {
            (raw_fx, raw_fy, raw_cx, raw_cy)
        };
        let columns = self.binning_x.max(1);
        let rows = self.binning_y.max(1);
        let of_region = |part: u32, whole: u32| if part > 0 { part } else { whole };
        let width = of_region(self.roi.width, self.width) / columns;
        let height = of_region(self.roi.height, self.height) / rows;
        let fx = fx / f64::from(columns);
        let cx = (cx - f64::from(self.roi.x_offset)) / f64::from(columns);
        let fy = fy / f64::from(rows);
        let cy = (cy - f64::from(self.roi.y_offset)) / f64::from(rows);
        let is_usable =
            fx > 0.0 && fy > 0.0 && cx.is_finite() && cy.is_finite() && width > 0 && height > 0;
        let unusable = || {
            InputRefusal::BadOptics.with(format!(
                "{width}x{height} pixels, fx {fx}, fy {fy}, cx {cx}, cy {cy}"
            ))
        };
        is_usable
            .then_some(Intrinsics {
                width,
                height,
                fx,
                fy,
                cx,
                cy,
            })
            .ok_or_else(unusable)
    }
}

/// The conversion from a message's frame to the cell's.
struct ToMap {
    origin: Pose,
    turn: Matrix3<f64>,
    is_optical: bool,
}

impl ToMap {
    fn position(&self, point: &Vector3<f64>) -> [f64; 2] {
        let turned = self.turn * point;
        [
            self.origin.position.x + turned.x,
            self.origin.position.y + turned.y,
        ]
    }

    fn heading(&self, direction: &Vector3<f64>) -> f64 {
        let turned = self.turn * direction;
        turned.y.atan2(turned.x)
    }

    /// `[xx, xy, yy]` in m²; `None` if it is not stated: all zeros, or a negative variance.
    fn covariance(&self, [x, y, z, ..]: &[[f64; 6]; 6]) -> Option<[f64; 3]> {
        let rows = [x, y, z].map(|[a, b, c, ..]| [*a, *b, *c]);
        let stated = Matrix3::from_fn(|row, column| {
            rows.get(row)
                .and_then(|row| row.get(column))
                .copied()
                .unwrap_or(0.0)
        });
        let turned = self.turn * stated * self.turn.transpose();
        let xx = turned.m11;
        let xy = turned.m12;
        let yy = turned.m22;
        (xx > 0.0 && yy > 0.0).then_some([xx, xy, yy])
    }
}

#[cfg(test)]
mod tests;
