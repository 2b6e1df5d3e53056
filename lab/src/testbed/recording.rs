//! The intersection of the paper's VOTE testbed: the detections of the vehicles, frame by frame,
//! and the true objects.
//!
//! Files are in inches, degrees and shares of the image, and converted while being read.

use std::collections::{BTreeMap, HashSet};

use ecod::model::detection::{BoundingBox, Detection};
use ecod::model::names::{Label, LandmarkId};
use ecod::perception::camera::Intrinsics;
use ecod::perception::landmark::{Landmark, Synonym};
use nalgebra::Point2;
use serde::Deserialize;
use serde_json::Value;

use super::Cav;
use super::file::{CameraFields, CavFields, KeyPath, TestbedError, UnitFields};

/// The order of a box's edges in a file.
const BOX_ORDER: &str = "y_min, x_min, y_max, x_max";
/// Frames and boxes that a file may have, to bound memory.
const MAX_BOXES: usize = 1_000_000;

/// The true objects, and the detections of the vehicles that watch them.
#[derive(Debug, Clone, PartialEq)]
pub struct IntersectionRecording {
    /// The camera of every vehicle.
    pub intrinsics: Intrinsics,
    /// Objects and their places.
    pub objects: Vec<KnownObject>,
    /// The vehicles that watch the objects.
    pub cavs: Vec<Cav>,
    /// The frames of each vehicle, in the order of `cavs`; some may have fewer.
    pub frames: Vec<Vec<Vec<Detection>>>,
}

/// An object with its place and labels.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownObject {
    /// Name of its location.
    pub id: LandmarkId,
    /// Where it stands, in metres.
    pub position: Point2<f64>,
    /// Labels that count as right; at least one. The other labels count as the last one.
    pub accepted: Vec<Label>,
}

impl IntersectionRecording {
    /// True if a JSON file is a recording, not a list of scenes.
    pub fn is_recording(file: &Value) -> bool {
        file.get("frames").is_some() && file.get("objects").is_some()
    }

    /// Reads a recording.
    ///
    /// # Errors
    /// Returns a [`TestbedError`] if the text is not JSON; otherwise it names the key and the fault
    /// of its value.
    pub fn from_json(text: &str) -> Result<Self, TestbedError> {
        let place = KeyPath("recording".into());
        let value: Value = serde_json::from_str(text).map_err(TestbedError::NotJson)?;
        place.parse::<RecordingFields>(value)?.check(&place)
    }

    /// Frames of the vehicle that has most.
    pub fn frame_count(&self) -> usize {
        self.frames.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// The objects as landmarks of VOTE, with accepted labels as synonyms of the last one.
    pub fn landmarks(&self) -> Vec<Landmark> {
        self.objects.iter().map(KnownObject::landmark).collect()
    }
}

impl KnownObject {
    /// The label that verdicts use for this object when they are right.
    pub fn label(&self) -> Option<&Label> {
        self.accepted.last()
    }

    fn landmark(&self) -> Landmark {
        let others = &self.accepted[..self.accepted.len().saturating_sub(1)];
        let synonym = |from: &Label| {
            self.label().map(|label| Synonym {
                from: from.clone(),
                label: label.clone(),
            })
        };
        Landmark {
            id: self.id.clone(),
            position: self.position,
            facing_rad: None,
            vacancy: None,
            synonyms: others.iter().filter_map(synonym).collect(),
        }
    }
}

#[derive(Deserialize)]
struct RecordingFields {
    #[serde(default)]
    units: UnitFields,
    camera: CameraFields,
    objects: Vec<RecordedFields>,
    cavs: Vec<CavFields>,
    #[serde(default)]
    bounding_box_order: Option<String>,
    frames: BTreeMap<String, Vec<Vec<DetectionFields>>>,
}

#[derive(Deserialize)]
struct RecordedFields {
    id: String,
    position: [f64; 2],
    accepted_labels: Vec<String>,
}

#[derive(Deserialize)]
struct DetectionFields {
    bounding_box: [f64; 4],
    label: String,
    confidence: f64,
}

impl RecordingFields {
    fn check(mut self, place: &KeyPath) -> Result<IntersectionRecording, TestbedError> {
        self.units.check(place)?;
        if let Some(order) = self
            .bounding_box_order
            .filter(|order| !order.starts_with(BOX_ORDER))
        {
            return Err(place.error(
                "bounding_box_order",
                format_args!("is {order:?}, must be {BOX_ORDER:?}"),
            ));
        }
        let intrinsics = self.camera.check(place)?.intrinsics;
        let mut ids = HashSet::new();
        let mut objects = Vec::with_capacity(self.objects.len());
        for (index, fields) in self.objects.into_iter().enumerate() {
            let object = fields.check(index, place)?;
            if !ids.insert(object.id.clone()) {
                return Err(place.error(
                    format!("objects[{index}].id"),
                    format_args!("is {:?}, used before", object.id),
                ));
            }
            objects.push(object);
        }
        let boxes: usize = self
            .frames
            .values()
            .flatten()
            .map(|frame| 1 + frame.len())
            .sum();
        if boxes > MAX_BOXES {
            return Err(place.error(
                "frames",
                format_args!("holds more than {MAX_BOXES} frames and boxes"),
            ));
        }
        let mut cavs: Vec<Cav> = Vec::with_capacity(self.cavs.len());
        let mut frames = Vec::with_capacity(self.cavs.len());
        for (index, fields) in self.cavs.into_iter().enumerate() {
            let cav = fields.check(index, place)?;
            if cavs.iter().any(|other| other.name == cav.name) {
                return Err(place.error(
                    format!("cavs[{index}].id"),
                    format_args!("is {}, used before", cav.name),
                ));
            }
            let recorded = self.frames.remove(cav.name.as_str()).unwrap_or_default();
            frames.push(detections(recorded, &cav, &intrinsics, place)?);
            cavs.push(cav);
        }
        match self.frames.keys().next() {
            Some(stranger) => {
                Err(place.error(format!("frames.{stranger}"), "is of no vehicle in `cavs`"))
            }
            None => Ok(IntersectionRecording {
                intrinsics,
                objects,
                cavs,
                frames,
            }),
        }
    }
}

impl RecordedFields {
    fn check(self, index: usize, place: &KeyPath) -> Result<KnownObject, TestbedError> {
        let key = |name: &str| format!("objects[{index}].{name}");
        if self.accepted_labels.is_empty() {
            return Err(place.error(key("accepted_labels"), "is empty"));
        }
        let labels = self
            .accepted_labels
            .into_iter()
            .map(|label| place.label(&key("accepted_labels"), label));
        Ok(KnownObject {
            id: place.label(&key("id"), self.id)?,
            position: place.point(&key("position"), self.position)?,
            accepted: labels.collect::<Result<_, _>>()?,
        })
    }
}

fn detections(
    recorded: Vec<Vec<DetectionFields>>,
    cav: &Cav,
    camera: &Intrinsics,
    place: &KeyPath,
) -> Result<Vec<Vec<Detection>>, TestbedError> {
    let mut frames = Vec::with_capacity(recorded.len());
    for (number, boxes) in recorded.into_iter().enumerate() {
        let mut frame = Vec::with_capacity(boxes.len());
        for (index, fields) in boxes.into_iter().enumerate() {
            let key = format!("frames.{}[{number}][{index}]", cav.name);
            frame.push(fields.check(&key, camera, place)?);
        }
        frames.push(frame);
    }
    Ok(frames)
}

impl DetectionFields {
    fn check(
        self,
        key: &str,
        camera: &Intrinsics,
        place: &KeyPath,
    ) -> Result<Detection, TestbedError> {
        let [y_min, x_min, y_max, x_max] = self.bounding_box;
        let width = f64::from(camera.width);
        let height = f64::from(camera.height);
        let bounding_box = BoundingBox {
            x_min: x_min * width,
            y_min: y_min * height,
            x_max: x_max * width,
            y_max: y_max * height,
        };
        if !bounding_box.is_valid() {
            let found = self.bounding_box;
            return Err(place.error(
                format!("{key}.bounding_box"),
                format_args!("is {found:?} and has no area"),
            ));
        }
        Ok(Detection {
            label: place.label(&format!("{key}.label"), self.label)?,
            confidence: place.number(
                &format!("{key}.confidence"),
                self.confidence,
                -f64::MIN_POSITIVE,
                1.0,
            )?,
            bounding_box,
            corners: None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = include_str!("../../../examples/testbed/vote_recording.json");

    #[test]
    fn recording_is_in_metres_and_pixels() {
        let recording = IntersectionRecording::from_json(TEXT).unwrap();
        assert_eq!(
            (
                recording.objects.len(),
                recording.cavs.len(),
                recording.frame_count()
            ),
            (3, 4, 3)
        );
        let landmarks = recording.landmarks();
        assert!((landmarks[0].position - Point2::new(0.5334, 0.889)).norm() < 1e-12);
        assert_eq!(
            (
                landmarks[0].synonyms[0].from.as_str(),
                landmarks[0].synonyms[0].label.as_str()
            ),
            ("vase", "sports ball")
        );
        let first = &recording.frames[0][0][0];
        assert_eq!(first.label, "sports ball");
        assert!((first.bounding_box.x_min - 0.5191 * 640.0).abs() < 1e-9);
        assert!((first.bounding_box.y_max - 0.7202 * 480.0).abs() < 1e-9);
    }

    #[test]
    fn unusable_recording_is_named() {
        for (from, to, parts) in [
            ("\"ball\"", "\"cup\"", ["objects[1].id", "used before"]),
            (
                "0.3548",
                "0.9",
                ["frames.euclid[0][0].bounding_box", "no area"],
            ),
            (
                "0.5625",
                "1.5",
                ["frames.euclid[0][0].confidence", "at most 1"],
            ),
            ("\"watson\"", "\"hal\"", ["frames.watson", "no vehicle"]),
            (
                "y_min, x_min",
                "x_min, y_min",
                ["bounding_box_order", "y_min, x_min"],
            ),
            (
                "\"length\": \"inch\"",
                "\"length\": \"mile\"",
                ["units.length", "inch"],
            ),
            (
                "\"accepted_labels\": [",
                "\"accepted_labels\": [], \"other\": [",
                ["objects[0].accepted_labels", "empty"],
            ),
        ] {
            assert!(TEXT.contains(from), "{from}");
            let error = IntersectionRecording::from_json(&TEXT.replacen(from, to, 1))
                .unwrap_err()
                .to_string();
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }
}
