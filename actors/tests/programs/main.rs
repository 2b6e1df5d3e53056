//! `ecod-node` as its users run it: commands, configurations, pictures and videos, logs, and the service.

#[cfg(feature = "camera")]
mod calibrate_mount;
mod cli;
mod example_configurations;
mod recording;
mod replay;
mod schema;
mod service;
#[cfg(all(feature = "camera", feature = "otel"))]
mod spans;
#[cfg(feature = "camera")]
mod try_pictures;
#[cfg(feature = "camera")]
mod video_sources;
