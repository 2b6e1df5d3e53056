//! Boxes found by networks, and non-maximum suppression of boxes that show the same object.

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::names::Label;
use opencv::core::{Rect2d, Vector};
use opencv::dnn;

/// A box that a network found, with the number of its class.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ScoredBox {
    pub(super) class: usize,
    pub(super) score: f32,
    pub(super) bounds: BoundingBox,
}

impl ScoredBox {
    /// The part of the box inside an image of this size; `None` if the box is outside or an edge is
    /// NaN.
    pub(super) fn inside(mut self, width: f64, height: f64) -> Option<Self> {
        let b = &mut self.bounds;
        b.x_min = b.x_min.clamp(0.0, width);
        b.x_max = b.x_max.clamp(0.0, width);
        b.y_min = b.y_min.clamp(0.0, height);
        b.y_max = b.y_max.clamp(0.0, height);
        b.is_valid().then_some(self)
    }

    /// The detection of the box.
    pub(super) fn labelled(&self, label: Label) -> Detection {
        let confidence = f64::from(self.score).clamp(0.0, 1.0);
        Detection {
            label,
            confidence,
            bounding_box: self.bounds,
            corners: None,
        }
    }
}

/// The best boxes of each class: of two that overlap by more than `max_overlap`, intersection over
/// union, the lower score goes.
pub(super) fn suppress(
    mut candidates: Vec<ScoredBox>,
    max_overlap: f64,
) -> opencv::Result<Vec<ScoredBox>> {
    candidates.sort_by_key(|candidate| candidate.class);
    let mut best = Vec::new();
    for of_class in candidates.chunk_by(|a, b| a.class == b.class) {
        let rect = |b: &BoundingBox| Rect2d::new(b.x_min, b.y_min, b.width(), b.height());
        let boxes: Vector<Rect2d> = of_class.iter().map(|c| rect(&c.bounds)).collect();
        let scores: Vector<f32> = of_class.iter().map(|c| c.score).collect();
        let mut kept = Vector::<i32>::new();
        dnn::nms_boxes_f64(&boxes, &scores, 0.0, max_overlap as f32, &mut kept, 1.0, 0)?;
        best.extend(
            kept.iter()
                .filter_map(|index| of_class.get(index as usize))
                .copied(),
        );
    }
    Ok(best)
}
