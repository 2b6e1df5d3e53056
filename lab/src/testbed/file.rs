//! The scene file: inches and degrees in, metres and radians out, every value checked.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Display;
use std::time::Duration;

use ecod::model::geometry::{Pose, wrap_angle};
use ecod::model::names::{Label, MAX_NAME_BYTES, NodeName, is_label};
use ecod::perception::camera::Intrinsics;
use nalgebra::{Point2, Vector2};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use super::{Camera, Cav, Placard, RecordedRun, Scene, Spot, Testbed};

const METRES_PER_INCH: f64 = 0.0254;
/// Bounds of the intervals in seconds: no camera takes 10,000 frames a second, and each is
/// rendered.
const MIN_INTERVAL_S: f64 = 1e-4;
const MAX_INTERVAL_S: f64 = 3600.0;
/// Most frames that are rendered for one submission.
const MAX_FRAMES_PER_SUBMISSION: f64 = 1000.0;
/// Farthest coordinate, to keep squares and quotients finite.
const MAX_COORDINATE_IN: f64 = 1e6;

/// A scene file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TestbedError {
    /// The text is not JSON.
    #[error("not json")]
    NotJson(#[source] serde_json::Error),
    /// A value is missing, of the wrong kind or out of range.
    #[error("{place}: `{key}` {reason}")]
    Value {
        /// `scene file`, `recording`, or `scene` and its name or, if it has no name, its number
        /// counted from 0.
        place: String,
        /// Path of the key, such as `spots[2].truth`.
        key: String,
        /// Reason, with the value found.
        reason: String,
    },
}

pub(super) fn read(text: &str) -> Result<Testbed, TestbedError> {
    let value: Value = serde_json::from_str(text).map_err(TestbedError::NotJson)?;
    let file = KeyPath("scene file".into());
    let head: FileFields = file.parse(value)?;
    head.units.check(&file)?;
    if head.scenes.is_empty() {
        return Err(file.error("scenes", "is empty, must have at least one scene"));
    }
    let camera = head.camera.check(&file)?;
    let placard = head.placard.check(&file)?;
    let mut scenes: Vec<Scene> = Vec::with_capacity(head.scenes.len());
    for (index, value) in head.scenes.into_iter().enumerate() {
        let name = value.get("name").and_then(Value::as_str);
        let place =
            KeyPath(name.map_or_else(|| format!("scene {index}"), |name| format!("scene {name}")));
        let scene = place.parse::<SceneFields>(value)?.check(&place)?;
        if scenes.iter().any(|other| other.name == scene.name) {
            return Err(place.error("name", "is used by an earlier scene"));
        }
        scenes.push(scene);
    }
    Ok(Testbed {
        camera,
        placard,
        scenes,
    })
}

/// The part of the file that an error is about.
pub(super) struct KeyPath(pub(super) String);

impl KeyPath {
    pub(super) fn error(&self, key: impl Into<String>, reason: impl Display) -> TestbedError {
        TestbedError::Value {
            place: self.0.clone(),
            key: key.into(),
            reason: reason.to_string(),
        }
    }

    pub(super) fn parse<T: DeserializeOwned>(&self, value: Value) -> Result<T, TestbedError> {
        serde_path_to_error::deserialize(value).map_err(|error| {
            self.error(
                error.path().to_string(),
                format_args!("cannot be read: {}", error.inner()),
            )
        })
    }

    /// A number above `low` and up to `high`.
    pub(super) fn number(
        &self,
        key: &str,
        value: f64,
        low: f64,
        high: f64,
    ) -> Result<f64, TestbedError> {
        if value > low && value <= high {
            Ok(value)
        } else {
            Err(self.error(
                key,
                format_args!("is {value}, must be above {low} and at most {high}"),
            ))
        }
    }

    pub(super) fn point(&self, key: &str, inches: [f64; 2]) -> Result<Point2<f64>, TestbedError> {
        if inches.iter().all(|value| value.abs() <= MAX_COORDINATE_IN) {
            Ok(Point2::from(inches) * METRES_PER_INCH)
        } else {
            Err(self.error(
                key,
                format_args!("is {inches:?}, must be within ±{MAX_COORDINATE_IN} inches"),
            ))
        }
    }

    pub(super) fn label(&self, key: &str, text: String) -> Result<Label, TestbedError> {
        if is_label(&text) {
            Ok(text.into())
        } else {
            Err(self.error(
                key,
                format_args!(
                    "is {text:?}, must have 1 to {MAX_NAME_BYTES} bytes and no control characters"
                ),
            ))
        }
    }
}

#[derive(Deserialize)]
struct FileFields {
    #[serde(default)]
    units: UnitFields,
    camera: CameraFields,
    placard: PlacardFields,
    scenes: Vec<Value>,
}

/// Other units are refused rather than misread.
#[derive(Deserialize, Default)]
pub(super) struct UnitFields {
    length: Option<String>,
    angle: Option<String>,
}

impl UnitFields {
    pub(super) fn check(&self, place: &KeyPath) -> Result<(), TestbedError> {
        let expect = |key: &str, found: &Option<String>, unit: &str| match found {
            Some(found) if !found.starts_with(unit) => {
                Err(place.error(key, format_args!("is {found:?}, must be {unit:?}")))
            }
            _ => Ok(()),
        };
        expect("units.length", &self.length, "inch")?;
        expect("units.angle", &self.angle, "degree")
    }
}

#[derive(Deserialize)]
pub(super) struct CameraFields {
    image_width: u32,
    image_height: u32,
    horizontal_fov_deg: f64,
    vertical_fov_deg: f64,
    #[serde(default = "default_capture_interval_s")]
    capture_interval_s: f64,
    #[serde(default = "default_submission_interval_s")]
    submission_interval_s: f64,
}

fn default_capture_interval_s() -> f64 {
    0.1
}

fn default_submission_interval_s() -> f64 {
    0.5
}

impl CameraFields {
    pub(super) fn check(&self, place: &KeyPath) -> Result<Camera, TestbedError> {
        place.number("camera.image_width", self.image_width.into(), 0.0, 8192.0)?;
        place.number("camera.image_height", self.image_height.into(), 0.0, 8192.0)?;
        let horizontal = place.number(
            "camera.horizontal_fov_deg",
            self.horizontal_fov_deg,
            0.0,
            170.0,
        )?;
        let vertical =
            place.number("camera.vertical_fov_deg", self.vertical_fov_deg, 0.0, 170.0)?;
        let capture_s = place.number(
            "camera.capture_interval_s",
            self.capture_interval_s,
            MIN_INTERVAL_S,
            MAX_INTERVAL_S,
        )?;
        let most_s = (MAX_FRAMES_PER_SUBMISSION * capture_s).min(MAX_INTERVAL_S);
        let submission_s = place.number(
            "camera.submission_interval_s",
            self.submission_interval_s,
            MIN_INTERVAL_S,
            most_s,
        )?;
        Ok(Camera {
            intrinsics: Intrinsics::from_field_of_view(
                self.image_width,
                self.image_height,
                horizontal.to_radians(),
                vertical.to_radians(),
            ),
            capture_interval: Duration::from_secs_f64(capture_s),
            submission_interval: Duration::from_secs_f64(submission_s),
        })
    }
}

#[derive(Deserialize)]
struct PlacardFields {
    qr_width: f64,
    qr_with_quiet_zone: f64,
    card_width: f64,
    card_height: f64,
    empty_text: String,
}

impl PlacardFields {
    fn check(self, place: &KeyPath) -> Result<Placard, TestbedError> {
        let width = place.number("placard.card_width", self.card_width, 0.0, 1e4)?;
        let height = place.number("placard.card_height", self.card_height, 0.0, 1e4)?;
        let quiet = place.number(
            "placard.qr_with_quiet_zone",
            self.qr_with_quiet_zone,
            0.0,
            width.min(height),
        )?;
        let qr = place.number("placard.qr_width", self.qr_width, 0.0, quiet)?;
        Ok(Placard {
            qr_width_m: qr * METRES_PER_INCH,
            quiet_width_m: quiet * METRES_PER_INCH,
            card_width_m: width * METRES_PER_INCH,
            card_height_m: height * METRES_PER_INCH,
            empty_text: place.label("placard.empty_text", self.empty_text)?,
        })
    }
}

#[derive(Deserialize)]
struct SceneFields {
    name: String,
    spots: Vec<SpotFields>,
    cavs: Vec<CavFields>,
    #[serde(default)]
    recorded: Option<Vec<RunFields>>,
}

impl SceneFields {
    fn check(self, place: &KeyPath) -> Result<Scene, TestbedError> {
        let spots = check_spots(self.spots, place)?;
        let mut cavs: Vec<Cav> = Vec::with_capacity(self.cavs.len());
        for (index, fields) in self.cavs.into_iter().enumerate() {
            let cav = fields.check(index, place)?;
            if cavs.iter().any(|other| other.name == cav.name) {
                return Err(place.error(
                    format!("cavs[{index}].id"),
                    format_args!("is {}, used before", cav.name),
                ));
            }
            cavs.push(cav);
        }
        let recorded = self
            .recorded
            .into_iter()
            .flatten()
            .map(|run| run.order_by(&cavs))
            .collect();
        Ok(Scene {
            name: self.name,
            spots,
            cavs,
            recorded,
        })
    }
}

#[derive(Deserialize)]
struct SpotFields {
    id: SpotId,
    occupied_placard: [f64; 2],
    #[serde(default)]
    empty_placard: Option<[f64; 2]>,
    #[serde(default)]
    truth: Option<String>,
}

#[derive(Deserialize)]
#[serde(untagged, expecting = "expected a number or a name")]
enum SpotId {
    Number(u64),
    Name(String),
}

fn check_spots(fields: Vec<SpotFields>, place: &KeyPath) -> Result<Vec<Spot>, TestbedError> {
    let mut ids = HashSet::new();
    let mut spots = Vec::with_capacity(fields.len());
    let mut undirected = Vec::new();
    let mut mean = Vector2::zeros();
    for (index, spot) in fields.into_iter().enumerate() {
        let key = |name: &str| format!("spots[{index}].{name}");
        let text = match spot.id {
            SpotId::Number(number) => format!("slot-{number}"),
            SpotId::Name(name) => format!("slot-{name}"),
        };
        let id = place.label(&key("id"), text)?;
        if !ids.insert(id.clone()) {
            return Err(place.error(key("id"), format_args!("gives {id:?}, used before")));
        }
        let occupied = place.point(&key("occupied_placard"), spot.occupied_placard)?;
        let empty = spot
            .empty_placard
            .map(|point| place.point(&key("empty_placard"), point))
            .transpose()?;
        let truth = spot
            .truth
            .map(|text| place.label(&key("truth"), text))
            .transpose()?;
        let direction = empty.and_then(|empty| (occupied - empty).try_normalize(1e-9));
        match direction {
            Some(direction) => mean += direction,
            None => undirected.push(index),
        }
        let facing_rad = direction.map_or(0.0, |direction| direction.y.atan2(direction.x));
        spots.push(Spot {
            id,
            occupied,
            empty,
            facing_rad,
            truth,
        });
    }
    // Spots without their own direction face in the others' average direction, or +x.
    let facing_rad = mean
        .try_normalize(1e-9)
        .map_or(0.0, |mean| mean.y.atan2(mean.x));
    for index in undirected {
        spots[index].facing_rad = facing_rad;
    }
    Ok(spots)
}

#[derive(Deserialize)]
pub(super) struct CavFields {
    id: String,
    position: [f64; 2],
    camera_heading_deg: f64,
}

impl CavFields {
    pub(super) fn check(self, index: usize, place: &KeyPath) -> Result<Cav, TestbedError> {
        let key = |name: &str| format!("cavs[{index}].{name}");
        let name = NodeName::new(&self.id)
            .map_err(|error| place.error(key("id"), format_args!("is a {error}")))?;
        let position = place.point(&key("position"), self.position)?;
        let heading_deg = place.number(
            &key("camera_heading_deg"),
            self.camera_heading_deg,
            -1e6,
            1e6,
        )?;
        Ok(Cav {
            name,
            pose: Pose {
                position,
                heading_rad: wrap_angle(heading_deg.to_radians()),
            },
        })
    }
}

#[derive(Deserialize)]
struct RunFields {
    #[serde(default)]
    pace_accuracy_pct: Option<f64>,
    #[serde(default)]
    single_cav_accuracy_pct: BTreeMap<String, f64>,
}

impl RunFields {
    fn order_by(self, cavs: &[Cav]) -> RecordedRun {
        let accuracy = |cav: &Cav| {
            Some((
                cav.name.clone(),
                *self.single_cav_accuracy_pct.get(cav.name.as_str())?,
            ))
        };
        RecordedRun {
            pace_accuracy_pct: self.pace_accuracy_pct,
            single_cav_accuracy_pct: cavs.iter().filter_map(accuracy).collect(),
        }
    }
}
