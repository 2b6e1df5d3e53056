//! The pictures that an argument of `try` names.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::camera::frame_source::SourceConfig;
use crate::camera::frame_source::images::is_image;

/// Frames per second at which images are shown.
const IMAGES_FPS: f64 = 5.0;

/// A source of pictures.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum PictureSource {
    /// A video file.
    Video(PathBuf),
    /// An image, a directory of images, or a pattern with the place of the number.
    Images(PathBuf),
    /// A camera of this machine.
    Device(PathBuf),
    /// A network camera.
    Url(String),
}

impl FromStr for PictureSource {
    type Err = String;

    /// Guesses the kind of a source. A file or directory has precedence over the number of a camera.
    fn from_str(text: &str) -> Result<Self, String> {
        let path = Path::new(text);
        let is_pattern = || {
            path.file_name()
                .is_some_and(|name| name.to_string_lossy().contains('%'))
        };
        match text.parse() {
            _ if text.contains("://") => Ok(Self::Url(text.to_owned())),
            _ if path.is_dir() => Ok(Self::Images(path.to_owned())),
            _ if path.is_file() && is_image(path) => Ok(Self::Images(path.to_owned())),
            _ if path.is_file() => Ok(Self::Video(path.to_owned())),
            _ if path.starts_with("/dev") => Ok(Self::Device(path.to_owned())),
            Ok(number) => Ok(Self::device(number)),
            Err(_) if is_pattern() => Ok(Self::Images(path.to_owned())),
            Err(_) => Err(
                "no such file or directory; give a video, an image, a directory of images, a pattern such as \
                 frames/%04d.png, a camera such as 0 or /dev/video0, or an address such as rtsp://192.168.1.20/stream1"
                    .to_owned(),
            ),
        }
    }
}

impl PictureSource {
    /// The camera of a number, 0 for `/dev/video0`.
    pub(super) fn device(number: u32) -> Self {
        Self::Device(format!("/dev/video{number}").into())
    }

    /// The kind as vehicles are named by it.
    pub(super) fn kind(&self) -> &'static str {
        match self {
            Self::Video(_) => "video",
            Self::Images(_) => "images",
            Self::Device(_) => "camera",
            Self::Url(_) => "url",
        }
    }

    /// The frame source. Paths are absolute, because a saved configuration should work in every
    /// directory.
    pub(super) fn into_config(self) -> SourceConfig {
        let absolute = |path: PathBuf| std::path::absolute(&path).unwrap_or(path);
        match self {
            Self::Video(path) => SourceConfig::Video {
                path: absolute(path),
                looping: true,
            },
            Self::Images(path) => SourceConfig::Images {
                path: absolute(path),
                fps: IMAGES_FPS,
                looping: true,
            },
            Self::Device(device) => SourceConfig::V4l2 {
                device,
                width: None,
                height: None,
                fps: None,
                latency_s: None,
            },
            Self::Url(url) => SourceConfig::Url {
                url,
                latency_s: None,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kind_is_guessed_from_argument() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        std::fs::write(path("drive.mp4"), "").unwrap();
        std::fs::write(path("still.JPG"), "").unwrap();
        let guess = |text: &Path| text.to_str().unwrap().parse::<PictureSource>();
        assert_eq!(
            guess(&path("drive.mp4")),
            Ok(PictureSource::Video(path("drive.mp4")))
        );
        assert_eq!(
            guess(&path("still.JPG")),
            Ok(PictureSource::Images(path("still.JPG")))
        );
        assert_eq!(
            guess(directory.path()),
            Ok(PictureSource::Images(directory.path().into()))
        );
        assert_eq!(
            guess(&path("%04d.png")),
            Ok(PictureSource::Images(path("%04d.png")))
        );
        assert_eq!("2".parse(), Ok(PictureSource::Device("/dev/video2".into())));
        assert_eq!(
            "/dev/video1".parse(),
            Ok(PictureSource::Device("/dev/video1".into()))
        );
        let url = "rtsp://192.168.1.20/stream1";
        assert_eq!(url.parse(), Ok(PictureSource::Url(url.into())));
        let error = guess(&path("missing.mp4")).unwrap_err();
        assert!(error.contains("no such file"), "{error}");
    }
}
