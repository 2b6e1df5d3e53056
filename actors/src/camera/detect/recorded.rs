//! Detections from a file instead of a detector: for recordings and for nodes without a usable
//! model.
//!
//! The file is JSON Lines: line n holds the detections of frame n as an array of
//! [`ecod::model::detection::Detection`]s, which may be empty, as may be the line:
//!
//! ```text
//! [{"label":"cup","confidence":0.93,"bounding_box":{"x_min":12.5,"y_min":80,"x_max":96,"y_max":171}}]
//! []
//! ```

use std::path::{Path, PathBuf};

use ecod::model::detection::{Detection, parse_detections};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Detect, DetectError};
use crate::camera::frame::CameraFrame;
use crate::platform::bounded_file;

/// Source of recorded detections.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RecordedConfig {
    /// The JSON Lines file.
    pub path: PathBuf,
    /// Whether to start again after the last line; default false: later frames have no detections.
    #[serde(default)]
    pub looping: bool,
}

/// A recording that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The file cannot be read.
    #[error("cannot read recorded detections {path:?}")]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        #[source]
        source: std::io::Error,
    },
    /// A line is not an array of detections.
    #[error("recorded detections {path:?}, line {line}: {reason}")]
    Malformed {
        /// Path of the file.
        path: PathBuf,
        /// Line number, from 1.
        line: usize,
        /// Reason why the line cannot be used.
        reason: String,
    },
}

/// Plays recorded detections back, one line for each frame.
#[derive(Debug)]
pub struct RecordedDetector {
    frames: Vec<Vec<Detection>>,
    looping: bool,
    next: usize,
}

impl RecordedDetector {
    /// Reads the whole recording.
    ///
    /// # Errors
    /// Returns a [`RecordingError`] that names the file and the first bad line.
    pub fn open(config: &RecordedConfig) -> Result<Self, RecordingError> {
        let path = &config.path;
        let text = bounded_file::read_text(path).map_err(|source| RecordingError::Unreadable {
            path: path.clone(),
            source,
        })?;
        // Editors leave empty lines at the end.
        let frames = text
            .trim_end()
            .lines()
            .enumerate()
            .map(|(index, line)| read_line(path, index + 1, line));
        Ok(Self {
            frames: frames.collect::<Result<_, _>>()?,
            looping: config.looping,
            next: 0,
        })
    }
}

impl Detect for RecordedDetector {
    fn detect(&mut self, _frame: &CameraFrame) -> Result<Vec<Detection>, DetectError> {
        if self.looping && self.next >= self.frames.len() {
            self.next = 0;
        }
        let detections = self.frames.get(self.next).cloned().unwrap_or_default();
        self.next = self.next.saturating_add(1);
        Ok(detections)
    }
}

fn read_line(path: &Path, line: usize, text: &str) -> Result<Vec<Detection>, RecordingError> {
    if text.trim().is_empty() {
        return Ok(Vec::new());
    }
    parse_detections(text).map_err(|reason| RecordingError::Malformed {
        path: path.to_owned(),
        line,
        reason,
    })
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use ecod::model::time::Timestamp;
    use opencv::core::Mat;

    use super::*;

    const CUP: &str = r#"[{"label":"cup","confidence":0.9,"bounding_box":{"x_min":1,"y_min":2,"x_max":30,"y_max":40}}]"#;

    fn open(text: &str, looping: bool) -> Result<RecordedDetector, RecordingError> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        RecordedDetector::open(&RecordedConfig {
            path: file.path().to_owned(),
            looping,
        })
    }

    fn counts(mut detector: RecordedDetector, frames: usize) -> Vec<usize> {
        let frame = CameraFrame {
            image: Mat::default(),
            captured_at: Timestamp(0),
            seq: 0,
        };
        (0..frames)
            .map(|_| detector.detect(&frame).unwrap().len())
            .collect()
    }

    #[test]
    fn plays_lines_once_or_looped() {
        let text = format!("{CUP}\n[]\n{CUP}\n");
        assert_eq!(counts(open(&text, false).unwrap(), 5), [1, 0, 1, 0, 0]);
        assert_eq!(counts(open(&text, true).unwrap(), 5), [1, 0, 1, 1, 0]);
        let marked = format!("\u{feff}{CUP}\r\n\r\n{CUP}\r\n\r\n \n");
        assert_eq!(counts(open(&marked, true).unwrap(), 4), [1, 0, 1, 1]);
        assert_eq!(counts(open("", true).unwrap(), 2), [0, 0]);
    }

    #[test]
    fn bad_recording_names_its_line() {
        for bad in [
            "{",
            r#"{"label":"cup"}"#,
            &CUP.replace("0.9", "1.9"),
            &CUP.replace("30", "0"),
            &CUP.replace("cup", ""),
        ] {
            let error = open(&format!("[]\n{bad}\n"), false)
                .expect_err("malformed")
                .to_string();
            assert!(error.contains("line 2: "), "{error}");
        }
        let missing = RecordedConfig {
            path: "no/such/file.jsonl".into(),
            looping: false,
        };
        assert!(
            RecordedDetector::open(&missing)
                .expect_err("missing")
                .to_string()
                .contains("no/such/file.jsonl")
        );
    }
}
