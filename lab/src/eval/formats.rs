//! Files of benchmarks, as truth and as output of a tracker or detector: KITTI tracking,
//! MOTChallenge and COCO.
//!
//! Frames are numbered in these files; frame n is n periods after the first. Positions are on the
//! ground, in metres; boxes in an image are placed there by the camera that took the image. A
//! directory contains one sequence per file, by name, a thousand seconds apart.

mod coco;
mod kitti;
mod mot;
mod standing_camera;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::ValueEnum;
use ecod::model::detection::BoundingBox;
use ecod::model::names::{Label, NodeName};
use ecod::model::time::Timestamp;
use ecod::wire::{ObjectReport, PerceivedObject, WirePose};
use ecod_actors::platform::bounded_file;
use nalgebra::Point2;

pub use standing_camera::StandingCamera;

/// Time between the beginnings of two sequences.
const SEQUENCE_US: u64 = 1_000_000_000;

/// The form of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FileFormat {
    /// KITTI tracking: label_02 and results, or AB3DMOT's detections; the frame of the vehicle, x
    /// forward, y left
    Kitti,
    /// MOTChallenge: positions on the ground (columns 8 and 9), as 3D MOT 2015 has them, or boxes
    /// of the camera in --config
    Mot,
    /// COCO: a dataset with annotations, or results; image n is frame n, with boxes of the camera
    /// in --config
    Coco,
}

/// An object in a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FileObject {
    /// Its identity in its sequence; `None` for detections.
    pub id: Option<i64>,
    /// Its class, its confidence (of truth, 1) and its place on the ground.
    pub perceived: PerceivedObject,
}

/// An object as stated in its file.
#[derive(Debug, Clone, PartialEq)]
struct ParsedObject {
    id: Option<i64>,
    label: Label,
    /// Confidence, 0 to 1 unless it is log-odds; of truth, 1.
    score: f64,
    place: FilePlace,
}

/// The place of an object in a file.
#[derive(Debug, Clone, Copy, PartialEq)]
enum FilePlace {
    /// On the ground, in metres.
    Ground(Point2<f64>),
    Image(BoundingBox),
}

/// The objects of every frame that has any, or that the file lists, by its number.
type ParsedFrames = BTreeMap<u64, Vec<ParsedObject>>;

/// The objects of every frame that has any, by its number.
pub type Frames = BTreeMap<u64, Vec<FileObject>>;

/// A sequence of frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Sequence {
    /// Name of its file, without ending.
    pub name: String,
    /// Number of the first frame.
    pub first: u64,
    /// Its frames.
    pub frames: Frames,
    /// The pose of the camera that placed the objects; it stands.
    pub pose: Option<WirePose>,
    /// Boxes without a place on the ground, by reason.
    pub discarded: BTreeMap<&'static str, u64>,
}

impl Sequence {
    /// Number of the last frame that has objects.
    pub fn last(&self) -> u64 {
        self.frames.keys().last().copied().unwrap_or(self.first)
    }

    /// A vehicle's reports of all frames up to `last`, where this is the sequence with that number.
    pub fn reports(
        &self,
        number: usize,
        frame_rate_hz: f64,
        node: &NodeName,
        last: u64,
    ) -> impl Iterator<Item = ObjectReport> {
        (self.first..=last).map(move |frame| {
            let objects = self
                .frames
                .get(&frame)
                .into_iter()
                .flatten()
                .map(|object| object.perceived.clone())
                .collect();
            let at = time_of(number, frame, frame_rate_hz);
            let moving = self.pose.map(|_| false);
            ObjectReport {
                objects,
                pose: self.pose,
                moving,
                ..ObjectReport::new(node.clone(), frame, at)
            }
        })
    }
}

/// A line that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {field}: {fault}")]
pub struct LineError {
    /// Its number, from 1.
    pub line: usize,
    /// The column and its expected content.
    pub field: String,
    /// The fault.
    pub fault: String,
}

impl FileFormat {
    /// The file, or all files of a directory with the extension of the format, sorted by name.
    ///
    /// # Errors
    /// Returns an error if there is no such file.
    pub fn files(self, path: &Path) -> anyhow::Result<Vec<PathBuf>> {
        if !path.is_dir() {
            return Ok(vec![path.to_owned()]);
        }
        let ending = if self == Self::Coco { "json" } else { "txt" };
        let entries =
            fs::read_dir(path).with_context(|| format!("cannot read {}", path.display()))?;
        let has_ending = |file: &PathBuf| {
            file.extension()
                .is_some_and(|extension| extension == ending)
        };
        let mut files: Vec<PathBuf> = entries
            .filter_map(Result::ok)
            .map(|entry| entry.path())
            .filter(has_ending)
            .collect();
        files.sort_by_cached_key(|file| file.file_stem().map(OsStr::to_owned));
        if files.is_empty() {
            bail!("there is no .{ending} file in {}", path.display())
        } else {
            Ok(files)
        }
    }

    /// Reads a file, or all files of a directory with the extension of the format. Boxes are seen
    /// by `camera`.
    ///
    /// # Errors
    /// Returns an error that names file, line and field.
    pub fn read(
        self,
        path: &Path,
        camera: Option<&StandingCamera>,
    ) -> anyhow::Result<Vec<Sequence>> {
        if self == Self::Kitti && camera.is_some() {
            bail!("positions of KITTI are those of its vehicle: they need no --config");
        }
        let files = self.files(path)?;
        let parse = |file: &PathBuf| {
            let text = bounded_file::read_text(file)
                .with_context(|| format!("cannot read {}", file.display()))?;
            self.parse(&text, camera.is_some())
                .with_context(|| file.display().to_string())
        };
        let mut parsed = files
            .iter()
            .map(parse)
            .collect::<anyhow::Result<Vec<_>>>()?;
        as_probabilities(&mut parsed);
        Ok(files
            .iter()
            .zip(parsed)
            .map(|(file, frames)| self.sequence(file, frames, camera))
            .collect())
    }

    fn sequence(
        self,
        file: &Path,
        parsed: ParsedFrames,
        camera: Option<&StandingCamera>,
    ) -> Sequence {
        let name = file
            .file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let first = match self {
            Self::Kitti => 0,
            Self::Mot => 1,
            Self::Coco => parsed.keys().next().copied().unwrap_or_default(),
        };
        let sequence = Sequence {
            name,
            first,
            frames: Frames::new(),
            pose: None,
            discarded: BTreeMap::new(),
        };
        standing_camera::placed(parsed, camera, sequence)
    }

    /// Reads the text of a file; a file with boxes needs a camera.
    fn parse(self, text: &str, has_camera: bool) -> anyhow::Result<ParsedFrames> {
        let text = text.trim_start_matches('\u{feff}');
        Ok(match self {
            Self::Coco => coco::frames(text, has_camera)?,
            _ => self.lines(text, has_camera)?,
        })
    }

    fn lines(self, text: &str, has_camera: bool) -> Result<ParsedFrames, LineError> {
        let mut frames = ParsedFrames::new();
        for (number, line) in text
            .lines()
            .enumerate()
            .filter(|(_, line)| !line.trim().is_empty())
        {
            let cells = Cells::new(number + 1, line);
            let object = if self == Self::Kitti {
                kitti::object(&cells)?
            } else {
                mot::object(&cells, has_camera)?
            };
            if let Some((frame, object)) = object {
                if let FilePlace::Ground(place) = object.place
                    && let Err((field, _)) =
                        PerceivedObject::new(object.label.clone(), 1.0, place.x, place.y)
                            .check_fields()
                {
                    let fault = format!("({}, {}) is out of bounds", place.x, place.y);
                    return Err(LineError {
                        line: number + 1,
                        field: format!("position ({field})"),
                        fault,
                    });
                }
                frames.entry(frame).or_default().push(object);
            }
        }
        Ok(frames)
    }
}

/// The number of a frame, if it is plausible. All frames up to the last make a report, also those
/// without objects.
fn frame_number(number: i64) -> Option<u64> {
    (0..1_000_000).contains(&number).then_some(number as u64)
}

/// The time of a frame.
pub fn time_of(sequence: usize, frame: u64, frame_rate_hz: f64) -> Timestamp {
    Timestamp(sequence as u64 * SEQUENCE_US + (frame as f64 * 1e6 / frame_rate_hz).round() as u64)
}

/// The number of the sequence that lasts at that time.
pub fn sequence_at(time: Timestamp) -> usize {
    (time.0 / SEQUENCE_US) as usize
}

/// Checks that no sequence, of several, lasts into the next one.
///
/// # Errors
/// Returns an error that names the sequence.
pub fn check_lengths<'a>(
    sequences: impl IntoIterator<Item = &'a Sequence>,
    frame_rate_hz: f64,
) -> anyhow::Result<()> {
    let lasts_on =
        |sequence: &&Sequence| sequence_at(time_of(0, sequence.last(), frame_rate_hz)) > 0;
    match sequences.into_iter().find(lasts_on) {
        Some(Sequence { name, .. }) => {
            let seconds = SEQUENCE_US / 1_000_000;
            bail!(
                "{name} lasts for more than the {seconds} s of one of several sequences; give its file by itself"
            )
        }
        None => Ok(()),
    }
}

/// Log-odds above which values are compressed, and the upper limit of the result: otherwise
/// probabilities would be too close to 1 to be distinguished.
const LARGE_LOG_ODDS: f64 = 20.0;
const MAX_LOG_ODDS: f64 = 30.0;

/// If any score is outside 0 to 1, all scores are interpreted as log-odds. Their order is kept.
fn as_probabilities(files: &mut [ParsedFrames]) {
    let objects = files.iter_mut().flat_map(BTreeMap::values_mut).flatten();
    let mut scores: Vec<&mut f64> = objects.map(|object| &mut object.score).collect();
    if scores.iter().any(|score| !(0.0..=1.0).contains(&**score)) {
        scores
            .iter_mut()
            .for_each(|score| **score = 1.0 / (1.0 + (-compressed(**score)).exp()));
    }
}

fn compressed(log_odds: f64) -> f64 {
    let beyond = (log_odds.abs() - LARGE_LOG_ODDS).max(0.0) / LARGE_LOG_ODDS;
    let most = MAX_LOG_ODDS - LARGE_LOG_ODDS;
    log_odds.clamp(-LARGE_LOG_ODDS, LARGE_LOG_ODDS)
        + log_odds.signum() * most * (1.0 - 1.0 / (1.0 + beyond))
}

/// The cells of a line, separated by commas or else by blanks.
struct Cells<'a> {
    line: usize,
    cells: Vec<&'a str>,
    has_commas: bool,
}

impl<'a> Cells<'a> {
    fn new(line: usize, text: &'a str) -> Self {
        let has_commas = text.contains(',');
        let cells = if has_commas {
            text.split(',').map(str::trim).collect()
        } else {
            text.split_ascii_whitespace().collect()
        };
        Self {
            line,
            cells,
            has_commas,
        }
    }

    fn text(&self, column: usize, name: &str) -> Result<&'a str, LineError> {
        let missing = || {
            self.error(
                column,
                name,
                format!("is missing, there are {} columns", self.cells.len()),
            )
        };
        self.cells.get(column - 1).copied().ok_or_else(missing)
    }

    /// A finite number.
    fn number(&self, column: usize, name: &str) -> Result<f64, LineError> {
        let text = self.text(column, name)?;
        let number = text.parse().ok().filter(|number: &f64| number.is_finite());
        number.ok_or_else(|| self.error(column, name, format!("{text:?} is no number")))
    }

    /// A whole number, which some programs write as a fraction of zero.
    fn integer(&self, column: usize, name: &str) -> Result<i64, LineError> {
        let number = self.number(column, name)?;
        let is_whole = number.fract() == 0.0 && number.abs() < 1e15;
        if is_whole {
            Ok(number as i64)
        } else {
            Err(self.error(column, name, format!("{number} is no whole number")))
        }
    }

    fn frame(&self) -> Result<u64, LineError> {
        let frame = self.integer(1, "frame")?;
        frame_number(frame)
            .ok_or_else(|| self.error(1, "frame", format!("{frame} is out of bounds")))
    }

    fn error(&self, column: usize, name: &str, fault: String) -> LineError {
        LineError {
            line: self.line,
            field: format!("column {column} ({name})"),
            fault,
        }
    }
}
