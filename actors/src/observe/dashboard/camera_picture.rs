//! A camera's picture for browsers: a JPEG with boxes, and the place of each detection.

use base64::prelude::{BASE64_STANDARD, Engine};
use bytes::Bytes;
use ecod::model::detection::Detection;
use ecod::model::names::Label;
use ecod::model::time::Timestamp;
use ecod::wire::PerceivedObject;
use opencv::core::{Mat, MatTraitConst, Size};
use opencv::imgproc;
use serde::Serialize;

use super::snapshot::json;
use crate::camera::frame::CameraFrame;
use crate::camera::image_codec::{self, ImageError};
use crate::camera::image_size::ImageSize;

/// A detection in a picture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PictureBox {
    label: Label,
    confidence: f64,
    /// Left, upper, right and lower edge, as shares of the picture's width and height.
    edges: [f64; 4],
    /// The object in the node's report; `None` if the detection has no place.
    pub object: Option<PerceivedObject>,
}

#[derive(Serialize)]
struct CameraPicture<'a> {
    captured_at_us: Timestamp,
    /// Size of the camera's own frame, which may be larger than the picture.
    width_px: u32,
    height_px: u32,
    jpeg: String,
    boxes: &'a [PictureBox],
}

/// Maximum width of a picture in pixels; wider frames are scaled down.
const MAX_WIDTH: i32 = 640;

const JPEG_QUALITY: u8 = 75;

impl PictureBox {
    /// A detection in an image of this size, without a place so far.
    pub fn new(detection: &Detection, image: ImageSize) -> Self {
        let width = f64::from(image.width);
        let height = f64::from(image.height);
        let b = &detection.bounding_box;
        Self {
            label: detection.label.clone(),
            confidence: detection.confidence,
            edges: [
                b.x_min / width,
                b.y_min / height,
                b.x_max / width,
                b.y_max / height,
            ],
            object: None,
        }
    }
}

/// The picture as a server-sent event named `camera`.
///
/// # Errors
/// Returns an [`ImageError`] of the JPEG encoder.
pub fn camera_event(frame: &CameraFrame, boxes: &[PictureBox]) -> Result<Bytes, ImageError> {
    let jpeg = BASE64_STANDARD.encode(jpeg(&frame.image)?);
    let ImageSize {
        width: width_px,
        height: height_px,
    } = ImageSize::of(&frame.image);
    let picture = json(&CameraPicture {
        captured_at_us: frame.captured_at,
        width_px,
        height_px,
        jpeg,
        boxes,
    });
    Ok([b"event: camera\ndata: ", &*picture, b"\n\n"]
        .concat()
        .into())
}

fn jpeg(image: &Mat) -> Result<Vec<u8>, ImageError> {
    let mut scaled = Mat::default();
    let image = if image.cols() > MAX_WIDTH {
        let size = Size::new(MAX_WIDTH, (image.rows() * MAX_WIDTH / image.cols()).max(1));
        imgproc::resize(image, &mut scaled, size, 0.0, 0.0, imgproc::INTER_AREA)?;
        &scaled
    } else {
        image
    };
    image_codec::encode_jpeg(image, JPEG_QUALITY)
}

#[cfg(test)]
mod tests {
    use ecod::model::detection::BoundingBox;
    use opencv::core::{CV_8UC3, Scalar};

    use super::*;

    #[test]
    fn boxes_are_fractions_of_picture() {
        let size = Size::new(1920, 1080);
        let image = Mat::new_size_with_default(size, CV_8UC3, Scalar::all(90.0)).unwrap();
        let bounding_box = BoundingBox {
            x_min: 480.0,
            y_min: 270.0,
            x_max: 960.0,
            y_max: 1080.0,
        };
        let cat = Detection {
            label: "cat".into(),
            confidence: 0.5,
            bounding_box,
            corners: None,
        };
        let boxes = [PictureBox::new(&cat, ImageSize::of(&image))];
        let event = camera_event(
            &CameraFrame {
                image,
                captured_at: Timestamp(7),
                seq: 0,
            },
            &boxes,
        )
        .unwrap();
        let data = event
            .strip_prefix(b"event: camera\ndata: ")
            .unwrap()
            .strip_suffix(b"\n\n")
            .unwrap();
        let picture: serde_json::Value = serde_json::from_slice(data).unwrap();
        assert_eq!(picture["captured_at_us"], 7);
        assert_eq!(
            (&picture["width_px"], &picture["height_px"]),
            (&1920.into(), &1080.into())
        );
        assert_eq!(
            picture["boxes"][0]["edges"],
            serde_json::json!([0.25, 0.25, 0.5, 1.0])
        );
        let jpeg = BASE64_STANDARD
            .decode(picture["jpeg"].as_str().unwrap())
            .unwrap();
        let shown = image_codec::decode(&jpeg).unwrap();
        assert_eq!((shown.cols(), shown.rows()), (640, 360));
    }
}
