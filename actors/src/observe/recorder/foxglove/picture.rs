//! A camera's pictures, the boxes of their detections, and the optics with which viewers overlay
//! both.

use base64::prelude::{BASE64_STANDARD, Engine};
use ecod::model::detection::Detection;
use schemars::JsonSchema;
use serde::Serialize;

use super::{Color, Time, optical_frame};
use crate::observe::recorder::log_sender::CapturedPicture;

/// `foxglove.CompressedImage`; `data` is in base64.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.CompressedImage")]
pub(crate) struct CompressedImage {
    timestamp: Time,
    frame_id: String,
    #[schemars(extend("contentEncoding" = "base64"))]
    data: String,
    format: &'static str,
}

/// `foxglove.CameraCalibration`; without distortion `D` is all zeros.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.CameraCalibration")]
pub(crate) struct CameraCalibration {
    timestamp: Time,
    frame_id: String,
    width: u32,
    height: u32,
    distortion_model: &'static str,
    #[serde(rename = "D")]
    distortion: Vec<f64>,
    #[serde(rename = "K")]
    intrinsics: [f64; 9],
    #[serde(rename = "R")]
    rectification: [f64; 9],
    #[serde(rename = "P")]
    projection: [f64; 12],
}

/// `foxglove.ImageAnnotations`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.ImageAnnotations")]
pub(crate) struct ImageAnnotations {
    circles: [(); 0],
    points: Vec<PointsAnnotation>,
    texts: Vec<TextAnnotation>,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
struct PicturePoint {
    x: f64,
    y: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct PointsAnnotation {
    timestamp: Time,
    #[serde(rename = "type")]
    kind: u8,
    points: [PicturePoint; 4],
    outline_color: Color,
    outline_colors: [(); 0],
    fill_color: Color,
    thickness: f64,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct TextAnnotation {
    timestamp: Time,
    position: PicturePoint,
    text: String,
    font_size: f64,
    text_color: Color,
    background_color: Color,
}

/// `PointsAnnotationType` of a closed line.
const LINE_LOOP: u8 = 2;

/// Rows of a picture for each pixel of a line's width, and of a text's height.
const ROWS_PER_LINE: f64 = 240.0;
const ROWS_PER_TEXT: f64 = 30.0;

const BOX: Color = Color {
    r: 1.0,
    g: 0.75,
    b: 0.1,
    a: 1.0,
};
const CLEAR: Color = Color {
    r: 0.0,
    g: 0.0,
    b: 0.0,
    a: 0.0,
};
const SHADE: Color = Color {
    r: 0.0,
    g: 0.0,
    b: 0.0,
    a: 0.6,
};

impl CompressedImage {
    pub(crate) fn of(picture: &CapturedPicture) -> Self {
        let data = BASE64_STANDARD.encode(&picture.jpeg);
        Self {
            timestamp: picture.captured_at.into(),
            frame_id: optical_frame(&picture.reporter),
            data,
            format: "jpeg",
        }
    }
}

impl CameraCalibration {
    /// The optics of a picture; `None` if there are no optics for its shape.
    pub(crate) fn of(picture: &CapturedPicture) -> Option<Self> {
        let (camera, distortion) = picture.optics?;
        let fx = camera.fx;
        let fy = camera.fy;
        let cx = camera.cx;
        let cy = camera.cy;
        let coefficients = distortion.unwrap_or_default();
        let (polynomial, denominator) = coefficients.split_at(5);
        let is_rational = denominator.iter().any(|k| *k != 0.0);
        Some(Self {
            timestamp: picture.captured_at.into(),
            frame_id: optical_frame(&picture.reporter),
            width: camera.width,
            height: camera.height,
            distortion_model: if is_rational {
                "rational_polynomial"
            } else {
                "plumb_bob"
            },
            distortion: if is_rational {
                coefficients.to_vec()
            } else {
                polynomial.to_vec()
            },
            intrinsics: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            rectification: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            projection: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        })
    }
}

impl ImageAnnotations {
    /// A box for each detection, and its label and confidence above.
    pub(crate) fn of(picture: &CapturedPicture) -> Self {
        let timestamp = Time::from(picture.captured_at);
        let rows = f64::from(picture.height);
        let outline = |detection: &Detection| {
            let b = &detection.bounding_box;
            let corners = [
                (b.x_min, b.y_min),
                (b.x_max, b.y_min),
                (b.x_max, b.y_max),
                (b.x_min, b.y_max),
            ];
            PointsAnnotation {
                timestamp,
                kind: LINE_LOOP,
                points: corners.map(|(x, y)| PicturePoint { x, y }),
                outline_color: BOX,
                outline_colors: [],
                fill_color: CLEAR,
                thickness: (rows / ROWS_PER_LINE).max(1.0),
            }
        };
        let text = |detection: &Detection| TextAnnotation {
            timestamp,
            position: PicturePoint {
                x: detection.bounding_box.x_min,
                y: detection.bounding_box.y_min,
            },
            text: format!("{} {:.0} %", detection.label, detection.confidence * 100.0),
            font_size: (rows / ROWS_PER_TEXT).max(8.0),
            text_color: BOX,
            background_color: SHADE,
        };
        let detections = &picture.detections;
        let points = detections.iter().map(outline).collect();
        let texts = detections.iter().map(text).collect();
        Self {
            circles: [],
            points,
            texts,
        }
    }
}
