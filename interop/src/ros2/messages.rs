//! Messages of ROS 2 (Humble and later) and vision_msgs 4, as they are on the wire, and their definitions.

use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, ObjectReport, WirePose};
use nalgebra::UnitQuaternion;
use serde::Serialize;

use crate::object::CellObject;

/// A message with a name and a definition by which others read it.
pub(super) trait Definition {
    /// Package, kind and name.
    const NAME: &'static str;
    /// Its own fields.
    const FIELDS: &'static str;
    /// The messages inside it.
    const INSIDE: &'static [(&'static str, &'static str)];

    /// The definition as MCAP has it: the fields, and those of each message inside.
    fn definition() -> String {
        let rule = "=".repeat(80);
        let inside = Self::INSIDE.iter().map(|(name, fields)| format!("{rule}\nMSG: {name}\n{fields}"));
        std::iter::once(Self::FIELDS.to_owned()).chain(inside).collect()
    }
}

const HEADER: (&str, &str) = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n");
const TIME: (&str, &str) = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
const POSE: (&str, &str) =
    ("geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n");
const POINT: (&str, &str) = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n");
const QUATERNION: (&str, &str) = ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n");
const VECTOR: (&str, &str) = ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n");
const IMAGE: &str = "std_msgs/Header header\nstring format\nuint8[] data\n";

/// Extent of an object of which no size is known, and height of all, in metres.
const UNKNOWN_SIZE_M: f64 = 1.0;
const HEIGHT_M: f64 = 1.5;

/// Variance of what is not known, as in `robot_localization`: large, and harmless to a filter.
const UNKNOWN_VARIANCE: f64 = 1e6;

#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(super) struct RosTime {
    sec: i32,
    nanosec: u32,
}

impl RosTime {
    pub(super) fn of(time: Timestamp) -> Self {
        let micros = time.micros();
        let sec = i32::try_from(micros / 1_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (micros % 1_000_000) as u32 * 1000 }
    }
}

#[derive(Debug, Clone, Default, Serialize)]
pub(super) struct Header {
    pub(super) stamp: RosTime,
    pub(super) frame_id: String,
}

impl Header {
    pub(super) fn in_map(time: Timestamp) -> Self {
        Self { stamp: RosTime::of(time), frame_id: "map".to_owned() }
    }
}

#[derive(Debug, Clone, Copy, Default, Serialize)]
struct RosVector {
    x: f64,
    y: f64,
    z: f64,
}

#[derive(Debug, Clone, Copy, Serialize)]
struct RosQuaternion {
    x: f64,
    y: f64,
    z: f64,
    w: f64,
}

impl RosQuaternion {
    /// A turn by the heading, then by pitch and roll about the axes so turned.
    fn of(roll_rad: f64, pitch_rad: f64, heading_rad: f64) -> Self {
        let turn = UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, heading_rad);
        Self { x: turn.i, y: turn.j, z: turn.k, w: turn.w }
    }
}

#[derive(Debug, Clone, Copy, Serialize)]
struct RosPose {
    position: RosVector,
    orientation: RosQuaternion,
}

#[derive(Debug, Serialize)]
struct PoseWithCovariance {
    pose: RosPose,
    covariance: [[f64; 6]; 6],
}

#[derive(Debug, Serialize)]
struct ObjectHypothesis {
    class_id: String,
    score: f64,
}

#[derive(Debug, Serialize)]
struct ObjectHypothesisWithPose {
    hypothesis: ObjectHypothesis,
    pose: PoseWithCovariance,
}

#[derive(Debug, Serialize)]
struct BoundingBox3D {
    center: RosPose,
    size: RosVector,
}

#[derive(Debug, Serialize)]
struct Detection3D {
    header: Header,
    results: Vec<ObjectHypothesisWithPose>,
    bbox: BoundingBox3D,
    id: String,
}

fn pose(object: &CellObject<'_>) -> RosPose {
    let [x, y] = object.position_m;
    let orientation = RosQuaternion::of(0.0, 0.0, object.heading_rad.unwrap_or(0.0));
    RosPose { position: RosVector { x, y, z: HEIGHT_M / 2.0 }, orientation }
}

fn size(object: &CellObject<'_>) -> RosVector {
    let [x, y] = object.size_m.unwrap_or([UNKNOWN_SIZE_M; 2]);
    RosVector { x, y, z: HEIGHT_M }
}

fn detection(object: &CellObject<'_>, header: &Header, id: String) -> Detection3D {
    let mut covariance = [[0.0; 6]; 6];
    for (index, row) in covariance.iter_mut().enumerate() {
        row.iter_mut().skip(index).take(1).for_each(|variance| *variance = UNKNOWN_VARIANCE);
    }
    if let (Some([xx, xy, yy]), [[a, b, ..], [c, d, ..], ..]) = (object.covariance_m2, &mut covariance) {
        (*a, *b, *c, *d) = (xx, xy, xy, yy);
    }
    let only = [(object.label, &object.confidence)];
    let scores: Vec<_> = if object.scores.is_empty() { only.into() } else { object.scores.iter().collect() };
    let results = scores.into_iter().map(|(label, score)| ObjectHypothesisWithPose {
        hypothesis: ObjectHypothesis { class_id: label.to_string(), score: *score },
        pose: PoseWithCovariance { pose: pose(object), covariance },
    });
    let bbox = BoundingBox3D { center: pose(object), size: size(object) };
    Detection3D { header: header.clone(), results: results.collect(), bbox, id }
}

#[derive(Debug, Serialize)]
pub(super) struct Detection3DArray {
    header: Header,
    detections: Vec<Detection3D>,
}

impl Detection3DArray {
    pub(super) fn of_map(map: &GlobalMap) -> Self {
        let header = Header::in_map(map.fused_at_us);
        let objects = map.objects.iter().map(|object| (object.into(), object.id.to_string()));
        let at_places = map.landmarks.iter().filter_map(|place| Some((CellObject::at(place)?, place.id.to_string())));
        let detections = objects.chain(at_places).map(|(object, id)| detection(&object, &header, id)).collect();
        Self { header, detections }
    }

    pub(super) fn of_report(report: &ObjectReport) -> Self {
        let header = Header::in_map(report.captured_at_us);
        let detections = report.objects.iter().map(|object| {
            let id = object.landmark.as_ref().map(ToString::to_string).unwrap_or_default();
            detection(&object.into(), &header, id)
        });
        Self { detections: detections.collect(), header }
    }
}

impl Definition for Detection3DArray {
    const NAME: &'static str = "vision_msgs/msg/Detection3DArray";
    const FIELDS: &'static str = "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n";
    const INSIDE: &'static [(&'static str, &'static str)] = &[
        HEADER,
        TIME,
        (
            "vision_msgs/Detection3D",
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\nstring id\n",
        ),
        (
            "vision_msgs/ObjectHypothesisWithPose",
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
        ),
        ("vision_msgs/ObjectHypothesis", "string class_id\nfloat64 score\n"),
        ("vision_msgs/BoundingBox3D", "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n"),
        ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"),
        POSE,
        POINT,
        QUATERNION,
        VECTOR,
    ];
}

#[derive(Debug, Serialize)]
struct Transform {
    translation: RosVector,
    rotation: RosQuaternion,
}

#[derive(Debug, Serialize)]
struct TransformStamped {
    header: Header,
    child_frame_id: String,
    transform: Transform,
}

#[derive(Debug, Serialize)]
pub(super) struct TFMessage {
    transforms: Vec<TransformStamped>,
}

impl TFMessage {
    /// A camera's pose, and the direction of its optical frame.
    pub(super) fn of_pose(header: Header, camera: String, pose: WirePose) -> Self {
        let within = Header { frame_id: camera.clone(), ..header.clone() };
        let translation = RosVector { x: pose.x_m, y: pose.y_m, z: pose.height_m.unwrap_or(0.0) };
        let (roll_rad, pitch_rad) = (pose.roll_rad.unwrap_or(0.0), pose.pitch_rad.unwrap_or(0.0));
        let transform = Transform { translation, rotation: RosQuaternion::of(roll_rad, pitch_rad, pose.heading_rad) };
        let rotation = RosQuaternion { x: -0.5, y: 0.5, z: -0.5, w: 0.5 };
        let to_optical = Transform { translation: RosVector::default(), rotation };
        let optical = format!("{camera}_optical");
        Self {
            transforms: vec![
                TransformStamped { header, child_frame_id: camera, transform },
                TransformStamped { header: within, child_frame_id: optical, transform: to_optical },
            ],
        }
    }
}

impl Definition for TFMessage {
    const NAME: &'static str = "tf2_msgs/msg/TFMessage";
    const FIELDS: &'static str = "geometry_msgs/TransformStamped[] transforms\n";
    const INSIDE: &'static [(&'static str, &'static str)] = &[
        (
            "geometry_msgs/TransformStamped",
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
        ),
        ("geometry_msgs/Transform", "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"),
        HEADER,
        TIME,
        VECTOR,
        QUATERNION,
    ];
}

#[derive(Debug, Default, Serialize)]
pub(super) struct RosImage {
    pub(super) header: Header,
    pub(super) format: String,
    pub(super) data: Vec<u8>,
}

impl Definition for RosImage {
    const NAME: &'static str = "sensor_msgs/msg/CompressedImage";
    const FIELDS: &'static str = IMAGE;
    const INSIDE: &'static [(&'static str, &'static str)] = &[HEADER, TIME];
}

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
    /// Boxes and labels of all objects, in place of those before.
    pub(super) fn of_map(map: &GlobalMap) -> Self {
        let none = RosPose { position: RosVector::default(), orientation: RosQuaternion::of(0.0, 0.0, 0.0) };
        let marker = |ns: &str, id: i32| Marker {
            header: Header::in_map(map.fused_at_us),
            ns: ns.to_owned(),
            id,
            kind: CUBE,
            action: 0,
            pose: none,
            scale: RosVector::default(),
            color: ColorRGBA { r: 0.2, g: 0.6, b: 1.0, a: 0.6 },
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
        let mut markers = vec![Marker { action: DELETE_ALL, ..marker("objects", 0) }];
        for (object, number) in map.objects.iter().map(CellObject::from).zip(1..) {
            let pose = pose(&object);
            let mut above = pose;
            above.position.z = HEIGHT_M + 0.5;
            let scale = RosVector { z: 0.5, ..RosVector::default() };
            let color = ColorRGBA { r: 1.0, g: 1.0, b: 1.0, a: 1.0 };
            let text = object.label.to_string();
            markers.push(Marker { pose, scale: size(&object), ..marker("objects", number) });
            markers.push(Marker { kind: TEXT, pose: above, scale, color, text, ..marker("labels", number) });
        }
        Self { markers }
    }
}

impl Definition for MarkerArray {
    const NAME: &'static str = "visualization_msgs/msg/MarkerArray";
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
        ("std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"),
        ("builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"),
        ("visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n"),
        ("visualization_msgs/MeshFile", "string filename\nuint8[] data\n"),
        ("sensor_msgs/CompressedImage", IMAGE),
        HEADER,
        TIME,
        POSE,
        POINT,
        QUATERNION,
        VECTOR,
    ];
}
