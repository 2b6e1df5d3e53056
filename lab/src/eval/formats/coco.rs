//! COCO (Lin et al., arXiv 1405.0312): a dataset with annotations, or the results of a detector.
//!
//! A dataset has `images`, `categories` and `annotations`; results are a list of entries in place
//! of the annotations, with scores, and their categories are the truth's or COCO's own. Crowds are left out. An
//! identity is a `track_id` or `instance_id`, as in extensions for videos.

use anyhow::{Context, bail};
use ecod::model::detection::BoundingBox;
use ecod::model::names::{Label, MAX_NAME_BYTES, is_label};
use ecod_actors::camera::detect::coco::labels;
use hashbrown::HashMap;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::{Categories, FilePlace, ParsedFile, ParsedObject, frame_number};

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

/// Reads a dataset, or results whose categories are `categories` or else COCO's. Entries without a
/// usable object are skipped, unless all are.
pub(super) fn frames(
    text: &str,
    has_camera: bool,
    categories: Option<&Categories>,
) -> anyhow::Result<ParsedFile> {
    if !has_camera {
        bail!("boxes in an image have no place on the ground: give their camera with --config");
    }
    let mut file = ParsedFile::default();
    let of_dataset;
    let list = if is_results(text) { "" } else { "annotations" };
    let annotations: Vec<Annotation>;
    let categories = if is_results(text) {
        annotations = parsed(text)?;
        categories
    } else {
        let dataset: Dataset = parsed(text)?;
        for (place, image) in dataset.images.iter().enumerate() {
            let frame = frame_number(image.id)
                .with_context(|| format!("images[{place}].id: {} is out of bounds", image.id))?;
            file.frames.entry(frame).or_default();
        }
        of_dataset = by_number(dataset.categories)?;
        annotations = dataset.annotations;
        Some(&of_dataset)
    };
    let mut tracks = HashMap::new();
    let mut objects = 0;
    for (place, annotation) in annotations
        .iter()
        .enumerate()
        .filter(|(_, annotation)| annotation.iscrowd == 0)
    {
        let at = |field: &str, fault: String| format!("{list}[{place}].{field}: {fault}");
        let (frame, object) = match object(place, annotation, categories) {
            Ok(read) => read,
            Err((field, fault)) => {
                file.skipped.add(at(field, fault));
                continue;
            }
        };
        if let Some(id) = object.id
            && let Some(first) = tracks.insert((frame, id), place)
        {
            bail!(at(
                "track_id",
                format!("{id} is in image {frame} already, in {list}[{first}]")
            ));
        }
        file.frames.entry(frame).or_default().push(object);
        objects += 1;
    }
    if objects == 0 && file.skipped.count > 0 {
        bail!(file.skipped.first);
    }
    Ok(file)
}

/// The categories of a dataset; results state no names.
pub(super) fn categories(text: &str) -> anyhow::Result<Categories> {
    #[derive(Deserialize)]
    struct CategoriesOnly {
        categories: Vec<Category>,
    }
    if is_results(text) {
        return Ok(Categories::new());
    }
    by_number(parsed::<CategoriesOnly>(text)?.categories)
}

fn is_results(text: &str) -> bool {
    text.trim_ascii_start().starts_with('[')
}

fn by_number(categories: Vec<Category>) -> anyhow::Result<Categories> {
    let mut names = Categories::new();
    for (place, Category { id, name }) in categories.into_iter().enumerate() {
        if !is_label(&name) {
            bail!("categories[{place}].name: must be a text of 1 to {MAX_NAME_BYTES} bytes");
        }
        if names.insert(id, name).is_some() {
            bail!("categories[{place}].id: {id} is the id of another category, too");
        }
    }
    Ok(names)
}

/// An annotation's frame and object, or the field that is not usable and its fault.
fn object(
    place: usize,
    annotation: &Annotation,
    categories: Option<&Categories>,
) -> Result<(u64, ParsedObject), (&'static str, String)> {
    let Annotation {
        image_id,
        category_id,
        bbox: [x_min, y_min, width, height],
        score,
        track_id,
        ..
    } = *annotation;
    let frame = frame_number(image_id)
        .ok_or_else(|| ("image_id", format!("{image_id} is out of bounds")))?;
    let named = match categories {
        Some(categories) => categories.get(&category_id).cloned(),
        None => usize::try_from(category_id)
            .ok()
            .and_then(labels::name)
            .map(Label::new_static),
    };
    let unknown = || ("category_id", format!("{category_id} is no known category"));
    let label = named.ok_or_else(unknown)?;
    let image = BoundingBox {
        x_min,
        y_min,
        x_max: x_min + width,
        y_max: y_min + height,
    };
    if !image.is_valid() {
        return Err(("bbox", format!("{:?} is no box", annotation.bbox)));
    }
    let object = ParsedObject {
        entry: place,
        // A `track_id` of −1 marks a box without an identity.
        id: track_id.filter(|id| *id >= 0),
        label,
        score,
        place: FilePlace::Image(image),
    };
    Ok((frame, object))
}

/// Names the path of the unreadable part.
fn parsed<T: DeserializeOwned>(text: &str) -> anyhow::Result<T> {
    Ok(serde_path_to_error::deserialize(
        &mut serde_json::Deserializer::from_str(text),
    )?)
}
