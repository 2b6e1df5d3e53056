//! ECOD's actors: everything that touches a clock, a socket, a camera or a disk.

#[cfg(feature = "camera")]
pub mod calibrate;
pub mod clock;
#[cfg(feature = "camera")]
pub mod corner_pose;
#[cfg(feature = "camera")]
pub mod detect;
#[cfg(feature = "camera")]
pub mod frame;
#[cfg(feature = "camera")]
pub mod frame_source;
pub mod latest_slot;
#[cfg(feature = "camera")]
pub mod lens;
