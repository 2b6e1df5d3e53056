//! From the numbers of a network's outputs to boxes with scores.

use ecod::model::detection::BoundingBox;
use nalgebra::Vector2;

use super::family::{Family, Head, Layout, STRIDES};
use super::network::NamedTensor;
use crate::camera::detect::candidates::ScoredBox;
use crate::camera::image_size::ImageSize;

/// Meaning of the four numbers of a box.
#[derive(Debug, Clone, Copy)]
enum Edges {
    /// Centre, width and height.
    Centre,
    /// Left, upper, right and lower edge.
    Corners,
    /// Upper, left, lower and right edge.
    RowFirst,
}

/// A class of an object, by its place in the list of classes, with its score or logit.
#[derive(Debug, Clone, Copy)]
struct ScoredClass {
    class: usize,
    score: f32,
}

impl ScoredClass {
    /// The same class, its score multiplied by the objectness.
    fn times(self, objectness: f32) -> Self {
        Self {
            score: self.score * objectness,
            ..self
        }
    }

    /// The same class, with the probability for its logit.
    fn sigmoid(self) -> Self {
        Self {
            score: 1.0 / (1.0 + (-self.score).exp()),
            ..self
        }
    }
}

impl Edges {
    /// The box, each direction multiplied by its scale.
    fn bounds(self, numbers: [f32; 4], scale: Vector2<f64>) -> BoundingBox {
        let [a, b, c, d] = numbers.map(f64::from);
        let (x_min, y_min, x_max, y_max) = match self {
            Self::Centre => (a - c / 2.0, b - d / 2.0, a + c / 2.0, b + d / 2.0),
            Self::Corners => (a, b, c, d),
            Self::RowFirst => (b, a, d, c),
        };
        BoundingBox {
            x_min: x_min * scale.x,
            y_min: y_min * scale.y,
            x_max: x_max * scale.x,
            y_max: y_max * scale.y,
        }
    }
}

impl Head {
    /// Boxes with a score of `least` or more, in pixels of the network's input.
    pub(super) fn decode(
        &self,
        outputs: &[NamedTensor],
        input: ImageSize,
        least: f32,
    ) -> Vec<ScoredBox> {
        let values = |output: usize| outputs.get(output).map_or(&[][..], |output| &output.values);
        let width = |output: usize| {
            outputs
                .get(output)
                .and_then(|o| o.shape.last())
                .map_or(1, |last| (*last).max(1))
        };
        let pixels = Vector2::repeat(1.0);
        let shares = Vector2::new(f64::from(input.width), f64::from(input.height));
        let best = |scores: &[f32]| {
            scores
                .iter()
                .copied()
                .enumerate()
                .max_by(|a, b| a.1.total_cmp(&b.1))
                .map(|(class, score)| ScoredClass { class, score })
        };
        let found = |best: ScoredClass, edges: Edges, numbers: [f32; 4], scale: Vector2<f64>| {
            (best.score >= least).then(|| ScoredBox {
                class: best.class,
                score: best.score,
                bounds: edges.bounds(numbers, scale),
            })
        };
        match self.layout {
            Layout::Objectness(output) => values(output)
                .chunks_exact(width(output))
                .filter_map(|row| {
                    let best = best(row.get(5..)?)?.times(row[4]);
                    found(best, Edges::Centre, four(row)?, pixels)
                })
                .collect(),
            Layout::Cells(output) => cells(input)
                .zip(values(output).chunks_exact(width(output)))
                .filter_map(|((column, line, stride), row)| {
                    let best = best(row.get(5..)?)?.times(row[4]);
                    let [x, y, width, height] = four(row)?;
                    let numbers = [x + column, y + line, width.exp(), height.exp()];
                    found(best, Edges::Centre, numbers, Vector2::repeat(stride))
                })
                .collect(),
            Layout::Columns(output) => {
                let values = values(output);
                let count = width(output);
                let row = |index: usize| {
                    values
                        .chunks_exact(count)
                        .map(|column| column[index])
                        .collect::<Vec<f32>>()
                };
                let decoded =
                    |row: Vec<f32>| found(best(row.get(4..)?)?, Edges::Centre, four(&row)?, pixels);
                (0..count).filter_map(|index| decoded(row(index))).collect()
            }
            Layout::Rows(output) => values(output)
                .chunks_exact(width(output))
                .filter_map(|row| found(best(row.get(4..)?)?, Edges::Centre, four(row)?, shares))
                .collect(),
            Layout::Picked(output) => {
                let is_rtdetr = self.family == Family::Rtdetr;
                let (edges, scale) = if is_rtdetr {
                    (Edges::Centre, shares)
                } else {
                    (Edges::Corners, pixels)
                };
                let rows = values(output).chunks_exact(6);
                rows.filter_map(|row| {
                    let class = class_of(row[5])?;
                    let score = row[4];
                    found(ScoredClass { class, score }, edges, four(row)?, scale)
                })
                .collect()
            }
            Layout::Queries { boxes, logits } => values(boxes)
                .chunks_exact(4)
                .zip(values(logits).chunks_exact(width(logits)))
                .filter_map(|(row, logits)| {
                    let best = if self.family == Family::Detr {
                        softmax(logits)?
                    } else {
                        best(logits)?.sigmoid()
                    };
                    found(best, Edges::Centre, four(row)?, shares)
                })
                .collect(),
            Layout::Priors { boxes, scores } => values(boxes)
                .chunks_exact(4)
                .zip(values(scores).chunks_exact(width(scores)))
                .filter_map(|(row, scores)| {
                    let first = self.first_class;
                    let ScoredClass { class, score } = best(scores.get(first..)?)?;
                    let class = class + first;
                    found(
                        ScoredClass { class, score },
                        Edges::Corners,
                        four(row)?,
                        shares,
                    )
                })
                .collect(),
            Layout::Listed {
                boxes,
                scores,
                classes,
            } => {
                let (edges, scale) = if self.is_tensorflow {
                    (Edges::RowFirst, shares)
                } else {
                    (Edges::Corners, pixels)
                };
                let lists = values(boxes)
                    .chunks_exact(4)
                    .zip(values(scores))
                    .zip(values(classes));
                lists
                    .filter_map(|((row, score), class)| {
                        let class = class_of(*class)?;
                        let score = *score;
                        found(ScoredClass { class, score }, edges, four(row)?, scale)
                    })
                    .collect()
            }
        }
    }
}

/// The number of a listed class; `None` for the filling of a list, such as -1.
fn class_of(number: f32) -> Option<usize> {
    (number >= 0.0).then_some(number as usize)
}

fn four(row: &[f32]) -> Option<[f32; 4]> {
    row.first_chunk().copied()
}

/// Column, line and stride in pixels of every cell of the grids, in the order of YOLOX.
fn cells(input: ImageSize) -> impl Iterator<Item = (f32, f32, f64)> {
    STRIDES.into_iter().flat_map(move |stride| {
        let columns = input.width / stride;
        let lines = input.height / stride;
        (0..lines).flat_map(move |line| {
            (0..columns).map(move |column| (column as f32, line as f32, f64::from(stride)))
        })
    })
}

/// The most probable class with its probability; the last logit is for no object.
fn softmax(logits: &[f32]) -> Option<ScoredClass> {
    let most = logits.iter().copied().max_by(f32::total_cmp)?;
    let sum: f32 = logits.iter().map(|logit| (logit - most).exp()).sum();
    let (_, classes) = logits.split_last()?;
    let (class, logit) = classes
        .iter()
        .copied()
        .enumerate()
        .max_by(|a, b| a.1.total_cmp(&b.1))?;
    let score = (logit - most).exp() / sum;
    Some(ScoredClass { class, score })
}
