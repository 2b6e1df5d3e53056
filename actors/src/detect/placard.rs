//! interim
use ecod::config::ConfigError;
use ecod::detection::{BoundingBox, Detection};
use nalgebra::Point2;
use opencv::core::{Mat, Size};
use opencv::imgproc;
use opencv::prelude::*;
use serde::{Deserialize, Serialize};
use zxing_cpp::{BarcodeFormat, BarcodeReader, ImageFormat, ImageView};

use super::{Detect, DetectError};
use crate::frame::Frame;

/// interim
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlacardConfig {}
impl PlacardConfig {
    /// interim
    /// # Errors
    /// none
    pub fn validate(&self) -> Result<(), ConfigError> { Ok(()) }
}
/// interim
pub struct PlacardDetector { reader: BarcodeReader }
impl PlacardDetector {
    /// interim
    pub fn new(_: PlacardConfig) -> Self {
        Self { reader: zxing_cpp::read().formats([BarcodeFormat::QRCode]).try_harder(true).try_rotate(false).try_invert(false).try_downscale(false) }
    }
}
impl Detect for PlacardDetector {
    fn detect(&mut self, frame: &Frame) -> Result<Vec<Detection>, DetectError> {
        let cv = |step| move |source| DetectError::OpenCv { step, source };
        let mut gray = Mat::default();
        imgproc::cvt_color_def(&frame.image, &mut gray, imgproc::COLOR_BGR2GRAY).map_err(cv("gray"))?;
        let mut found: Vec<Detection> = Vec::new();
        for (fx, fy, conf) in [(1.0, 1.0, 0.98), (2.0, 2.0, 0.95), (4.0, 2.0, 0.9)] {
            let mut image = Mat::default();
            if fx == 1.0 { image = gray.clone(); } else {
                imgproc::resize(&gray, &mut image, Size::default(), fx, fy, imgproc::INTER_CUBIC).map_err(cv("resize"))?;
            }
            let view = ImageView::from_slice(image.data_bytes().map_err(cv("b"))?, image.cols(), image.rows(), ImageFormat::Lum).map_err(|e| DetectError::Decoder(e.to_string()))?;
            for code in self.reader.from(&view).map_err(|e| DetectError::Decoder(e.to_string()))? {
                if !code.is_valid() { continue; }
                let p = code.position();
                let corners = [p.top_left, p.top_right, p.bottom_right, p.bottom_left].map(|c| Point2::new((c.x as f64 + 0.5) / fx, (c.y as f64 + 0.5) / fy));
                let bounding_box = BoundingBox::around(&corners);
                let d = Detection { label: code.text().into(), confidence: conf, bounding_box, corners: Some(corners) };
                if let Some(old) = found.iter_mut().find(|o| o.bounding_box.intersection_over_union(&bounding_box) > 0.3) { if fx > 1.0 { old.corners = d.corners; old.bounding_box = d.bounding_box; } } else { found.push(d); }
            }
        }
        Ok(found)
    }
}
