//! The network of a model file: its inputs, metadata and outputs, run by `rten`.

use std::fmt;
use std::path::Path;

use rten::{DataType, Dimension, Model, NodeId, Value, ValueType};
use rten_tensor::Tensor;
use rten_tensor::prelude::*;

use super::OnnxError;
use crate::camera::image_size::ImageSize;
use crate::platform::bounded_file;

/// One output of a network.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct NamedTensor {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f32>,
}

impl fmt::Display for NamedTensor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {:?}", self.name, self.shape)
    }
}

/// A network that takes one image.
pub(super) struct Network {
    model: Model,
    image: NodeId,
    shape: Vec<usize>,
    size: ImageSize,
    is_bytes: bool,
    has_channels_last: bool,
    /// Second input of some exports: the size that boxes are scaled to.
    scaled_to: Option<NodeId>,
}

impl Network {
    /// Loads a file. `configured` is the configured size of the input.
    ///
    /// # Errors
    /// Returns an [`OnnxError`] if the file cannot be read or run, if its input is not one image, or
    /// if the input's size differs from the configured size.
    pub(super) fn load(path: &Path, configured: Option<ImageSize>) -> Result<Self, OnnxError> {
        bounded_file::open(path).map_err(|source| OnnxError::Unreadable {
            path: path.to_owned(),
            source,
        })?;
        let model = Model::load_file(path).map_err(|error| OnnxError::NotRunnable {
            path: path.to_owned(),
            reason: error.to_string(),
        })?;
        let refused = || OnnxError::UnknownInputs {
            path: path.to_owned(),
            inputs: inputs(&model),
        };
        let (image, scaled_to) = match model.input_ids() {
            [image] => (*image, None),
            [image, second] if is_size(&model, *second) => (*image, Some(*second)),
            _ => return Err(refused()),
        };
        let kind = model.node_info(image).and_then(|node| node.dtype());
        let is_bytes = kind == Some(ValueType::Tensor(DataType::UInt8));
        if !is_bytes && kind.is_some_and(|kind| kind != ValueType::Tensor(DataType::Float)) {
            return Err(refused());
        }
        let dimensions = model
            .node_info(image)
            .and_then(|node| node.shape())
            .ok_or_else(refused)?;
        let fixed = |dimension: &Dimension| match dimension {
            Dimension::Fixed(length) => u32::try_from(*length).ok(),
            Dimension::Symbolic(_) => None,
        };
        let lengths: Vec<Option<u32>> = dimensions.iter().map(fixed).collect();
        let (has_channels_last, [height, width]) = match lengths[..] {
            [Some(3), height, width] | [Some(1) | None, Some(3), height, width] => {
                (false, [height, width])
            }
            [height, width, Some(3)] | [Some(1) | None, height, width, Some(3)] => {
                (true, [height, width])
            }
            [Some(1) | None, None, height, width] => (false, [height, width]),
            _ => return Err(refused()),
        };
        let size = match (
            width
                .zip(height)
                .map(|(width, height)| ImageSize { width, height }),
            configured,
        ) {
            (Some(taken), Some(configured)) if taken != configured => {
                return Err(OnnxError::OtherSize {
                    path: path.to_owned(),
                    taken,
                    configured,
                });
            }
            (taken, configured) => {
                let said = || {
                    stated_size(&model).ok_or_else(|| OnnxError::AnySize {
                        path: path.to_owned(),
                    })
                };
                taken.or(configured).map_or_else(said, Ok)?
            }
        };
        let height = size.height as usize;
        let width = size.width as usize;
        let image_shape = if has_channels_last {
            [height, width, 3]
        } else {
            [3, height, width]
        };
        let shape = [&vec![1; lengths.len() - 3], &image_shape[..]].concat();
        Ok(Self {
            image,
            shape,
            size,
            is_bytes,
            has_channels_last,
            scaled_to,
            model,
        })
    }

    /// Size of the image that the network takes.
    pub(super) fn input_size(&self) -> ImageSize {
        self.size
    }

    /// True if the network takes the levels of a pixel as bytes.
    pub(super) fn takes_bytes(&self) -> bool {
        self.is_bytes
    }

    /// True if the three numbers of a pixel are adjacent, false if each channel is a plane.
    pub(super) fn has_channels_last(&self) -> bool {
        self.has_channels_last
    }

    /// True if the network has an input for the size to which it scales its boxes.
    pub(super) fn scales_boxes(&self) -> bool {
        self.scaled_to.is_some()
    }

    /// A field that the exporter wrote into the file.
    pub(super) fn metadata(&self, key: &str) -> Option<&str> {
        self.model.metadata().get(key)
    }

    /// Runs the network on one image of [`Self::input_size`]. Networks that scale their boxes
    /// return them in pixels of this image.
    ///
    /// # Errors
    /// Returns the error message of the runtime.
    pub(super) fn run(&self, pixels: Vec<f32>) -> Result<Vec<NamedTensor>, String> {
        let image: Value = if self.is_bytes {
            let bytes: Vec<u8> = pixels.into_iter().map(|value| value as u8).collect();
            Tensor::<u8>::from_data(self.shape.as_slice(), bytes).into()
        } else {
            Tensor::<f32>::from_data(self.shape.as_slice(), pixels).into()
        };
        let mut inputs = vec![(self.image, image.into())];
        if let Some(node) = self.scaled_to {
            let ImageSize { width, height } = self.size;
            inputs.push((
                node,
                Value::from(Tensor::<i32>::from_data(
                    &[1, 2],
                    vec![width as i32, height as i32],
                ))
                .into(),
            ));
        }
        let nodes = self.model.output_ids();
        let values = self
            .model
            .run(inputs, nodes, None)
            .map_err(|error| error.to_string())?;
        let name = |node: &NodeId| {
            self.model
                .node_info(*node)
                .and_then(|info| info.name())
                .unwrap_or_default()
                .to_owned()
        };
        Ok(nodes
            .iter()
            .zip(values)
            .map(|(node, value)| output(name(node), &value))
            .collect())
    }
}

/// The output's numbers; empty for a type that detectors do not use.
fn output(name: String, value: &Value) -> NamedTensor {
    let shape = value.shape().to_vec();
    let values = match value {
        Value::FloatTensor(tensor) => tensor.to_vec(),
        Value::Int32Tensor(tensor) => tensor.iter().map(|value| *value as f32).collect(),
        _ => Vec::new(),
    };
    NamedTensor {
        name,
        shape,
        values,
    }
}

/// The size that the exporter wrote: `imgsz` of Ultralytics, `[height, width]`.
fn stated_size(model: &Model) -> Option<ImageSize> {
    let said: Vec<u32> = serde_json::from_str(model.metadata().get("imgsz")?).ok()?;
    match said[..] {
        [height, width] => Some(ImageSize { width, height }),
        _ => None,
    }
}

/// True for an input of two whole numbers, such as `orig_target_sizes` of RT-DETR.
fn is_size(model: &Model, node: NodeId) -> bool {
    model.node_info(node).is_some_and(|info| {
        info.dtype() == Some(ValueType::Tensor(DataType::Int32))
            && info
                .shape()
                .is_some_and(|shape| matches!(&shape[..], [_, Dimension::Fixed(2)]))
    })
}

/// Names, types and shapes of a model's inputs.
fn inputs(model: &Model) -> String {
    let input = |node: &NodeId| {
        let Some(info) = model.node_info(*node) else {
            return "?".to_owned();
        };
        let kind = info
            .dtype()
            .map_or_else(|| "?".to_owned(), |kind| kind.to_string());
        let length = |dimension: &Dimension| match dimension {
            Dimension::Fixed(length) => length.to_string(),
            Dimension::Symbolic(name) => name.clone(),
        };
        let shape = info
            .shape()
            .map(|shape| shape.iter().map(length).collect::<Vec<_>>().join(", "));
        format!(
            "{} {kind} [{}]",
            info.name().unwrap_or("?"),
            shape.unwrap_or_else(|| "?".to_owned())
        )
    };
    model
        .input_ids()
        .iter()
        .map(input)
        .collect::<Vec<_>>()
        .join("; ")
}
