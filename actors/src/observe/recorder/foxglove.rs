//! Drawings for Foxglove and Lichtblick, with the names and fields of their published schemas. Unused list fields are
//! written as empty lists.
//!
//! The fixed frame is `map`: east, north, up in metres. Each vehicle with a pose has a frame of its own name.

use std::borrow::Cow;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, ObjectReport, WirePose};
use nalgebra::UnitQuaternion;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::Serialize;

/// Name of the cell's frame.
const MAP: &str = "map";

/// A point in time or a duration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, JsonSchema)]
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
pub(crate) struct FoxglovePose {
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

/// Severity of a log line.
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

#[derive(Debug, Clone, Default, PartialEq, Serialize, JsonSchema)]
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
    texts: Vec<FoxgloveText>,
    models: [(); 0],
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct KeyValue {
    key: &'static str,
    value: String,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Arrow {
    pose: FoxglovePose,
    shaft_length: f64,
    shaft_diameter: f64,
    head_length: f64,
    head_diameter: f64,
    color: Color,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct Sphere {
    pose: FoxglovePose,
    size: Vector3,
    color: Color,
}

#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
struct FoxgloveText {
    pose: FoxglovePose,
    billboard: bool,
    font_size: f64,
    scale_invariant: bool,
    color: Color,
    text: String,
}

/// Time for which an entity is drawn after its last update.
const LIFETIME: Time = Time { sec: 1, nsec: 0 };

/// Diameters of fused objects and of single detections, length of a vehicle, size of text.
const FUSED_M: f64 = 0.3;
const DETECTED_M: f64 = 0.12;
const VEHICLE_M: f64 = 0.6;
const TEXT_PX: f64 = 14.0;

const FUSED: Color = Color { r: 0.10, g: 0.55, b: 0.35, a: 0.9 };
const EMPTY: Color = Color { r: 0.55, g: 0.55, b: 0.55, a: 0.35 };
const DETECTED: Color = Color { r: 0.90, g: 0.55, b: 0.10, a: 0.6 };
const VEHICLE: Color = Color { r: 0.15, g: 0.40, b: 0.80, a: 1.0 };

impl SceneUpdate {
    /// Known locations with their labels, and tracked objects.
    pub(crate) fn of_map(map: &GlobalMap) -> Self {
        let landmarks = map.landmarks.iter().map(|landmark| {
            let pose = plane_pose(landmark.x_m, landmark.y_m, 0.0);
            let color = if landmark.label.is_some() { FUSED } else { EMPTY };
            let label = landmark.label.as_deref().unwrap_or("-");
            SceneEntity::new(map.fused_at_us, format!("landmark/{}", landmark.id))
                .sphere(pose, FUSED_M, color)
                .text(pose, format!("{} {label}", landmark.id))
                .note("confidence", landmark.confidence.to_string())
                .note("contributors", listed(&landmark.contributors))
        });
        let objects = map.objects.iter().map(|object| {
            let pose = plane_pose(object.x_m, object.y_m, 0.0);
            SceneEntity::new(map.fused_at_us, format!("object/{}", object.id))
                .sphere(pose, FUSED_M, FUSED)
                .text(pose, object.label.to_string())
                .note("contributors", listed(&object.contributors))
        });
        Self { deletions: [], entities: landmarks.chain(objects).collect() }
    }

    /// A vehicle and its detections.
    pub(crate) fn of_report(report: &ObjectReport) -> Self {
        let at = report.captured_at_us;
        let vehicle = report.pose.map(|pose| {
            let pose = camera_pose(&pose);
            let entity = SceneEntity::new(at, format!("vehicle/{}", report.node));
            entity.arrow(pose, VEHICLE_M, VEHICLE).text(pose, report.node.to_string())
        });
        let objects = report.objects.iter().enumerate().map(|(number, object)| {
            SceneEntity::new(at, format!("detection/{}/{number}", report.node))
                .sphere(plane_pose(object.x_m, object.y_m, 0.0), DETECTED_M, DETECTED)
                .note("label", object.label.to_string())
        });
        Self { deletions: [], entities: vehicle.into_iter().chain(objects).collect() }
    }
}

impl FrameTransform {
    /// A vehicle's pose.
    pub(crate) fn of(node: &NodeName, pose: WirePose, at: Timestamp) -> Self {
        let FoxglovePose { position: translation, orientation: rotation } = camera_pose(&pose);
        Self { timestamp: at.into(), parent_frame_id: MAP, child_frame_id: node.clone(), translation, rotation }
    }
}

impl SceneEntity {
    fn new(at: Timestamp, id: String) -> Self {
        Self { timestamp: at.into(), frame_id: MAP, id, lifetime: LIFETIME, ..Self::default() }
    }

    fn arrow(mut self, pose: FoxglovePose, length_m: f64, color: Color) -> Self {
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

    fn sphere(mut self, pose: FoxglovePose, diameter_m: f64, color: Color) -> Self {
        self.spheres.push(Sphere { pose, size: Vector3 { x: diameter_m, y: diameter_m, z: diameter_m }, color });
        self
    }

    fn text(mut self, pose: FoxglovePose, text: String) -> Self {
        let text =
            FoxgloveText { pose, billboard: true, font_size: TEXT_PX, scale_invariant: true, color: VEHICLE, text };
        self.texts.push(text);
        self
    }

    fn note(mut self, key: &'static str, value: String) -> Self {
        self.metadata.push(KeyValue { key, value });
        self
    }
}

/// Pose in the plane: east and north in metres, heading in radians counter-clockwise from east.
fn plane_pose(x_m: f64, y_m: f64, heading_rad: f64) -> FoxglovePose {
    camera_pose(&WirePose::new(x_m, y_m, heading_rad))
}

/// Pose of a camera, on the ground and level as far as nothing else is stated.
fn camera_pose(pose: &WirePose) -> FoxglovePose {
    let (roll_rad, pitch_rad) = (pose.roll_rad.unwrap_or(0.0), pose.pitch_rad.unwrap_or(0.0));
    let turn = UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, pose.heading_rad);
    FoxglovePose {
        position: Vector3 { x: pose.x_m, y: pose.y_m, z: pose.height_m.unwrap_or(0.0) },
        orientation: Quaternion { x: turn.i, y: turn.j, z: turn.k, w: turn.w },
    }
}

fn listed(nodes: &[NodeName]) -> String {
    nodes.iter().map(NodeName::as_str).collect::<Vec<_>>().join(" ")
}
