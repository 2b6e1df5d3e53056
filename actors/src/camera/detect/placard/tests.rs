use ecod::model::time::Timestamp;
use ecod::perception::camera::Intrinsics;
use nalgebra::{Point3, Rotation3, Vector3};
use opencv::core::{
    BORDER_TRANSPARENT, CV_8U, CV_16SC1, CV_16UC1, Point2f, Rect, add, randn, set_rng_seed,
};
use qrcode::{Color, EcLevel, QrCode};

use super::*;
use crate::camera::corner_pose::locate_target;

const SIDE_M: f64 = 0.0492;
const INCH_M: f64 = 0.0254;
/// Samples per pixel along each axis before the image is brought to its size.
const FINE: f64 = 4.0;

fn camera() -> Intrinsics {
    Intrinsics::from_field_of_view(640, 480, 62.2f64.to_radians(), 48.8f64.to_radians())
}

/// An image drawn at four times the resolution of the camera.
struct Scene(Mat);

impl Scene {
    fn empty() -> Self {
        Self(Mat::new_rows_cols_with_default(1920, 2560, CV_8UC1, Scalar::all(120.0)).unwrap())
    }

    /// Draws a code with its quiet zone and returns its corners.
    fn put(
        &mut self,
        code: &QrCode,
        range_in: f64,
        bearing_deg: f64,
        yaw_deg: f64,
    ) -> [Point2<f64>; 4] {
        let middle = Rotation3::from_euler_angles(0.0, bearing_deg.to_radians(), 0.0)
            * Point3::new(0.0, 0.004, range_in * INCH_M);
        let turn = Rotation3::from_euler_angles(0.0, (bearing_deg + yaw_deg).to_radians(), 0.0);
        let half = SIDE_M / 2.0;
        let corners =
            [(-half, -half), (half, -half), (half, half), (-half, half)].map(|(right, down)| {
                camera()
                    .project(&(middle + turn * Vector3::new(right, down, 0.0)))
                    .unwrap()
            });
        self.warp(&flat(code), code.width() as f64, &corners);
        corners
    }

    fn warp(&mut self, flat: &Mat, modules: f64, corners: &[Point2<f64>; 4]) {
        let point = |x: f64, y: f64| Point2f::new((x - 0.5) as f32, (y - 0.5) as f32);
        let low = 4.0 * MODULE;
        let high = (4.0 + modules) * MODULE;
        let from: Vector<Point2f> = [(low, low), (high, low), (high, high), (low, high)]
            .into_iter()
            .map(|(x, y)| point(x, y))
            .collect();
        let to: Vector<Point2f> = corners
            .iter()
            .map(|c| point(c.x * FINE, c.y * FINE))
            .collect();
        let warp = imgproc::get_perspective_transform_def(&from, &to).unwrap();
        let size = self.0.size().unwrap();
        let area = imgproc::INTER_AREA;
        let transparent = BORDER_TRANSPARENT;
        imgproc::warp_perspective(
            flat,
            &mut self.0,
            &warp,
            size,
            area,
            transparent,
            Scalar::default(),
        )
        .unwrap();
    }

    /// The picture that a camera takes of the scene: blur of 0.7 and noise of 5 gray levels, both
    /// standard deviations.
    fn seen(&self) -> CameraFrame {
        let mut small = Mat::default();
        let mut blurred = Mat::default();
        let mut image = Mat::default();
        let size = Size::new(640, 480);
        imgproc::resize(&self.0, &mut small, size, 0.0, 0.0, imgproc::INTER_AREA).unwrap();
        imgproc::gaussian_blur_def(&small, &mut blurred, Size::default(), 0.7).unwrap();
        let mut noise =
            Mat::new_rows_cols_with_default(480, 640, CV_16SC1, Scalar::all(0.0)).unwrap();
        set_rng_seed(1).unwrap();
        randn(&mut noise, &Scalar::all(0.0), &Scalar::all(5.0)).unwrap();
        add(&blurred, &noise, &mut image, &Mat::default(), CV_8U).unwrap();
        frame(image)
    }
}

/// Codes at several places and distances are read alike in the part of the image with contrast and in the whole image.
#[test]
fn plain_surroundings_change_no_code() {
    let whole = Rect::new(0, 0, 640, 480);
    let mut read = 0;
    for (range_in, bearing_deg, yaw_deg) in [
        (12.0, 0.0, 0.0),
        (20.0, -14.0, 20.0),
        (26.0, 18.0, -30.0),
        (34.0, 5.0, 0.0),
        (16.0, -24.0, 45.0),
    ] {
        let mut scene = Scene::empty();
        let code = code("ABCD123");
        scene.put(&code, range_in, bearing_deg, yaw_deg);
        let image = gray(&scene.seen()).unwrap();
        let region = region_of_contrast(&image).unwrap().unwrap();
        assert!(region.area() < whole.area() / 2, "{region:?}");
        let placed = |region: Rect| -> Vec<_> {
            let codes = PlacardDetector::new(PlacardConfig::default())
                .codes_in(&mut image.try_clone().unwrap(), region)
                .unwrap();
            codes
                .into_iter()
                .map(|code| (code.text, code.corners))
                .collect()
        };
        let expected = placed(whole);
        read += expected.len();
        assert_eq!(
            placed(region),
            expected,
            "{range_in} {bearing_deg} {yaw_deg}"
        );
    }
    assert!(read >= 3, "{read}");
    assert!(
        region_of_contrast(&gray(&Scene::empty().seen()).unwrap())
            .unwrap()
            .is_none()
    );
}

/// Side of a module in the flat drawing, in pixels.
const MODULE: f64 = 16.0;

fn flat(code: &QrCode) -> Mat {
    let modules = code.width() as i32;
    let module = MODULE as i32;
    let side = (modules + 8) * module;
    let mut flat =
        Mat::new_rows_cols_with_default(side, side, CV_8UC1, Scalar::all(230.0)).unwrap();
    for (x, y) in (0..modules).flat_map(|y| (0..modules).map(move |x| (x, y))) {
        if code[(x as usize, y as usize)] == Color::Dark {
            let module = Rect::new((x + 4) * module, (y + 4) * module, module, module);
            imgproc::rectangle(
                &mut flat,
                module,
                Scalar::all(25.0),
                imgproc::FILLED,
                imgproc::LINE_8,
                0,
            )
            .unwrap();
        }
    }
    flat
}

fn code(text: impl AsRef<[u8]>) -> QrCode {
    QrCode::with_error_correction_level(text, EcLevel::M).unwrap()
}

fn frame(image: Mat) -> CameraFrame {
    CameraFrame {
        image,
        captured_at: Timestamp::default(),
        seq: 7,
    }
}

fn detect(frame: &CameraFrame) -> Vec<Detection> {
    PlacardDetector::new(PlacardConfig::default())
        .detect(frame)
        .unwrap()
}

#[test]
fn placard_is_read_near_and_slanted() {
    for (range_in, yaw_deg) in [
        (8.0, 0.0),
        (8.0, 63.0),
        (13.5, 30.0),
        (13.5, -60.0),
        (20.0, 0.0),
        (20.0, 40.0),
    ] {
        let mut scene = Scene::empty();
        let corners = scene.put(&code("7ABC123"), range_in, 8.0, yaw_deg);
        let found = detect(&scene.seen());
        let [detection] = &found[..] else {
            panic!("{range_in} in, {yaw_deg}°: {found:?}")
        };
        assert_eq!(detection.label, "7ABC123");
        assert!((0.5..=0.99).contains(&detection.confidence));
        let found = detection.corners.unwrap();
        let module_px = nalgebra::distance(&corners[0], &corners[3]) / 21.0;
        // The decoder estimates the lower right corner, which has no finder pattern.
        for (corner, allowed_modules) in [(0, 0.5), (1, 0.5), (2, 1.5), (3, 0.5)] {
            let error = nalgebra::distance(&found[corner], &corners[corner]) / module_px;
            assert!(
                error <= allowed_modules,
                "{range_in} in, {yaw_deg}°: corner {corner} is {error} modules off"
            );
        }
        let at = locate_target(&found, SIDE_M, &camera()).unwrap();
        let error_in = at.coords.norm() / INCH_M - range_in;
        assert!(
            error_in.abs() < 0.04 * range_in,
            "{range_in} in, {yaw_deg}°: {error_in} in off"
        );
    }
}

#[test]
fn nearer_placards_are_trusted_more() {
    let confidence = |range_in| {
        let mut scene = Scene::empty();
        scene.put(&code("7ABC123"), range_in, 0.0, 0.0);
        detect(&scene.seen())[0].confidence
    };
    assert!(confidence(8.0) > confidence(14.0));
    assert!(confidence(14.0) > confidence(20.0));
}

#[test]
fn repeated_text_is_two_placards() {
    let mut scene = Scene::empty();
    let left = scene.put(&code("EMPTY"), 13.5, -12.0, 0.0);
    let right = scene.put(&code("EMPTY"), 13.5, 12.0, 60.0);
    let mut found = detect(&scene.seen());
    found.sort_by(|a, b| a.bounding_box.x_min.total_cmp(&b.bounding_box.x_min));
    assert_eq!(found.len(), 2, "{found:?}");
    for (detection, corners) in found.iter().zip([left, right]) {
        assert_eq!(detection.label, "EMPTY");
        assert!(
            detection
                .bounding_box
                .intersection_over_union(&BoundingBox::around(&corners))
                > 0.8
        );
    }
}

#[test]
fn code_count_is_limited() {
    let mut scene = Scene::empty();
    scene.put(&code("A"), 12.0, -12.0, 0.0);
    scene.put(&code("B"), 12.0, 12.0, 0.0);
    let mut one = PlacardDetector::new(PlacardConfig {
        max_codes: 1,
        ..PlacardConfig::default()
    });
    assert_eq!(one.detect(&scene.seen()).unwrap().len(), 1);
}

#[test]
fn there_is_nothing_in_noise() {
    assert!(detect(&Scene::empty().seen()).is_empty());
}

#[test]
fn color_frames_are_read() {
    let mut scene = Scene::empty();
    scene.put(&code("SLOT-3"), 10.0, 0.0, 0.0);
    let mut color = Mat::default();
    imgproc::cvt_color_def(&scene.seen().image, &mut color, imgproc::COLOR_GRAY2BGR).unwrap();
    assert_eq!(detect(&frame(color))[0].label, "SLOT-3");
}

#[test]
fn invalid_texts_are_skipped() {
    for odd in [
        &b"\xff\xfe\x80abc"[..],
        b"two\nlines",
        b"nul\0",
        &[b'x'; 65],
    ] {
        let mut scene = Scene::empty();
        scene.put(&code(odd), 7.0, -12.0, 0.0);
        scene.put(&code("SLOT-3"), 10.0, 15.0, 0.0);
        let found = detect(&scene.seen());
        assert_eq!(
            found.iter().map(|d| d.label.as_str()).collect::<Vec<_>>(),
            ["SLOT-3"],
            "{odd:?}"
        );
    }
}

#[test]
fn images_need_8_bit_pixels() {
    let deep = Mat::new_rows_cols_with_default(48, 64, CV_16UC1, Scalar::all(0.0)).unwrap();
    for image in [Mat::default(), deep] {
        let error = PlacardDetector::new(PlacardConfig::default())
            .detect(&frame(image))
            .unwrap_err();
        assert!(
            matches!(error, DetectError::UnusableImage { seq: 7, .. }),
            "{error}"
        );
    }
}

#[test]
fn unusable_configurations_are_refused() {
    PlacardConfig::default().validate().unwrap();
    let pass = |stretch_x| Pass {
        stretch_x,
        stretch_y: 1.0,
    };
    for (config, key) in [
        (
            PlacardConfig {
                passes: vec![],
                ..PlacardConfig::default()
            },
            "passes",
        ),
        (
            PlacardConfig {
                passes: vec![pass(1.0), pass(f64::NAN)],
                ..PlacardConfig::default()
            },
            "passes.1.stretch_x",
        ),
        (
            PlacardConfig {
                max_codes: 0,
                ..PlacardConfig::default()
            },
            "max_codes",
        ),
    ] {
        assert_eq!(config.validate().unwrap_err().key, key);
    }
}

#[test]
fn texts_that_are_no_labels_are_dropped() {
    assert_eq!(label("cafe\u{301}".into()), Some("caf\u{e9}".into()));
    for text in ["", "car\n", "car\u{202e}", &"x".repeat(65)] {
        assert_eq!(label(text.into()), None, "{}", text.escape_unicode());
    }
}
