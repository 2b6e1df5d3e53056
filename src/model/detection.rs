//! Detections in one image, in pixels.

use nalgebra::Point2;
use serde::{Deserialize, Serialize};

use crate::model::names::{Label, MAX_NAME_BYTES, is_label};

/// An axis-aligned box in pixels; x grows to the right, y downwards.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BoundingBox {
    /// Left edge in pixels.
    pub x_min: f64,
    /// Upper edge in pixels.
    pub y_min: f64,
    /// Right edge in pixels.
    pub x_max: f64,
    /// Lower edge in pixels.
    pub y_max: f64,
}

impl BoundingBox {
    /// The smallest box around the points.
    pub fn around(points: &[Point2<f64>]) -> Self {
        points.iter().fold(
            Self {
                x_min: f64::INFINITY,
                y_min: f64::INFINITY,
                x_max: f64::NEG_INFINITY,
                y_max: f64::NEG_INFINITY,
            },
            |b, p| Self {
                x_min: b.x_min.min(p.x),
                y_min: b.y_min.min(p.y),
                x_max: b.x_max.max(p.x),
                y_max: b.y_max.max(p.y),
            },
        )
    }

    /// Width in pixels.
    pub fn width(&self) -> f64 {
        self.x_max - self.x_min
    }

    /// Height in pixels.
    pub fn height(&self) -> f64 {
        self.y_max - self.y_min
    }

    /// Middle of the box in pixels.
    pub fn center(&self) -> Point2<f64> {
        Point2::new(
            (self.x_min + self.x_max) / 2.0,
            (self.y_min + self.y_max) / 2.0,
        )
    }

    /// True if all edges are finite and the box has an area.
    pub fn is_valid(&self) -> bool {
        let edges = [self.x_min, self.y_min, self.x_max, self.y_max];
        edges.iter().all(|e| e.is_finite()) && self.width() > 0.0 && self.height() > 0.0
    }

    /// Area shared with another box over the area of both together, 0 to 1.
    pub fn intersection_over_union(&self, other: &Self) -> f64 {
        let width = self.x_max.min(other.x_max) - self.x_min.max(other.x_min);
        let height = self.y_max.min(other.y_max) - self.y_min.max(other.y_min);
        if width <= 0.0 || height <= 0.0 {
            return 0.0;
        }
        let shared = width * height;
        shared / (self.width() * self.height() + other.width() * other.height() - shared)
    }
}

/// One object found in one image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// Class label or decoded text.
    pub label: Label,
    /// The detector's confidence, 0 to 1.
    pub confidence: f64,
    /// Bounds in the image, in pixels.
    pub bounding_box: BoundingBox,
    /// Corners of a square target in pixels, as seen from its front: top left, top right, bottom
    /// right, bottom left.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub corners: Option<[Point2<f64>; 4]>,
}

/// Reads the detections of one frame from a line of a recording, a JSON array.
///
/// # Errors
/// Returns a description of the first flaw.
pub fn parse_detections(line: &str) -> Result<Vec<Detection>, String> {
    let detections: Vec<Detection> =
        serde_json::from_str(line).map_err(|error| error.to_string())?;
    for Detection {
        label,
        confidence,
        bounding_box,
        ..
    } in &detections
    {
        if !bounding_box.is_valid() {
            return Err(format!("the box of {label:?} has no area"));
        }
        if !is_label(label) {
            return Err(format!(
                "the label {label:?} must be a text of 1 to {MAX_NAME_BYTES} bytes"
            ));
        }
        if !(0.0..=1.0).contains(confidence) {
            return Err(format!(
                "the confidence of {label:?} is {confidence}, must be 0 to 1"
            ));
        }
    }
    Ok(detections)
}
