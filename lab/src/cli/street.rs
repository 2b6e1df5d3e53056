//! `ecod-lab street`: what `ecod-node try` looks at when it is told nothing.

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::cli::Failure;

use crate::demo::street_demo::camera_node;
use crate::street::{Street, video};

/// Flags of `street`.
#[derive(Debug, Args)]
pub(super) struct StreetArguments {
    /// Directory for videos and configurations
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub(super) fn run(arguments: &StreetArguments) -> Result<(), Failure> {
    let street = Street::default();
    fs::create_dir_all(&arguments.out).with_context(|| format!("cannot make {}", arguments.out.display()))?;
    for camera in street.cameras.iter().filter(|camera| !street.drives(camera)) {
        let name = format!("{}.mp4", camera.name);
        video::write(&street, camera, &arguments.out.join(&name))?;
        let source = SourceConfig::Video { path: name.into(), looping: true };
        let config = camera_node(&street, camera, source, None).to_toml_changed().map_err(|error| anyhow!(error))?;
        let file = arguments.out.join(format!("{}.toml", camera.name));
        fs::write(&file, config).with_context(|| format!("cannot write {}", file.display()))?;
    }
    Ok(())
}
