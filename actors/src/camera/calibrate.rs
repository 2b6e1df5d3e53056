//! Camera calibration from photographs of a chessboard, and the calibration file.

pub mod board;
pub mod mount;

use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use ecod::perception::camera::Intrinsics;
use ecod::perception::distortion;
use opencv::core::{
    Mat, MatTraitConst, Point2f, Point3f, Size, TermCriteria, TermCriteria_Type, Vector,
};
use opencv::{calib3d, imgproc};
use serde::{Deserialize, Serialize};

use crate::camera::frame_source::images;
use crate::camera::image_codec;
use crate::camera::image_size::ImageSize;
use crate::camera::lens::Lens;
use crate::platform::bounded_file;

/// Minimum number of photographs that show the whole board.
pub const MIN_VIEWS: usize = 5;

/// Allowed numbers of distortion coefficients: 4 without k3, 5 with k3, 8 for OpenCV's rational
/// model.
const COEFFICIENT_COUNTS: [usize; 3] = [4, 5, 8];

/// Plausible fields of view in degrees. A focal length in millimetres or as a fraction of the image
/// falls outside.
const PLAUSIBLE_FOV_DEG: RangeInclusive<f64> = 0.2..=175.0;

/// Plausible range of the principal point, as a fraction of the image size.
const PLAUSIBLE_MIDDLE: RangeInclusive<f64> = 0.02..=0.98;

/// A printed chessboard, whose inner corners are found in photographs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chessboard {
    /// Inner corners along a row: squares minus one.
    pub columns: u16,
    /// Inner corners along a column: squares minus one.
    pub rows: u16,
    /// Side of a square in millimetres.
    pub square_mm: f64,
}

/// A calibrated camera, as kept in a TOML file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Image width in pixels.
    pub image_width: u32,
    /// Image height in pixels.
    pub image_height: u32,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Column of the principal point in pixels.
    pub cx: f64,
    /// Row of the principal point in pixels.
    pub cy: f64,
    /// OpenCV's k1, k2, p1, p2, then perhaps k3, then perhaps k4, k5, k6 of the rational model.
    pub distortion: Vec<f64>,
    /// Root mean square distance in pixels between found and reprojected corners; good is below
    /// 0.5.
    pub rms_px: f64,
    /// Paths of the photographs in which the whole board was found.
    pub images: Vec<PathBuf>,
}

/// The result of [`calibrate`].
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationReport {
    /// Optics of the camera, as the calibration file contains them.
    pub calibration: Calibration,
    /// Photographs in which the whole board was not found.
    pub without_board: Vec<PathBuf>,
}

/// Error of a calibration or its file.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The board is too small.
    #[error("chessboard of {columns}x{rows} inner corners and {square_mm} mm squares: need at least 3x3 and a size",
        columns = .0.columns, rows = .0.rows, square_mm = .0.square_mm)]
    InvalidBoard(Chessboard),
    /// OpenCV cannot read the image.
    #[error("cannot read image {0:?}")]
    UnreadableImage(PathBuf),
    /// The photographs have different sizes.
    #[error("image {path:?} is {size}, the others are {expected}")]
    SizeDiffers {
        /// Path of the image.
        path: PathBuf,
        /// Size of this image.
        size: ImageSize,
        /// Size of the first image.
        expected: ImageSize,
    },
    /// Too few photographs show the board.
    #[error(
        "the chessboard was found in {found} images, need {MIN_VIEWS}; not in {without_board:?}"
    )]
    TooFewViews {
        /// Number of photographs with the board.
        found: usize,
        /// Paths of the photographs in which the board was not found.
        without_board: Vec<PathBuf>,
    },
    /// OpenCV failed on an image or in a step.
    #[error("opencv failed on {0}")]
    OpenCv(String, #[source] opencv::Error),
    /// A directory of photographs cannot be listed.
    #[error("cannot list images in {0:?}")]
    Directory(PathBuf, #[source] std::io::Error),
    /// The calibration file cannot be read or written.
    #[error("calibration file {0:?}")]
    File(PathBuf, #[source] std::io::Error),
    /// The calibration file does not hold a calibration.
    #[error("calibration file {0:?}: {1}")]
    Malformed(PathBuf, String),
}

/// Photographs among files and directories; the files of a directory are sorted by name.
///
/// # Errors
/// Returns [`CalibrationError::Directory`] if a directory cannot be listed.
pub fn photographs(paths: &[PathBuf]) -> Result<Vec<PathBuf>, CalibrationError> {
    let mut photographs = Vec::new();
    for path in paths {
        if path.is_dir() {
            let listed = images::in_directory(path);
            photographs
                .extend(listed.map_err(|error| CalibrationError::Directory(path.clone(), error))?);
        } else {
            photographs.push(path.clone());
        }
    }
    Ok(photographs)
}

/// A photograph as 8-bit gray.
///
/// # Errors
/// Returns [`CalibrationError::UnreadableImage`].
pub fn read_gray(path: &Path) -> Result<Mat, CalibrationError> {
    let unreadable = |_| CalibrationError::UnreadableImage(path.to_owned());
    let mut gray = Mat::default();
    imgproc::cvt_color_def(
        &image_codec::read(path).map_err(unreadable)?,
        &mut gray,
        imgproc::COLOR_BGR2GRAY,
    )
    .map_err(|error| CalibrationError::OpenCv(format!("image {path:?}"), error))?;
    Ok(gray)
}

/// Calibrates a camera (Zhang 2000). The photographs should show the board at different angles and
/// all over the image.
///
/// # Errors
/// Returns a [`CalibrationError`], that names the image it is about.
pub fn calibrate(
    images: &[PathBuf],
    board: &Chessboard,
) -> Result<CalibrationReport, CalibrationError> {
    let Chessboard {
        columns,
        rows,
        square_mm,
    } = *board;
    if columns < 3 || rows < 3 || !(square_mm.is_finite() && square_mm > 0.0) {
        return Err(CalibrationError::InvalidBoard(*board));
    }
    let mut used = Vec::new();
    let mut without_board = Vec::new();
    let mut views = Vector::<Vector<Point2f>>::new();
    let mut size = None;
    for path in images {
        let image = read_gray(path)?;
        let found = ImageSize::of(&image);
        let expected = *size.get_or_insert(found);
        if found != expected {
            return Err(CalibrationError::SizeDiffers {
                path: path.clone(),
                size: found,
                expected,
            });
        }
        let corners = find_board(&image, board)
            .map_err(|error| CalibrationError::OpenCv(format!("image {path:?}"), error))?;
        match corners {
            Some(corners) => {
                views.push(corners);
                used.push(path.clone());
            }
            None => without_board.push(path.clone()),
        }
    }
    let Some(size) = size.filter(|_| used.len() >= MIN_VIEWS) else {
        return Err(CalibrationError::TooFewViews {
            found: used.len(),
            without_board,
        });
    };
    let calibration = solve(&views, size, board, used)
        .map_err(|error| CalibrationError::OpenCv("calibration".into(), error))?;
    Ok(CalibrationReport {
        calibration,
        without_board,
    })
}

impl Calibration {
    /// The camera with its distortion.
    pub fn lens(&self) -> Lens {
        let Self {
            image_width: width,
            image_height: height,
            fx,
            fy,
            cx,
            cy,
            ..
        } = *self;
        Lens {
            distortion: distortion::from_first(&self.distortion),
            ..Lens::ideal(Intrinsics {
                width,
                height,
                fx,
                fy,
                cx,
                cy,
            })
        }
    }

    /// Reads a calibration file.
    ///
    /// # Errors
    /// Returns [`CalibrationError::File`] or [`CalibrationError::Malformed`].
    pub fn read(path: &Path) -> Result<Self, CalibrationError> {
        let text = bounded_file::read_text(path)
            .map_err(|error| CalibrationError::File(path.to_owned(), error))?;
        let malformed = |reason| CalibrationError::Malformed(path.to_owned(), reason);
        let read: Self = toml::from_str(&text).map_err(|e| malformed(e.to_string()))?;
        let focal = [read.fx, read.fy].iter().all(|f| f.is_finite() && *f > 0.0);
        let rest = [read.cx, read.cy]
            .iter()
            .chain(&read.distortion)
            .all(|v| v.is_finite());
        if !focal || !rest || read.image_width == 0 || read.image_height == 0 {
            return Err(malformed(
                "image size and focal lengths must be positive, all numbers finite".into(),
            ));
        }
        read.check_model().map_err(malformed)?;
        Ok(read)
    }

    /// Checks the count of coefficients, and that lengths are in pixels of the image.
    fn check_model(&self) -> Result<(), String> {
        let count = self.distortion.len();
        if !COEFFICIENT_COUNTS.contains(&count) {
            return Err(format!(
                "`distortion` has {count} coefficients, must have 4, 5 or 8: k1, k2, p1, p2, k3, k4, k5, k6; fisheye calibrations are not supported"
            ));
        }
        let sides = [
            (self.image_width, ["fx", "cx"], [self.fx, self.cx]),
            (self.image_height, ["fy", "cy"], [self.fy, self.cy]),
        ];
        for (side, [focal_key, middle_key], [focal, middle]) in sides {
            let side = f64::from(side);
            let angle_deg = (2.0 * (side / (2.0 * focal)).atan()).to_degrees();
            if !PLAUSIBLE_FOV_DEG.contains(&angle_deg) {
                return Err(format!(
                    "`{focal_key}` is {focal}, a field of view of {angle_deg:.1}°: it must be in pixels of an image of {side} px"
                ));
            }
            if !PLAUSIBLE_MIDDLE.contains(&(middle / side)) {
                return Err(format!(
                    "`{middle_key}` is {middle}, at the edge or outside of an image of {side} px: it must be in its pixels"
                ));
            }
        }
        Ok(())
    }

    /// Writes a calibration file.
    ///
    /// # Errors
    /// Returns [`CalibrationError::File`] if it cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), CalibrationError> {
        let text = toml::to_string(self)
            .map_err(|error| CalibrationError::Malformed(path.to_owned(), error.to_string()))?;
        std::fs::write(path, text).map_err(|error| CalibrationError::File(path.to_owned(), error))
    }
}

/// Inner corners of the board with subpixel accuracy, if all are visible.
fn find_board(image: &Mat, board: &Chessboard) -> opencv::Result<Option<Vector<Point2f>>> {
    let mut corners = Vector::<Point2f>::new();
    let pattern = Size::new(board.columns.into(), board.rows.into());
    if !calib3d::find_chessboard_corners_def(image, pattern, &mut corners)? {
        return Ok(None);
    }
    let none = Size::new(-1, -1);
    imgproc::corner_sub_pix(
        image,
        &mut corners,
        Size::new(5, 5),
        none,
        stop_after(30, 1e-3)?,
    )?;
    Ok(Some(corners))
}

fn solve(
    views: &Vector<Vector<Point2f>>,
    size: ImageSize,
    board: &Chessboard,
    images: Vec<PathBuf>,
) -> opencv::Result<Calibration> {
    let square = board.square_mm as f32;
    let corners: Vector<Point3f> = (0..board.rows)
        .flat_map(|row| (0..board.columns).map(move |column| (column, row)))
        .map(|(column, row)| Point3f::new(f32::from(column) * square, f32::from(row) * square, 0.0))
        .collect();
    let boards: Vector<Vector<Point3f>> = views.iter().map(|_| corners.clone()).collect();
    let mut camera = Mat::default();
    let mut distortion = Mat::default();
    let rms_px = calib3d::calibrate_camera(
        &boards,
        views,
        Size::new(size.width as i32, size.height as i32),
        &mut camera,
        &mut distortion,
        &mut Vector::<Mat>::new(),
        &mut Vector::<Mat>::new(),
        0,
        stop_after(100, 1e-9)?,
    )?;
    let entry = |row, column| camera.at_2d::<f64>(row, column).copied();
    let coefficients = (0..5).map(|index| distortion.at::<f64>(index).copied());
    Ok(Calibration {
        image_width: size.width,
        image_height: size.height,
        fx: entry(0, 0)?,
        fy: entry(1, 1)?,
        cx: entry(0, 2)?,
        cy: entry(1, 2)?,
        distortion: coefficients.collect::<opencv::Result<_>>()?,
        rms_px,
        images,
    })
}

fn stop_after(iterations: i32, change: f64) -> opencv::Result<TermCriteria> {
    TermCriteria::new(
        TermCriteria_Type::COUNT as i32 | TermCriteria_Type::EPS as i32,
        iterations,
        change,
    )
}

#[cfg(test)]
mod tests;
