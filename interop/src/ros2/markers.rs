//! Drawings for RViz: `visualization_msgs`.

use ecod::wire::GlobalMap;
use serde::Serialize;

use super::camera::{IMAGE, RosImage};
use super::detections::{HEIGHT_M, pose, size};
use super::messages::{
    Definition, HEADER, Header, POINT, POSE, QUATERNION, RosMessage, RosPose, RosQuaternion,
    RosTime, RosVector, TIME, VECTOR,
};
use crate::object::CellObject;

#[derive(Debug, Clone, Copy, Default, Serialize)]
struct ColorRGBA {
    r: f32,
    g: f32,
    b: f32,
    a: f32,
}

#[derive(Debug, Default, Serialize)]
struct MeshFile {
    filename: String,
    data: Vec<u8>,
}

#[derive(Debug, Serialize)]
struct Marker {
    header: Header,
    ns: String,
    id: i32,
    kind: i32,
    action: i32,
    pose: RosPose,
    scale: RosVector,
    color: ColorRGBA,
    lifetime: RosTime,
    frame_locked: bool,
    points: Vec<RosVector>,
    colors: Vec<ColorRGBA>,
    texture_resource: String,
    texture: RosImage,
    uv_coordinates: Vec<[f32; 2]>,
    text: String,
    mesh_resource: String,
    mesh_file: MeshFile,
    mesh_use_embedded_materials: bool,
}

/// Kinds and actions of markers.
const CUBE: i32 = 1;
const TEXT: i32 = 9;
const DELETE_ALL: i32 = 3;

#[derive(Debug, Serialize)]
pub(super) struct MarkerArray {
    markers: Vec<Marker>,
}

impl MarkerArray {
    /// Boxes and labels of all objects, replacing the previous ones; certain objects are opaque.
    pub(super) fn of_map(map: &GlobalMap) -> Self {
        let none = RosPose {
            position: RosVector::default(),
            orientation: RosQuaternion::of(0.0, 0.0, 0.0),
        };
        let marker = |ns: &str, id: i32| Marker {
            header: Header::in_map(map.fused_at_us),
            ns: ns.to_owned(),
            id,
            kind: CUBE,
            action: 0,
            pose: none,
            scale: RosVector::default(),
            color: ColorRGBA::default(),
            lifetime: RosTime::default(),
            frame_locked: false,
            points: Vec::new(),
            colors: Vec::new(),
            texture_resource: String::new(),
            texture: RosImage::default(),
            uv_coordinates: Vec::new(),
            text: String::new(),
            mesh_resource: String::new(),
            mesh_file: MeshFile::default(),
            mesh_use_embedded_materials: false,
        };
        let mut markers = vec![Marker {
            action: DELETE_ALL,
            ..marker("objects", 0)
        }];
        for ((object, _), number) in CellObject::all_of(map).zip(1..) {
            let pose = pose(&object);
            // Ghosts are faint.
            let a = object.confidence as f32;
            let mut above = pose;
            above.position.z = HEIGHT_M + 0.5;
            let scale = RosVector {
                z: 0.5,
                ..RosVector::default()
            };
            let box_color = ColorRGBA {
                r: 0.2,
                g: 0.6,
                b: 1.0,
                a,
            };
            let color = ColorRGBA {
                r: 1.0,
                g: 1.0,
                b: 1.0,
                a,
            };
            let text = object.label.to_string();
            markers.push(Marker {
                pose,
                scale: size(&object),
                color: box_color,
                ..marker("objects", number)
            });
            markers.push(Marker {
                kind: TEXT,
                pose: above,
                scale,
                color,
                text,
                ..marker("labels", number)
            });
        }
        Self { markers }
    }
}

impl RosMessage for MarkerArray {
    const NAME: &'static str = "visualization_msgs/msg/MarkerArray";
}

impl Definition for MarkerArray {
    const FIELDS: &'static str = "visualization_msgs/Marker[] markers\n";
    const INSIDE: &'static [(&'static str, &'static str)] = &[
        (
            "visualization_msgs/Marker",
            "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose pose\n\
             geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration lifetime\nbool frame_locked\n\
             geometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring texture_resource\n\
             sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\nstring text\n\
             string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n",
        ),
        (
            "std_msgs/ColorRGBA",
            "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
        ),
        ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
        ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n"),
        (
            "visualization_msgs/MeshFile",
            "string filename\nuint8[] data\n",
        ),
        ("sensor_msgs/CompressedImage", IMAGE),
        HEADER,
        TIME,
        POSE,
        POINT,
        QUATERNION,
        VECTOR,
    ];
}
