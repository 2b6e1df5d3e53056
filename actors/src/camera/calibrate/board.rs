//! Photographs of a printed board on the ground: a QR code or a chessboard.

use ecod::perception::camera::Intrinsics;
use nalgebra::Point2;
use opencv::calib3d;
use opencv::core::{Mat, MatTraitConst, Point2f, Size, Vector, perspective_transform};
use opencv::imgproc;

use super::mount::{GroundFit, GroundFitError, GroundPoint, fit_ground_points};
use super::{Chessboard, find_board, stop_after};
use crate::camera::detect::DetectError;
use crate::camera::detect::placard::{Code, Pass, PlacardConfig, PlacardDetector};
use crate::camera::lens::Lens;

/// A board of given size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum GroundBoard {
    /// A QR code of which the side is given.
    QrCode {
        /// Side of the code without its quiet zone, in millimetres.
        side_mm: f64,
    },
    /// A chessboard of which corners and squares are given.
    Chessboard(Chessboard),
}

/// Error of a photograph of a board.
#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    /// No board was found.
    #[error(
        "no {0} was found: photograph all of it, sharp, with nothing on it, and as large as it fits"
    )]
    NotFound(&'static str),
    /// Several codes were found.
    #[error("{0} QR codes were found, and only one has the stated size: cover the others")]
    SeveralCodes(usize),
    /// No camera fits the board.
    #[error("the board gives no camera")]
    Fit(#[from] GroundFitError),
    /// The detector of QR codes failed.
    #[error("cannot look for codes")]
    Decoder(#[from] DetectError),
    /// OpenCV failed in a step of the fit.
    #[error("opencv failed on the board")]
    OpenCv(#[from] opencv::Error),
}

/// Fits the camera to a board in an 8-bit gray photograph; `lens` is the lens of its frames. Poses
/// are in the frame of the board.
///
/// # Errors
/// Returns a [`BoardError`] if the board is not found or fits no camera.
pub fn fit_board(
    photograph: &Mat,
    board: &GroundBoard,
    lens: &Lens,
) -> Result<GroundFit, BoardError> {
    let (pixels, places) = match board {
        GroundBoard::QrCode { side_mm } => {
            // A board on the ground is foreshortened along the columns.
            let passes = [(1.0, 1.0), (1.0, 2.0), (2.0, 4.0)]
                .map(|(stretch_x, stretch_y)| Pass {
                    stretch_x,
                    stretch_y,
                })
                .to_vec();
            let mut codes = PlacardDetector::new(PlacardConfig {
                passes,
                ..PlacardConfig::default()
            })
            .codes(&mut photograph.try_clone()?)?;
            let code = codes.pop().ok_or(BoardError::NotFound("QR code"))?;
            if !codes.is_empty() {
                return Err(BoardError::SeveralCodes(codes.len() + 1));
            }
            (
                finder_corners(photograph, &code)?,
                finder_places(code.modules, side_mm / 1000.0),
            )
        }
        GroundBoard::Chessboard(board) => {
            let corners =
                find_board(photograph, board)?.ok_or(BoardError::NotFound("whole chessboard"))?;
            let pixels = corners
                .iter()
                .map(|corner| Point2::new(f64::from(corner.x) + 0.5, f64::from(corner.y) + 0.5));
            (pixels.collect(), chessboard_places(board))
        }
    };
    let size = lens.intrinsics;
    let scale = f64::from(size.width) / f64::from(photograph.cols());
    let straight: Vec<_> = pixels
        .iter()
        .map(|pixel| lens.undistorted(&Point2::from(pixel.coords * scale)))
        .collect();
    fit(&straight, &places, &size)
}

/// The fit to a board, whose corners may count from either side of it.
fn fit(
    pixels: &[Point2<f64>],
    places: &[Point2<f64>],
    intrinsics: &Intrinsics,
) -> Result<GroundFit, BoardError> {
    let points = |side: f64| -> Vec<GroundPoint> {
        let point = |(pixel, place): (&Point2<f64>, &Point2<f64>)| GroundPoint {
            pixel: *pixel,
            place: Point2::new(place.x, side * place.y),
        };
        pixels.iter().zip(places).map(point).collect()
    };
    match fit_ground_points(&points(1.0), intrinsics) {
        Err(GroundFitError::BelowGround) => Ok(fit_ground_points(&points(-1.0), intrinsics)?),
        outcome => Ok(outcome?),
    }
}

fn chessboard_places(board: &Chessboard) -> Vec<Point2<f64>> {
    let square_m = board.square_mm / 1000.0;
    let place = |row: u16, column: u16| {
        Point2::new(f64::from(column) * square_m, -f64::from(row) * square_m)
    };
    (0..board.rows)
        .flat_map(|row| (0..board.columns).map(move |column| place(row, column)))
        .collect()
}

/// Corners of a code's three finder patterns in modules: rows and columns count from the upper left
/// corner. Each pattern is a dark square of 7 modules that contains a light square of 5 and a dark
/// square of 3 (ISO/IEC 18004).
fn finder_modules(modules: f64) -> Vec<Point2<f64>> {
    let far = modules - 7.0;
    let patterns = [(0.0, 0.0), (far, 0.0), (0.0, far)];
    let squares = [0.0, 1.0, 2.0].map(|inset| (inset, 7.0 - inset));
    let corners = |(low, high): (f64, f64)| [(low, low), (high, low), (high, high), (low, high)];
    let all = patterns.into_iter().flat_map(|(column, row)| {
        squares
            .into_iter()
            .flat_map(corners)
            .map(move |(x, y)| Point2::new(column + x, row + y))
    });
    all.collect()
}

/// These corners on the ground, in metres.
fn finder_places(modules: f64, side_m: f64) -> Vec<Point2<f64>> {
    let module_m = side_m / modules;
    finder_modules(modules)
        .into_iter()
        .map(|corner| Point2::new(corner.x * module_m, -corner.y * module_m))
        .collect()
}

/// These corners in the photograph: estimated from the corners of the code, then refined at the
/// edges.
fn finder_corners(photograph: &Mat, code: &Code) -> opencv::Result<Vec<Point2<f64>>> {
    let single = |point: &Point2<f64>| Point2f::new(point.x as f32, point.y as f32);
    let n = code.modules;
    let outer: Vector<Point2f> = [(0.0, 0.0), (n, 0.0), (n, n), (0.0, n)]
        .iter()
        .map(|&(x, y)| single(&Point2::new(x, y)))
        .collect();
    let seen: Vector<Point2f> = code.corners.iter().map(single).collect();
    let modules: Vector<Point2f> = finder_modules(n).iter().map(single).collect();
    let mut to_image = calib3d::find_homography_def(&outer, &seen, &mut Mat::default())?;
    let mut corners = Vector::<Point2f>::new();
    for _ in 0..REFINEMENTS {
        perspective_transform(&modules, &mut corners, &to_image)?;
        let sides = corners
            .iter()
            .zip(corners.iter().skip(1))
            .map(|(a, b)| f64::from((a.x - b.x).hypot(a.y - b.y)));
        // The distance to the next corner is more than a module.
        let reach = (sides.fold(f64::INFINITY, f64::min) / 3.0 * 0.7)
            .floor()
            .clamp(1.0, 10.0) as i32;
        // OpenCV's refinement has the middle of the first pixel at 0, everything else here at 0.5.
        let mut middles: Vector<Point2f> = corners
            .iter()
            .map(|c| Point2f::new(c.x - 0.5, c.y - 0.5))
            .collect();
        let none = Size::new(-1, -1);
        imgproc::corner_sub_pix(
            photograph,
            &mut middles,
            Size::new(reach, reach),
            none,
            stop_after(40, 1e-3)?,
        )?;
        corners = middles
            .iter()
            .map(|c| Point2f::new(c.x + 0.5, c.y + 0.5))
            .collect();
        to_image = calib3d::find_homography(
            &modules,
            &corners,
            &mut Mat::default(),
            calib3d::RANSAC,
            OFF_PX,
        )?;
    }
    Ok(corners
        .iter()
        .map(|corner| Point2::new(f64::from(corner.x), f64::from(corner.y)))
        .collect())
}

const REFINEMENTS: usize = 3;
/// Distance in pixels from which a refined corner must be a different corner.
const OFF_PX: f64 = 1.5;

#[cfg(test)]
mod tests;
