//! Counters of a node, and spans of what it does.

pub mod counters;
#[cfg(feature = "otel")]
pub mod otlp;
pub mod spans;
pub mod troubles;
