//! Detector of placards: square QR codes that name a slot or a vehicle, read by zxing-cpp.
//!
//! Each pass reads the part of the frame that has contrast at a larger size. Codes that were read are
//! painted over before the next pass, so that no code is read twice.

use ecod::config::{ConfigError, check_range};
use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::names::{Label, is_label};
use nalgebra::Point2;
use opencv::core::{CV_8UC1, CV_8UC3, Mat, Point, Rect, Scalar, Size, ToInputArray, Vector};
use opencv::imgproc;
use opencv::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use zxingcpp::{Barcode, BarcodeFormat, BarcodeReader, ImageFormat, ImageView};

use super::{Detect, DetectError};
use crate::camera::frame::CameraFrame;

/// Configuration of the placard detector.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PlacardConfig {
    /// Enlargements of the frame, cheapest first. Default 1x1, 2x2 and 4x2. Trade-off: more passes
    /// read smaller and more slanted codes; the time of a pass grows with its area.
    pub passes: Vec<Pass>,
    /// Maximum number of codes in one frame, 1 to 255. Default 32. Reaching it ends the passes.
    pub max_codes: u8,
}

/// One reading of the frame, enlarged by cubic interpolation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Pass {
    /// Horizontal enlargement, 1 to 4. Slanted views make codes narrow, so this is usually the
    /// larger one.
    pub stretch_x: f64,
    /// Vertical enlargement, 1 to 4.
    pub stretch_y: f64,
}

impl Default for PlacardConfig {
    fn default() -> Self {
        let pass = |stretch_x, stretch_y| Pass {
            stretch_x,
            stretch_y,
        };
        Self {
            passes: vec![pass(1.0, 1.0), pass(2.0, 2.0), pass(4.0, 2.0)],
            max_codes: 32,
        }
    }
}

impl PlacardConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        if !(1..=MAX_PASSES).contains(&self.passes.len()) {
            return Err(ConfigError::new(
                "passes",
                format!("a list of {} passes", self.passes.len()),
                format!("1 to {MAX_PASSES} passes"),
            ));
        }
        for (index, pass) in self.passes.iter().enumerate() {
            check_range(
                &format!("passes.{index}.stretch_x"),
                pass.stretch_x,
                1.0,
                4.0,
            )?;
            check_range(
                &format!("passes.{index}.stretch_y"),
                pass.stretch_y,
                1.0,
                4.0,
            )?;
        }
        check_range("max_codes", self.max_codes.into(), 1.0, 255.0)
    }
}

/// Maximum number of passes.
const MAX_PASSES: usize = 8;
/// Module sizes in pixels between which confidence rises.
const CONFIDENCE_MODULES_PX: (f64, f64) = (1.0, 4.0);
/// Confidence at those sizes.
const CONFIDENCES: (f64, f64) = (0.5, 0.99);

/// Detector of placards.
///
/// Error correction of the code makes wrong texts very rare. Confidence therefore describes the
/// corners: it rises from 0.5 for modules of one pixel along the code's shortest side to 0.99 for
/// modules of four pixels.
///
/// The decoder extrapolates the lower right corner, which has no finder pattern. In codes of
/// version 1 it is typically off by 0.45 modules, the other corners by 0.2.
///
/// Texts that cannot be a label are skipped: empty, longer than 64 bytes, not UTF-8, or with
/// control characters.
pub struct PlacardDetector {
    config: PlacardConfig,
}

impl PlacardDetector {
    /// A detector for a validated configuration.
    pub fn new(config: PlacardConfig) -> Self {
        Self { config }
    }

    /// The codes in a continuous gray image, which are painted over.
    pub(crate) fn codes(&self, gray: &mut Mat) -> Result<Vec<Code>, DetectError> {
        let region = region_of_contrast(gray).map_err(|source| DetectError::OpenCv {
            step: "measuring contrast",
            source,
        })?;
        region.map_or_else(|| Ok(Vec::new()), |region| self.codes_in(gray, region))
    }

    /// The codes in a part of the image.
    fn codes_in(&self, gray: &mut Mat, region: Rect) -> Result<Vec<Code>, DetectError> {
        let reader = zxingcpp::read()
            .formats(BarcodeFormat::QRCode)
            .max_number_of_symbols(self.config.max_codes)
            .try_harder(true)
            .try_rotate(false)
            .try_invert(false)
            .try_downscale(false);
        let mut codes: Vec<Code> = Vec::new();
        for &pass in &self.config.passes {
            let found = read(&reader, gray, region, pass)?;
            for code in &found {
                paint_over(gray, code).map_err(|source| DetectError::OpenCv {
                    step: "painting over a code",
                    source,
                })?;
            }
            codes.extend(found);
            if codes.len() >= self.config.max_codes.into() {
                break;
            }
        }
        codes.truncate(self.config.max_codes.into());
        Ok(codes)
    }
}

/// Smallest difference of gray between paper and ink, after the noise of single pixels is averaged,
/// of a code that is looked for: the decoder takes smaller ones for noise.
const MIN_CONTRAST: f64 = 24.0;

/// Side in pixels of the square in which contrast is measured: edges of modules up to this size
/// join to an area.
const CONTRAST_PX: i32 = 9;

/// Side in pixels of the smallest area of contrast. Single edges, such as horizons, are narrower.
const AREA_PX: i32 = 16;

/// Reduction from one scale to the next: codes with larger modules are areas at a smaller scale.
const SCALE: i32 = 4;

/// Pixels of the surroundings of a place on which its reading depends, and the steps at which the
/// decoder divides columns and rows: a part that begins at a multiple is read like the whole image.
const SURROUNDINGS_PX: i32 = 24;
const COLUMN_STEP_PX: i32 = 8;
const ROW_STEP_PX: i32 = 24;

/// The part of the image that may contain codes: all areas with contrast. `None` without such an
/// area.
///
/// Walls, floors and sky would take most of the time of the passes.
fn region_of_contrast(gray: &Mat) -> opencv::Result<Option<Rect>> {
    let whole = Rect::new(0, 0, gray.cols(), gray.rows());
    if whole.width.min(whole.height) < 2 * AREA_PX {
        return Ok(Some(whole));
    }
    let mut found = Rect::default();
    let mut image = gray.try_clone()?;
    let mut scale = 1;
    while image.cols().min(image.rows()) >= 2 * AREA_PX {
        let area = area_of_contrast(&image)?;
        let area = Rect::new(
            area.x * scale,
            area.y * scale,
            area.width * scale,
            area.height * scale,
        );
        found |= area;
        let mut smaller = Mat::default();
        let factor = 1.0 / f64::from(SCALE);
        let size = Size::default();
        imgproc::resize(
            &image,
            &mut smaller,
            size,
            factor,
            factor,
            imgproc::INTER_AREA,
        )?;
        image = smaller;
        scale *= SCALE;
    }
    if found.empty() {
        return Ok(None);
    }
    let low = |at: i32, step: i32| (at - SURROUNDINGS_PX).max(0) / step * step;
    let high = |at: i32, step: i32, end: i32| {
        let aligned = (at + SURROUNDINGS_PX + step - 1) / step * step;
        aligned.min(end)
    };
    let x = low(found.x, COLUMN_STEP_PX);
    let y = low(found.y, ROW_STEP_PX);
    let right = high(found.x + found.width, COLUMN_STEP_PX, whole.width);
    let bottom = high(found.y + found.height, ROW_STEP_PX, whole.height);
    Ok(Some(Rect::new(x, y, right - x, bottom - y)))
}

/// The smallest rectangle around all areas of contrast at one scale, in pixels; empty without such
/// an area.
fn area_of_contrast(image: &Mat) -> opencv::Result<Rect> {
    let mut smooth = Mat::default();
    let mut contrast = Mat::default();
    let mut is_high = Mat::default();
    let mut areas = Mat::default();
    imgproc::blur_def(image, &mut smooth, Size::new(3, 3))?;
    let square =
        |side| imgproc::get_structuring_element_def(imgproc::MORPH_RECT, Size::new(side, side));
    imgproc::morphology_ex_def(
        &smooth,
        &mut contrast,
        imgproc::MORPH_GRADIENT,
        &square(CONTRAST_PX)?,
    )?;
    let binary = imgproc::THRESH_BINARY;
    imgproc::threshold(&contrast, &mut is_high, MIN_CONTRAST, 255.0, binary)?;
    imgproc::morphology_ex_def(&is_high, &mut areas, imgproc::MORPH_OPEN, &square(AREA_PX)?)?;
    imgproc::bounding_rect(&areas)
}

impl Detect for PlacardDetector {
    fn detect(&mut self, frame: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
        let codes = self.codes(&mut gray(frame)?)?;
        Ok(codes.into_iter().filter_map(Code::into_detection).collect())
    }
}

/// Codes in one enlargement of a part of the image, with corners in pixels of the original.
fn read(
    reader: &BarcodeReader,
    image: &Mat,
    region: Rect,
    pass: Pass,
) -> Result<Vec<Code>, DetectError> {
    let opencv_error = |source| DetectError::OpenCv {
        step: "enlarging a frame",
        source,
    };
    let enlarged = Mat::roi(image, region)
        .and_then(|part| enlarge(&part, pass))
        .map_err(opencv_error)?;
    let pixels = enlarged.data_bytes().map_err(opencv_error)?;
    let view = ImageView::from_slice(pixels, enlarged.cols(), enlarged.rows(), ImageFormat::Lum);
    let codes = view
        .and_then(|view| reader.from(&view))
        .map_err(|error| DetectError::Decoder(error.to_string()))?;
    Ok(codes
        .iter()
        .filter(|code| code.is_valid())
        .map(|code| Code::of(code, region, pass))
        .collect())
}

/// A QR code that was decoded in an image.
pub(crate) struct Code {
    text: Vec<u8>,
    /// Modules along a side.
    pub(crate) modules: f64,
    /// Corners in pixels, clockwise from the upper left as printed.
    pub(crate) corners: [Point2<f64>; 4],
}

impl Code {
    /// zxing-cpp puts the centre of the first pixel at (0.5, 0.5) and rounds the outer corners of
    /// the code to whole numbers; enlarging by OpenCV keeps the edges of the image in place, so
    /// both coordinates only scale.
    fn of(barcode: &Barcode, region: Rect, pass: Pass) -> Self {
        let position = barcode.position();
        let corners = [
            position.top_left,
            position.top_right,
            position.bottom_right,
            position.bottom_left,
        ]
        .map(|c| {
            Point2::new(
                f64::from(region.x) + f64::from(c.x) / pass.stretch_x,
                f64::from(region.y) + f64::from(c.y) / pass.stretch_y,
            )
        });
        let version: u8 = barcode.extra_with_key("Version").parse().unwrap_or(1);
        Self {
            text: barcode.bytes(),
            modules: 17.0 + 4.0 * f64::from(version),
            corners,
        }
    }

    fn into_detection(self) -> Option<Detection> {
        let label = label(self.text)?;
        let bounding_box = BoundingBox::around(&self.corners);
        let confidence = confidence(&self.corners, self.modules);
        bounding_box.is_valid().then_some(Detection {
            label,
            confidence,
            bounding_box,
            corners: Some(self.corners),
        })
    }
}

fn label(text: Vec<u8>) -> Option<Label> {
    let label = Label::from(String::from_utf8(text).ok()?);
    is_label(&label).then_some(label)
}

fn confidence(corners: &[Point2<f64>; 4], modules: f64) -> f64 {
    let side = (0..4)
        .map(|i| nalgebra::distance(&corners[i], &corners[(i + 1) % 4]))
        .fold(f64::INFINITY, f64::min);
    let (small, large) = CONFIDENCE_MODULES_PX;
    let share = ((side / modules - small) / (large - small)).clamp(0.0, 1.0);
    CONFIDENCES.0 + share * (CONFIDENCES.1 - CONFIDENCES.0)
}

/// A continuous grayscale copy of the frame.
fn gray(frame: &CameraFrame) -> Result<Mat, DetectError> {
    let image = &frame.image;
    let unusable = |found: String| DetectError::UnusableImage {
        seq: frame.seq,
        found,
    };
    if image.empty() || image.dims() != 2 {
        return Err(unusable("no pixels".into()));
    }
    let converted = match image.typ() {
        CV_8UC1 => image.try_clone(),
        CV_8UC3 => {
            let mut gray = Mat::default();
            imgproc::cvt_color_def(image, &mut gray, imgproc::COLOR_BGR2GRAY).map(|()| gray)
        }
        other => return Err(unusable(format!("opencv pixel type {other}"))),
    };
    converted.map_err(|source| DetectError::OpenCv {
        step: "converting a frame to gray",
        source,
    })
}

fn enlarge(image: &(impl MatTraitConst + ToInputArray), pass: Pass) -> opencv::Result<Mat> {
    if pass.stretch_x == 1.0 && pass.stretch_y == 1.0 {
        return image.try_clone();
    }
    let mut enlarged = Mat::default();
    let size = Size::default();
    let interpolation = imgproc::INTER_CUBIC;
    imgproc::resize(
        image,
        &mut enlarged,
        size,
        pass.stretch_x,
        pass.stretch_y,
        interpolation,
    )?;
    Ok(enlarged)
}

fn paint_over(image: &mut Mat, code: &Code) -> opencv::Result<()> {
    let corners: Vector<Point> = code
        .corners
        .iter()
        .map(|c| Point::new(c.x.round() as i32, c.y.round() as i32))
        .collect();
    imgproc::fill_convex_poly_def(image, &corners, Scalar::all(255.0))
}

#[cfg(test)]
mod tests;
