//! A camera's pictures and optics: `sensor_msgs`.

use serde::{Deserialize, Serialize};

use super::messages::{Definition, HEADER, Header, RosMessage, TIME};

pub(super) const IMAGE: &str = "std_msgs/Header header\nstring format\nuint8[] data\n";

#[derive(Debug, Default, Serialize)]
pub(super) struct RosImage {
    pub(super) header: Header,
    pub(super) format: String,
    pub(super) data: Vec<u8>,
}

impl RosMessage for RosImage {
    const NAME: &'static str = "sensor_msgs/msg/CompressedImage";
}

impl Definition for RosImage {
    const FIELDS: &'static str = IMAGE;
    const INSIDE: &'static [(&'static str, &'static str)] = &[HEADER, TIME];
}

#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct RegionOfInterest {
    pub(crate) x_offset: u32,
    pub(crate) y_offset: u32,
    pub(crate) height: u32,
    pub(crate) width: u32,
    pub(crate) do_rectify: bool,
}

/// Optics of a camera. `d` are OpenCV's k1, k2, p1, p2, k3; `p` is for pictures without distortion.
/// All are for the whole sensor, of which a picture is the region of interest, with one pixel for
/// `binning_x` by `binning_y`; zeros mean the whole and one.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct CameraInfo {
    pub(crate) header: Header,
    pub(crate) height: u32,
    pub(crate) width: u32,
    pub(crate) distortion_model: String,
    pub(crate) d: Vec<f64>,
    pub(crate) k: [f64; 9],
    pub(crate) r: [f64; 9],
    pub(crate) p: [f64; 12],
    pub(crate) binning_x: u32,
    pub(crate) binning_y: u32,
    pub(crate) roi: RegionOfInterest,
}

impl RosMessage for CameraInfo {
    const NAME: &'static str = "sensor_msgs/msg/CameraInfo";
}

impl Definition for CameraInfo {
    const FIELDS: &'static str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n\
                                  float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n\
                                  sensor_msgs/RegionOfInterest roi\n";
    const INSIDE: &'static [(&'static str, &'static str)] = &[
        HEADER,
        TIME,
        (
            "sensor_msgs/RegionOfInterest",
            "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
        ),
    ];
}
