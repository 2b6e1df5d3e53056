//! A source whose frames have black masks. Frames that cannot be masked are refused.
//!
//! All kinds of sources pass here, in the node: `ecod-video` delivers whole frames. Pictures for
//! page and log are encoded from the masked pixels; the bytes that a camera sent are not kept.

use ecod::perception::polygon::Polygon;
use opencv::core::{Mat, Point, Scalar, Vector};
use opencv::imgproc;

use super::{FrameError, FrameSource, TimeSource};
use crate::camera::frame::CameraFrame;
use crate::camera::image_size::ImageSize;

/// A source with masks.
pub(in crate::camera) struct MaskedSource {
    /// The source of whole frames.
    pub(in crate::camera) source: Box<dyn FrameSource>,
    /// Device, pipeline, address or path for errors.
    pub(in crate::camera) origin: String,
    /// Masks in shares of the picture's width and height.
    pub(in crate::camera) masks: Vec<Polygon>,
    /// A size with the aspect ratio of the picture on which the masks were drawn. A camera that
    /// delivers another ratio may show another part of the scene.
    pub(in crate::camera) shape: ImageSize,
}

impl FrameSource for MaskedSource {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        let mut frame = self.source.next_frame()?;
        let unusable = |reason: String| FrameError::Unusable {
            origin: self.origin.clone(),
            reason,
        };
        let size = ImageSize::of(&frame.image);
        self.shape.check_shape(size).map_err(|error| {
            unusable(format!(
                "{error}, then compare camera.masks with the picture"
            ))
        })?;
        for mask in &self.masks {
            let mask = mask.scaled(size.width.into(), size.height.into());
            blacken(&mut frame.image, &mask).map_err(|error| unusable(error.message))?;
        }
        Ok(frame)
    }

    fn time_source(&self) -> TimeSource {
        self.source.time_source()
    }
}

/// Fractional bits of the corners for OpenCV.
const SHIFT: i32 = 4;

/// Width in pixels of the outline that is drawn over a mask's edges. OpenCV fills pixels whose
/// middle is inside; with the outline, pixels that are partly inside are black, too.
const OUTLINE_PX: i32 = 3;

/// Blackens each pixel that a mask touches, in pixels of the image. Each mask is drawn
/// separately: where two masks overlap, OpenCV would leave a hole.
fn blacken(image: &mut Mat, mask: &Polygon) -> opencv::Result<()> {
    // The middle of the first pixel is at 0.5 in masks, and at 0 in OpenCV.
    let fixed_point = |pixels: f64| ((pixels - 0.5) * f64::from(1 << SHIFT)).round() as i32;
    let corners: Vector<Point> = mask
        .corners()
        .iter()
        .map(|corner| Point::new(fixed_point(corner.x), fixed_point(corner.y)))
        .collect();
    let black = Scalar::all(0.0);
    let outline = Vector::<Vector<Point>>::from_iter([corners]);
    imgproc::fill_poly(
        image,
        &outline,
        black,
        imgproc::LINE_8,
        SHIFT,
        Point::default(),
    )?;
    imgproc::polylines(
        image,
        &outline,
        true,
        black,
        OUTLINE_PX,
        imgproc::LINE_8,
        SHIFT,
    )
}

#[cfg(test)]
mod tests;
