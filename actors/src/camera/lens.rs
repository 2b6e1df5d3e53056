//! Intrinsics and lens distortion of a camera, and the undistortion of detections.

use ecod::model::detection::Detection;
use ecod::perception::camera::Intrinsics;
use ecod::perception::distortion::{Distortion, undistort, undistorted};
use nalgebra::Point2;

use crate::camera::image_size::{ImageSize, SizeMismatch};

/// Optics of a camera: its intrinsics and the distortion of its lens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Focal lengths and principal point, in pixels.
    pub intrinsics: Intrinsics,
    /// `None` for an ideal lens.
    pub distortion: Option<Distortion>,
    /// True if frames may have any shape; the horizontal field of view then applies to all of them.
    pub is_any_shape: bool,
}

impl Lens {
    /// A lens without distortion.
    pub fn ideal(intrinsics: Intrinsics) -> Self {
        Self {
            intrinsics,
            distortion: None,
            is_any_shape: false,
        }
    }

    /// The lens for frames of this size: this one if they have its shape.
    ///
    /// # Errors
    /// Returns a [`SizeMismatch`] for frames of another shape, unless the lens takes any.
    pub fn of_frames(&self, frame: ImageSize) -> Result<Self, SizeMismatch> {
        let size = ImageSize::from(&self.intrinsics);
        match size.check_shape(frame) {
            Err(_) if self.is_any_shape && frame.width > 0 && frame.height > 0 => {
                let height =
                    f64::from(frame.height) * f64::from(size.width) / f64::from(frame.width);
                let horizontal_rad = self.intrinsics.horizontal_field_of_view();
                let intrinsics = Intrinsics::with_square_pixels(
                    size.width,
                    height.round().max(1.0) as u32,
                    horizontal_rad,
                );
                Ok(Self {
                    intrinsics,
                    ..*self
                })
            }
            outcome => outcome.map(|()| *self),
        }
    }

    /// The lens of frames of this size, with their detections scaled to its image size.
    ///
    /// # Errors
    /// Returns a [`SizeMismatch`] for frames of another shape, unless the lens takes any.
    pub fn fitted(
        &self,
        frame: ImageSize,
        detections: &mut [Detection],
    ) -> Result<Self, SizeMismatch> {
        let lens = self.of_frames(frame)?;
        ImageSize::from(&lens.intrinsics).fit(frame, detections)?;
        Ok(lens)
    }

    /// The lens for pixels of frames of this size.
    ///
    /// # Errors
    /// Returns the errors of [`Self::of_frames`].
    pub fn in_pixels_of(&self, frame: ImageSize) -> Result<Self, SizeMismatch> {
        let lens = self.of_frames(frame)?;
        let Intrinsics {
            width,
            height,
            fx,
            fy,
            cx,
            cy,
        } = lens.intrinsics;
        let x = f64::from(frame.width) / f64::from(width);
        let y = f64::from(frame.height) / f64::from(height);
        let width = frame.width;
        let height = frame.height;
        Ok(Self {
            intrinsics: Intrinsics {
                width,
                height,
                fx: fx * x,
                fy: fy * y,
                cx: cx * x,
                cy: cy * y,
            },
            ..lens
        })
    }

    /// Undistorts boxes and corners.
    pub fn undistort(&self, detections: &mut [Detection]) {
        if let Some(distortion) = &self.distortion {
            for detection in detections {
                undistort(detection, &self.intrinsics, distortion);
            }
        }
    }

    /// The pixel at which a lens without distortion would show the same point.
    pub fn undistorted(&self, pixel: &Point2<f64>) -> Point2<f64> {
        self.distortion.map_or(*pixel, |distortion| {
            undistorted(pixel, &self.intrinsics, &distortion)
        })
    }
}

#[cfg(test)]
mod tests {
    use ecod::model::detection::BoundingBox;

    use super::*;

    const DISTORTION: Distortion = [-0.3, 0.1, 0.001, -0.002, 0.0, 0.05, 0.02, 0.01];

    fn camera() -> Intrinsics {
        Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians())
    }

    /// The Brown-Conrady model, as written in OpenCV's documentation of `calib3d`.
    fn distorted(ideal: Point2<f64>) -> Point2<f64> {
        let Intrinsics { fx, fy, cx, cy, .. } = camera();
        let [k1, k2, p1, p2, k3, k4, k5, k6] = DISTORTION;
        let x = (ideal.x - cx) / fx;
        let y = (ideal.y - cy) / fy;
        let r2 = x * x + y * y;
        let polynomial = |a, b, c| 1.0 + a * r2 + b * r2 * r2 + c * r2 * r2 * r2;
        let radial = polynomial(k1, k2, k3) / polynomial(k4, k5, k6);
        Point2::new(
            cx + fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)),
            cy + fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y),
        )
    }

    #[test]
    fn corners_match_ideal_lens() {
        let ideal = [
            (500.0, 100.0),
            (560.0, 105.0),
            (555.0, 160.0),
            (495.0, 150.0),
        ]
        .map(|(x, y)| Point2::new(x, y));
        let bent = ideal.map(distorted);
        assert!(
            (bent[1] - ideal[1]).norm() > 5.0,
            "the lens bends enough to be seen"
        );
        let seen = Detection {
            label: "QR".into(),
            confidence: 1.0,
            bounding_box: BoundingBox::around(&bent),
            corners: Some(bent),
        };
        let mut detections = vec![
            Detection {
                corners: None,
                ..seen.clone()
            },
            seen,
        ];
        Lens {
            distortion: Some(DISTORTION),
            ..Lens::ideal(camera())
        }
        .undistort(&mut detections);
        for (straight, ideal) in detections[1].corners.unwrap().iter().zip(ideal) {
            assert!((straight - ideal).norm() < 1e-6, "{straight} {ideal}");
        }
        assert_eq!(detections[0].bounding_box, detections[1].bounding_box);
        assert!(
            (detections[0].bounding_box.center() - BoundingBox::around(&ideal).center()).norm()
                < 1.0
        );
    }

    #[test]
    fn field_of_view_fits_any_shape() {
        let horizontal_rad = 70f64.to_radians();
        let narrow = Lens::ideal(Intrinsics::with_square_pixels(640, 480, horizontal_rad));
        let wide = ImageSize {
            width: 1920,
            height: 1080,
        };
        assert!(narrow.of_frames(wide).is_err());
        let any = Lens {
            is_any_shape: true,
            ..narrow
        };
        assert_eq!(
            any.of_frames(ImageSize {
                width: 1280,
                height: 960
            }),
            Ok(any)
        );
        let Intrinsics {
            width,
            height,
            fx,
            fy,
            cy,
            ..
        } = any.of_frames(wide).unwrap().intrinsics;
        assert_eq!((width, height, cy), (640, 360, 180.0));
        assert!((fx - 320.0 / (horizontal_rad / 2.0).tan()).abs() < 1e-9 && fx == fy);
        assert!(
            any.of_frames(ImageSize {
                width: 640,
                height: 0
            })
            .is_err()
        );
    }

    #[test]
    fn an_ideal_lens_changes_nothing() {
        let bounding_box = BoundingBox {
            x_min: 1.0,
            y_min: 2.0,
            x_max: 30.0,
            y_max: 40.0,
        };
        let seen = vec![Detection {
            label: "cup".into(),
            confidence: 1.0,
            bounding_box,
            corners: None,
        }];
        let mut detections = seen.clone();
        Lens::ideal(camera()).undistort(&mut detections);
        assert_eq!(detections, seen);
    }
}
