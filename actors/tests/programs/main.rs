//! `ecod-node` as its users run it: commands, help, configurations, errors, pictures and videos, logs, and the service.

#[cfg(feature = "camera")]
mod calibrate_mount;
#[cfg(feature = "camera")]
mod camera_masks;
mod cli;
#[cfg(feature = "camera")]
mod configuration_reference;
#[cfg(feature = "camera")]
mod errors;
mod example_configurations;
#[cfg(feature = "camera")]
mod help;
mod recording;
mod replay;
mod schema;
mod service;
#[cfg(all(feature = "camera", feature = "otel"))]
mod spans;
mod status;
#[cfg(feature = "camera")]
mod try_pictures;
#[cfg(feature = "camera")]
mod v4l2_camera;
#[cfg(feature = "camera")]
mod video_sources;

use std::process::Command;

use ecod_testkit::command;

/// The program without input, and without variables of the environment that configure it.
fn ecod_node() -> Command {
    command(env!("CARGO_BIN_EXE_ecod-node"))
}
