//! From pixels to positions: cameras, projection, fields of view, landmarks, poses over time.

pub mod box_projection;
pub mod camera;
pub mod distortion;
pub mod landmark;
pub mod polygon;
pub mod pose_history;
pub mod projection;
pub mod view;
