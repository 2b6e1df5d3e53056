//! Tests with the models of `tests/data/onnx`. Its `make.py` wrote the models and decoded their
//! outputs independently.

use std::collections::BTreeMap;

use ecod::model::detection::BoundingBox;
use ecod::model::time::Timestamp;
use opencv::core::{CV_8UC3, Mat, Scalar};

use super::*;
use crate::camera::image_codec;

fn path(name: &str) -> PathBuf {
    PathBuf::from(format!(
        "{}/tests/data/onnx/{name}",
        env!("CARGO_MANIFEST_DIR")
    ))
}

fn config(model: &str) -> OnnxConfig {
    toml::from_str(&format!(
        "model = {:?}\nthreshold = 0.5",
        path(&format!("{model}.onnx"))
    ))
    .unwrap()
}

/// The configuration, with labels for a model without names.
fn labelled(model: &str) -> OnnxConfig {
    let has_names = ["yolov5", "yolov8", "rtdetr_rows"]
        .iter()
        .any(|named| model.starts_with(named));
    OnnxConfig {
        labels: (!has_names).then(|| path("labels.txt")),
        ..config(model)
    }
}

fn frame() -> CameraFrame {
    let image = image_codec::read(&path("frame.png")).unwrap();
    CameraFrame {
        image,
        captured_at: Timestamp(0),
        seq: 7,
    }
}

fn refusal(config: OnnxConfig) -> String {
    let error: anyhow::Error = OnnxDetector::new(config).err().expect("refused").into();
    format!("{error:#}")
}

#[derive(Debug, Deserialize)]
struct Expected {
    label: String,
    score: f64,
    r#box: [f64; 4],
}

impl Expected {
    fn is(&self, found: &Detection) -> bool {
        let b = &found.bounding_box;
        let edges = [b.x_min, b.y_min, b.x_max, b.y_max];
        found.label == self.label
            && (self.score - found.confidence).abs() < 1e-3
            && edges
                .iter()
                .zip(self.r#box)
                .all(|(edge, expected)| (edge - expected).abs() < 0.02)
    }
}

fn expected() -> BTreeMap<String, Vec<Expected>> {
    serde_json::from_str(&std::fs::read_to_string(path("expected.json")).unwrap()).unwrap()
}

#[test]
fn every_family_matches_independent_decoder() {
    let expected = expected();
    assert_eq!(expected.len(), 13);
    for (model, expected) in expected {
        let mut detector =
            OnnxDetector::new(labelled(&model)).unwrap_or_else(|error| panic!("{model}: {error}"));
        let found = detector.detect(&frame()).unwrap();
        assert_eq!(found.len(), expected.len(), "{model}: {found:?}");
        for object in &expected {
            assert!(
                found.iter().any(|found| object.is(found)),
                "{model}: {object:?} is not in {found:?}"
            );
        }
    }
}

#[test]
fn stated_family_must_fit_model() {
    for (model, family) in [
        ("yolov5", Family::Yolov5),
        ("yolov8_nms", Family::Yolov8),
        ("detr", Family::Detr),
    ] {
        OnnxDetector::new(OnnxConfig {
            family: Some(family),
            ..labelled(model)
        })
        .unwrap();
    }
    let error = refusal(OnnxConfig {
        family: Some(Family::Yolox),
        ..config("yolov8")
    });
    assert!(
        error.contains("output0 [1, 7, 84] for an image of 64x64, which do not match yolox"),
        "{error}"
    );
}

#[test]
fn background_class_is_no_object() {
    let directory = tempfile::tempdir().unwrap();
    for model in ["yolov5", "yolov8", "yolov8_nms"] {
        let all = OnnxDetector::new(labelled(model))
            .unwrap()
            .detect(&frame())
            .unwrap();
        let names = directory.path().join("names.txt");
        std::fs::write(&names, "background\ntraffic light\nit's a \"car\"\n").unwrap();
        let found = OnnxDetector::new(OnnxConfig {
            labels: Some(names),
            ..config(model)
        })
        .unwrap()
        .detect(&frame())
        .unwrap();
        let labels = found.iter().map(|object| object.label.as_str());
        let others = all.iter().map(|object| object.label.as_str());
        assert_eq!(
            labels.collect::<Vec<_>>(),
            others
                .filter(|label| *label != "person")
                .collect::<Vec<_>>(),
            "{model}"
        );
    }
}

#[test]
fn threshold_applies_to_one_label() {
    let all = OnnxDetector::new(labelled("yolov5"))
        .unwrap()
        .detect(&frame())
        .unwrap();
    let thresholds = BTreeMap::from([("person".into(), 1.0)]);
    let others = OnnxDetector::new(OnnxConfig {
        thresholds,
        ..labelled("yolov5")
    })
    .unwrap()
    .detect(&frame())
    .unwrap();
    assert!(all.iter().any(|found| found.label == "person") && !others.is_empty());
    assert_eq!(
        others,
        all.into_iter()
            .filter(|found| found.label != "person")
            .collect::<Vec<_>>()
    );
}

#[test]
fn unknown_outputs_are_printed() {
    let error = refusal(config("yolov8_segments"));
    for part in [
        "output0 [1, 39, 84]; output1 [1, 32, 4, 4]",
        "64x64",
        "any known family",
        "docs/cameras.md",
    ] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn yolox_in_pixels_is_refused() {
    let error = refusal(OnnxConfig {
        labels: Some(path("labels.txt")),
        ..config("yolox_in_pixels")
    });
    assert!(
        error.contains("export it without `--decode_in_inference`"),
        "{error}"
    );
}

#[test]
fn unusable_files_are_named() {
    let missing = refusal(config("no_such"));
    assert!(
        missing.contains("cannot read") && missing.contains("no_such.onnx"),
        "{missing}"
    );
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), b"this is not a network").unwrap();
    let junk = refusal(OnnxConfig {
        model: file.path().to_owned(),
        ..config("yolov8")
    });
    assert!(
        junk.contains("cannot be run") && junk.contains("export it to onnx"),
        "{junk}"
    );
    let no_labels = refusal(OnnxConfig {
        labels: Some("no/labels.txt".into()),
        ..config("yolov8")
    });
    assert!(no_labels.contains("no/labels.txt"), "{no_labels}");
}

#[test]
fn input_size_comes_from_model() {
    let message = refusal(OnnxConfig {
        input_px: Some([96, 64]),
        ..config("yolov8")
    });
    assert!(
        message.contains("takes images of 64x64, not 96x64: remove `input_px`"),
        "{message}"
    );
    // Its grids are for 64x64, in contradiction to its shape.
    let refused = refusal(OnnxConfig {
        input_px: Some([96, 64]),
        ..config("yolov8_dynamic")
    });
    assert!(
        refused.contains("fails with an image of 96x64") && refused.contains("multiples of 32"),
        "{refused}"
    );
}

#[test]
fn label_count_must_match_classes() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), "one\ntwo\n").unwrap();
    let labels = Some(file.path().to_owned());
    for model in ["yolov8", "yolox", "ssd", "rtdetr", "rfdetr"] {
        let error = refusal(OnnxConfig {
            labels: labels.clone(),
            ..config(model)
        });
        assert!(
            error.contains("2 labels in") && error.contains("the model has 3 classes"),
            "{model}: {error}"
        );
    }
    let none = refusal(config("yolox"));
    assert!(
        none.contains("3 classes without names: set `labels`"),
        "{none}"
    );
    let thresholds = BTreeMap::from([("persn".into(), 0.5)]);
    let unknown = refusal(OnnxConfig {
        thresholds,
        ..config("yolov8")
    });
    assert!(
        unknown.contains("`thresholds` names \"persn\", but the labels"),
        "{unknown}"
    );
    assert!(
        unknown.contains("person, traffic light, it's a \"car\""),
        "{unknown}"
    );
    std::fs::write(file.path(), "one\ntwo\nthr\u{7}ee\n").unwrap();
    let bad = refusal(OnnxConfig {
        labels,
        ..config("yolov8")
    });
    assert!(bad.contains(r#"label "thr\u{7}ee""#), "{bad}");
}

#[test]
fn class_without_label_fails_frame() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), "one\n").unwrap();
    let config = OnnxConfig {
        labels: Some(file.path().to_owned()),
        ..config("ssd_torchvision")
    };
    let error = OnnxDetector::new(config)
        .unwrap()
        .detect(&frame())
        .expect_err("class 2 or 3")
        .to_string();
    assert!(
        error.contains("there are 1 labels: list all of its classes in `labels`"),
        "{error}"
    );
}

#[test]
fn names_come_from_file_or_metadata() {
    for (text, names, first) in [
        (
            r#"{0: 'person', 1: "it's", 2: 'a \'b\''}"#,
            &["person", "it's", "a 'b'"][..],
            Some(0),
        ),
        ("['a', 'b']", &["a", "b"], None),
        ("(u'a', 'b',)", &["a", "b"], None),
        (r#"{"0": "a", "1": "b"}"#, &["a", "b"], Some(0)),
        ("{1: 'drone', 0: 'gate'}", &["gate", "drone"], Some(0)),
        ("{10: 'c', 9: 'b', 8: 'a'}", &["a", "b", "c"], Some(8)),
        (r#"{"person": 0, "car": 1}"#, &["person", "car"], Some(0)),
        ("{0: 'background', 1: 'cat'}", &["cat"], Some(1)),
        ("{0: 30, 1: 50,}", &["30", "50"], Some(0)),
        (
            r#"["gr\u00fcn", "a:b, {c}", "\ud83d\ude97", 'caf\xe9\n']"#,
            &["gr\u{fc}n", "a:b, {c}", "\u{1f697}", "caf\u{e9}\n"],
            None,
        ),
        ("{}", &[], None),
    ] {
        let stated = labels::parse(text).unwrap();
        assert_eq!(
            (&stated.names[..], stated.first),
            (
                &names.iter().map(ToString::to_string).collect::<Vec<_>>()[..],
                first
            ),
            "{text}"
        );
    }
    for (text, fault) in [
        ("{0: 'open", "a quote is missing"),
        ("{0: 'a', 2: 'c'}", "class 1 has no name"),
        ("{0: 'a', 0: 'c'}", "class 0 has two names"),
        ("person, car", "`,` follows the end"),
        ("'person'", "neither a list nor a map"),
        (r"['\ud83d']", "half a character"),
        ("['a' 'b']", "`'` in place of a comma"),
        ("{0 'a'}", "`'` in place of a colon"),
        ("[['a']]", "a name is a list"),
        ("", "a value is missing"),
    ] {
        let found = labels::parse(text).unwrap_err();
        assert!(found.contains(fault), "{text}: {found}");
    }
    assert!(labels::parse(&"[".repeat(1000)).is_err());
    let file = labels::read("BACKGROUND\r\n aeroplane \n\nbicycle");
    assert_eq!(file.names, ["aeroplane", "bicycle"]);
    assert!(file.has_background);
    assert_eq!(labels::read("__background__\ncat").names, ["cat"]);
}

#[test]
fn coco_labels_fit_every_family() {
    let label = |scores, first, has_none_last, class: usize| {
        let classes = labels::Classes {
            scores,
            first,
            has_none_last,
        };
        classes.labels(None).unwrap()[class].clone()
    };
    assert_eq!(label(Some(80), 0, false, 79).unwrap(), "toothbrush");
    assert_eq!(label(Some(81), 1, false, 80).unwrap(), "toothbrush");
    assert_eq!(label(Some(91), 1, false, 90).unwrap(), "toothbrush");
    assert_eq!(label(Some(91), 0, false, 90).unwrap(), "toothbrush");
    assert_eq!(label(Some(92), 0, true, 90).unwrap(), "toothbrush");
    assert_eq!(label(None, 1, false, 90).unwrap(), "toothbrush");
    assert_eq!(label(None, 0, false, 79).unwrap(), "toothbrush");
    assert_eq!(
        label(Some(92), 0, true, 12),
        None,
        "an id that is not in use"
    );
}

#[test]
fn letterbox_keeps_box_positions() {
    let input = ImageSize {
        width: 640,
        height: 480,
    };
    let whole = BoundingBox {
        x_min: 0.0,
        y_min: 0.0,
        x_max: 1920.0,
        y_max: 1080.0,
    };
    for (fit, placed) in [
        (letterbox::Fit::Centred, [0.0, 60.0, 640.0, 420.0]),
        (letterbox::Fit::TopLeft, [0.0, 0.0, 640.0, 360.0]),
        (letterbox::Fit::Stretched, [0.0, 0.0, 640.0, 480.0]),
    ] {
        let [x_min, y_min, x_max, y_max] = placed;
        let back = Letterbox::new(
            fit,
            ImageSize {
                width: 1920,
                height: 1080,
            },
            input,
        )
        .to_image(&BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        });
        assert!(
            back.intersection_over_union(&whole) > 1.0 - 1e-9,
            "{fit:?}: {back:?}"
        );
    }
}

#[test]
fn boxes_stay_inside_any_frame() {
    for model in ["yolov5", "yolox", "ssd", "rtdetr"] {
        let mut detector = OnnxDetector::new(OnnxConfig {
            threshold: 0.01,
            ..labelled(model)
        })
        .unwrap();
        for (width, height) in [(1, 1), (2000, 3), (3, 2000), (64, 64)] {
            let image = Mat::new_rows_cols_with_default(height, width, CV_8UC3, Scalar::all(255.0))
                .unwrap();
            for found in detector
                .detect(&CameraFrame {
                    image,
                    captured_at: Timestamp(0),
                    seq: 1,
                })
                .unwrap()
            {
                let b = found.bounding_box;
                assert!(
                    b.is_valid() && b.x_min >= 0.0 && b.y_min >= 0.0,
                    "{model}: {b:?}"
                );
                assert!(
                    b.x_max <= f64::from(width) && b.y_max <= f64::from(height),
                    "{model}: {b:?}"
                );
            }
        }
    }
}

/// An object that `photos.py` found.
#[derive(Debug, Deserialize)]
struct Photographed {
    class: usize,
    score: f64,
    r#box: [f64; 4],
}

#[test]
#[ignore = "needs weights of YOLOX: make models-check YOLOX=FILE"]
fn yolox_matches_onnx_runtime() {
    let file = |key| PathBuf::from(std::env::var_os(key).expect(key));
    let expected = std::fs::read_to_string(file("YOLOX_PHOTOS")).unwrap();
    let expected: BTreeMap<String, Vec<Photographed>> = serde_json::from_str(&expected).unwrap();
    assert!(
        expected.len() == 3 && expected.values().all(|objects| !objects.is_empty()),
        "{expected:?}"
    );
    let names: Vec<_> = crate::camera::detect::coco::labels::all()
        .map(|(_, name)| name)
        .collect();
    let mut detector = OnnxDetector::new(OnnxConfig {
        threshold: 0.3,
        ..OnnxConfig::of(file("YOLOX_MODEL"))
    })
    .unwrap();
    for (name, expected) in expected {
        let photograph = path(&format!("../photos/{name}.jpg"));
        let image = image_codec::read(&photograph).unwrap();
        let found = detector.detect(&CameraFrame { image, ..frame() }).unwrap();
        assert_eq!(found.len(), expected.len(), "{name}: {found:?}");
        for Photographed {
            class,
            score,
            r#box,
        } in expected
        {
            let same = found.iter().find(|found| found.label == names[class]);
            let Detection {
                confidence,
                bounding_box: b,
                ..
            } = same.unwrap_or_else(|| panic!("{name}: {found:?}"));
            let edges = [b.x_min, b.y_min, b.x_max, b.y_max];
            let off_px = edges
                .iter()
                .zip(r#box)
                .map(|(edge, expected)| (edge - expected).abs())
                .fold(0.0, f64::max);
            println!(
                "{name}: {} {confidence:.4}, off by {:.5}, box by {off_px:.3} px",
                names[class],
                confidence - score
            );
            assert!(
                (confidence - score).abs() < 0.01 && off_px < 0.5,
                "{name}: {same:?} at {edges:?}"
            );
        }
    }
}

/// The bytes of a model whose metadata has other text of the same length.
fn edited(model: &str, edits: &[(&str, &str)]) -> tempfile::NamedTempFile {
    let mut bytes = std::fs::read(path(&format!("{model}.onnx"))).unwrap();
    for (old, new) in edits {
        assert_eq!(old.len(), new.len(), "lengths are in the file");
        let places: Vec<usize> = (0..bytes.len() - old.len())
            .filter(|at| bytes[*at..].starts_with(old.as_bytes()))
            .collect();
        assert!(!places.is_empty(), "{old}");
        for at in places {
            bytes[at..at + old.len()].copy_from_slice(new.as_bytes());
        }
    }
    let file = tempfile::Builder::new().suffix(".onnx").tempfile().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    file
}

fn config_of(file: &tempfile::NamedTempFile) -> OnnxConfig {
    OnnxConfig {
        model: file.path().to_owned(),
        ..config("yolov8")
    }
}

const NAMES: &str = r#"{0: 'person', 1: 'traffic light', 2: 'it\'s a "car"'}"#;

#[test]
fn metadata_names_keep_their_numbers() {
    let swapped = r#"{1: 'traffic light', 0: 'person', 2: 'it\'s a "car"'}"#;
    let file = edited("yolov8", &[(NAMES, swapped)]);
    let found = OnnxDetector::new(config_of(&file))
        .unwrap()
        .detect(&frame())
        .unwrap();
    let expected = &expected()["yolov8"];
    assert_eq!(found.len(), expected.len());
    assert!(
        expected
            .iter()
            .all(|object| found.iter().any(|found| object.is(found)))
    );
    let from_1 = r#"{1: 'person', 2: 'traffic light', 3: 'it\'s a "car"'}"#;
    let error = refusal(config_of(&edited("yolov8", &[(NAMES, from_1)])));
    assert!(
        error.contains("begin with class 1, but classes of yolov8 begin with 0: set `first_class`"),
        "{error}"
    );
    let torn = r#"{0: 'person', 1: 'traffic light', 2: 'it\'s a "car" }"#;
    let error = refusal(config_of(&edited("yolov8", &[(NAMES, torn)])));
    assert!(
        error.contains("a quote is missing; set `labels`"),
        "{error}"
    );
    let two = r#"{0: 'person', 1: 'traffic light, 2: it\'s a "car"'  }"#;
    let error = refusal(config_of(&edited("yolov8", &[(NAMES, two)])));
    assert!(
        error.contains("has 2 names in its metadata, but output0 [1, 7, 84] are for 3 classes"),
        "{error}"
    );
}

#[test]
fn foreign_task_model_is_refused() {
    let error = refusal(config_of(&edited("yolov8", &[("detect", "posing")])));
    assert!(
        error.contains("the task \"posing\"") && error.contains("export a model for detection"),
        "{error}"
    );
    assert_eq!(other_task("obb").unwrap(), "oriented boxes");
    assert_eq!(other_task("detect"), None);
}

#[test]
fn unknown_exporter_needs_first_class() {
    let labels = Some(path("labels.txt"));
    let file = edited("ssd_torchvision", &[("boxes", "b_box")]);
    let unknown = OnnxConfig {
        labels: labels.clone(),
        ..config_of(&file)
    };
    let error = refusal(unknown.clone());
    assert!(
        error.contains("b_box [") && error.contains("set `first_class` to 0"),
        "{error}"
    );
    let stated = OnnxConfig {
        first_class: Some(1),
        ..unknown.clone()
    };
    let found = OnnxDetector::new(stated).unwrap().detect(&frame()).unwrap();
    assert_eq!(found.len(), expected()["ssd_torchvision"].len());
    let shifted = OnnxConfig {
        first_class: Some(0),
        ..unknown
    };
    let mut shifted = OnnxDetector::new(shifted).unwrap();
    assert!(shifted.detect(&frame()).is_err(), "class 3 of 0 to 2");
    assert!(
        OnnxConfig {
            first_class: Some(2),
            ..config("yolov8")
        }
        .validate()
        .is_err()
    );
}

#[test]
fn contradictory_scores_are_dropped() {
    let input = ImageSize {
        width: 640,
        height: 480,
    };
    let head = |family, layout, is_tensorflow| Head {
        family,
        layout,
        is_tensorflow,
        first_class: 0,
    };
    let listed = family::Layout::Listed {
        boxes: 0,
        scores: 1,
        classes: 2,
    };
    let columns = head(Family::Yolov8, family::Layout::Columns(0), false);
    let corners = head(Family::Ssd, listed, false);
    let shares = head(Family::Ssd, listed, true);
    let is_wrong = |head: Head, score, [x_min, y_min, x_max, y_max]: [f64; 4]| {
        let bounds = BoundingBox {
            x_min,
            y_min,
            x_max,
            y_max,
        };
        let found = ScoredBox {
            class: 0,
            score,
            bounds,
        };
        head.contradiction(&found, input).is_some()
    };
    let usual = [10.0, 20.0, 300.0, 480.0];
    for head in [columns, corners, shares] {
        assert!(!is_wrong(head, 1.0, usual), "{head:?}");
        assert!(is_wrong(head, 1.4, usual), "an angle in place of a score");
    }
    assert!(is_wrong(columns, 0.9, [0.1, 0.2, 0.4, 0.9]));
    assert!(is_wrong(corners, 0.9, [0.1, 0.2, 0.4, 0.9]));
    assert!(is_wrong(corners, 0.9, [300.0, 200.0, 40.0, 30.0]));
    assert!(is_wrong(
        shares,
        0.9,
        [6400.0, 9600.0, 192_000.0, 230_400.0]
    ));
}

#[test]
fn third_input_side_is_refused() {
    let read =
        |sides: &str| toml::from_str::<OnnxConfig>(&format!("model = 'm'\ninput_px = {sides}"));
    assert_eq!(read("[640, 480]").unwrap().input_px, Some([640, 480]));
    for sides in ["[640]", "[640, 480, 3]", "[3, 640, 640, 1]"] {
        let error = read(sides).unwrap_err().to_string();
        assert!(error.contains("expected width and height"), "{error}");
    }
}
