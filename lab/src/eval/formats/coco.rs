//! COCO (Lin et al., arXiv 1405.0312): a dataset with annotations, or the results of a detector.
//!
//! A dataset has `images`, `categories` and `annotations`; results are a list of entries in place
//! of the annotations, with scores, and their categories are COCO's own. Crowds are left out. An
//! identity is a `track_id` or `instance_id`, as in extensions for videos.

use anyhow::{Context, bail};
use ecod::model::detection::BoundingBox;
use ecod::model::names::{Label, MAX_NAME_BYTES, is_label};
use ecod_actors::camera::detect::coco::labels;
use hashbrown::HashMap;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::{FilePlace, ParsedFrames, ParsedObject, frame_number};

#[derive(Deserialize)]
struct Dataset {
    images: Vec<Image>,
    categories: Vec<Category>,
    annotations: Vec<Annotation>,
}

#[derive(Deserialize)]
struct Image {
    id: i64,
}

#[derive(Deserialize)]
struct Category {
    id: i64,
    name: Label,
}

#[derive(Deserialize)]
struct Annotation {
    image_id: i64,
    category_id: i64,
    /// Left, top, width and height in pixels.
    bbox: [f64; 4],
    #[serde(default = "certain")]
    score: f64,
    #[serde(default, alias = "instance_id")]
    track_id: Option<i64>,
    #[serde(default)]
    iscrowd: u8,
}

fn certain() -> f64 {
    1.0
}

pub(super) fn frames(text: &str, has_camera: bool) -> anyhow::Result<ParsedFrames> {
    if !has_camera {
        bail!("boxes in an image have no place on the ground: give their camera with --config");
    }
    let mut frames = ParsedFrames::new();
    let (list, annotations, categories): (_, Vec<Annotation>, Option<HashMap<_, _>>) =
        if text.trim_ascii_start().starts_with('[') {
            ("", parsed(text)?, None)
        } else {
            let Dataset {
                images,
                categories,
                annotations,
            } = parsed(text)?;
            for (place, image) in images.iter().enumerate() {
                let frame = frame_number(image.id);
                let frame = frame.with_context(|| {
                    format!("images[{place}].id: {} is out of bounds", image.id)
                })?;
                frames.entry(frame).or_default();
            }
            if let Some(place) = categories
                .iter()
                .position(|category| !is_label(&category.name))
            {
                bail!("categories[{place}].name: must be a text of 1 to {MAX_NAME_BYTES} bytes");
            }
            (
                "annotations",
                annotations,
                Some(categories.into_iter().map(|c| (c.id, c.name)).collect()),
            )
        };
    for (place, annotation) in annotations
        .iter()
        .enumerate()
        .filter(|(_, annotation)| annotation.iscrowd == 0)
    {
        let at = |field: &str, fault: String| format!("{list}[{place}].{field}: {fault}");
        let Annotation {
            image_id,
            category_id,
            bbox: [x_min, y_min, width, height],
            score,
            track_id,
            ..
        } = *annotation;
        let frame = frame_number(image_id)
            .with_context(|| at("image_id", format!("{image_id} is out of bounds")))?;
        let label = match &categories {
            Some(categories) => categories.get(&category_id).cloned(),
            None => usize::try_from(category_id)
                .ok()
                .and_then(labels::name)
                .map(Label::new_static),
        };
        let label = label
            .with_context(|| at("category_id", format!("{category_id} is no known category")))?;
        let image = BoundingBox {
            x_min,
            y_min,
            x_max: x_min + width,
            y_max: y_min + height,
        };
        if !image.is_valid() {
            bail!(at("bbox", format!("{:?} is no box", annotation.bbox)));
        }
        let object = ParsedObject {
            id: track_id,
            label,
            score,
            place: FilePlace::Image(image),
        };
        frames.entry(frame).or_default().push(object);
    }
    Ok(frames)
}

/// Names the path of the unreadable part.
fn parsed<T: DeserializeOwned>(text: &str) -> anyhow::Result<T> {
    Ok(serde_path_to_error::deserialize(
        &mut serde_json::Deserializer::from_str(text),
    )?)
}
