use opencv::core::{CV_8UC1, CV_8UC3, Scalar, Vec3b};

use super::*;

const RED: [u8; 3] = [0, 0, 255];
const BLUE: [u8; 3] = [255, 0, 0];

/// 32 rows of 48 columns, blue with a red upper left quarter.
fn flag() -> Mat {
    let mut image =
        Mat::new_rows_cols_with_default(32, 48, CV_8UC3, Scalar::new(255.0, 0.0, 0.0, 0.0))
            .unwrap();
    for (row, column) in (0..16).flat_map(|row| (0..24).map(move |column| (row, column))) {
        *image.at_2d_mut::<Vec3b>(row, column).unwrap() = RED.into();
    }
    image
}

fn color_at(image: &Mat, row: i32, column: i32) -> [u8; 3] {
    image.at_2d::<Vec3b>(row, column).unwrap().0
}

fn is_near(color: [u8; 3], expected: [u8; 3]) -> bool {
    color.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 6)
}

/// An EXIF segment of a JPEG file that contains only this orientation.
fn exif(orientation: u8) -> Vec<u8> {
    let tiff = [
        b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".as_slice(),
        &[orientation, 0, 0, 0],
        &[0; 4],
    ]
    .concat();
    let body = [b"Exif\0\0".as_slice(), &tiff].concat();
    [
        &[0xff, 0xe1],
        (body.len() as u16 + 2).to_be_bytes().as_slice(),
        &body,
    ]
    .concat()
}

#[test]
fn photograph_is_turned_upright() {
    let jpeg = encode_jpeg(&flag(), 95).unwrap();
    // Orientation by EXIF 2.3: size, and the middle of the red quarter.
    for (orientation, size, (row, column)) in [
        (1, (32, 48), (8, 12)),
        (2, (32, 48), (8, 36)),
        (3, (32, 48), (24, 36)),
        (4, (32, 48), (24, 12)),
        (5, (48, 32), (12, 8)),
        (6, (48, 32), (12, 24)),
        (7, (48, 32), (36, 24)),
        (8, (48, 32), (36, 8)),
    ] {
        let file = [&jpeg[..2], &exif(orientation), &jpeg[2..]].concat();
        let image = decode(&file).unwrap();
        assert_eq!(
            (image.rows(), image.cols()),
            size,
            "orientation {orientation}"
        );
        assert!(
            is_near(color_at(&image, row, column), RED),
            "orientation {orientation}"
        );
        let opposite_row = size.0 - 1 - row;
        let opposite_column = size.1 - 1 - column;
        assert!(
            is_near(color_at(&image, opposite_row, opposite_column), BLUE),
            "orientation {orientation}"
        );
    }
}

#[test]
fn format_is_recognised_by_content() {
    use image::{ExtendedColorType, ImageFormat};
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("frame.png");
    let rgb = [200, 100, 50].repeat(6);
    for format in [
        ImageFormat::Bmp,
        ImageFormat::Jpeg,
        ImageFormat::Png,
        ImageFormat::Pnm,
        ImageFormat::WebP,
    ] {
        image::save_buffer_with_format(&path, &rgb, 3, 2, ExtendedColorType::Rgb8, format).unwrap();
        let image = read(&path).unwrap();
        assert_eq!(
            (image.rows(), image.cols(), image.typ()),
            (2, 3, CV_8UC3),
            "{format:?}"
        );
        assert!(
            is_near(color_at(&image, 1, 2), [50, 100, 200]),
            "{format:?}: {:?}",
            color_at(&image, 1, 2)
        );
    }
    for (pixels, kind) in [
        (vec![90; 6], ExtendedColorType::L8),
        ([90, 90, 90, 0].repeat(6), ExtendedColorType::Rgba8),
    ] {
        image::save_buffer_with_format(&path, &pixels, 3, 2, kind, ImageFormat::Png).unwrap();
        let image = read(&path).unwrap();
        assert_eq!(
            (image.typ(), color_at(&image, 0, 0)),
            (CV_8UC3, [90; 3]),
            "{kind:?}"
        );
    }
}

#[test]
fn incomplete_image_is_refused() {
    let jpeg = encode_jpeg(&flag(), 95).unwrap();
    let mut png = Cursor::new(Vec::new());
    image::write_buffer_with_format(
        &mut png,
        &[7; 300],
        10,
        10,
        image::ExtendedColorType::Rgb8,
        image::ImageFormat::Png,
    )
    .unwrap();
    let png = png.into_inner();
    for bytes in [
        b"".as_slice(),
        b"half a fi",
        &jpeg[..100],
        &png[..png.len() / 2],
    ] {
        let error = decode(bytes).expect_err("refused").to_string();
        assert!(error.starts_with("not an image"), "{error}");
    }
}

#[test]
fn gray_and_color_survive_jpeg() {
    assert!(is_near(
        color_at(&decode(&encode_jpeg(&flag(), 95).unwrap()).unwrap(), 8, 12),
        RED
    ));
    let gray = Mat::new_rows_cols_with_default(10, 20, CV_8UC1, Scalar::all(77.0)).unwrap();
    let shown = decode(&encode_jpeg(&gray, 95).unwrap()).unwrap();
    assert_eq!((shown.rows(), shown.cols()), (10, 20));
    assert!(is_near(color_at(&shown, 5, 5), [77; 3]));

    let long = Mat::new_rows_cols_with_default(1, 70_000, CV_8UC1, Scalar::all(0.0)).unwrap();
    assert!(
        encode_jpeg(&long, 95)
            .expect_err("too long")
            .to_string()
            .contains("70000x1")
    );
}

#[test]
fn oversized_header_is_refused() {
    let error = decode(b"P6\n65000 65000\n255\n").unwrap_err();
    assert!(
        matches!(error, ImageError::Malformed(image::ImageError::Limits(_))),
        "{error:?}"
    );
}

#[test]
fn jpeg_without_end_is_refused() {
    let whole = encode_jpeg(&flag(), 95).unwrap();
    let thumbnail = [
        &[0xff, 0xe1],
        (whole.len() as u16 + 2).to_be_bytes().as_slice(),
        &whole,
    ]
    .concat();
    let pictured = [&whole[..2], &thumbnail, &whole[2..]].concat();
    // Telephones append a film to a photograph.
    let extended = [&whole[..], &[0; 100]].concat();
    for file in [&whole, &pictured, &extended] {
        decode(file).unwrap();
    }
    let cut = |bytes: usize| decode(&pictured[..pictured.len() - bytes]);
    for bytes in [1, 2, 20] {
        let error = cut(bytes).expect_err("cut off");
        assert!(matches!(error, ImageError::CutOff), "{bytes}: {error}");
    }
    assert!(cut(whole.len() / 2).is_err());
    let next = [&pictured[..pictured.len() - 20], &whole[..]].concat();
    assert!(
        matches!(decode(&next), Err(ImageError::CutOff)),
        "the end of the next picture"
    );
    let zeros = [&whole[..whole.len() / 2], &vec![0; whole.len() / 2]].concat();
    assert!(
        decode(&zeros).is_err(),
        "as a crash of a file system leaves it"
    );
}
