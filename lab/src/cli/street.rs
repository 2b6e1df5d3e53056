//! `ecod-lab street`: the scene that `ecod-node try` shows by default.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::cli::Failure;

use crate::demo::street_demo::camera_node;
use crate::street::{Street, StreetCamera, video};

/// Flags of `street`.
#[derive(Debug, Args)]
pub(super) struct StreetArguments {
    /// Directory for videos and configurations
    #[arg(short, long = "output", alias = "out", value_name = "DIR")]
    out: PathBuf,
}

pub(super) fn run(arguments: &StreetArguments) -> Result<(), Failure> {
    let street = Street::default();
    fs::create_dir_all(&arguments.out)
        .with_context(|| format!("cannot make {}", arguments.out.display()))?;
    for camera in fixed_cameras(&street) {
        video::write(&street, camera, &arguments.out.join(video_of(camera)))?;
        let file = arguments.out.join(format!("{}.toml", camera.name));
        fs::write(&file, config(&street, camera)?)
            .with_context(|| format!("cannot write {}", file.display()))?;
    }
    Ok(())
}

fn fixed_cameras(street: &Street) -> impl Iterator<Item = &StreetCamera> {
    street
        .cameras
        .iter()
        .filter(|camera| !street.drives(camera))
}

fn video_of(camera: &StreetCamera) -> String {
    format!("{}.mp4", camera.name)
}

fn config(street: &Street, camera: &StreetCamera) -> anyhow::Result<String> {
    let source = SourceConfig::Video {
        path: video_of(camera).into(),
        looping: true,
    };
    camera_node(street, camera, source, None)
        .to_toml_changed()
        .context("the configuration cannot be written as TOML")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bundled_street_files_match_cameras() {
        let street = Street::default();
        for camera in fixed_cameras(&street) {
            let file = format!(
                "{}/../examples/street/{}.toml",
                env!("CARGO_MANIFEST_DIR"),
                camera.name
            );
            assert_eq!(
                fs::read_to_string(&file).unwrap(),
                config(&street, camera).unwrap(),
                "{file}"
            );
        }
    }
}
