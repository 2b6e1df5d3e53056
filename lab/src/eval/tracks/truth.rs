//! The true positions of all objects, frame by frame.

use ecod::model::names::{Label, MAX_NAME_BYTES};
use ecod::model::time::Timestamp;
use hashbrown::{HashMap, HashSet};
use nalgebra::Point2;
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::TrueObject;
use crate::eval::formats::{Sequence, time_of};

/// The period of a truth of one frame, in microseconds.
const USUAL_PERIOD_US: u64 = 100_000;

/// The true objects of every frame.
///
/// As JSON, other keys are ignored:
///
/// ```text
/// {"frames": [{"t_us": 1732154400000000, "objects": [{"id": "car-1", "label": "car", "x_m": 12.5, "y_m": -3.0}]}]}
/// ```
///
/// Frames ascend in time; an `id` is text or a whole number, unique in a frame, and identifies an
/// object across frames. If any object lacks an id, identities are not evaluated.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackTruth {
    frames: Vec<TrueFrame>,
    has_identities: bool,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) struct TrueFrame {
    pub(super) at: Timestamp,
    pub(super) objects: Vec<TrueObject>,
}

/// A truth file that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TrackTruthError {
    /// Not of the form.
    #[error("at {place}: {reason}")]
    Form {
        /// The path of the value, as `frames[3].objects[0].x_m`.
        place: String,
        /// Reason why the value cannot be used.
        reason: String,
    },
    /// No frame at all, or no object in the files of a benchmark.
    #[error("truth has no frame")]
    Empty,
}

#[derive(Deserialize)]
struct Fields {
    frames: Vec<FrameFields>,
}

#[derive(Deserialize)]
struct FrameFields {
    t_us: Timestamp,
    objects: Vec<ObjectFields>,
}

#[derive(Deserialize)]
struct ObjectFields {
    id: Option<Id>,
    label: String,
    x_m: f64,
    y_m: f64,
}

#[derive(Deserialize, PartialEq, Eq, Hash)]
#[serde(untagged, expecting = "expected text or a whole number")]
enum Id {
    Number(i64),
    Text(String),
}

impl TrackTruth {
    /// True if a truth file describes moving objects, not locations: its `frames` is a list, empty
    /// or of objects with a time or with objects.
    pub fn is_in(text: &str) -> bool {
        #[derive(Deserialize)]
        struct TruthKeys {
            frames: Vec<FrameKeys>,
        }
        #[derive(Deserialize)]
        struct FrameKeys {
            t_us: Option<IgnoredAny>,
            objects: Option<IgnoredAny>,
        }
        let is_frame = |frame: &FrameKeys| frame.t_us.is_some() || frame.objects.is_some();
        serde_json::from_str::<TruthKeys>(trimmed(text))
            .is_ok_and(|probe| probe.frames.is_empty() || probe.frames.iter().any(is_frame))
    }

    /// Reads a truth file.
    ///
    /// # Errors
    /// Returns a [`TrackTruthError`] that names the place and the fault.
    pub fn parse(text: &str) -> Result<Self, TrackTruthError> {
        let mut source = serde_json::Deserializer::from_str(trimmed(text));
        let fields: Fields = serde_path_to_error::deserialize(&mut source)
            .map_err(|error| form(error.path().to_string(), error.into_inner().to_string()))?;
        source
            .end()
            .map_err(|error| form("the end", error.to_string()))?;
        let mut ids = Ids {
            has_identities: true,
            ..Ids::default()
        };
        let mut frames: Vec<TrueFrame> = Vec::with_capacity(fields.frames.len());
        for (number, frame) in fields.frames.into_iter().enumerate() {
            let place = format!("frames[{number}]");
            if frames.last().is_some_and(|before| before.at >= frame.t_us) {
                return Err(form(
                    format!("{place}.t_us"),
                    "is not after the frame before",
                ));
            }
            frames.push(TrueFrame {
                at: frame.t_us,
                objects: objects(frame.objects, &place, &mut ids)?,
            });
        }
        let Ids { has_identities, .. } = ids;
        if frames.is_empty() {
            Err(TrackTruthError::Empty)
        } else {
            Ok(Self {
                frames,
                has_identities,
            })
        }
    }

    /// The truth in files of a benchmark, with an empty frame for each that a file leaves out.
    ///
    /// # Errors
    /// Returns an error that names sequence and frame where an identity occurs twice, or when there
    /// is no object at all.
    pub fn from_sequences(
        sequences: &[Sequence],
        frame_rate_hz: f64,
    ) -> Result<Self, TrackTruthError> {
        let mut ids = Ids {
            has_identities: true,
            ..Ids::default()
        };
        let mut frames = Vec::new();
        for (number, sequence) in sequences.iter().enumerate() {
            let last = sequence
                .frames
                .keys()
                .last()
                .copied()
                .unwrap_or(sequence.first);
            for frame in sequence.first..=last {
                let objects = sequence
                    .frames
                    .get(&frame)
                    .map(Vec::as_slice)
                    .unwrap_or_default();
                let fields = objects.iter().map(|object| ObjectFields {
                    id: object.id.map(|id| Id::Text(format!("{number}/{id}"))),
                    label: object.perceived.label.to_string(),
                    x_m: object.perceived.x_m,
                    y_m: object.perceived.y_m,
                });
                let place = format!("sequence {}, frame {frame}", sequence.name);
                let objects = self::objects(fields.collect(), &place, &mut ids)?;
                frames.push(TrueFrame {
                    at: time_of(number, frame, frame_rate_hz),
                    objects,
                });
            }
        }
        if ids.next == 0 {
            Err(TrackTruthError::Empty)
        } else {
            Ok(Self {
                frames,
                has_identities: ids.has_identities,
            })
        }
    }

    /// True if the same object has the same id in every frame.
    pub(super) fn has_identities(&self) -> bool {
        self.has_identities
    }

    /// Ascending in time, at least one.
    pub(super) fn frames(&self) -> &[TrueFrame] {
        &self.frames
    }

    /// The median time between frames.
    pub(super) fn period_us(&self) -> u64 {
        let mut steps: Vec<u64> = self
            .frames
            .windows(2)
            .map(|pair| pair[1].at.micros() - pair[0].at.micros())
            .collect();
        steps.sort_unstable();
        steps
            .get(steps.len() / 2)
            .copied()
            .unwrap_or(USUAL_PERIOD_US)
    }

    /// The objects of a frame, where they were at a time near it: on a straight line to the frame
    /// before or after.
    pub(super) fn at(&self, number: usize, time: Timestamp) -> Vec<TrueObject> {
        let frame = &self.frames[number];
        let ahead = time.micros_from(frame.at);
        let other = if ahead < 0 {
            number.checked_sub(1)
        } else {
            Some(number + 1)
        };
        let mut objects = frame.objects.clone();
        let Some(other) = other
            .and_then(|other| self.frames.get(other))
            .filter(|_| ahead != 0)
        else {
            return objects;
        };
        let share = ahead as f64 / other.at.micros_from(frame.at) as f64;
        let places: HashMap<u32, Point2<f64>> = other
            .objects
            .iter()
            .map(|object| (object.id, object.position))
            .collect();
        for object in &mut objects {
            if let Some(place) = places.get(&object.id) {
                object.position += (place - object.position) * share;
            }
        }
        objects
    }
}

/// The numbers of the objects' ids; an object without one gets a number of its own.
#[derive(Default)]
struct Ids {
    numbers: HashMap<Id, u32>,
    next: u32,
    has_identities: bool,
}

impl Ids {
    fn number(&mut self, id: Option<Id>) -> u32 {
        let next = self.next;
        let number = match id {
            Some(id) => *self.numbers.entry(id).or_insert(next),
            None => {
                self.has_identities = false;
                next
            }
        };
        self.next = next.max(number + 1);
        number
    }
}

fn objects(
    fields: Vec<ObjectFields>,
    place: &str,
    ids: &mut Ids,
) -> Result<Vec<TrueObject>, TrackTruthError> {
    let mut in_frame = HashSet::new();
    let mut objects = Vec::with_capacity(fields.len());
    for (
        number,
        ObjectFields {
            id,
            label,
            x_m,
            y_m,
        },
    ) in fields.into_iter().enumerate()
    {
        let place = |field: &str| format!("{place}.objects[{number}].{field}");
        if !(1..=MAX_NAME_BYTES).contains(&label.len()) {
            return Err(form(
                place("label"),
                format!("is not 1 to {MAX_NAME_BYTES} bytes long"),
            ));
        }
        let id = ids.number(id);
        if !in_frame.insert(id) {
            return Err(form(place("id"), "is in this frame already"));
        }
        objects.push(TrueObject {
            id,
            label: Label::new(label),
            position: Point2::new(x_m, y_m),
        });
    }
    Ok(objects)
}

fn trimmed(text: &str) -> &str {
    text.trim_start_matches('\u{feff}')
}

fn form(place: impl Into<String>, reason: impl Into<String>) -> TrackTruthError {
    TrackTruthError::Form {
        place: place.into(),
        reason: reason.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_and_landmarks_are_distinguished() {
        let text = "\u{feff}{\"note\": 1, \"frames\": [
            {\"t_us\": 100, \"objects\": [{\"id\": 7, \"label\": \"car\", \"x_m\": 1.0, \"y_m\": 2.0, \"vx_mps\": 3.0}]},
            {\"t_us\": 200, \"objects\": [{\"id\": \"b\", \"label\": \"car\", \"x_m\": 0, \"y_m\": 0},
                {\"id\": 7, \"label\": \"car\", \"x_m\": 3.0, \"y_m\": 2.0}]}]}";
        assert!(TrackTruth::is_in(text) && TrackTruth::is_in(r#"{"frames": []}"#));
        for other in [
            r#"{"a": "cup"}"#,
            r#"{"frames": ["vase", "cup"]}"#,
            r#"{"frames": [{"from_us": 0, "label": "x"}]}"#,
        ] {
            assert!(!TrackTruth::is_in(other), "{other}");
        }
        let truth = TrackTruth::parse(text).unwrap();
        assert_eq!((truth.frames().len(), truth.period_us()), (2, 100));
        let place = |number, at| {
            truth
                .at(number, Timestamp(at))
                .iter()
                .find(|o| o.id == 0)
                .unwrap()
                .position
                .x
        };
        assert_eq!(
            [place(0, 100), place(0, 125), place(1, 175), place(1, 200)],
            [1.0, 1.5, 2.5, 3.0]
        );
        assert_eq!(
            [place(0, 75), place(1, 250)],
            [1.0, 3.0],
            "beyond the ends the truth is unknown"
        );
    }

    #[test]
    fn unreadable_entry_is_named() {
        let object = |rest: &str| {
            format!(
                r#"{{"frames": [{{"t_us": 1, "objects": [{{"id": 1, "label": "car", {rest}}}]}}]}}"#
            )
        };
        for (text, part) in [
            ("{}".to_owned(), "missing field `frames`"),
            (r#"{"frames": []}"#.to_owned(), "no frame"),
            (
                r#"{"frames": [{"t_us": -1, "objects": []}]}"#.to_owned(),
                "frames[0].t_us",
            ),
            (
                r#"{"frames": [{"t_us": 1, "objects": []}, {"t_us": 1, "objects": []}]}"#
                    .to_owned(),
                "frames[1].t_us",
            ),
            (object(r#""x_m": 1"#), "missing field `y_m`"),
            (
                object(r#""x_m": "east", "y_m": 0"#),
                "frames[0].objects[0].x_m",
            ),
            (
                object(r#""x_m": 0, "y_m": 0}, {"id": 1, "label": "car", "x_m": 0, "y_m": 0"#),
                "frames[0].objects[1].id",
            ),
            (
                object(r#""x_m": 0, "y_m": 0}, {"id": 1.5, "label": "car", "x_m": 0, "y_m": 0"#),
                "whole number",
            ),
            (
                object(r#""x_m": 0, "y_m": 0}, {"id": 2, "label": "", "x_m": 0, "y_m": 0"#),
                "objects[1].label",
            ),
            (object(r#""x_m": 0, "y_m": 0"#) + "}", "trailing"),
        ] {
            let error = TrackTruth::parse(&text).unwrap_err().to_string();
            assert!(error.contains(part), "{text}: {error}");
        }
    }
}
