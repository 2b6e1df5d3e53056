//! Tests with the weights inside the program.
#![cfg(feature = "coco-weights")]

use ecod::model::time::Timestamp;
use opencv::imgproc;

use super::*;
use crate::camera::image_codec;

fn photograph(name: &str) -> Mat {
    image_codec::read(
        format!(
            "{}/tests/data/photos/{name}.jpg",
            env!("CARGO_MANIFEST_DIR")
        )
        .as_ref(),
    )
    .unwrap()
}

fn frame(image: Mat) -> CameraFrame {
    CameraFrame {
        image,
        captured_at: Timestamp(0),
        seq: 7,
    }
}

fn best(detections: &[Detection]) -> &Detection {
    detections
        .iter()
        .max_by(|a, b| a.confidence.total_cmp(&b.confidence))
        .expect("something is detected")
}

#[test]
fn objects_in_photographs_are_detected() {
    let mut detector = CocoDetector::new(CocoConfig::default()).unwrap();
    for (name, label, least, middle) in [
        ("coffee", "cup", 0.9, (310.0, 190.0)),
        ("chelsea", "cat", 0.9, (240.0, 150.0)),
        ("astronaut", "person", 0.5, (250.0, 260.0)),
    ] {
        let found = detector.detect(&frame(photograph(name))).unwrap();
        let best = best(&found);
        assert_eq!(best.label, label, "{name}: {found:?}");
        assert!(best.confidence > least, "{name}: {best:?}");
        let b = best.bounding_box;
        assert!(
            b.x_min < middle.0 && middle.0 < b.x_max && b.y_min < middle.1 && middle.1 < b.y_max,
            "{name}: {b:?}"
        );
    }
    let mut gray = Mat::default();
    imgproc::cvt_color_def(&photograph("chelsea"), &mut gray, imgproc::COLOR_BGR2GRAY).unwrap();
    let gray = detector.detect(&frame(gray)).unwrap();
    assert_eq!(best(&gray).label, "cat", "{gray:?}");
}

/// The cat, shrunk to a thumbnail in the lower right of a large plain image.
fn distant_cat() -> Mat {
    let mut image =
        Mat::new_rows_cols_with_default(960, 1280, CV_8UC3, Scalar::all(128.0)).unwrap();
    let mut small = Mat::default();
    let size = Size::new(220, 147);
    let cat = photograph("chelsea");
    imgproc::resize(&cat, &mut small, size, 0.0, 0.0, imgproc::INTER_AREA).unwrap();
    let mut place = Mat::roi_mut(&mut image, Rect::new(900, 650, size.width, size.height)).unwrap();
    small.copy_to(&mut place).unwrap();
    image
}

#[test]
fn tiles_find_small_objects() {
    let config = CocoConfig {
        threshold: 0.05,
        ..CocoConfig::default()
    };
    let image = frame(distant_cat());
    let cat = |tiling| {
        let mut detector = CocoDetector::new(CocoConfig {
            tiling,
            ..config.clone()
        })
        .unwrap();
        let found = detector.detect(&image).unwrap();
        found
            .into_iter()
            .filter(|d| d.label == "cat")
            .max_by(|a, b| a.confidence.total_cmp(&b.confidence))
    };
    let tiled = cat(true).expect("the cat is seen in a tile");
    assert!(
        tiled.confidence > cat(false).map_or(0.0, |d| d.confidence),
        "{tiled:?}"
    );
    let place = BoundingBox {
        x_min: 900.0,
        y_min: 650.0,
        x_max: 1120.0,
        y_max: 797.0,
    };
    assert!(
        tiled.bounding_box.intersection_over_union(&place) > 0.5,
        "{tiled:?}"
    );
}

#[test]
fn tiles_report_object_once() {
    let mut detector = CocoDetector::new(CocoConfig {
        tiling: true,
        ..CocoConfig::default()
    })
    .unwrap();
    let found = detector.detect(&frame(photograph("coffee"))).unwrap();
    assert_eq!(
        found.iter().filter(|d| d.label == "cup").count(),
        1,
        "{found:?}"
    );
}

#[test]
fn an_unusable_model_is_named() {
    let missing = CocoConfig {
        model: Some("no/such/model.onnx".into()),
        ..CocoConfig::default()
    };
    let error = CocoDetector::new(missing)
        .err()
        .expect("missing")
        .to_string();
    assert!(
        error.contains("cannot read model") && error.contains("no/such/model.onnx"),
        "{error}"
    );

    let file = tempfile::NamedTempFile::new().unwrap();
    for junk in [
        &b""[..],
        b"this is not a network",
        &BUILT_IN.unwrap()[..100_000],
    ] {
        std::fs::write(file.path(), junk).unwrap();
        let config = CocoConfig {
            model: Some(file.path().to_owned()),
            ..CocoConfig::default()
        };
        let error = CocoDetector::new(config).err().expect("junk").to_string();
        assert!(
            error.contains("not an ssdlite network")
                && error.contains(file.path().to_str().unwrap()),
            "{error}"
        );
    }
}

#[test]
fn detector_survives_unusable_image() {
    let mut detector = CocoDetector::new(CocoConfig::default()).unwrap();
    let error = detector
        .detect(&frame(Mat::default()))
        .expect_err("empty")
        .to_string();
    assert!(error.contains("frame 7 has no pixels"), "{error}");
    let deep = Mat::new_rows_cols_with_default(10, 10, CV_32F, Scalar::all(0.0)).unwrap();
    assert!(detector.detect(&frame(deep)).is_err());
    assert!(
        !detector
            .detect(&frame(photograph("chelsea")))
            .unwrap()
            .is_empty()
    );
}

#[test]
fn classes_have_coco_numbers() {
    let name = |id| {
        labels::all()
            .find(|(class, _)| *class == id)
            .map(|(_, name)| name)
    };
    assert_eq!(labels::all().count(), 80);
    assert_eq!(
        [1, 37, 47, 74, 86, 90].map(name),
        [
            "person",
            "sports ball",
            "cup",
            "mouse",
            "vase",
            "toothbrush"
        ]
        .map(Some)
    );
    assert_eq!(name(12), None);
    assert_eq!(anchors::all().len(), 1917);
}

#[test]
fn every_label_has_usual_size() {
    let sizes = ecod::perception::projection::ObjectSizes::default();
    let without: Vec<_> = labels::all()
        .filter(|(_, label)| sizes.of(label).is_none())
        .collect();
    assert!(
        without.is_empty() && labels::all().count() == 80,
        "{without:?}"
    );
}
