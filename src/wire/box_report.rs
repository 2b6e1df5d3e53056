//! Boxes of one image and the camera that took it, from a program that leaves the projection to its
//! node.

use std::f64::consts::{FRAC_PI_2, PI};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::flaw::read_json;
use super::validation::{check_between, check_confidence, check_labels, check_pose};
use super::{Flaw, InvalidValue, Limits, RejectReason, SCHEMA_VERSION, WirePose, numbers};
use crate::model::detection::BoundingBox;
use crate::model::names::{Label, MAX_NAME_BYTES, NodeName};
use crate::model::time::Timestamp;

/// The boxes that a detector found in one image.
///
/// The node whose broker receives it projects the boxes and passes them on as an
/// [`ObjectReport`](super::ObjectReport).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BoxReport {
    /// Major version of the payload, [`SCHEMA_VERSION`].
    pub schema: u32,
    /// The reporting node or part of a node; equals the last level of the topic.
    pub node: NodeName,
    /// Increases by one with every report since the program started.
    pub seq: u64,
    /// Capture time of the image by the sender's clock.
    pub captured_at_us: Timestamp,
    /// Pose of the camera. With its height above the ground, objects are ranged by the ground, too;
    /// an absent pitch or roll is 0.
    pub pose: WirePose,
    /// The camera's image and its accuracy.
    pub camera: BoxCamera,
    /// The boxes. An image without objects is a report, too.
    pub boxes: Vec<PixelBox>,
    /// False if the camera is fixed at the road and no object of the map; absent for a vehicle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub moving: Option<bool>,
}

/// Size, optics and accuracy of a camera, by the names of `camera.optics`, of calibration files and
/// of `camera.projection`.
///
/// The optics are a field of view or, from a calibration, focal lengths and principal point.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BoxCamera {
    /// Width in pixels of the image that the boxes refer to.
    pub width_px: u32,
    /// Height in pixels of that image.
    pub height_px: u32,
    /// Horizontal field of view in degrees, of a lens without distortion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub horizontal_fov_deg: Option<f64>,
    /// Vertical field of view in degrees; if absent, pixels are square.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vertical_fov_deg: Option<f64>,
    /// Horizontal focal length in pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fx: Option<f64>,
    /// Vertical focal length in pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fy: Option<f64>,
    /// Column of the principal point in pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cx: Option<f64>,
    /// Row of the principal point in pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cy: Option<f64>,
    /// OpenCV's k1, k2, p1, p2, then perhaps k3, then perhaps k4, k5, k6 of the rational model;
    /// empty for an image without distortion.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub distortion: Vec<f64>,
    /// Standard deviation of a box edge in pixels; default 3.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixel_sigma_px: Option<f64>,
    /// Standard deviation of the camera's heading in radians; default 0.01.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heading_sigma_rad: Option<f64>,
    /// Standard deviation of pitch and roll in radians; default 0.0175, which is 1°.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tilt_sigma_rad: Option<f64>,
    /// Standard deviation of the height above the ground in metres; default 0.02.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height_sigma_m: Option<f64>,
    /// Standard deviation of the camera's position in metres, each axis; default 0.005.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub position_sigma_m: Option<f64>,
}

/// One box of a detector.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PixelBox {
    /// Class label.
    pub label: Label,
    /// The detector's confidence, 0 to 1.
    pub confidence: f64,
    /// Left edge in pixels of the image.
    pub x_min: f64,
    /// Upper edge in pixels.
    pub y_min: f64,
    /// Right edge in pixels.
    pub x_max: f64,
    /// Lower edge in pixels.
    pub y_max: f64,
}

/// Encodes boxes as JSON.
///
/// # Panics
/// Does not panic: boxes serialise into memory.
#[expect(clippy::expect_used, reason = "writing to memory does not fail")]
pub fn encode_boxes(report: &BoxReport) -> Vec<u8> {
    serde_json::to_vec(report).expect("boxes serialise into memory")
}

/// Decodes boxes in JSON or CBOR with names, and checks every value; `topic_node` is the node named
/// by the topic.
///
/// # Errors
/// Returns the first flaw, with its field.
pub fn decode_boxes(
    bytes: &[u8],
    topic_node: &NodeName,
    limits: &Limits,
) -> Result<BoxReport, Flaw> {
    if bytes.len() > limits.payload_bytes {
        let fault = format!("is longer than {} bytes", limits.payload_bytes);
        return Err(Flaw::new(RejectReason::TooLarge, "", fault));
    }
    let report: BoxReport = read(bytes)?;
    report.check(limits)?;
    if report.node != *topic_node {
        let fault = format!("is {}, and the topic names {topic_node}", report.node);
        return Err(Flaw::new(RejectReason::NodeMismatch, "node", fault));
    }
    Ok(report)
}

fn read(bytes: &[u8]) -> Result<BoxReport, Flaw> {
    if bytes.trim_ascii_start().first() != Some(&b'{') {
        return numbers::read_cbor(bytes).map_err(|unreadable| {
            Flaw::new(unreadable.reason, unreadable.field, unreadable.fault)
        });
    }
    read_json(bytes).or_else(|(field, fault)| {
        let reason = match fault.as_str() {
            "is NaN" | "is Infinity" => RejectReason::NotFinite,
            _ => RejectReason::Malformed,
        };
        numbers::read_json(bytes).ok_or(Flaw::new(reason, field, fault))
    })
}

/// Share of the image's width and height by which a box may extend beyond the image. Some detectors
/// do not limit their boxes to the image.
const MAX_OVERHANG: f64 = 0.02;

impl BoxReport {
    /// Checks version, counts, numbers and labels, that the optics are complete, and that the boxes
    /// have an area and are in the image.
    ///
    /// # Errors
    /// Returns the first flaw.
    pub fn check(&self, limits: &Limits) -> Result<(), Flaw> {
        if self.schema != SCHEMA_VERSION {
            let fault = format!("is {}, not {SCHEMA_VERSION}", self.schema);
            return Err(Flaw::new(RejectReason::UnknownSchema, "schema", fault));
        }
        if self.boxes.len() > limits.objects {
            let fault = format!("has more than {} entries", limits.objects);
            return Err(Flaw::new(RejectReason::TooManyObjects, "boxes", fault));
        }
        check_pose(&self.pose).map_err(|InvalidValue { field, reason }| {
            let shown = serde_json::to_value(self).unwrap_or_default();
            Flaw::of_value(&shown, reason, field)
        })?;
        let WirePose {
            height_m,
            pitch_rad,
            roll_rad,
            ..
        } = self.pose;
        for (field, value, low, high) in [
            ("pose.height_m", height_m, 0.01, 1000.0),
            ("pose.pitch_rad", pitch_rad, -FRAC_PI_2, FRAC_PI_2),
            ("pose.roll_rad", roll_rad, -PI, PI),
        ] {
            check_number(field, value, low, high)?;
        }
        self.camera.check()?;
        self.boxes
            .iter()
            .enumerate()
            .try_for_each(|(index, found)| found.check(index, &self.camera))
    }
}

impl BoxCamera {
    fn check(&self) -> Result<(), Flaw> {
        let width = f64::from(self.width_px);
        let height = f64::from(self.height_px);
        for (field, value, low, high) in [
            ("camera.width_px", Some(width), 16.0, 16_384.0),
            ("camera.height_px", Some(height), 16.0, 16_384.0),
            (
                "camera.horizontal_fov_deg",
                self.horizontal_fov_deg,
                1.0,
                175.0,
            ),
            ("camera.vertical_fov_deg", self.vertical_fov_deg, 1.0, 175.0),
            ("camera.fx", self.fx, width / 50.0, width * 500.0),
            ("camera.fy", self.fy, height / 50.0, height * 500.0),
            ("camera.cx", self.cx, 0.0, width),
            ("camera.cy", self.cy, 0.0, height),
            ("camera.pixel_sigma_px", self.pixel_sigma_px, 0.0, 1e3),
            ("camera.heading_sigma_rad", self.heading_sigma_rad, 0.0, PI),
            ("camera.tilt_sigma_rad", self.tilt_sigma_rad, 0.0, 1.0),
            ("camera.height_sigma_m", self.height_sigma_m, 0.0, 1e3),
            ("camera.position_sigma_m", self.position_sigma_m, 0.0, 1e3),
        ] {
            check_number(field, value, low, high)?;
        }
        let calibrated = [self.fx, self.fy, self.cx, self.cy];
        let is_complete = match self.horizontal_fov_deg {
            Some(_) => calibrated == [None; 4] && self.distortion.is_empty(),
            None => calibrated.iter().all(Option::is_some) && self.vertical_fov_deg.is_none(),
        };
        if !is_complete {
            let fault = "needs either horizontal_fov_deg, or fx, fy, cx and cy of a calibration, perhaps with distortion";
            return Err(Flaw::new(RejectReason::Malformed, "camera", fault));
        }
        if ![0, 4, 5, 8].contains(&self.distortion.len()) {
            let fault = format!(
                "has {} coefficients, and must have 4, 5 or 8",
                self.distortion.len()
            );
            return Err(Flaw::new(
                RejectReason::Malformed,
                "camera.distortion",
                fault,
            ));
        }
        for (index, coefficient) in self.distortion.iter().enumerate() {
            let field = format!("camera.distortion[{index}]");
            check_number(&field, Some(*coefficient), -1e6, 1e6)?;
        }
        Ok(())
    }
}

impl PixelBox {
    /// The edges as a box.
    pub fn bounding_box(&self) -> BoundingBox {
        let Self {
            x_min,
            y_min,
            x_max,
            y_max,
            ..
        } = *self;
        BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        }
    }

    fn check(&self, index: usize, camera: &BoxCamera) -> Result<(), Flaw> {
        let flaw = |field: &str, reason, fault: String| {
            Flaw::new(reason, format!("boxes[{index}]{field}"), fault)
        };
        let bounds @ BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        } = self.bounding_box();
        for (field, edge) in [
            (".x_min", x_min),
            (".y_min", y_min),
            (".x_max", x_max),
            (".y_max", y_max),
        ] {
            if !edge.is_finite() {
                let fault = "is not a finite number".to_owned();
                return Err(flaw(field, RejectReason::NotFinite, fault));
            }
        }
        if !bounds.is_valid() {
            let fault = format!("has no area: [{x_min}, {y_min}, {x_max}, {y_max}]");
            return Err(flaw("", RejectReason::OutOfRange, fault));
        }
        let width = f64::from(camera.width_px);
        let height = f64::from(camera.height_px);
        let is_inside = |low: f64, high: f64, size: f64| {
            low >= -size * MAX_OVERHANG && high <= size * (1.0 + MAX_OVERHANG)
        };
        if !is_inside(x_min, x_max, width) || !is_inside(y_min, y_max, height) {
            let fault = format!(
                "is outside the image of {width}x{height} pixels: [{x_min}, {y_min}, {x_max}, {y_max}]; camera.width_px and \
                 height_px must be the size of the image in which the box was found"
            );
            return Err(flaw("", RejectReason::OutOfRange, fault));
        }
        check_confidence(self.confidence).map_err(|reason| {
            let fault = format!("is {}, and must be 0 to 1", self.confidence);
            flaw(".confidence", reason, fault)
        })?;
        check_labels([&*self.label]).map_err(|reason| {
            let fault =
                format!("is empty, longer than {MAX_NAME_BYTES} bytes, or has control characters");
            flaw(".label", reason, fault)
        })
    }
}

fn check_number(field: &str, value: Option<f64>, low: f64, high: f64) -> Result<(), Flaw> {
    let Some(value) = value else { return Ok(()) };
    check_between(value, low, high).map_err(|reason| {
        let fault = format!("is {value}, and must be a number from {low} to {high}");
        Flaw::new(reason, field, fault)
    })
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn valid() -> Value {
        json!({
            "schema": 1, "node": "euclid--yolo", "seq": 1, "captured_at_us": 5,
            "pose": {"x_m": 1, "y_m": 6, "heading_rad": -1.57, "height_m": 1.3, "pitch_rad": 0.1},
            "camera": {"width_px": 640, "height_px": 480, "horizontal_fov_deg": 62.2},
            "boxes": [{"label": "car", "confidence": 0.9, "x_min": 10, "y_min": 20.5, "x_max": 110, "y_max": 90}],
        })
    }

    fn decoded(bytes: &[u8]) -> Result<BoxReport, Flaw> {
        let node = NodeName::from_static("euclid--yolo");
        decode_boxes(bytes, &node, &Limits::default())
    }

    #[test]
    fn json_and_cbor_boxes_are_read() {
        let mut cbor = Vec::new();
        ciborium::into_writer(&valid(), &mut cbor).unwrap();
        let report = decoded(valid().to_string().as_bytes()).unwrap();
        assert_eq!(report.boxes[0].y_min, 20.5);
        assert_eq!(decoded(&encode_boxes(&report)), Ok(report.clone()));
        assert_eq!(decoded(&cbor), Ok(report));
    }

    #[test]
    fn flaws_name_field_and_remedy() {
        let flaws = [
            ("/schema", json!(2), "schema: is 2, not 1"),
            ("/node", json!("gauss"), "node: is gauss, and the topic"),
            ("/pose", Value::Null, "pose: "),
            (
                "/pose/heading_rad",
                json!(-90),
                "pose.heading_rad: is beyond 2π: -90",
            ),
            (
                "/pose/pitch_rad",
                json!(4),
                "pose.pitch_rad: is 4, and must",
            ),
            ("/pose/height_m", json!(0), "pose.height_m: is 0, and must"),
            ("/camera", Value::Null, "camera: "),
            (
                "/camera",
                json!({"width_px": 640, "height_px": 480}),
                "camera: needs either horizontal_fov_deg",
            ),
            (
                "/camera",
                json!({"width_px": 640, "height_px": 480, "fx": 500, "cx": 320, "cy": 240}),
                "camera: needs either",
            ),
            (
                "/camera/width_px",
                json!(0),
                "camera.width_px: is 0, and must",
            ),
            (
                "/camera/horizontal_fov_deg",
                json!(0.5),
                "camera.horizontal_fov_deg: is 0.5",
            ),
            ("/camera/fov", json!(62), "camera.fov: unknown field"),
            (
                "/boxes/0/x_max",
                json!(1280),
                "boxes[0]: is outside the image of 640x480",
            ),
            ("/boxes/0/x_max", json!(10), "boxes[0]: has no area"),
            (
                "/boxes/0/confidence",
                json!(93),
                "boxes[0].confidence: is 93",
            ),
            ("/boxes/0/label", json!(""), "boxes[0].label: is empty"),
        ];
        for (place, value, expected) in flaws {
            let mut report = valid();
            let (parent, key) = place.rsplit_once('/').unwrap();
            report.pointer_mut(parent).unwrap()[key] = value;
            let flaw = decoded(report.to_string().as_bytes()).unwrap_err();
            assert!(flaw.to_string().starts_with(expected), "{place}: {flaw}");
        }
        let text = valid().to_string().replace("20.5", "NaN");
        let flaw = decoded(text.as_bytes()).unwrap_err();
        assert_eq!(flaw.reason, RejectReason::NotFinite);
        assert!(flaw.to_string().contains("is NaN"), "{flaw}");
    }

    #[test]
    fn box_slightly_beyond_image_is_accepted() {
        let mut report = valid();
        report["boxes"][0]["x_min"] = json!(-0.4);
        assert!(decoded(report.to_string().as_bytes()).is_ok());
    }
}
