//! Image size, and scaling of detections between sizes.

use std::fmt;

use ecod::model::detection::Detection;
use ecod::perception::camera::Intrinsics;
use opencv::core::{Mat, MatTraitConst};

/// Width and height in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    /// Number of pixel columns.
    pub width: u32,
    /// Number of pixel rows.
    pub height: u32,
}

/// Mismatch of aspect ratios between a frame and the camera's optics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "frame has {frame} pixels, but camera.optics describes {optics} with another aspect ratio: \
     change the source, or set or calibrate the optics for {frame}"
)]
pub struct SizeMismatch {
    /// Size of the refused frame.
    pub frame: ImageSize,
    /// The size of the optics.
    pub optics: ImageSize,
}

/// Maximum relative difference between horizontal and vertical scale, which rounding to whole
/// pixels explains.
const ASPECT_TOLERANCE: f64 = 0.01;

impl ImageSize {
    /// The size of an image.
    pub fn of(image: &Mat) -> Self {
        Self {
            width: image.cols().unsigned_abs(),
            height: image.rows().unsigned_abs(),
        }
    }

    /// Checks that a frame of this size can be scaled to this one.
    ///
    /// # Errors
    /// Returns a [`SizeMismatch`] for another aspect ratio.
    pub fn check_shape(self, frame: Self) -> Result<(), SizeMismatch> {
        let [x, y] = self.scale(frame);
        let is_scaled = x.is_finite() && y.is_finite() && (x / y - 1.0).abs() <= ASPECT_TOLERANCE;
        if is_scaled {
            Ok(())
        } else {
            Err(SizeMismatch {
                frame,
                optics: self,
            })
        }
    }

    fn scale(self, frame: Self) -> [f64; 2] {
        [(self.width, frame.width), (self.height, frame.height)]
            .map(|(to, from)| f64::from(to) / f64::from(from))
    }

    /// Scales detections from a frame's size to this one.
    ///
    /// # Errors
    /// Returns a [`SizeMismatch`] for another aspect ratio; the detections are then unchanged.
    pub fn fit(self, frame: Self, detections: &mut [Detection]) -> Result<(), SizeMismatch> {
        self.check_shape(frame)?;
        if frame == self {
            return Ok(());
        }
        let [x, y] = self.scale(frame);
        for Detection {
            bounding_box,
            corners,
            ..
        } in detections
        {
            bounding_box.x_min *= x;
            bounding_box.x_max *= x;
            bounding_box.y_min *= y;
            bounding_box.y_max *= y;
            for corner in corners.iter_mut().flatten() {
                corner.x *= x;
                corner.y *= y;
            }
        }
        Ok(())
    }
}

impl From<&Intrinsics> for ImageSize {
    fn from(intrinsics: &Intrinsics) -> Self {
        Self {
            width: intrinsics.width,
            height: intrinsics.height,
        }
    }
}

impl fmt::Display for ImageSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

#[cfg(test)]
mod tests {
    use ecod::model::detection::BoundingBox;
    use nalgebra::Point2;

    use super::*;

    const OPTICS: ImageSize = ImageSize {
        width: 640,
        height: 480,
    };

    fn seen() -> Vec<Detection> {
        let bounding_box = BoundingBox {
            x_min: 100.0,
            y_min: 50.0,
            x_max: 300.0,
            y_max: 250.0,
        };
        let corners = [(100.0, 50.0), (300.0, 50.0), (300.0, 250.0), (100.0, 250.0)]
            .map(|(x, y)| Point2::new(x, y));
        vec![Detection {
            label: "QR".into(),
            confidence: 1.0,
            bounding_box,
            corners: Some(corners),
        }]
    }

    #[test]
    fn frame_of_equal_shape_is_scaled() {
        let mut detections = seen();
        OPTICS
            .fit(
                ImageSize {
                    width: 1280,
                    height: 960,
                },
                &mut detections,
            )
            .unwrap();
        let Detection {
            bounding_box,
            corners,
            ..
        } = &detections[0];
        assert_eq!(
            *bounding_box,
            BoundingBox {
                x_min: 50.0,
                y_min: 25.0,
                x_max: 150.0,
                y_max: 125.0
            }
        );
        assert_eq!(corners.unwrap()[2], Point2::new(150.0, 125.0));
    }

    #[test]
    fn other_shape_names_both_sizes() {
        for (width, height) in [(1280, 720), (480, 640), (640, 0)] {
            let mut detections = seen();
            let error = OPTICS
                .fit(ImageSize { width, height }, &mut detections)
                .unwrap_err()
                .to_string();
            assert!(
                error.contains(&format!("{width}x{height}")) && error.contains("640x480"),
                "{error}"
            );
            assert_eq!(detections, seen());
        }
    }
}
