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
use hashbrown::HashMap;
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
    /// Its line from 1, or its place in a list from 0.
    entry: usize,
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

/// A file as read.
#[derive(Debug, Default)]
struct ParsedFile {
    frames: ParsedFrames,
    skipped: SkippedEntries,
}

/// Entries of a file that state no usable object.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SkippedEntries {
    /// Number of these entries.
    pub count: u64,
    /// The first of them as text, with its fault.
    pub first: String,
}

impl SkippedEntries {
    fn add(&mut self, fault: String) {
        if self.count == 0 {
            self.first = fault;
        }
        self.count += 1;
    }
}

/// Names of the categories of datasets in the form of COCO, by their numbers.
pub type Categories = BTreeMap<i64, Label>;

/// The vehicle's camera and the dataset that files belong to.
#[derive(Debug, Clone, Copy, Default)]
pub struct FileContext<'a> {
    /// The camera that saw the boxes.
    pub camera: Option<&'a StandingCamera>,
    /// The categories of results in the form of COCO. Default: COCO's own.
    pub categories: Option<&'a Categories>,
}

/// The objects of every frame that has any, by its number.
pub type Frames = BTreeMap<u64, Vec<FileObject>>;

/// A sequence of frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Sequence {
    /// Name of its file, without ending.
    pub name: String,
    /// Number of the first frame.
    pub first: u64,
    /// Objects by the number of the frame.
    pub frames: Frames,
    /// The pose of the camera that placed the objects; it stands.
    pub pose: Option<WirePose>,
    /// Boxes without a place on the ground, by reason.
    pub discarded: BTreeMap<&'static str, u64>,
    /// Entries that state no usable object.
    pub skipped: SkippedEntries,
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
    /// Fault of the column as text.
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

    /// The categories that the datasets in these files state, if any.
    ///
    /// # Errors
    /// Returns an error that names the file, also if datasets use a number for several categories.
    pub fn categories(self, path: &Path) -> anyhow::Result<Option<Categories>> {
        if self != Self::Coco {
            return Ok(None);
        }
        let mut categories = Categories::new();
        for file in self.files(path)? {
            let of_file =
                coco::categories(&text_of(&file)?).with_context(|| file.display().to_string())?;
            for (id, name) in of_file {
                let known = categories.entry(id).or_insert_with(|| name.clone());
                if *known != name {
                    let file = file.display();
                    bail!("{file}: category {id} is {name}, and {known} in another file");
                }
            }
        }
        Ok(Some(categories).filter(|categories| !categories.is_empty()))
    }

    /// Reads a file, or all files of a directory with the extension of the format.
    ///
    /// # Errors
    /// Returns an error that names file, line and field.
    pub fn read(
        self,
        path: &Path,
        FileContext { camera, categories }: FileContext<'_>,
    ) -> anyhow::Result<Vec<Sequence>> {
        if self == Self::Kitti && camera.is_some() {
            bail!("positions of KITTI are those of its vehicle: they need no --config");
        }
        let files = self.files(path)?;
        let parse = |file: &PathBuf| {
            self.parse(&text_of(file)?, camera.is_some(), categories)
                .with_context(|| file.display().to_string())
        };
        let mut parsed = files
            .iter()
            .map(parse)
            .collect::<anyhow::Result<Vec<_>>>()?;
        self.as_probabilities(&files, &mut parsed)?;
        Ok(files
            .iter()
            .zip(parsed)
            .map(|(file, frames)| self.sequence(file, frames, camera))
            .collect())
    }

    fn sequence(
        self,
        file: &Path,
        ParsedFile {
            frames: parsed,
            skipped,
        }: ParsedFile,
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
            skipped,
        };
        standing_camera::placed(parsed, camera, sequence)
    }

    /// Reads the text of a file; a file with boxes needs a camera.
    fn parse(
        self,
        text: &str,
        has_camera: bool,
        categories: Option<&Categories>,
    ) -> anyhow::Result<ParsedFile> {
        Ok(match self {
            Self::Coco => coco::frames(text, has_camera, categories)?,
            _ => self.lines(text, has_camera)?,
        })
    }

    fn lines(self, text: &str, has_camera: bool) -> Result<ParsedFile, LineError> {
        let mut parsed = ParsedFile::default();
        let mut tracks = HashMap::new();
        let mut without_area = None;
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
                if let FilePlace::Image(image) = object.place
                    && !image.is_valid()
                {
                    let fault = cells.error(5, "width", "and height are of no box".into());
                    parsed.skipped.add(fault.to_string());
                    without_area.get_or_insert(fault);
                    continue;
                }
                if let Some(id) = object.id
                    && let Some(first) = tracks.insert((frame, id), number + 1)
                {
                    let fault = format!("{id} is in frame {frame} already, in line {first}");
                    return Err(cells.error(2, "track", fault));
                }
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
                parsed.frames.entry(frame).or_default().push(object);
            }
        }
        match without_area.filter(|_| parsed.frames.is_empty()) {
            Some(error) => Err(error),
            None => Ok(parsed),
        }
    }

    /// Turns log-odds into probabilities if the files have them: many scores are then outside of 0
    /// to 1. A few such scores are faults, unless they are errors of rounding.
    fn as_probabilities(self, names: &[PathBuf], files: &mut [ParsedFile]) -> anyhow::Result<()> {
        let is_probability = |score: f64| (0.0..=1.0).contains(&score);
        let all = || files.iter().flat_map(|file| file.frames.values()).flatten();
        let count = all().count();
        let outside = all().filter(|o| !is_probability(o.score)).count();
        let are_log_odds = outside as f64 >= LOG_ODDS_SHARE * count as f64;
        for (name, file) in names.iter().zip(files).filter(|_| outside > 0) {
            for ParsedObject { entry, score, .. } in file.frames.values_mut().flatten() {
                if are_log_odds {
                    *score = 1.0 / (1.0 + (-compressed(*score)).exp());
                    continue;
                }
                let clamped = score.clamp(0.0, 1.0);
                if (*score - clamped).abs() > ROUNDING {
                    let place = match self {
                        Self::Coco => format!("entry [{entry}]"),
                        Self::Kitti | Self::Mot => format!("line {entry}"),
                    };
                    bail!(
                        "{}: {place}: score {score} is not within 0 to 1, where all but {outside} of {count} are: correct it, or state log-odds for all",
                        name.display()
                    );
                }
                *score = clamped;
            }
        }
        Ok(())
    }
}

fn text_of(file: &Path) -> anyhow::Result<String> {
    bounded_file::read_text(file).with_context(|| format!("cannot read {}", file.display()))
}

/// Least share of scores outside of 0 to 1 by which all scores are log-odds.
const LOG_ODDS_SHARE: f64 = 0.1;

/// Most by which a probability is outside of 0 to 1 after calculations with 32-bit numbers.
const ROUNDING: f64 = 1e-3;

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
