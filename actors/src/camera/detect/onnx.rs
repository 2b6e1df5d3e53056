//! Detector that runs an exported model: YOLO, SSD and DETR families, in ONNX.
//!
//! The file contains the input's size and often the labels. One run on a plain image shows the
//! shapes of the outputs, which identify the family.

mod decode;
mod family;
mod labels;
mod letterbox;
mod literal;
mod network;

use std::collections::BTreeMap;
use std::path::PathBuf;

use ecod::config::{ConfigError, check_range};
use ecod::model::detection::Detection;
use ecod::model::names::Label;
use schemars::JsonSchema;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

pub use self::family::{Family, Normalization};

use self::family::{Clues, Head, NoHead};
use self::labels::StatedNames;
use self::letterbox::Letterbox;
use self::network::{NamedTensor, Network};
use super::candidates::{ScoredBox, suppress};
use super::{Detect, DetectError, bgr};
use crate::camera::frame::CameraFrame;
use crate::camera::image_size::ImageSize;
use crate::platform::bounded_file;

/// Configuration of the detector of exported models.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OnnxConfig {
    /// The model's ONNX file.
    pub model: PathBuf,
    /// File with the label of each class on its own line. Default: not set; the labels are taken
    /// from the model's metadata, or are COCO's.
    #[serde(default)]
    pub labels: Option<PathBuf>,
    /// Family of the model. Default: not set; detected from its outputs.
    #[serde(default)]
    pub family: Option<Family>,
    /// Width and height of the network's input in pixels. Default: not set; taken from the model.
    #[serde(default, deserialize_with = "two_sides")]
    pub input_px: Option<[u16; 2]>,
    /// Range of pixel values. Default: not set; the family's values.
    #[serde(default)]
    pub normalization: Option<Normalization>,
    /// Number of the first class in the outputs: 0, or 1 where 0 is the background. Default: not
    /// set; the family's number.
    #[serde(default)]
    pub first_class: Option<u8>,
    /// Minimum confidence of a detection. Default 0.4.
    #[serde(default = "default_threshold")]
    pub threshold: f64,
    /// Minimum confidence by label, in place of `threshold`.
    #[serde(default)]
    pub thresholds: BTreeMap<Label, f64>,
    /// Intersection over union above which two boxes of one class are merged. Default 0.5. Not for
    /// models that suppress such boxes themselves.
    #[serde(default = "default_max_overlap")]
    pub max_overlap: f64,
}

fn default_threshold() -> f64 {
    0.4
}

/// Reads two numbers; TOML's own reader would drop a third.
fn two_sides<'de, D: Deserializer<'de>>(source: D) -> Result<Option<[u16; 2]>, D::Error> {
    let Some(sides) = Option::<Vec<u16>>::deserialize(source)? else {
        return Ok(None);
    };
    let sides = <[u16; 2]>::try_from(sides).map_err(|sides| {
        D::Error::invalid_length(sides.len(), &"width and height, such as [640, 480]")
    })?;
    Ok(Some(sides))
}

fn default_max_overlap() -> f64 {
    0.5
}

impl OnnxConfig {
    /// A model with the defaults of the other keys.
    pub fn of(model: PathBuf) -> Self {
        Self {
            model,
            labels: None,
            family: None,
            input_px: None,
            normalization: None,
            first_class: None,
            threshold: default_threshold(),
            thresholds: BTreeMap::new(),
            max_overlap: default_max_overlap(),
        }
    }

    /// Checks every value; files are checked when they are loaded.
    ///
    /// # Errors
    /// Returns a [`ConfigError`] with the first key out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        for side in self.input_px.into_iter().flatten() {
            check_range("input_px", f64::from(side), 32.0, 4096.0)?;
        }
        if let Some(first) = self.first_class {
            check_range("first_class", f64::from(first), 0.0, 1.0)?;
        }
        check_range("threshold", self.threshold, 0.01, 1.0)?;
        for (label, threshold) in &self.thresholds {
            check_range(&format!("thresholds.{label}"), *threshold, 0.01, 1.0)?;
        }
        check_range("max_overlap", self.max_overlap, 0.0, 1.0)
    }
}

/// Error of loading a model.
#[derive(Debug, thiserror::Error)]
pub enum OnnxError {
    /// A file cannot be read.
    #[error("cannot read {path:?}")]
    Unreadable {
        /// The model or the labels.
        path: PathBuf,
        /// The operating system's error.
        #[source]
        source: std::io::Error,
    },
    /// The runtime refuses the file.
    #[error(
        "model {path:?} cannot be run: {reason}; export it to onnx with 32-bit weights and standard operators"
    )]
    NotRunnable {
        /// Path of the model file.
        path: PathBuf,
        /// Error message of the runtime.
        reason: String,
    },
    /// The network does not take one image.
    #[error(
        "model {path:?} takes {inputs}; export it for one image, such as images tensor(f32) [1, 3, 640, 640]"
    )]
    UnknownInputs {
        /// Path of the model file.
        path: PathBuf,
        /// Names, types and shapes.
        inputs: String,
    },
    /// The file does not contain the size of the image.
    #[error(
        "model {path:?} takes images of any size: set `input_px` to the size of its training, such as [640, 640]"
    )]
    AnySize {
        /// Path of the model file.
        path: PathBuf,
    },
    /// The network takes another size than the configured one.
    #[error(
        "model {path:?} takes images of {taken}, not {configured}: remove `input_px` or export it for that size"
    )]
    OtherSize {
        /// Path of the model file.
        path: PathBuf,
        /// Size of the network.
        taken: ImageSize,
        /// Size that `input_px` configures.
        configured: ImageSize,
    },
    /// The network fails at the configured size.
    #[error(
        "model {path:?} fails with an image of {size}: {reason}; try sides that are multiples of 32 in `input_px`"
    )]
    RefusedSize {
        /// Path of the model file.
        path: PathBuf,
        /// Size of the image.
        size: ImageSize,
        /// Error message of the runtime.
        reason: String,
    },
    /// The outputs fit no family, or not the configured one.
    #[error(
        "model {path:?} has outputs {outputs} for an image of {size}, which do not match {family}; \
         docs/cameras.md lists the shapes"
    )]
    UnknownOutputs {
        /// Path of the model file.
        path: PathBuf,
        /// Names and shapes of the outputs, as text.
        outputs: String,
        /// Size of the input.
        size: ImageSize,
        /// The configured family, or all.
        family: String,
    },
    /// The model is not an object detector.
    #[error(
        "model {path:?} is a model for {task}, but a node needs boxes parallel to the image's edges: export a model for detection"
    )]
    OtherTask {
        /// Path of the model file.
        path: PathBuf,
        /// The task in words.
        task: String,
    },
    /// The numbers of the classes are unknown.
    #[error(
        "model {path:?} lists numbers of classes in {outputs}: set `first_class` to 0 or, if 0 is the background, to 1"
    )]
    UnknownFirstClass {
        /// Path of the model file.
        path: PathBuf,
        /// Names and shapes of the outputs, as text.
        outputs: String,
    },
    /// The names in the metadata cannot be read.
    #[error(
        "the `names` in the metadata of model {path:?} cannot be read: {fault}; set `labels` to a file with one on each line"
    )]
    BadNames {
        /// Path of the model file.
        path: PathBuf,
        /// Reason why the names cannot be read.
        fault: String,
    },
    /// The names in the metadata have other numbers than the outputs.
    #[error(
        "the `names` in the metadata of model {path:?} begin with class {stated}, but classes of {family} begin with {first}: set `first_class`, or `labels` to a file with one on each line"
    )]
    OtherFirstClass {
        /// Path of the model file.
        path: PathBuf,
        /// Number of the first name.
        stated: usize,
        /// The family in use.
        family: String,
        /// Number of its first class.
        first: usize,
    },
    /// The number of names in the metadata differs from the number of classes in the outputs.
    #[error(
        "model {path:?} has {names} names in its metadata, but {outputs} are for {classes} classes: export a model for detection, without other values beside boxes and scores"
    )]
    NameCount {
        /// Path of the model file.
        path: PathBuf,
        /// Number of names in the metadata.
        names: usize,
        /// Names and shapes of the outputs, as text.
        outputs: String,
        /// Number of classes in the outputs.
        classes: usize,
    },
    /// The network takes bytes, so that no other range of values is possible.
    #[error("model {path:?} takes bytes, 0 to 255: remove `normalization`")]
    TakesBytes {
        /// Path of the model file.
        path: PathBuf,
    },
    /// A YOLOX model with other outputs than its family's.
    #[error(
        "model {path:?} gives boxes of yolox in pixels: export it without `--decode_in_inference`"
    )]
    InPixels {
        /// Path of the model file.
        path: PathBuf,
    },
    /// The number of labels differs from the number of classes.
    #[error(
        "{labels} labels in {path:?}, but the model has {classes} classes: list one on each line, in its order"
    )]
    LabelCount {
        /// The file of the labels.
        path: PathBuf,
        /// Number of labels in the file.
        labels: usize,
        /// Number of classes of the model.
        classes: usize,
    },
    /// A name cannot be a label.
    #[error("label {label:?} in {path:?} must have 1 to 64 bytes without control characters")]
    BadLabel {
        /// The file of the labels or of the model.
        path: PathBuf,
        /// The name that cannot be a label.
        label: String,
    },
    /// No labels are available.
    #[error(
        "model {path:?} has {classes} classes without names: set `labels` to a file with one on each line"
    )]
    NoLabels {
        /// Path of the model file.
        path: PathBuf,
        /// Number of classes of the model.
        classes: usize,
    },
    /// A threshold is for a label that the model does not have.
    #[error("`thresholds` names {label:?}, but the labels of model {path:?} are {labels}")]
    UnknownLabel {
        /// Path of the model file.
        path: PathBuf,
        /// Label that `thresholds` names.
        label: Label,
        /// All labels of the model, as text.
        labels: String,
    },
}

/// A class of a model.
#[derive(Debug, Clone, PartialEq)]
struct Class {
    label: Label,
    threshold: f32,
}

/// Detector of the objects that a model was trained for.
pub struct OnnxDetector {
    config: OnnxConfig,
    network: Network,
    head: Head,
    /// True if class 0 is the background and the network scores it like other classes. Boxes of the
    /// background are then ignored and are no error.
    finds_background: bool,
    /// By the network's numbers; `None` for numbers without a class.
    classes: Vec<Option<Class>>,
}

impl OnnxDetector {
    /// Loads the model and runs it once to see its outputs.
    ///
    /// # Errors
    /// Returns an [`OnnxError`] with the file and the remedy.
    pub fn new(config: OnnxConfig) -> Result<Self, OnnxError> {
        let path = &config.model;
        let configured = config.input_px.map(|[width, height]| ImageSize {
            width: width.into(),
            height: height.into(),
        });
        let network = Network::load(path, configured)?;
        if let Some(task) = network.metadata("task").and_then(other_task) {
            return Err(OnnxError::OtherTask {
                path: path.clone(),
                task,
            });
        }
        if network.takes_bytes()
            && config
                .normalization
                .is_some_and(|n| n != Normalization::Raw)
        {
            return Err(OnnxError::TakesBytes { path: path.clone() });
        }
        let size = network.input_size();
        let outputs = network
            .run(vec![0.0; 3 * size.width as usize * size.height as usize])
            .map_err(|reason| match configured {
                Some(size) => OnnxError::RefusedSize {
                    path: path.clone(),
                    size,
                    reason,
                },
                None => OnnxError::NotRunnable {
                    path: path.clone(),
                    reason,
                },
            })?;
        let (names, names_path) = names(&config, &network)?;
        let is_of_model = config.labels.is_none();
        let description = ["description", "head"]
            .map(|key| network.metadata(key).unwrap_or_default())
            .join(" ");
        let background_first = names.as_ref().is_some_and(|stated| stated.has_background);
        let clues = Clues {
            configured: config.family,
            first_class: config.first_class.or(background_first.then_some(1)),
            description: &description,
            input: size,
            scales_boxes: network.scales_boxes(),
        };
        let head = Head::find(&clues, &outputs).map_err(|reason| match reason {
            NoHead::UnknownOutputs => unknown_outputs(&config, size, &outputs),
            NoHead::UnknownFirstClass => OnnxError::UnknownFirstClass {
                path: path.clone(),
                outputs: listed(&outputs),
            },
        })?;
        if head.is_in_pixels(&outputs, size) {
            return Err(OnnxError::InPixels { path: path.clone() });
        }
        if let Some(stated) = names.as_ref().and_then(|stated| stated.first)
            && stated != head.first_class
        {
            return Err(OnnxError::OtherFirstClass {
                path: path.clone(),
                stated,
                family: head.family.to_string(),
                first: head.first_class,
            });
        }
        let finds_background = background_first || !head.lists_numbers();
        let names = names.map(|stated| stated.names);
        let labels = head
            .classes(&outputs)
            .labels(names.as_deref())
            .map_err(|classes| {
                let classes = classes.unwrap_or_default();
                match &names {
                    Some(names) if is_of_model => OnnxError::NameCount {
                        path: names_path,
                        names: names.len(),
                        outputs: listed(&outputs),
                        classes,
                    },
                    Some(names) => OnnxError::LabelCount {
                        path: names_path,
                        labels: names.len(),
                        classes,
                    },
                    None => OnnxError::NoLabels {
                        path: path.clone(),
                        classes,
                    },
                }
            })?;
        let classes = classes(&config, labels)?;
        tracing::info!(model = %path.display(), family = %head.family, input = %size, "model loaded");
        Ok(Self {
            head,
            finds_background,
            classes,
            network,
            config,
        })
    }
}

impl Detect for OnnxDetector {
    fn detect(&mut self, frame: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
        let image = bgr(frame)?;
        let failed = |step| move |source| DetectError::OpenCv { step, source };
        let size = ImageSize::of(&image);
        let input = self.network.input_size();
        let letterbox = Letterbox::new(self.head.fit(), size, input);
        let factors = self
            .config
            .normalization
            .unwrap_or_else(|| {
                if self.network.takes_bytes() {
                    Normalization::Raw
                } else {
                    self.head.normalization()
                }
            })
            .factors();
        let is_bgr = self.head.is_bgr();
        let convert = |[blue, green, red]: [u8; 3]| {
            let channels = if is_bgr {
                [blue, green, red]
            } else {
                [red, green, blue]
            };
            std::array::from_fn(|c| f32::from(channels[c]) * factors[c].0 + factors[c].1)
        };
        let pixels = letterbox
            .fill(&image, self.network.has_channels_last(), convert)
            .map_err(failed("fitting a frame into the network"))?;
        let outputs = self.network.run(pixels).map_err(DetectError::Model)?;
        let least = self
            .classes
            .iter()
            .flatten()
            .map(|class| class.threshold)
            .fold(1.0, f32::min);
        let mut found = Vec::new();
        for candidate in self.head.decode(&outputs, input, least) {
            let contradiction = self.head.contradiction(&candidate, input);
            let is_background = candidate.class < self.head.first_class;
            let is_contradictory = is_background && !self.finds_background;
            let zero = || "a found class is 0, the background".to_owned();
            if let Some(what) = contradiction.or_else(|| is_contradictory.then(zero)) {
                return Err(DetectError::Contradiction {
                    family: self.head.family.to_string(),
                    what,
                });
            }
            let class = self
                .classes
                .get(candidate.class)
                .ok_or(DetectError::UnknownClass {
                    class: candidate.class,
                    labels: self.classes.iter().flatten().count(),
                })?;
            if class
                .as_ref()
                .is_some_and(|class| candidate.score >= class.threshold)
            {
                let bounds = letterbox.to_image(&candidate.bounds);
                found.extend(
                    ScoredBox {
                        bounds,
                        ..candidate
                    }
                    .inside(size.width.into(), size.height.into()),
                );
            }
        }
        if self.head.needs_suppression() {
            found = suppress(found, self.config.max_overlap)
                .map_err(failed("non-maximum suppression"))?;
        }
        let labelled = |found: &ScoredBox| {
            Some(found.labelled(self.classes[found.class].as_ref()?.label.clone()))
        };
        Ok(found.iter().filter_map(labelled).collect())
    }
}

/// Describes the task of an Ultralytics model; `None` for box detection.
fn other_task(task: &str) -> Option<String> {
    match task {
        "detect" => None,
        "obb" => Some("oriented boxes".into()),
        "segment" => Some("masks".into()),
        "pose" => Some("key points".into()),
        "classify" => Some("whole images".into()),
        other => Some(format!("the task {other:?}")),
    }
}

/// Names of the classes, if available, and their file.
fn names(
    config: &OnnxConfig,
    network: &Network,
) -> Result<(Option<StatedNames>, PathBuf), OnnxError> {
    let (names, path) = match &config.labels {
        Some(path) => {
            let text = bounded_file::read_text(path).map_err(|source| OnnxError::Unreadable {
                path: path.clone(),
                source,
            })?;
            (Some(labels::read(&text)), path)
        }
        None => {
            let names = network
                .metadata("names")
                .map(labels::parse)
                .transpose()
                .map_err(|fault| OnnxError::BadNames {
                    path: config.model.clone(),
                    fault,
                })?;
            (names, &config.model)
        }
    };
    let path = path.clone();
    let unusable = names
        .as_ref()
        .and_then(|stated| labels::first_unusable(&stated.names));
    match unusable {
        Some(label) => Err(OnnxError::BadLabel {
            label: label.to_owned(),
            path,
        }),
        None => Ok((names, path)),
    }
}

fn listed(outputs: &[NamedTensor]) -> String {
    outputs
        .iter()
        .map(NamedTensor::to_string)
        .collect::<Vec<_>>()
        .join("; ")
}

fn unknown_outputs(config: &OnnxConfig, size: ImageSize, outputs: &[NamedTensor]) -> OnnxError {
    let outputs = listed(outputs);
    let family = config.family.map_or_else(
        || "any known family".to_owned(),
        |family| family.to_string(),
    );
    OnnxError::UnknownOutputs {
        path: config.model.clone(),
        outputs,
        size,
        family,
    }
}

fn classes(
    config: &OnnxConfig,
    labels: Vec<Option<Label>>,
) -> Result<Vec<Option<Class>>, OnnxError> {
    let is_known = |label: &Label| labels.iter().flatten().any(|known| known == label);
    if let Some(label) = config.thresholds.keys().find(|label| !is_known(label)) {
        let labels = labels
            .iter()
            .flatten()
            .map(Label::as_str)
            .collect::<Vec<_>>()
            .join(", ");
        return Err(OnnxError::UnknownLabel {
            path: config.model.clone(),
            label: label.clone(),
            labels,
        });
    }
    let threshold = |label: &Label| {
        config
            .thresholds
            .get(label)
            .copied()
            .unwrap_or(config.threshold) as f32
    };
    let class = |label: Label| Class {
        threshold: threshold(&label),
        label,
    };
    Ok(labels.into_iter().map(|label| label.map(class)).collect())
}

#[cfg(test)]
mod tests;
