//! Counters of a node, and spans of its work.

#[cfg(feature = "camera")]
pub mod camera_troubles;
pub mod counters;
pub(crate) mod line_throttle;
#[cfg(feature = "otel")]
pub mod otlp;
pub mod spans;
pub mod troubles;
