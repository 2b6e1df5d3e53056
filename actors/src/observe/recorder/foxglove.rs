//! Messages that Foxglove and Lichtblick draw, under the names and fields of their published schemas; fields of theirs
//! that are always empty here are written as empty lists.
//!
//! The fixed frame is `map`: east, north, up in metres. Every vehicle that reports its pose has a frame of its name.

use std::borrow::Cow;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, ObjectReport, WirePose};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::Serialize;

/// The frame of the cell.
const MAP: &str = "map";

/// A point in time or a span.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, JsonSchema)]
#[schemars(title = "time")]
pub(crate) struct Time {
    sec: u64,
    nsec: u32,
}

impl From<Timestamp> for Time {
    fn from(at: Timestamp) -> Self {
        Self { sec: at.micros() / 1_000_000, nsec: (at.micros() % 1_000_000) as u32 * 1000 }
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, JsonSchema)]
pub(crate) struct Vector3 {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub(crate) struct Quaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub(crate) struct Pose {
    position: Vector3,
    orientation: Quaternion,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub(crate) struct Color {
    r: f64,
    g: f64,
    b: f64,
    a: f64,
}

/// `foxglove.FrameTransform`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.FrameTransform")]
pub(crate) struct FrameTransform {
    timestamp: Time,
    parent_frame_id: &'static str,
    child_frame_id: NodeName,
    translation: Vector3,
    rotation: Quaternion,
}

/// `foxglove.Log`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.Log")]
pub(crate) struct Log {
    pub(crate) timestamp: Time,
    pub(crate) level: Level,
    pub(crate) message: String,
    pub(crate) name: String,
    pub(crate) file: String,
    pub(crate) line: u32,
}

/// How much an entry of the log matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(into = "u8")]
pub(crate) enum Level {
    Info = 2,
    Warning = 3,
}

impl From<Level> for u8 {
    fn from(level: Level) -> Self {
        level as Self
    }
}

impl JsonSchema for Level {
    fn schema_name() -> Cow<'static, str> {
        "LogLevel".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "oneOf": [{ "title": "INFO", "const": 2 }, { "title": "WARNING", "const": 3 }] })
    }
}

/// `foxglove.CompressedImage`; `data` is in base64.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.CompressedImage")]
pub(crate) struct CompressedImage {
    pub(crate) timestamp: Time,
    pub(crate) frame_id: NodeName,
    #[schemars(extend("contentEncoding" = "base64"))]
    pub(crate) data: String,
    pub(crate) format: &'static str,
}

/// `foxglove.SceneUpdate`.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
#[schemars(title = "foxglove.SceneUpdate")]
pub(crate) struct SceneUpdate {
    deletions: [(); 0],
    entities: Vec<SceneEntity>,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct SceneEntity {
    timestamp: Time,
    frame_id: &'static str,
    id: String,
    #[schemars(title = "duration")]
    lifetime: Time,
    frame_locked: bool,
    metadata: Vec<KeyValue>,
    arrows: Vec<Arrow>,
    cubes: [(); 0],
    spheres: Vec<Sphere>,
    cylinders: [(); 0],
    lines: [(); 0],
    triangles: [(); 0],
    texts: Vec<Text>,
    models: [(); 0],
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct KeyValue {
    key: &'static str,
    value: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Arrow {
    pose: Pose,
    shaft_length: f64,
    shaft_diameter: f64,
    head_length: f64,
    head_diameter: f64,
    color: Color,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Sphere {
    pose: Pose,
    size: Vector3,
    color: Color,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Text {
    pose: Pose,
    billboard: bool,
    font_size: f64,
    scale_invariant: bool,
    color: Color,
    text: String,
}

/// How long a thing is drawn after it was last said to be there.
const LIFETIME: Time = Time { sec: 1, nsec: 0 };

/// Sizes in metres: of what stands at a location, of what one vehicle detected, of a vehicle, and of text in pixels.
const FUSED_M: f64 = 0.3;
const DETECTED_M: f64 = 0.12;
const VEHICLE_M: f64 = 0.6;
const TEXT_PX: f64 = 14.0;

const FUSED: Color = Color { r: 0.10, g: 0.55, b: 0.35, a: 0.9 };
const EMPTY: Color = Color { r: 0.55, g: 0.55, b: 0.55, a: 0.35 };
const DETECTED: Color = Color { r: 0.90, g: 0.55, b: 0.10, a: 0.6 };
const VEHICLE: Color = Color { r: 0.15, g: 0.40, b: 0.80, a: 1.0 };

impl SceneUpdate {
    /// The known locations and what stands there, and the objects of the open world.
    pub(crate) fn of_map(map: &GlobalMap) -> Self {
        let landmarks = map.landmarks.iter().map(|landmark| {
            let pose = placed(landmark.x_m, landmark.y_m, 0.0);
            let color = if landmark.label.is_some() { FUSED } else { EMPTY };
            let label = landmark.label.as_deref().unwrap_or("-");
            SceneEntity::new(map.fused_at_us, format!("landmark/{}", landmark.id))
                .sphere(pose, FUSED_M, color)
                .text(pose, format!("{} {label}", landmark.id))
                .note("confidence", landmark.confidence.to_string())
                .note("contributors", listed(&landmark.contributors))
        });
        let objects = map.objects.iter().map(|object| {
            let pose = placed(object.x_m, object.y_m, 0.0);
            SceneEntity::new(map.fused_at_us, format!("object/{}", object.id))
                .sphere(pose, FUSED_M, FUSED)
                .text(pose, object.label.to_string())
                .note("contributors", listed(&object.contributors))
        });
        Self { deletions: [], entities: landmarks.chain(objects).collect() }
    }

    /// A vehicle and what it detected.
    pub(crate) fn of_report(report: &ObjectReport) -> Self {
        let at = report.captured_at_us;
        let vehicle = report.pose.map(|pose| {
            let pose = placed(pose.x_m, pose.y_m, pose.heading_rad);
            let entity = SceneEntity::new(at, format!("vehicle/{}", report.node));
            entity.arrow(pose, VEHICLE_M, VEHICLE).text(pose, report.node.to_string())
        });
        let objects = report.objects.iter().enumerate().map(|(number, object)| {
            SceneEntity::new(at, format!("detection/{}/{number}", report.node))
                .sphere(placed(object.x_m, object.y_m, 0.0), DETECTED_M, DETECTED)
                .note("label", object.label.to_string())
        });
        Self { deletions: [], entities: vehicle.into_iter().chain(objects).collect() }
    }
}

impl FrameTransform {
    /// Where a vehicle stands.
    pub(crate) fn of(node: &NodeName, pose: WirePose, at: Timestamp) -> Self {
        let Pose { position, orientation } = placed(pose.x_m, pose.y_m, pose.heading_rad);
        Self {
            timestamp: at.into(),
            parent_frame_id: MAP,
            child_frame_id: node.clone(),
            translation: position,
            rotation: orientation,
        }
    }
}

impl SceneEntity {
    fn new(at: Timestamp, id: String) -> Self {
        Self {
            timestamp: at.into(),
            frame_id: MAP,
            id,
            lifetime: LIFETIME,
            frame_locked: false,
            metadata: Vec::new(),
            arrows: Vec::new(),
            cubes: [],
            spheres: Vec::new(),
            cylinders: [],
            lines: [],
            triangles: [],
            texts: Vec::new(),
            models: [],
        }
    }

    fn arrow(mut self, pose: Pose, length_m: f64, color: Color) -> Self {
        self.arrows.push(Arrow {
            pose,
            shaft_length: length_m * 0.7,
            shaft_diameter: length_m * 0.2,
            head_length: length_m * 0.3,
            head_diameter: length_m * 0.4,
            color,
        });
        self
    }

    fn sphere(mut self, pose: Pose, diameter_m: f64, color: Color) -> Self {
        self.spheres.push(Sphere { pose, size: Vector3 { x: diameter_m, y: diameter_m, z: diameter_m }, color });
        self
    }

    fn text(mut self, pose: Pose, text: String) -> Self {
        let text = Text { pose, billboard: true, font_size: TEXT_PX, scale_invariant: true, color: VEHICLE, text };
        self.texts.push(text);
        self
    }

    fn note(mut self, key: &'static str, value: String) -> Self {
        self.metadata.push(KeyValue { key, value });
        self
    }
}

/// East and north in metres, heading in radians counter-clockwise from east: a rotation about the vertical.
fn placed(x: f64, y: f64, heading_rad: f64) -> Pose {
    let (z, w) = (heading_rad / 2.0).sin_cos();
    Pose { position: Vector3 { x, y, z: 0.0 }, orientation: Quaternion { x: 0.0, y: 0.0, z, w } }
}

fn listed(nodes: &[NodeName]) -> String {
    nodes.iter().map(NodeName::as_str).collect::<Vec<_>>().join(" ")
}
