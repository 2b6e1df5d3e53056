//! `ecod-node calibrate mount`: height and tilt of a camera, and its place if the points determine
//! it.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow};
use clap::{Args, Subcommand};
use ecod::model::geometry::Pose;
use ecod::model::names::Label;
use ecod::model::origin::StatedPose;
use ecod::perception::projection::{MountEstimate, ObjectSize};
use tokio::time::{Instant, timeout_at};
use toml_edit::{DocumentMut, Item, TableLike};

use super::{Failure, print};
use crate::camera::calibrate::board::{GroundBoard, fit_board};
use crate::camera::calibrate::mount::PointFit;
use crate::camera::calibrate::{Chessboard, read_gray};
use crate::camera::config::{CameraConfig, MountConfig};
use crate::camera::frame_source::SourceConfig;
use crate::camera::frame_source::capture::Capture;
use crate::camera::image_size::ImageSize;
use crate::camera::lens::Lens;
use crate::camera::mount_calibration::people::PeopleWatch;
use crate::camera::mount_calibration::{MeasuredPoint, fit_mount_to_points, mount_table};
use crate::node;
use crate::node::config::NodeConfig;
use crate::platform::bounded_file;

#[derive(Debug, Subcommand)]
pub(super) enum MountCommand {
    /// From four or more points on the ground: pixel and place of each
    Points(PointsArguments),
    /// From a photograph of a QR code or chessboard on the ground
    Board(GroundBoardArguments),
    /// From people who walk in front of the camera, with the node's own source and detector
    People(PeopleArguments),
}

/// Flags of all three.
#[derive(Debug, Args)]
struct MountArguments {
    /// Configuration of the node (TOML), which contains the optics; measurements are in pixels of
    /// its frames
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Name of the camera, if there are several. Default: the name in `[camera]`
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// Write the mount into that file as well
    #[arg(long)]
    write: bool,
}

/// Flags of `points`.
#[derive(Debug, Args)]
pub(super) struct PointsArguments {
    #[command(flatten)]
    node: MountArguments,
    /// A point: column and row in pixels, metres ahead and to the left of the vehicle's reference
    /// point
    #[arg(long = "point", value_name = "COLUMN,ROW=AHEAD,LEFT", value_parser = measured_point)]
    points: Vec<MeasuredPoint>,
    /// The picture in which the points were measured, whose size counts. Default the size of
    /// `camera.optics`
    #[arg(long, value_name = "IMAGE")]
    image: Option<PathBuf>,
    /// Places are metres east and north in the cell's frame; the vehicle's position is `pose` in
    /// the configuration
    #[arg(long)]
    in_map: bool,
    /// File of more points, four numbers a line; lines that begin with # are left out
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
}

/// Flags of `board`.
#[derive(Debug, Args)]
pub(super) struct GroundBoardArguments {
    #[command(flatten)]
    node: MountArguments,
    /// Side of the QR code without its white rim, in millimetres
    #[arg(
        long,
        value_name = "MM",
        required_unless_present = "square_mm",
        conflicts_with = "square_mm"
    )]
    qr_side_mm: Option<f64>,
    /// Side of a square of the chessboard in millimetres
    #[arg(long, value_name = "MM")]
    square_mm: Option<f64>,
    /// Inner corners along a row of the chessboard
    #[arg(long, default_value_t = 9)]
    columns: u16,
    /// Inner corners along a column of the chessboard
    #[arg(long, default_value_t = 6)]
    rows: u16,
    /// The photograph, taken by the node's camera
    #[arg(value_name = "IMAGE")]
    photograph: PathBuf,
}

/// Flags of `people`.
#[derive(Debug, Args)]
pub(super) struct PeopleArguments {
    #[command(flatten)]
    node: MountArguments,
    /// Watch this video instead of `camera.source`
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Seconds to watch
    #[arg(long, value_name = "SECONDS", default_value_t = 60.0)]
    for_s: f64,
    /// Height with shoes in metres, if a single person walks. Default: the usual size of people
    #[arg(long, value_name = "METRES")]
    height_m: Option<f64>,
    /// The detector's label of people
    #[arg(long, default_value = "person")]
    label: String,
}

/// Relative standard deviation of the given height of one person.
const KNOWN_HEIGHT_SIGMA: f64 = 0.02;

/// Maximum time for the camera to end.
const STOP_TIMEOUT: Duration = Duration::from_secs(1);

fn measured_point(text: &str) -> Result<MeasuredPoint, String> {
    let words = text
        .split(|c: char| c == ',' || c == '=' || c == ';' || c.is_whitespace())
        .filter(|word| !word.is_empty());
    let numbers: Option<Vec<f64>> = words
        .map(|word| word.parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    match numbers.as_deref() {
        Some(&[column, row, x_m, y_m]) => Ok(MeasuredPoint {
            pixel: [column, row],
            position_m: [x_m, y_m],
        }),
        _ => Err(format!(
            "{text:?} is not four numbers: column and row in pixels, two distances in metres"
        )),
    }
}

pub(super) fn run(command: &MountCommand) -> Result<(), Failure> {
    match command {
        MountCommand::Points(arguments) => arguments.run(),
        MountCommand::Board(arguments) => arguments.run(),
        MountCommand::People(arguments) => arguments.run(),
    }
}

impl MountArguments {
    fn load(&self) -> Result<(NodeConfig, CameraConfig, Lens), Failure> {
        let config = NodeConfig::load(Some(&self.config), &BTreeMap::<String, String>::new())
            .map_err(Failure::usage)?;
        let camera = match &self.camera {
            None => config.camera.as_ref(),
            Some(name) => config
                .all_cameras()
                .find(|camera| camera.name.as_ref() == Some(name)),
        };
        let no_camera = || match &self.camera {
            None => anyhow!(
                "{:?} has no [camera]: `ecod-node try --output node.toml` writes one",
                self.config
            ),
            Some(name) => anyhow!(
                "{:?} has no camera {name:?}: see `name` in its [[cameras]]",
                self.config
            ),
        };
        let camera = camera
            .cloned()
            .ok_or_else(no_camera)
            .map_err(Failure::usage)?;
        let lens = node::camera::lens(&camera).map_err(Failure::usage)?;
        Ok((config, camera, lens))
    }

    /// Prints the mount to paste into a configuration, and writes it there if requested.
    fn report_mount(&self, estimate: &MountEstimate, lens: &Lens) -> Result<(), Failure> {
        print(&mount_table(estimate, self.camera.is_some()).context("the mount as TOML")?)?;
        if let Some([near_m, far_m]) = estimate.mount.ground_in_view(&lens.intrinsics) {
            let far = if far_m.is_finite() {
                format!("to {far_m:.1} m")
            } else {
                "to the horizon".to_owned()
            };
            eprintln!("the middle of the image shows the ground from {near_m:.1} m {far}");
        }
        if self.write {
            self.write_into(&MountConfig::rounded(&estimate.mount))
                .map_err(Failure::usage)?;
            eprintln!("written to {}", self.config.display());
        }
        Ok(())
    }

    /// Sets the keys of the mount in the configuration file, whose other lines stay as they are.
    fn write_into(&self, mount: &MountConfig) -> anyhow::Result<()> {
        let place = || format!("cannot write the mount to {}", self.config.display());
        let text = bounded_file::read_text(&self.config).with_context(place)?;
        let mut document: DocumentMut = text.parse().with_context(place)?;
        let camera = self
            .table(&mut document)
            .context("its camera is written elsewhere: paste the lines");
        let table = camera
            .with_context(place)?
            .entry("mount")
            .or_insert_with(toml_edit::table)
            .as_table_like_mut()
            .context("`mount` is no table")
            .with_context(place)?;
        let keys = toml::Table::try_from(mount).with_context(place)?;
        for (key, number) in keys
            .iter()
            .filter_map(|(key, value)| Some((key, value.as_float()?)))
        {
            table.insert(key, toml_edit::value(number));
        }
        std::fs::write(&self.config, document.to_string()).with_context(place)
    }

    /// The table of the camera.
    fn table<'a>(&self, document: &'a mut DocumentMut) -> Option<&'a mut dyn TableLike> {
        let is_named = |table: &dyn TableLike| {
            table.get("name").and_then(Item::as_str) == self.camera.as_deref()
        };
        if self.camera.is_none()
            || document
                .get("camera")
                .and_then(Item::as_table_like)
                .is_some_and(is_named)
        {
            return document.get_mut("camera")?.as_table_like_mut();
        }
        let mut cameras = document
            .get_mut("cameras")?
            .as_array_of_tables_mut()?
            .iter_mut();
        cameras
            .find(|camera| is_named(*camera))
            .map(|camera| camera as &mut dyn TableLike)
    }
}

impl PointsArguments {
    fn run(&self) -> Result<(), Failure> {
        let (config, _, lens) = self.node.load()?;
        let mut stated = self.points.clone();
        if let Some(file) = &self.file {
            let text = bounded_file::read_text(file)
                .with_context(|| format!("cannot read points from {}", file.display()))
                .map_err(Failure::usage)?;
            for (number, line) in text.lines().enumerate() {
                if !line.trim().is_empty() && !line.trim_start().starts_with('#') {
                    let place =
                        |problem| anyhow!("{}, line {}: {problem}", file.display(), number + 1);
                    stated.push(
                        measured_point(line)
                            .map_err(place)
                            .map_err(Failure::usage)?,
                    );
                }
            }
        }
        let picture = self.picture(&lens)?;
        let vehicle = self.vehicle(&config)?;
        let fit = fit_mount_to_points(&stated, picture, &lens, &vehicle)
            .context("the points give no mount")?;
        for (
            PointFit {
                error_px,
                error_m,
                is_outlier,
            },
            MeasuredPoint {
                pixel: [column, row],
                ..
            },
        ) in fit.points.iter().zip(&stated)
        {
            let on_ground = error_m.map_or_else(
                || "above the horizon".to_owned(),
                |metres| format!("{metres:.3} m"),
            );
            let outlier = if *is_outlier {
                "  OUTLIER, left out: measure it again"
            } else {
                ""
            };
            eprintln!("point {column},{row}: off by {error_px:.1} px, {on_ground}{outlier}");
        }
        self.node.report_mount(
            &fit.estimate,
            &lens.of_frames(picture).map_err(Failure::usage)?,
        )
    }

    /// The size of the picture in which the points were measured.
    fn picture(&self, lens: &Lens) -> Result<ImageSize, Failure> {
        let Some(path) = &self.image else {
            let unknown =
                anyhow!("`camera.optics` says no size of the image: give the picture with --image");
            return if lens.is_any_shape {
                Err(Failure::usage(unknown))
            } else {
                Ok((&lens.intrinsics).into())
            };
        };
        let size = ImageSize::of(&read_gray(path).map_err(Failure::usage)?);
        lens.of_frames(size).map(|_| size).map_err(Failure::usage)
    }

    /// The frame of the places: the vehicle's own, or its pose in the cell's.
    fn vehicle(&self, config: &NodeConfig) -> Result<Pose, Failure> {
        match config.pose.stated() {
            _ if !self.in_map => Ok(Pose::new(0.0, 0.0, 0.0)),
            StatedPose::InMap(pose) if config.pose.listen.is_none() => Ok(pose),
            _ => Err(Failure::usage(anyhow!(
                "--in-map needs `pose.x_m`, `y_m` and `heading_deg` of a vehicle that stands: measure from the vehicle instead"
            ))),
        }
    }
}

impl GroundBoardArguments {
    fn run(&self) -> Result<(), Failure> {
        let (_, camera, lens) = self.node.load()?;
        let board = match (self.qr_side_mm, self.square_mm) {
            (Some(side_mm), _) => GroundBoard::QrCode { side_mm },
            (None, square_mm) => {
                let columns = self.columns;
                let rows = self.rows;
                let square_mm = square_mm.unwrap_or_default();
                GroundBoard::Chessboard(Chessboard {
                    columns,
                    rows,
                    square_mm,
                })
            }
        };
        let photograph = read_gray(&self.photograph).map_err(Failure::usage)?;
        let lens = lens
            .of_frames(ImageSize::of(&photograph))
            .map_err(Failure::usage)?;
        let fit = fit_board(&photograph, &board, &lens)
            .with_context(|| format!("{} gives no mount", self.photograph.display()))?;
        let used = fit.points.iter().filter(|point| !point.is_outlier);
        let worst_px = used.clone().map(|point| point.error_px).fold(0.0, f64::max);
        eprintln!(
            "{} corners of the board, off by {worst_px:.2} px at most",
            used.count()
        );
        self.node.report_mount(
            &MountEstimate {
                mount: camera.mount.placed(&fit.estimate.mount),
                ..fit.estimate
            },
            &lens,
        )
    }
}

impl PeopleArguments {
    fn run(&self) -> Result<(), Failure> {
        let (_, mut camera, lens) = self.node.load()?;
        if let Some(path) = &self.video {
            camera.source = SourceConfig::Video {
                path: path.clone(),
                looping: false,
            };
        }
        let no_size = || anyhow!("no size of {:?}: set camera.projection.sizes", self.label);
        let size = camera
            .projection
            .sizes
            .of(&self.label)
            .copied()
            .ok_or_else(no_size)
            .map_err(Failure::usage)?;
        let size = match self.height_m {
            Some(height_m) if (0.5..=2.5).contains(&height_m) => ObjectSize {
                height_m,
                relative_sigma: KNOWN_HEIGHT_SIGMA,
                ..size
            },
            Some(height_m) => {
                return Err(Failure::usage(anyhow!(
                    "--height-m {height_m}: must be 0.5 to 2.5"
                )));
            }
            None => size,
        };
        let watched = self.watch(camera, lens, size)?;
        eprintln!(
            "{} whole boxes of {:?} in {} frames",
            watched.boxes(),
            self.label,
            watched.frames()
        );
        let others: Vec<&str> = watched.others().iter().map(Label::as_str).collect();
        let seen = if others.is_empty() {
            String::new()
        } else {
            format!(" (also seen: {})", others.join(", "))
        };
        let estimate = watched
            .fit()
            .with_context(|| format!("{:?} gives no mount{seen}", self.label))?;
        self.node.report_mount(&estimate, watched.lens())
    }

    /// Detections of the node's detector until the time is up, or the source ends.
    fn watch(
        &self,
        camera: CameraConfig,
        lens: Lens,
        size: ObjectSize,
    ) -> Result<PeopleWatch, Failure> {
        let mut detector = camera.detector.build().map_err(Failure::usage)?;
        let capture = camera.capture.clone();
        let timeout = node::camera::open_timeout(&camera);
        camera.open(timeout).map(drop).map_err(Failure::usage)?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .build()
            .context("cannot start")?;
        let for_s = Duration::try_from_secs_f64(self.for_s).map_err(Failure::usage)?;
        let capture =
            Capture::start(camera.opener(timeout), capture).context("cannot start the camera")?;
        let mut watched = PeopleWatch::new(camera, lens, self.label.clone().into(), size);
        let end = Instant::now() + for_s;
        eprintln!("watches for {} s, or until the frames end", self.for_s);
        while let Ok(Some(frame)) =
            runtime.block_on(async { timeout_at(end, capture.next_frame()).await })
        {
            let detections = detector.detect(&frame).context("the detector failed")?;
            watched
                .add(detections, ImageSize::of(&frame.image))
                .map_err(Failure::usage)?;
        }
        let readers = capture.readers();
        drop(capture);
        readers.wait_for_end(STOP_TIMEOUT);
        Ok(watched)
    }
}
