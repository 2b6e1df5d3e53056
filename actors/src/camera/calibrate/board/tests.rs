//! Photographs of boards on the ground, drawn flat and projected into the image of a camera with a
//! given mount.

use ecod::model::geometry::Pose;
use ecod::perception::camera::Mount;
use ecod::perception::view::PosedCamera;
use opencv::core::{BORDER_CONSTANT, CV_8UC1, Point, Rect, Scalar, hconcat, vconcat};
use opencv::prelude::*;
use qrcode::{Color, QrCode};

use super::*;

fn lens() -> Lens {
    Lens::ideal(Intrinsics::from_field_of_view(
        1280,
        720,
        70f64.to_radians(),
        43f64.to_radians(),
    ))
}

const SIDE_MM: f64 = 400.0;
/// Pixels per module or square of the drawing.
const DRAWN_PX: i32 = 24;

/// Dark squares on white, with a white border of four squares.
fn flat(side: i32, is_dark: impl Fn(i32, i32) -> bool) -> Mat {
    let whole = (side + 8) * DRAWN_PX;
    let mut image =
        Mat::new_rows_cols_with_default(whole, whole, CV_8UC1, Scalar::all(235.0)).unwrap();
    for (row, column) in (0..side).flat_map(|row| (0..side).map(move |column| (row, column))) {
        if is_dark(row, column) {
            let at = Point::new((column + 4) * DRAWN_PX, (row + 4) * DRAWN_PX);
            let square = Rect::from_point_size(at, Size::new(DRAWN_PX, DRAWN_PX));
            imgproc::rectangle(
                &mut image,
                square,
                Scalar::all(25.0),
                imgproc::FILLED,
                imgproc::LINE_8,
                0,
            )
            .unwrap();
        }
    }
    image
}

fn code(text: &str) -> (Mat, f64) {
    let code = QrCode::new(text).unwrap();
    let side = code.width() as i32;
    let modules = code.to_colors();
    (
        flat(side, |row, column| {
            modules[(row * side + column) as usize] == Color::Dark
        }),
        f64::from(side),
    )
}

/// A drawing of `side` squares of `square_m` that lies `ahead_m` in front of a camera, turned by
/// `yaw_rad`, slightly out of focus.
fn photograph(
    drawing: &Mat,
    side: f64,
    square_m: f64,
    ahead_m: f64,
    yaw_rad: f64,
    mount: &Mount,
) -> Mat {
    let posed = PosedCamera::new(Pose::new(0.0, 0.0, 0.0), mount, lens().intrinsics);
    let middle = Pose::new(ahead_m, 0.1, yaw_rad);
    let half = (side / 2.0 + 4.0) * square_m;
    let whole = f64::from(drawing.cols());
    // The drawing's columns run to the right of its heading, its rows downwards.
    let corners = [(half, half), (half, -half), (-half, -half), (-half, half)];
    let seen: Vector<Point2f> = corners
        .iter()
        .map(|&(forward_m, left_m)| posed.pixel(&middle.transform(forward_m, left_m)).unwrap())
        .map(|pixel| Point2f::new(pixel.x as f32 - 0.5, pixel.y as f32 - 0.5))
        .collect();
    let drawn = [(0.0, 0.0), (whole, 0.0), (whole, whole), (0.0, whole)];
    let drawn: Vector<Point2f> = drawn
        .iter()
        .map(|&(x, y)| Point2f::new(x as f32 - 0.5, y as f32 - 0.5))
        .collect();
    let to_image = calib3d::find_homography_def(&drawn, &seen, &mut Mat::default()).unwrap();
    let mut image = Mat::default();
    let size = Size::new(1280, 720);
    let ground = Scalar::all(120.0);
    imgproc::warp_perspective(
        drawing,
        &mut image,
        &to_image,
        size,
        imgproc::INTER_AREA,
        BORDER_CONSTANT,
        ground,
    )
    .unwrap();
    let mut blurred = Mat::default();
    imgproc::gaussian_blur_def(&image, &mut blurred, Size::new(5, 5), 0.8).unwrap();
    blurred
}

fn mount(height_m: f64, pitch_deg: f64, roll_deg: f64) -> Mount {
    let pitch_rad = pitch_deg.to_radians();
    let roll_rad = roll_deg.to_radians();
    Mount {
        height_m: Some(height_m),
        pitch_rad,
        roll_rad,
        ..Mount::default()
    }
}

#[track_caller]
fn is_near(found: &Mount, real: &Mount) {
    let tilt_deg = [
        found.pitch_rad - real.pitch_rad,
        found.roll_rad - real.roll_rad,
    ]
    .map(|off| off.to_degrees().abs());
    let height = found.height_m.unwrap() / real.height_m.unwrap() - 1.0;
    println!(
        "pitch {:.2}°, roll {:.2}°, height {:.2} %",
        tilt_deg[0],
        tilt_deg[1],
        100.0 * height
    );
    assert!(
        tilt_deg[0] < 0.5 && tilt_deg[1] < 0.5 && height.abs() < 0.01,
        "{found:?} {real:?}"
    );
}

#[test]
fn qr_code_gives_height_and_tilt() {
    let (drawing, modules) = code("ecod");
    for (real, ahead_m, yaw_rad) in [
        (mount(1.3, 25.0, 0.0), 2.2, 0.3),
        (mount(1.3, 25.0, -4.0), 2.4, -0.4),
        (mount(2.0, 40.0, 5.0), 2.0, 0.1),
    ] {
        let photograph = photograph(
            &drawing,
            modules,
            SIDE_MM / 1000.0 / modules,
            ahead_m,
            yaw_rad,
            &real,
        );
        let fit = fit_board(
            &photograph,
            &GroundBoard::QrCode { side_mm: SIDE_MM },
            &lens(),
        )
        .unwrap();
        is_near(&fit.estimate.mount, &real);
    }
}

#[test]
fn chessboard_gives_height_and_tilt() {
    let drawing = flat(8, |row, column| row < 7 && (row + column) % 2 == 0);
    let board = GroundBoard::Chessboard(Chessboard {
        columns: 7,
        rows: 6,
        square_mm: 60.0,
    });
    for (real, yaw_rad) in [(mount(1.3, 25.0, -4.0), 0.3), (mount(1.8, 30.0, 3.0), 2.0)] {
        let photograph = photograph(&drawing, 8.0, 0.06, 2.4, yaw_rad, &real);
        is_near(
            &fit_board(&photograph, &board, &lens())
                .unwrap()
                .estimate
                .mount,
            &real,
        );
    }
}

#[test]
fn missing_or_second_board_reported() {
    let qr_code = GroundBoard::QrCode { side_mm: SIDE_MM };
    let blank = Mat::new_rows_cols_with_default(720, 1280, CV_8UC1, Scalar::all(90.0)).unwrap();
    let none = fit_board(&blank, &qr_code, &lens())
        .unwrap_err()
        .to_string();
    assert!(none.contains("no QR code was found"), "{none}");
    let (left, modules) = code("left");
    let (right, _) = code("rite");
    let mut row = Mat::default();
    let mut both = Mat::default();
    hconcat(&Vector::<Mat>::from_iter([left, right]), &mut row).unwrap();
    let white =
        Mat::new_size_with_default(row.size().unwrap(), CV_8UC1, Scalar::all(235.0)).unwrap();
    vconcat(&Vector::<Mat>::from_iter([row, white]), &mut both).unwrap();
    let both = photograph(
        &both,
        2.0 * modules + 8.0,
        0.02,
        2.4,
        0.0,
        &mount(1.3, 25.0, 0.0),
    );
    let several = fit_board(&both, &qr_code, &lens());
    assert!(
        matches!(several, Err(BoardError::SeveralCodes(2))),
        "{several:?}"
    );
}
