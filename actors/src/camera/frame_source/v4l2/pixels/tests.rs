use opencv::core::{CV_8UC3, Scalar};

use super::*;

fn way(fourcc: &[u8; 4]) -> Way {
    PixelConversion::choose(&[FourCC::new(fourcc)]).unwrap().way
}

fn convert(fourcc: &[u8; 4], size: [u32; 2], stride: u32, buffer: &[u8]) -> Result<Mat, String> {
    FrameLayout::of(way(fourcc), size, stride)?.to_bgr(buffer)
}

fn pixel(image: &Mat, row: i32, column: i32) -> [u8; 3] {
    image.at_2d::<Vec3b>(row, column).unwrap().0
}

#[test]
fn cheapest_format_is_chosen() {
    let formats = |names: &[&[u8; 4]]| {
        names
            .iter()
            .map(|name| FourCC::new(name))
            .collect::<Vec<_>>()
    };
    let chosen = |names: &[&[u8; 4]]| {
        PixelConversion::choose(&formats(names)).map(|it| it.format().to_string())
    };
    assert_eq!(
        chosen(&[b"MJPG", b"YUYV"]).as_deref(),
        Some("YUYV"),
        "as most USB cameras"
    );
    assert_eq!(chosen(&[b"H264", b"MJPG"]).as_deref(), Some("MJPG"));
    assert_eq!(
        chosen(&[b"YUYV", b"YU12", b"BGR3"]).as_deref(),
        Some("BGR3")
    );
    assert_eq!(chosen(&[b"H264", b"pBAA"]), None);
}

/// Red has brightness 81 and colours 90 and 240 by BT.601, gray 126 and 128 twice.
#[test]
fn packed_and_planar_become_bgr() {
    let y = 81;
    let u = 90;
    let v = 240;
    let planes = |chroma: [u8; 4]| [vec![y; 8], chroma.to_vec()].concat();
    let buffers: [(&[u8; 4], Vec<u8>); 6] = [
        (b"YUYV", [y, u, y, v].repeat(4)),
        (b"UYVY", [u, y, v, y].repeat(4)),
        (b"YU12", planes([u, u, v, v])),
        (b"YV12", planes([v, v, u, u])),
        (b"NV12", planes([u, v, u, v])),
        (b"NV21", planes([v, u, v, u])),
    ];
    for (fourcc, buffer) in buffers {
        let image = convert(fourcc, [4, 2], 0, &buffer).unwrap();
        assert_eq!((image.rows(), image.cols(), image.typ()), (2, 4, CV_8UC3));
        let [blue, green, red] = pixel(&image, 1, 3);
        assert!(
            blue < 5 && green < 5 && red > 250,
            "{fourcc:?}: {blue} {green} {red}"
        );
    }
    let rgb = [10, 20, 30].repeat(8);
    assert_eq!(
        pixel(&convert(b"RGB3", [4, 2], 0, &rgb).unwrap(), 1, 3),
        [30, 20, 10]
    );
    assert_eq!(
        pixel(&convert(b"BGR3", [4, 2], 0, &rgb).unwrap(), 1, 3),
        [10, 20, 30]
    );
    assert_eq!(
        pixel(&convert(b"GREY", [4, 2], 0, &[77; 8]).unwrap(), 1, 3),
        [77; 3]
    );
}

#[test]
fn row_padding_is_ignored() {
    // Two pixels of gray, then padding that would be green.
    let row = [126, 128, 126, 128, 0, 0, 0, 0];
    let image = convert(b"YUYV", [2, 2], 8, &row.repeat(2)).unwrap();
    assert_eq!((image.rows(), image.cols()), (2, 2));
    let [blue, green, red] = pixel(&image, 1, 1);
    assert!(
        blue == green && green == red && blue.abs_diff(128) < 3,
        "{blue} {green} {red}"
    );
    assert!(
        convert(b"BGR3", [2, 2], 7, &[0; 14])
            .unwrap_err()
            .contains("7 bytes in a row")
    );
    assert!(
        convert(b"YUYV", [4, 2], 4, &[0; 16])
            .unwrap_err()
            .contains("4x2")
    );
}

#[test]
fn partial_frame_is_refused() {
    assert!(
        convert(b"YUYV", [4, 2], 0, &[0; 15])
            .unwrap_err()
            .contains("15 of 16 bytes")
    );
    assert!(
        convert(b"MJPG", [4, 2], 0, &[0xff, 0xd8, 0xff])
            .unwrap_err()
            .contains("not an image")
    );
}

/// Segments of a JPEG file up to its picture data, and the rest.
fn without_huffman_tables(jpeg: &[u8]) -> Vec<u8> {
    let mut bare = jpeg[..2].to_vec();
    let mut rest = &jpeg[2..];
    while rest[1] != 0xda {
        let (segment, after) =
            rest.split_at(2 + usize::from(u16::from_be_bytes([rest[2], rest[3]])));
        if segment[1] != 0xc4 {
            bare.extend(segment);
        }
        rest = after;
    }
    [&bare, rest].concat()
}

#[test]
fn incomplete_motion_jpeg_is_read() {
    let image =
        Mat::new_rows_cols_with_default(48, 64, CV_8UC3, Scalar::new(200.0, 100.0, 50.0, 0.0))
            .unwrap();
    let jpeg = image_codec::encode_jpeg(&image, 90).unwrap();
    let bare = without_huffman_tables(&jpeg);
    assert!(
        bare.len() + 400 < jpeg.len(),
        "the four tables are left out"
    );
    for file in [jpeg.clone(), bare, [jpeg, vec![0; 1000]].concat()] {
        let shown = convert(b"MJPG", [64, 48], 0, &file).unwrap();
        assert_eq!((shown.rows(), shown.cols()), (48, 64));
        let near = pixel(&shown, 24, 32)
            .iter()
            .zip([200, 100, 50])
            .all(|(a, b)| a.abs_diff(b) <= 4);
        assert!(near, "{:?}", pixel(&shown, 24, 32));
    }
}
