//! Transforms between frames: `tf2_msgs`.

use ecod::wire::WirePose;
use serde::Serialize;

use super::messages::{
    Definition, HEADER, Header, QUATERNION, RosMessage, RosQuaternion, RosVector, TIME, VECTOR,
};

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
        let within = Header {
            frame_id: camera.clone(),
            ..header.clone()
        };
        let translation = RosVector {
            x: pose.x_m,
            y: pose.y_m,
            z: pose.height_m.unwrap_or(0.0),
        };
        let roll_rad = pose.roll_rad.unwrap_or(0.0);
        let pitch_rad = pose.pitch_rad.unwrap_or(0.0);
        let transform = Transform {
            translation,
            rotation: RosQuaternion::of(roll_rad, pitch_rad, pose.heading_rad),
        };
        let rotation = RosQuaternion {
            x: -0.5,
            y: 0.5,
            z: -0.5,
            w: 0.5,
        };
        let to_optical = Transform {
            translation: RosVector::default(),
            rotation,
        };
        let optical = format!("{camera}_optical");
        Self {
            transforms: vec![
                TransformStamped {
                    header,
                    child_frame_id: camera,
                    transform,
                },
                TransformStamped {
                    header: within,
                    child_frame_id: optical,
                    transform: to_optical,
                },
            ],
        }
    }
}

impl RosMessage for TFMessage {
    const NAME: &'static str = "tf2_msgs/msg/TFMessage";
}

impl Definition for TFMessage {
    const FIELDS: &'static str = "geometry_msgs/TransformStamped[] transforms\n";
    const INSIDE: &'static [(&'static str, &'static str)] = &[
        (
            "geometry_msgs/TransformStamped",
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
        ),
        (
            "geometry_msgs/Transform",
            "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
        ),
        HEADER,
        TIME,
        VECTOR,
        QUATERNION,
    ];
}
