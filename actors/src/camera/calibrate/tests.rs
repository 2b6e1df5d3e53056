use nalgebra::{Matrix3, Rotation3, Vector3};
use opencv::core::{BORDER_CONSTANT, CV_8UC1, Matx33d, Point, Rect, Scalar};

use super::*;

const BOARD: Chessboard = Chessboard {
    columns: 8,
    rows: 5,
    square_mm: 25.0,
};
const FOCAL_PX: f64 = 530.0;
/// Pixels of the drawn board to a square.
const SQUARE_PX: i32 = 40;

/// A board of black and white squares with a white rim, drawn flat.
fn flat_board() -> Mat {
    let columns = i32::from(BOARD.columns) + 1;
    let rows = i32::from(BOARD.rows) + 1;
    let white = Scalar::all(255.0);
    let mut image = Mat::new_rows_cols_with_default(
        (rows + 2) * SQUARE_PX,
        (columns + 2) * SQUARE_PX,
        CV_8UC1,
        white,
    )
    .unwrap();
    for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
        if (row + column) % 2 == 0 {
            let at = Point::new((column + 1) * SQUARE_PX, (row + 1) * SQUARE_PX);
            let square = Rect::from_point_size(at, Size::new(SQUARE_PX, SQUARE_PX));
            imgproc::rectangle(
                &mut image,
                square,
                Scalar::all(0.0),
                imgproc::FILLED,
                imgproc::LINE_8,
                0,
            )
            .unwrap();
        }
    }
    image
}

/// The board photographed from `distance_mm`, turned by the given angles, by an ideal 640x480
/// camera.
fn photograph(flat: &Mat, turn: [f64; 3], shift_mm: [f64; 2], distance_mm: f64) -> Mat {
    let camera = Matrix3::new(FOCAL_PX, 0.0, 320.0, 0.0, FOCAL_PX, 240.0, 0.0, 0.0, 1.0);
    let [pitch, yaw, roll] = turn;
    let rotation = Rotation3::from_euler_angles(pitch, yaw, roll);
    let middle = Vector3::new(shift_mm[0], shift_mm[1], distance_mm);
    let mm_per_px = BOARD.square_mm / f64::from(SQUARE_PX);
    let half_width = f64::from(flat.cols()) / 2.0;
    let half_height = f64::from(flat.rows()) / 2.0;
    // Pixels of the drawn board to the plane z = 0 of the board, in millimetres.
    let plane = Matrix3::new(
        mm_per_px,
        0.0,
        -half_width * mm_per_px, //
        0.0,
        mm_per_px,
        -half_height * mm_per_px, //
        0.0,
        0.0,
        1.0,
    );
    let r = rotation.matrix();
    let pose = Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), middle]);
    let homography = camera * pose * plane;
    let entries: [f64; 9] = std::array::from_fn(|i| homography[(i / 3, i % 3)]);
    let mut image = Mat::default();
    imgproc::warp_perspective(
        flat,
        &mut image,
        &Matx33d::from_array(entries),
        Size::new(640, 480),
        imgproc::INTER_LINEAR,
        BORDER_CONSTANT,
        Scalar::all(120.0),
    )
    .unwrap();
    image
}

fn write(directory: &Path, name: &str, image: &Mat) -> PathBuf {
    let path = directory.join(name);
    std::fs::write(&path, image_codec::encode_jpeg(image, 100).unwrap()).unwrap();
    path
}

fn take_photographs(directory: &Path) -> Vec<PathBuf> {
    let flat = flat_board();
    let views = [
        ([0.0, 0.4, 0.0], [0.0, 0.0], 420.0),
        ([0.4, 0.0, 0.1], [40.0, 10.0], 430.0),
        ([-0.4, 0.2, 0.0], [-50.0, 20.0], 450.0),
        ([0.3, -0.4, -0.1], [30.0, -30.0], 460.0),
        ([-0.2, -0.5, 0.2], [0.0, 20.0], 400.0),
        ([0.5, 0.3, 0.0], [-30.0, -20.0], 420.0),
        ([0.1, 0.5, 0.3], [50.0, 0.0], 450.0),
    ];
    let photograph = |(index, (turn, shift, distance))| {
        write(
            directory,
            &format!("board{index}.jpg"),
            &photograph(&flat, turn, shift, distance),
        )
    };
    (0..).zip(views).map(photograph).collect()
}

#[test]
fn camera_is_recovered_within_percent() {
    let directory = tempfile::tempdir().unwrap();
    let mut images = take_photographs(directory.path());
    let blank = Mat::new_rows_cols_with_default(480, 640, CV_8UC1, Scalar::all(90.0)).unwrap();
    images.insert(2, write(directory.path(), "blank.jpg", &blank));

    let report = calibrate(&images, &BOARD).unwrap();
    let found = &report.calibration;
    assert!((found.fx / FOCAL_PX - 1.0).abs() < 0.01, "fx {}", found.fx);
    assert!((found.fy / FOCAL_PX - 1.0).abs() < 0.01, "fy {}", found.fy);
    assert!(
        (found.cx - 320.0).abs() < 5.0 && (found.cy - 240.0).abs() < 5.0,
        "{} {}",
        found.cx,
        found.cy
    );
    assert!(found.rms_px < 0.5, "rms {}", found.rms_px);
    assert_eq!(report.without_board, [directory.path().join("blank.jpg")]);
    assert_eq!(found.images.len(), 7);

    let file = directory.path().join("camera.toml");
    found.write(&file).unwrap();
    let read = Calibration::read(&file).unwrap();
    assert_eq!(&read, found);
    assert_eq!(read.lens().intrinsics.width, 640);
    assert_eq!(read.lens().distortion.unwrap()[..5], found.distortion);
}

#[test]
fn errors_name_the_image() {
    let directory = tempfile::tempdir().unwrap();
    let mut images = take_photographs(directory.path());
    assert_eq!(
        photographs(&[directory.path().to_owned()]).unwrap(),
        images,
        "a directory means its images"
    );
    let few = calibrate(&images[..2], &BOARD)
        .expect_err("two views")
        .to_string();
    assert!(few.contains("found in 2 images"), "{few}");

    let text = directory.path().join("notes.png");
    std::fs::write(&text, "not an image").unwrap();
    for unreadable in [text, directory.path().join("missing.png")] {
        images[1] = unreadable.clone();
        let error = calibrate(&images, &BOARD)
            .expect_err("unreadable")
            .to_string();
        assert!(error.contains(unreadable.to_str().unwrap()), "{error}");
    }
    let small = Mat::new_rows_cols_with_default(240, 320, CV_8UC1, Scalar::all(90.0)).unwrap();
    images[1] = write(directory.path(), "small.jpg", &small);
    let error = calibrate(&images, &BOARD)
        .expect_err("sizes differ")
        .to_string();
    assert!(
        error.contains("small.jpg") && error.contains("320x240"),
        "{error}"
    );
}

#[test]
fn bad_calibration_file_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("camera.toml");
    assert!(matches!(
        Calibration::read(&file),
        Err(CalibrationError::File(..))
    ));
    let good = "image_width=640\nimage_height=480\nfx=500.0\nfy=500.0\ncx=320.0\ncy=240.0\n\
                distortion=[0.0,0.0,0.0,0.0,0.0]\nrms_px=0.1\nimages=[]\n";
    for bad in [
        good.replace("fx=500.0", "fx=0.0"),
        good.replace("fx=500.0", "fx=nan"),
        good.replace("cx=320.0\n", ""),
    ] {
        std::fs::write(&file, bad).unwrap();
        let error = Calibration::read(&file).expect_err("malformed").to_string();
        assert!(error.contains("camera.toml"), "{error}");
    }
    std::fs::write(&file, good).unwrap();
    assert_eq!(Calibration::read(&file).unwrap().lens().distortion, None);
    for (coefficients, taken) in [
        ("[-0.3,0.1,0,0]", [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        (
            "[-0.3,0.1,0,0,0.2,0.3,0.4,0.5]",
            [-0.3, 0.1, 0.0, 0.0, 0.2, 0.3, 0.4, 0.5],
        ),
    ] {
        std::fs::write(&file, good.replace("[0.0,0.0,0.0,0.0,0.0]", coefficients)).unwrap();
        let lens = Calibration::read(&file).unwrap().lens();
        assert_eq!(lens.distortion, Some(taken));
    }
    for (old, new, fault) in [
        ("[0.0,", "[0.0,0.0,", "`distortion` has 6 coefficients"),
        (
            "fx=500.0",
            "fx=3.6",
            "`fx` is 3.6, a field of view of 178.7°",
        ),
        ("fy=500.0", "fy=0.78", "`fy` is 0.78"),
        ("fy=500.0", "fy=5e6", "`fy` is 5000000"),
        ("cx=320.0", "cx=0.5", "`cx` is 0.5"),
        (
            "cy=240.0",
            "cy=480.0",
            "`cy` is 480, at the edge or outside",
        ),
    ] {
        std::fs::write(&file, good.replace(old, new)).unwrap();
        let error = Calibration::read(&file).expect_err("implausible");
        assert!(error.to_string().contains(fault), "{error}");
    }
}
