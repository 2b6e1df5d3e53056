//! Detector of the 80 COCO classes: SSDLite-MobileNetV2 run by OpenCV.
//!
//! Feature `coco-weights` compiles the weights into the program; see `models/README.md` for their
//! source, inputs and outputs.

mod anchors;
pub mod labels;

use std::path::PathBuf;

use ecod::config::{ConfigError, check_range};
use ecod::model::detection::{BoundingBox, Detection};
use opencv::core::{CV_8UC3, CV_32F, Mat, Rect, Scalar, Size, Vector};
use opencv::dnn::{self, Net};
use opencv::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use self::anchors::Anchor;
use super::candidates::{ScoredBox, suppress};
use super::{Detect, DetectError, bgr};
use crate::camera::frame::CameraFrame;
use crate::platform::bounded_file;
use crate::platform::installed;

/// Configuration of the COCO detector.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CocoConfig {
    /// ONNX file with the inputs and outputs of the built-in model. Default: not set, the built-in
    /// model.
    pub model: Option<PathBuf>,
    /// Minimum confidence of a detection. Default 0.4. Trade-off: lower values find more objects
    /// and more false ones.
    pub threshold: f64,
    /// Intersection over union above which two boxes of one class are merged. Default 0.5.
    pub max_overlap: f64,
    /// Whether to also search four overlapping quarters of the image. Default false. Finds objects
    /// of half the size and takes five times as long.
    pub tiling: bool,
}

impl Default for CocoConfig {
    fn default() -> Self {
        Self {
            model: None,
            threshold: 0.4,
            max_overlap: 0.5,
            tiling: false,
        }
    }
}

impl CocoConfig {
    /// Checks every value; the model is checked when it is loaded.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        check_range("threshold", self.threshold, 0.01, 1.0)?;
        check_range("max_overlap", self.max_overlap, 0.0, 1.0)
    }
}

/// Error of loading a model.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The file cannot be read.
    #[error("cannot read model {path:?}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: std::io::Error,
    },
    /// The program has no built-in or installed weights, and no file is configured.
    #[error(
        "there are no weights for coco: install the package ecod-node-coco, or set `model` to a file, such as \
         models/ssdlite_mobilenet_v2_coco.onnx"
    )]
    NoWeights,
    /// OpenCV cannot run the file, or its inputs and outputs differ.
    #[error(
        "model {path} is not an ssdlite network that opencv can run; for other models set `kind = \"onnx\"`: {reason}"
    )]
    Unusable {
        /// The file, or `built-in`.
        path: String,
        /// Description of the problem.
        reason: String,
    },
}

#[cfg(feature = "coco-weights")]
static BUILT_IN: Option<&[u8]> = Some(include_bytes!(concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../models/ssdlite_mobilenet_v2_coco.onnx"
)));
#[cfg(not(feature = "coco-weights"))]
static BUILT_IN: Option<&[u8]> = None;

/// Weights of the package `ecod-node-coco`.
const PACKAGED: &str = "share/ecod-node/models/ssdlite_mobilenet_v2_coco.onnx";

/// Side of the network's input in pixels.
const INPUT_PX: i32 = 300;
/// Side of a tile as a share of the image's side: neighbouring tiles overlap by a fifth of the
/// image.
const TILE_SHARE: f64 = 0.6;
/// Distance from a tile's inner edge, as a share of the tile's side, below which a box counts as
/// cut.
const CUT_SHARE: f64 = 0.02;

/// Detector of COCO objects.
pub struct CocoDetector {
    config: CocoConfig,
    net: Net,
    anchors: Vec<Anchor>,
}

impl CocoDetector {
    /// Loads the model and runs it once to check it.
    ///
    /// # Errors
    /// Returns a [`ModelError`] that names the file.
    pub fn new(config: CocoConfig) -> Result<Self, ModelError> {
        let packaged = || installed::path(PACKAGED).filter(|_| BUILT_IN.is_none());
        let file = config.model.clone().or_else(packaged);
        let name = file
            .as_ref()
            .map_or_else(|| "built-in".into(), |path| format!("{path:?}"));
        // OpenCV gives more details in further lines.
        let first_line = |reason: String| reason.lines().next().unwrap_or_default().to_owned();
        let unusable = |reason: String| ModelError::Unusable {
            path: name.clone(),
            reason: first_line(reason),
        };
        // Through a buffer of ours the heap would stay larger by the whole file.
        let read = match file {
            Some(path) => match bounded_file::open(&path) {
                Ok(_) => dnn::read_net_from_onnx(&path),
                Err(source) => return Err(ModelError::Unreadable { path, source }),
            },
            None => dnn::read_net_from_onnx_buffer(&Vector::from_slice(
                BUILT_IN.ok_or(ModelError::NoWeights)?,
            )),
        };
        let net = read.map_err(|e| unusable(e.message))?;
        let mut detector = Self {
            config,
            net,
            anchors: anchors::all(),
        };
        let black = Mat::new_rows_cols_with_default(INPUT_PX, INPUT_PX, CV_8UC3, Scalar::all(0.0));
        black
            .and_then(|image| detector.run_network(&image))
            .map_err(|e| unusable(e.message))?;
        Ok(detector)
    }

    /// Runs the network on one image. Boxes are in shares of its sides.
    fn run_network(&mut self, image: &Mat) -> opencv::Result<Vec<ScoredBox>> {
        let scale = 1.0 / 127.5;
        let middle = Scalar::all(127.5);
        let blob = dnn::blob_from_image(
            image,
            scale,
            Size::new(INPUT_PX, INPUT_PX),
            middle,
            true,
            false,
            CV_32F,
        )?;
        self.net.set_input_def(&blob)?;
        let mut outputs = Vector::<Mat>::new();
        let names: Vector<String> = ["boxes", "scores"].into_iter().collect();
        self.net.forward(&mut outputs, &names)?;
        let box_output = outputs.get(0)?;
        let score_output = outputs.get(1)?;
        let boxes = box_output.data_typed::<f32>()?;
        let scores = score_output.data_typed::<f32>()?;
        let count = self.anchors.len();
        let classes = labels::CLASSES;
        if boxes.len() != count * 4 || scores.len() != count * classes {
            let message = format!("outputs of {} and {} numbers", boxes.len(), scores.len());
            return Err(opencv::Error::new(opencv::core::StsUnmatchedSizes, message));
        }
        let anchors = self
            .anchors
            .iter()
            .zip(boxes.chunks_exact(4))
            .zip(scores.chunks_exact(classes));
        Ok(anchors
            .filter_map(|((anchor, offsets), scores)| {
                let (class, score) = best_class(scores)?;
                let bounds = anchor.decode(offsets);
                (f64::from(score) >= self.config.threshold).then_some(ScoredBox {
                    class,
                    score,
                    bounds,
                })
            })
            .collect())
    }

    fn run_on_image(&mut self, image: &Mat) -> opencv::Result<Vec<ScoredBox>> {
        let width = f64::from(image.cols());
        let height = f64::from(image.rows());
        let mut found = self.run_network(image)?;
        for candidate in &mut found {
            candidate.bounds = placed(&candidate.bounds, 0.0, 0.0, width, height);
        }
        if self.config.tiling {
            for (right, lower) in [(false, false), (true, false), (false, true), (true, true)] {
                let tile_width = (width * TILE_SHARE).floor();
                let tile_height = (height * TILE_SHARE).floor();
                let x = if right { width - tile_width } else { 0.0 };
                let y = if lower { height - tile_height } else { 0.0 };
                let area = Rect::new(x as i32, y as i32, tile_width as i32, tile_height as i32);
                let tile = Mat::roi(image, area)?.try_clone()?;
                let whole = self
                    .run_network(&tile)?
                    .into_iter()
                    .filter(|c| !is_cut(&c.bounds, right, lower));
                found.extend(whole.map(|c| ScoredBox {
                    bounds: placed(&c.bounds, x, y, tile_width, tile_height),
                    ..c
                }));
            }
        }
        Ok(found
            .into_iter()
            .filter_map(|candidate| candidate.inside(width, height))
            .collect())
    }
}

impl Detect for CocoDetector {
    fn detect(&mut self, frame: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
        let failed = |step| move |source| DetectError::OpenCv { step, source };
        let image = bgr(frame)?;
        let candidates = self
            .run_on_image(&image)
            .map_err(failed("the coco network"))?;
        let best = suppress(candidates, self.config.max_overlap)
            .map_err(failed("non-maximum suppression"))?;
        Ok(best
            .iter()
            .filter_map(|found| Some(found.labelled(labels::name(found.class)?.into())))
            .collect())
    }
}

fn best_class(scores: &[f32]) -> Option<(usize, f32)> {
    scores
        .iter()
        .copied()
        .enumerate()
        .skip(1)
        .max_by(|a, b| a.1.total_cmp(&b.1))
}

/// Converts a box from shares of a tile's sides to pixels of the image.
fn placed(b: &BoundingBox, x: f64, y: f64, width: f64, height: f64) -> BoundingBox {
    BoundingBox {
        x_min: x + b.x_min * width,
        y_min: y + b.y_min * height,
        x_max: x + b.x_max * width,
        y_max: y + b.y_max * height,
    }
}

/// True if an inner edge of a tile cuts the box. A neighbouring tile or the image shows all of it.
fn is_cut(b: &BoundingBox, right: bool, lower: bool) -> bool {
    let cut = |low: f64, high: f64, second: bool| {
        if second {
            low < CUT_SHARE
        } else {
            high > 1.0 - CUT_SHARE
        }
    };
    cut(b.x_min, b.x_max, right) || cut(b.y_min, b.y_max, lower)
}

#[cfg(test)]
mod tests;
