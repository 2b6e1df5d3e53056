//! Families of exported models, and how each arranges its outputs.

use ecod::model::detection::BoundingBox;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::labels::Classes;
use super::letterbox::Fit;
use super::network::NamedTensor;
use crate::camera::detect::candidates::ScoredBox;
use crate::camera::image_size::ImageSize;

/// Family of a model, by the project that exported it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, strum::Display, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Family {
    /// YOLOv5 and YOLOv7.
    Yolov5,
    /// YOLOv8, 11 and others of Ultralytics, with non-maximum suppression or without.
    Yolov8,
    /// YOLOX, exported without `--decode_in_inference`.
    Yolox,
    /// SSD of torchvision, of TensorFlow's Object Detection API and of pytorch-ssd.
    Ssd,
    /// DETR of Hugging Face.
    Detr,
    /// RT-DETR of Ultralytics, of Hugging Face and of its authors; D-FINE.
    Rtdetr,
    /// RF-DETR of Roboflow.
    Rfdetr,
}

/// Values that a network takes for the levels 0 to 255 of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Normalization {
    /// 0 to 255.
    Raw,
    /// 0 to 1.
    Unit,
    /// -1 to 1.
    Signed,
    /// 0 to 1, minus the mean of ImageNet, divided by its standard deviation.
    Imagenet,
}

impl Normalization {
    /// Factor and offset of each channel, red first.
    pub(super) fn factors(self) -> [(f32, f32); 3] {
        const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
        const SIGMA: [f32; 3] = [0.229, 0.224, 0.225];
        match self {
            Self::Raw => [(1.0, 0.0); 3],
            Self::Unit => [(1.0 / 255.0, 0.0); 3],
            Self::Signed => [(1.0 / 127.5, -1.0); 3],
            Self::Imagenet => {
                std::array::from_fn(|c| (1.0 / (255.0 * SIGMA[c]), -MEAN[c] / SIGMA[c]))
            }
        }
    }
}

/// Arrangement of a network's outputs. The numbers are places in the list of outputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Layout {
    /// `[1, boxes, 5 + classes]`: centre and size in pixels, objectness, scores.
    Objectness(usize),
    /// The same, with centre and logarithm of the size in cells of a grid.
    Cells(usize),
    /// `[1, 4 + classes, boxes]`: centre and size in pixels, scores.
    Columns(usize),
    /// `[1, boxes, 4 + classes]`: centre and size in shares of the image, scores.
    Rows(usize),
    /// `[1, boxes, 6]`: box, score, class.
    Picked(usize),
    /// `[1, boxes, 4]` and `[1, boxes, classes]`: centre and size in shares, logits.
    Queries { boxes: usize, logits: usize },
    /// `[1, boxes, 4]` and `[1, boxes, 1 + classes]`: corners in shares, scores with the background
    /// first.
    Priors { boxes: usize, scores: usize },
    /// `[…, boxes, 4]`, `[…, boxes]` and `[…, boxes]`: corners, score, class.
    Listed {
        boxes: usize,
        scores: usize,
        classes: usize,
    },
}

/// Family and layout of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Head {
    pub(super) family: Family,
    pub(super) layout: Layout,
    /// True for TensorFlow's lists: upper, left, lower and right edge in shares of the image.
    pub(super) is_tensorflow: bool,
    /// Number of the first class: 1 where 0 is the background.
    pub(super) first_class: usize,
}

/// Reason for which outputs have no head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NoHead {
    /// They fit no family, or another than the configured one.
    UnknownOutputs,
    /// They list numbers of classes, but their names and the configuration do not state whether
    /// the numbers begin with 0 or, after a background, with 1.
    UnknownFirstClass,
}

/// Evidence of a network's family in addition to its outputs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clues<'a> {
    /// The configured family.
    pub(super) configured: Option<Family>,
    /// The configured number of the first class.
    pub(super) first_class: Option<u8>,
    /// The exporter's name of the model.
    pub(super) description: &'a str,
    pub(super) input: ImageSize,
    /// True if the network has an input for the size to which it scales boxes.
    pub(super) scales_boxes: bool,
}

impl Head {
    /// The family and layout that the outputs fit.
    ///
    /// # Errors
    /// Returns a [`NoHead`].
    pub(super) fn find(clues: &Clues<'_>, outputs: &[NamedTensor]) -> Result<Self, NoHead> {
        let (family, layout) = by_names(clues, outputs)
            .or_else(|| by_shape(clues, outputs))
            .filter(|(family, _)| {
                clues
                    .configured
                    .is_none_or(|configured| configured == *family)
            })
            .ok_or(NoHead::UnknownOutputs)?;
        let is_tensorflow = outputs
            .iter()
            .any(|output| output.name.starts_with("detection_boxes"));
        let usual = match layout {
            Layout::Listed { boxes, .. } if family == Family::Ssd => {
                // torchvision's names; other exporters of lists differ in the first number.
                let is_known = is_tensorflow || outputs[boxes].name == "boxes";
                is_known.then_some(1)
            }
            _ => Some(usize::from(family == Family::Ssd)),
        };
        let first_class = clues.first_class.map(usize::from).or(usual);
        Ok(Self {
            family,
            layout,
            is_tensorflow,
            first_class: first_class.ok_or(NoHead::UnknownFirstClass)?,
        })
    }

    /// Numbers of the classes.
    pub(super) fn classes(&self, outputs: &[NamedTensor]) -> Classes {
        let last = |output: usize| outputs[output].shape.last().copied().unwrap_or(0);
        let scores = match self.layout {
            Layout::Objectness(output) | Layout::Cells(output) => Some(last(output) - 5),
            Layout::Columns(output) => Some(outputs[output].shape[1] - 4),
            Layout::Rows(output) => Some(last(output) - 4),
            Layout::Queries { logits, .. } => Some(last(logits)),
            Layout::Priors { scores, .. } => Some(last(scores)),
            Layout::Picked(_) | Layout::Listed { .. } => None,
        };
        let has_none_last = self.family == Family::Detr;
        Classes {
            scores,
            first: self.first_class,
            has_none_last,
        }
    }

    /// True if the network has turned the cells of YOLOX into pixels itself, for which
    /// [`Layout::Cells`] does not hold.
    pub(super) fn is_in_pixels(&self, outputs: &[NamedTensor], input: ImageSize) -> bool {
        let Layout::Cells(output) = self.layout else {
            return false;
        };
        let row = outputs[output].shape[2];
        // Centres are within a few cells of their own cell; in pixels they reach the right edge.
        outputs[output]
            .values
            .chunks_exact(row)
            .any(|row| row[0] > (input.width / STRIDES[0]) as f32)
    }

    /// What a found box shows to be wrong about this head, if anything. `bounds` are in pixels of
    /// the network's input.
    pub(super) fn contradiction(
        &self,
        ScoredBox { score, bounds, .. }: &ScoredBox,
        input: ImageSize,
    ) -> Option<String> {
        if *score > MAX_SCORE {
            return Some(format!("a score is {score}, above 1"));
        }
        let BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        } = *bounds;
        if self.lists_numbers() && (x_min > x_max || y_min > y_max) {
            return Some("a box ends before it begins, as centre and size would".into());
        }
        let are_pixels = match self.layout {
            Layout::Objectness(_) | Layout::Columns(_) => true,
            Layout::Picked(_) => self.family != Family::Rtdetr,
            Layout::Listed { .. } => !self.is_tensorflow,
            Layout::Cells(_) | Layout::Rows(_) | Layout::Queries { .. } | Layout::Priors { .. } => {
                false
            }
        };
        let width = f64::from(input.width);
        let height = f64::from(input.height);
        let largest = x_max.max(y_max);
        if are_pixels && largest <= MAX_SHARE && largest > 0.0 {
            let what = "is within the first pixel, as shares of the image would be";
            return Some(format!("a box {what}"));
        }
        let are_shares = !are_pixels && !matches!(self.layout, Layout::Cells(_));
        if are_shares && (x_max > MAX_OUTSIDE * width || y_max > MAX_OUTSIDE * height) {
            return Some("a box is far outside of the image, as pixels would be".into());
        }
        None
    }

    /// True if each box has the number of its class in place of a score for each class.
    pub(super) fn lists_numbers(&self) -> bool {
        matches!(self.layout, Layout::Picked(_) | Layout::Listed { .. })
    }

    /// True if one object has several boxes.
    pub(super) fn needs_suppression(&self) -> bool {
        match self.layout {
            Layout::Objectness(_)
            | Layout::Cells(_)
            | Layout::Columns(_)
            | Layout::Priors { .. } => true,
            Layout::Rows(_)
            | Layout::Picked(_)
            | Layout::Queries { .. }
            | Layout::Listed { .. } => false,
        }
    }

    /// Values of pixels in the training of the family.
    pub(super) fn normalization(&self) -> Normalization {
        match self.family {
            Family::Yolov5 | Family::Yolov8 | Family::Rtdetr => Normalization::Unit,
            Family::Yolox => Normalization::Raw,
            Family::Detr | Family::Rfdetr => Normalization::Imagenet,
            Family::Ssd if matches!(self.layout, Layout::Priors { .. }) => Normalization::Signed,
            Family::Ssd if self.is_tensorflow => Normalization::Raw,
            Family::Ssd => Normalization::Unit,
        }
    }

    /// True if the network takes blue first.
    pub(super) fn is_bgr(&self) -> bool {
        self.family == Family::Yolox
    }

    /// The image's place in the network's input.
    pub(super) fn fit(&self) -> Fit {
        match self.family {
            Family::Yolov5 | Family::Yolov8 => Fit::Centred,
            Family::Yolox => Fit::TopLeft,
            Family::Ssd | Family::Detr | Family::Rtdetr | Family::Rfdetr => Fit::Stretched,
        }
    }
}

/// Highest score of a probability, with rounding errors of 16-bit weights.
const MAX_SCORE: f32 = 1.01;
/// Highest coordinate of a box in shares of the image: boxes may reach over the edge.
const MAX_SHARE: f64 = 1.5;
/// Highest coordinate of a plausible box, in widths or heights of the image.
const MAX_OUTSIDE: f64 = 16.0;

/// Strides of the grids of YOLO.
pub(super) const STRIDES: [u32; 3] = [8, 16, 32];
/// Stride of one more grid, in variants for large images.
const COARSE_STRIDE: u32 = 64;

/// Boxes of DETR. RT-DETR, whose outputs have the same names, has 300.
const DETR_QUERIES: usize = 100;
/// Logits of DETR for COCO: 91 ids and no object.
const DETR_COCO_LOGITS: usize = 92;

fn cells(input: ImageSize, stride: u32) -> usize {
    (input.width / stride * (input.height / stride)) as usize
}

/// Networks with an output for boxes and others for their classes.
fn by_names(clues: &Clues<'_>, outputs: &[NamedTensor]) -> Option<(Family, Layout)> {
    let find = |words: &[&str], rank: std::ops::RangeInclusive<usize>| {
        outputs.iter().position(|o| {
            rank.contains(&o.shape.len()) && words.iter().any(|word| o.name.contains(word))
        })
    };
    let boxes =
        find(&["box", "dets"], 2..=3).filter(|boxes| outputs[*boxes].shape.last() == Some(&4))?;
    let count = outputs[boxes].shape[outputs[boxes].shape.len() - 2];
    let is_list = |at: &usize| outputs[*at].shape.last() == Some(&count);
    let is_table = |at: &usize| matches!(outputs[*at].shape[..], [_, rows, _] if rows == count);
    if let Some(logits) = find(&["logits"], 3..=3).filter(is_table) {
        let is_detr = count == DETR_QUERIES || outputs[logits].shape[2] == DETR_COCO_LOGITS;
        let found = clues.configured.unwrap_or(if is_detr {
            Family::Detr
        } else {
            Family::Rtdetr
        });
        let fits = matches!(found, Family::Detr | Family::Rtdetr | Family::Rfdetr);
        return fits.then_some((found, Layout::Queries { boxes, logits }));
    }
    if let Some(logits) = find(&["labels"], 3..=3).filter(is_table) {
        return Some((Family::Rfdetr, Layout::Queries { boxes, logits }));
    }
    let lists = [["scores", "scores"], ["labels", "classes"]]
        .map(|words| find(&words, 1..=2).filter(is_list));
    if let [Some(scores), Some(classes)] = lists {
        let family = if clues.scales_boxes {
            Family::Rtdetr
        } else {
            Family::Ssd
        };
        return Some((
            family,
            Layout::Listed {
                boxes,
                scores,
                classes,
            },
        ));
    }
    let scores = find(&["scores"], 3..=3).filter(is_table)?;
    Some((Family::Ssd, Layout::Priors { boxes, scores }))
}

/// Networks with one output, apart from the grids that early exports of YOLOv5 also had.
fn by_shape(clues: &Clues<'_>, outputs: &[NamedTensor]) -> Option<(Family, Layout)> {
    let (main, others) = outputs.split_first()?;
    let [1, rows, columns] = main.shape[..] else {
        return None;
    };
    if others.iter().any(|other| other.shape.len() != 5) {
        return None;
    }
    let fine: usize = STRIDES
        .iter()
        .map(|stride| cells(clues.input, *stride))
        .sum();
    let grids = [fine, fine + cells(clues.input, COARSE_STRIDE)];
    let description = clues.description.to_ascii_lowercase().replace('-', "");
    match clues.configured {
        Some(Family::Rtdetr) => rtdetr(columns),
        None if description.contains("rtdetr") => rtdetr(columns),
        Some(Family::Yolov5) if columns > 5 => Some((Family::Yolov5, Layout::Objectness(0))),
        Some(Family::Yolov8) if columns != 6 && rows > 4 => {
            Some((Family::Yolov8, Layout::Columns(0)))
        }
        _ if rows == fine && columns > 5 => Some((Family::Yolox, Layout::Cells(0))),
        _ if grids.iter().any(|cells| rows == 3 * cells) && columns > 5 => {
            Some((Family::Yolov5, Layout::Objectness(0)))
        }
        _ if grids.contains(&columns) && rows > 4 => Some((Family::Yolov8, Layout::Columns(0))),
        _ if columns == 6 => Some((Family::Yolov8, Layout::Picked(0))),
        _ => None,
    }
}

fn rtdetr(columns: usize) -> Option<(Family, Layout)> {
    let layout = if columns == 6 {
        Layout::Picked(0)
    } else {
        Layout::Rows(0)
    };
    (columns > 4).then_some((Family::Rtdetr, layout))
}
