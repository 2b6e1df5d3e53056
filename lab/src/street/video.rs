//! Videos of the street.

use std::path::Path;

use anyhow::{Context, ensure};
use opencv::core::Size;
use opencv::prelude::*;
use opencv::videoio::VideoWriter;

use super::network_camera::FRAMES_PER_S;
use super::view::StreetView;
use super::{Street, StreetCamera};

/// Frames of a video: as long as a car takes to come back, so that no car jumps when the video
/// starts again.
const FRAMES: u32 = 100;

/// Writes a camera's pictures as H.264.
///
/// # Errors
/// Returns an error if OpenCV has no encoder for it, or the file cannot be written.
pub(crate) fn write(street: &Street, camera: &StreetCamera, file: &Path) -> anyhow::Result<()> {
    let view = StreetView::new(street)?;
    let optics = Street::optics();
    let size = Size::new(optics.width.cast_signed(), optics.height.cast_signed());
    let name = file.to_str().context("the path is no UTF-8")?;
    let mut writer = VideoWriter::new(
        name,
        VideoWriter::fourcc('a', 'v', 'c', '1')?,
        FRAMES_PER_S,
        size,
        true,
    )?;
    ensure!(writer.is_opened()?, "OpenCV cannot write {name} as H.264");
    for frame in 0..FRAMES {
        writer.write(&view.render(street, camera, f64::from(frame) / FRAMES_PER_S)?)?;
    }
    Ok(writer.release()?)
}
