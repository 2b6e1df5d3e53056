//! Frames from image files.

use std::path::{Path, PathBuf};

use super::{FrameError, FramePacer, FrameSource, TimeSource};
use crate::camera::frame::CameraFrame;
use crate::camera::image_codec;
use crate::platform::clock;

const EXTENSIONS: [&str; 7] = ["bmp", "jpeg", "jpg", "pgm", "png", "ppm", "webp"];

/// Maximum number of digits in the names of a pattern: the digits of the largest number.
const MAX_DIGITS: usize = 20;

/// Images in the order of their names.
pub(super) struct ImageSequence {
    origin: String,
    files: Vec<PathBuf>,
    looping: bool,
    pace: FramePacer,
    /// Number of files read, including unusable ones.
    next: u64,
}

impl ImageSequence {
    /// Lists the images of a directory or a numbered pattern; `path` may also be one image.
    pub(super) fn open(path: &Path, fps: f64, looping: bool) -> Result<Self, FrameError> {
        let origin = path.display().to_string();
        let failed = |reason: String| FrameError::Open {
            origin: origin.clone(),
            reason,
        };
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let files = if name.contains('%') && !path.is_dir() {
            numbered(path, &name)
                .ok_or_else(|| failed("need one %d or %0Nd in the pattern".into()))?
        } else if path.is_file() {
            vec![path.to_owned()]
        } else {
            in_directory(path).map_err(|e| failed(e.to_string()))?
        };
        if files.is_empty() {
            return Err(failed("no images found".into()));
        }
        Ok(Self {
            origin,
            files,
            looping,
            pace: FramePacer::new(fps),
            next: 0,
        })
    }
}

impl FrameSource for ImageSequence {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        let count = self.files.len() as u64;
        if self.next >= count && !self.looping {
            return Err(FrameError::Ended {
                origin: self.origin.clone(),
            });
        }
        let file = &self.files[(self.next % count) as usize];
        let seq = self.next;
        self.next += 1;
        self.pace.wait();
        let unusable = |reason: String| FrameError::Unusable {
            origin: file.display().to_string(),
            reason,
        };
        let image = image_codec::read(file).map_err(|e| unusable(e.to_string()))?;
        Ok(CameraFrame {
            image,
            captured_at: clock::now(),
            seq,
        })
    }

    fn time_source(&self) -> TimeSource {
        TimeSource::Playback
    }
}

/// The images of a directory in the order of their names.
pub(crate) fn in_directory(directory: &Path) -> std::io::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(directory)?.map(|entry| Ok(entry?.path()));
    let mut files = entries.collect::<std::io::Result<Vec<PathBuf>>>()?;
    files.retain(|path| is_image(path));
    files.sort();
    Ok(files)
}

/// True if the name of a file is one of an image.
pub(crate) fn is_image(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str());
    extension.is_some_and(|e| EXTENSIONS.contains(&e.to_ascii_lowercase().as_str()))
}

/// Existing files of the pattern `name`, the last part of `path`, counting up to the first gap.
/// `None` unless the name has one place for the number.
fn numbered(path: &Path, name: &str) -> Option<Vec<PathBuf>> {
    let mut places = name.match_indices('%').filter_map(|(at, _)| {
        let (before, rest) = name.split_at(at);
        let (digits, after) = rest.strip_prefix('%')?.split_once('d')?;
        let width: usize = if digits.is_empty() {
            0
        } else {
            digits.parse().ok()?
        };
        (width <= MAX_DIGITS).then_some((before, width, after))
    });
    let (before, width, after) = places.next().filter(|_| places.next().is_none())?;
    let file = |number: u64| path.with_file_name(format!("{before}{number:0width$}{after}"));
    let first = if file(0).is_file() { 0 } else { 1 };
    Some(
        (first..)
            .map(file)
            .take_while(|path| path.is_file())
            .collect(),
    )
}
