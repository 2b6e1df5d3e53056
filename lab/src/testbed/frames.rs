//! Frames of a vehicle's camera as image files; its node plays them as it would any others.

use std::fs;
use std::path::Path;

use anyhow::{Context, ensure};
use ecod_actors::camera::frame_source::SourceConfig;
use opencv::core::Vector;
use opencv::imgcodecs::imwrite;

use super::camera::TestbedCamera;
use super::{Cav, Scene, Testbed};

/// Number of rendered frames; they are played repeatedly.
const FRAMES: u64 = 50;

/// Renders the vehicle's first frames into `directory`, without loss. The returned source plays
/// them at the rate of the scene's cameras.
///
/// # Errors
/// Returns an error if a frame cannot be rendered or written.
pub fn render(
    testbed: &Testbed,
    scene: &Scene,
    cav: &Cav,
    seed: u64,
    directory: &Path,
) -> anyhow::Result<SourceConfig> {
    let camera = TestbedCamera::new(testbed, scene, cav, seed)?;
    fs::create_dir_all(directory)
        .with_context(|| format!("cannot make {}", directory.display()))?;
    for number in 0..FRAMES {
        // Uncompressed: noise does not compress, and a camera's frames need no decoding either.
        let file = directory.join(format!("{number:04}.ppm"));
        let written = imwrite(&file, &camera.frame(number)?, &Vector::new());
        ensure!(
            written.with_context(|| format!("cannot write {}", file.display()))?,
            "cannot write {}",
            file.display()
        );
    }
    let path = fs::canonicalize(directory)
        .with_context(|| format!("cannot find {}", directory.display()))?;
    Ok(SourceConfig::Images {
        path,
        fps: 1.0 / testbed.camera.capture_interval.as_secs_f64(),
        looping: true,
    })
}
