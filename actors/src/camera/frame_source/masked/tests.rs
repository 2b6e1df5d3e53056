use ecod::model::detection::BoundingBox;
use ecod::model::time::Timestamp;
use nalgebra::Point2;
use opencv::core::{CV_8UC3, Vec3b};
use opencv::prelude::*;
use proptest::prelude::*;

use super::*;

const SIZE: ImageSize = ImageSize {
    width: 64,
    height: 48,
};

/// A camera that shows a white wall, in pictures of this size.
struct Wall(ImageSize);

impl FrameSource for Wall {
    fn next_frame(&mut self) -> Result<CameraFrame, FrameError> {
        let [rows, columns] = [self.0.height, self.0.width].map(|side| side as i32);
        let white = Scalar::all(255.0);
        let image = Mat::new_rows_cols_with_default(rows, columns, CV_8UC3, white).unwrap();
        Ok(CameraFrame {
            image,
            captured_at: Timestamp::default(),
            seq: 0,
        })
    }

    fn time_source(&self) -> TimeSource {
        TimeSource::Arrival
    }
}

fn masked(size: ImageSize, masks: Vec<Polygon>) -> Result<CameraFrame, FrameError> {
    let mut source = MaskedSource {
        source: Box::new(Wall(size)),
        origin: "wall".into(),
        masks,
        shape: SIZE,
    };
    source.next_frame()
}

/// Checks that each pixel that a mask touches is black, and each pixel far from it is white.
fn assert_covers(frame: &CameraFrame, masks: &[Polygon]) {
    let size = ImageSize::of(&frame.image);
    let in_pixels: Vec<_> = masks
        .iter()
        .map(|mask| mask.scaled(size.width.into(), size.height.into()))
        .collect();
    for (column, row) in (0..size.width).flat_map(|x| (0..size.height).map(move |y| (x, y))) {
        let around = |pixels: f64| BoundingBox {
            x_min: f64::from(column) - pixels,
            y_min: f64::from(row) - pixels,
            x_max: f64::from(column + 1) + pixels,
            y_max: f64::from(row + 1) + pixels,
        };
        let touches = |area: BoundingBox| in_pixels.iter().any(|mask| mask.overlaps(&area));
        let value = frame
            .image
            .at_2d::<Vec3b>(row as i32, column as i32)
            .unwrap();
        if touches(around(-1e-6)) {
            assert_eq!(value.0, [0; 3], "{column}, {row} of {masks:?}");
        } else if !touches(around(3.0)) {
            assert_eq!(value.0, [255; 3], "{column}, {row} of {masks:?}");
        }
    }
}

fn mask(corners: &[[f64; 2]]) -> Polygon {
    let corners: Vec<_> = corners.iter().copied().map(Point2::from).collect();
    Polygon::new(&corners).unwrap()
}

proptest! {
    #[test]
    fn masks_cover_each_touched_pixel(
        corners in prop::collection::vec([0.0..=1.0, 0.0..=1.0f64], 3..8),
        scale in 1u32..4,
    ) {
        let corners: Vec<_> = corners.into_iter().map(Point2::from).collect();
        // Corners at random usually cross from six on.
        let polygon = Polygon::new(&corners);
        prop_assume!(polygon.is_ok());
        let masks = vec![polygon.unwrap()];
        let size = ImageSize { width: 64 * scale, height: 48 * scale };
        let frame = masked(size, masks.clone()).unwrap();
        assert_covers(&frame, &masks);
    }
}

#[test]
fn overlapping_masks_leave_no_hole() {
    let masks = vec![
        mask(&[[0.1, 0.1], [0.6, 0.1], [0.6, 0.6], [0.1, 0.6]]),
        mask(&[[0.4, 0.4], [0.9, 0.4], [0.9, 0.9], [0.4, 0.9]]),
    ];
    let frame = masked(SIZE, masks.clone()).unwrap();
    assert_covers(&frame, &masks);
}

#[test]
fn whole_picture_can_be_masked() {
    let masks = vec![mask(&[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])];
    let frame = masked(SIZE, masks.clone()).unwrap();
    assert_covers(&frame, &masks);
}

/// The camera may show another part of the scene.
#[test]
fn other_shape_is_refused() {
    let wide = ImageSize {
        width: 64,
        height: 36,
    };
    let masks = vec![mask(&[[0.1, 0.1], [0.6, 0.1], [0.6, 0.6]])];
    let error = masked(wide, masks).unwrap_err();
    assert!(error.is_passing(), "the source continues");
    let text = error.to_string();
    assert!(
        text.contains("64x36") && text.contains("camera.masks"),
        "{text}"
    );
}
