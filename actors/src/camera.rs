//! Camera of a vehicle: frame sources, detectors, lens, calibration, and placing detections in the
//! world.

#[cfg(feature = "camera")]
pub mod calibrate;
#[cfg(feature = "camera")]
pub mod config;
#[cfg(feature = "camera")]
pub mod corner_pose;
#[cfg(feature = "camera")]
pub mod detect;
#[cfg(feature = "camera")]
pub mod frame;
#[cfg(feature = "camera")]
pub mod frame_source;
#[cfg(feature = "camera")]
pub mod image_codec;
#[cfg(feature = "camera")]
pub mod image_size;
#[cfg(feature = "camera")]
pub mod lens;
#[cfg(feature = "camera")]
pub mod mask;
#[cfg(feature = "camera")]
pub mod mount_calibration;
#[cfg(feature = "camera")]
pub mod perception;
pub mod vehicle_pose;
