//! Parts of messages of ROS 2 (Humble and later), as they are on the wire, and their definitions.

use ecod::model::time::Timestamp;
use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};

/// A message of ROS.
pub(crate) trait RosMessage {
    /// Package, kind and name.
    const NAME: &'static str;
}

/// A message with a name and a definition, with which other programs can read it.
pub(crate) trait Definition: RosMessage {
    /// Its own fields.
    const FIELDS: &'static str;
    /// The messages inside it.
    const INSIDE: &'static [(&'static str, &'static str)];

    /// The definition in MCAP's form: the fields, followed by the definitions of nested messages.
    fn definition() -> String {
        let rule = "=".repeat(80);
        let inside = Self::INSIDE
            .iter()
            .map(|(name, fields)| format!("{rule}\nMSG: {name}\n{fields}"));
        std::iter::once(Self::FIELDS.to_owned())
            .chain(inside)
            .collect()
    }
}

/// A message in CDR, little-endian, without the four bytes before it.
pub(crate) fn encode<M: Serialize>(message: &M) -> Result<Vec<u8>, cdr_encoding::Error> {
    cdr_encoding::to_vec::<M, byteorder::LittleEndian>(message)
}

pub(super) const HEADER: (&str, &str) = (
    "std_msgs/Header",
    "builtin_interfaces/Time stamp\nstring frame_id\n",
);
pub(super) const TIME: (&str, &str) = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n");
pub(super) const POSE: (&str, &str) = (
    "geometry_msgs/Pose",
    "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
);
pub(super) const POINT: (&str, &str) = ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n");
pub(super) const QUATERNION: (&str, &str) = (
    "geometry_msgs/Quaternion",
    "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
);
pub(super) const VECTOR: (&str, &str) =
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n");

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct RosTime {
    sec: i32,
    nanosec: u32,
}

impl RosTime {
    /// Microseconds since 1970; `None` before.
    #[cfg(feature = "dds")]
    fn micros(self) -> Option<u64> {
        Some(u64::try_from(self.sec).ok()? * 1_000_000 + u64::from(self.nanosec) / 1000)
    }

    pub(super) fn of(time: Timestamp) -> Self {
        let micros = time.micros();
        let sec = i32::try_from(micros / 1_000_000).unwrap_or(i32::MAX);
        Self {
            sec,
            nanosec: (micros % 1_000_000) as u32 * 1000,
        }
    }
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Header {
    pub(crate) stamp: RosTime,
    pub(crate) frame_id: String,
}

impl Header {
    /// The time of the stamp, or the current time for an unset stamp; `None` before 1970.
    #[cfg(feature = "dds")]
    pub(crate) fn time(&self) -> Option<Timestamp> {
        let micros = self.stamp.micros()?;
        Some(if micros > 0 {
            Timestamp(micros)
        } else {
            ecod_client::now()
        })
    }

    pub(super) fn in_map(time: Timestamp) -> Self {
        Self {
            stamp: RosTime::of(time),
            frame_id: "map".to_owned(),
        }
    }
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct RosVector {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) z: f64,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct RosQuaternion {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) z: f64,
    pub(crate) w: f64,
}

impl RosQuaternion {
    /// The rotation; `None` if it is invalid, for example all zeros.
    #[cfg(feature = "dds")]
    pub(crate) fn rotation(&self) -> Option<UnitQuaternion<f64>> {
        UnitQuaternion::try_new(
            nalgebra::Quaternion::new(self.w, self.x, self.y, self.z),
            1e-6,
        )
    }

    /// A turn by the heading, then by pitch and roll about the axes so turned.
    pub(super) fn of(roll_rad: f64, pitch_rad: f64, heading_rad: f64) -> Self {
        let turn = UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, heading_rad);
        Self {
            x: turn.i,
            y: turn.j,
            z: turn.k,
            w: turn.w,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct RosPose {
    pub(crate) position: RosVector,
    pub(crate) orientation: RosQuaternion,
}

#[cfg(feature = "dds")]
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct PoseStamped {
    pub(crate) header: Header,
    pub(crate) pose: RosPose,
}

#[cfg(feature = "dds")]
impl RosMessage for PoseStamped {
    const NAME: &'static str = "geometry_msgs/msg/PoseStamped";
}
