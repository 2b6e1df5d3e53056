//! Drawings for Foxglove and Lichtblick, with the names and fields of their published schemas.
//! Unused list fields are written as empty lists.
//!
//! The fixed frame is `map`: east, north, up in metres. Each camera with a pose has a frame of the
//! name under which it reports, x along its axis and z up, and below it `<name>/optical`, z along
//! the axis and x to the right.

pub(crate) mod picture;
pub(crate) mod scene;

use std::borrow::Cow;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::WirePose;
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
        Self {
            sec: at.micros() / 1_000_000,
            nsec: (at.micros() % 1_000_000) as u32 * 1000,
        }
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
    parent_frame_id: String,
    child_frame_id: String,
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

/// Suffix of the frame of a camera's pictures, after the name under which the camera reports.
pub(crate) const OPTICAL_FRAME: &str = "/optical";

/// The frame of a camera's pictures.
pub(crate) fn optical_frame(reporter: &NodeName) -> String {
    format!("{reporter}{OPTICAL_FRAME}")
}

impl FrameTransform {
    /// The transform of a vehicle's pose in the map's frame.
    pub(crate) fn of(node: &NodeName, pose: WirePose, at: Timestamp) -> Self {
        let FoxglovePose {
            position: translation,
            orientation: rotation,
        } = camera_pose(&pose);
        let parent_frame_id = MAP.to_owned();
        let child_frame_id = node.to_string();
        Self {
            timestamp: at.into(),
            parent_frame_id,
            child_frame_id,
            translation,
            rotation,
        }
    }

    /// The frame of a camera's pictures, relative to the frame of the camera.
    pub(crate) fn optical(reporter: &NodeName, at: Timestamp) -> Self {
        let rotation = Quaternion {
            x: -0.5,
            y: 0.5,
            z: -0.5,
            w: 0.5,
        };
        let parent_frame_id = reporter.to_string();
        let child_frame_id = optical_frame(reporter);
        Self {
            timestamp: at.into(),
            parent_frame_id,
            child_frame_id,
            translation: Vector3::default(),
            rotation,
        }
    }
}

/// Pose in the plane: east and north in metres, heading in radians counter-clockwise from east.
fn plane_pose(x_m: f64, y_m: f64, heading_rad: f64) -> FoxglovePose {
    camera_pose(&WirePose::new(x_m, y_m, heading_rad))
}

/// Pose of a camera; without stated height and tilt, it is on the ground and level.
fn camera_pose(pose: &WirePose) -> FoxglovePose {
    let roll_rad = pose.roll_rad.unwrap_or(0.0);
    let pitch_rad = pose.pitch_rad.unwrap_or(0.0);
    let turn = UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, pose.heading_rad);
    FoxglovePose {
        position: Vector3 {
            x: pose.x_m,
            y: pose.y_m,
            z: pose.height_m.unwrap_or(0.0),
        },
        orientation: Quaternion {
            x: turn.i,
            y: turn.j,
            z: turn.k,
            w: turn.w,
        },
    }
}
