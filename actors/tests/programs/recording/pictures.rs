//! Pictures of the camera in a log.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use ecod::wire::Role;
use ecod_actors::node;
use ecod_actors::observe::recorder::{SchemaName, files};
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::output_of;
use serde_json::Value;

use crate::recording::cell::{Log, config};

/// Has a camera vehicle record pictures until it has looked at 30 frames, ten a second; gives that number and the time that
/// it took. The frames have twice the pixels of the optics.
async fn record(directory: &Path) -> (usize, Duration) {
    let [frames, detections] = ["frames", "detections.jsonl"].map(|name| directory.join(name));
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(
        frames.join("0.ppm"),
        [b"P6 1280 960 255\n".as_slice(), &[128; 1280 * 960 * 3]].concat(),
    )
    .unwrap();
    let bounding_box = r#"{"x_min": 500, "y_min": 300, "x_max": 700, "y_max": 660}"#;
    let found =
        format!(r#"[{{"label": "car", "confidence": 0.93, "bounding_box": {bounding_box}}}]"#);
    std::fs::write(&detections, found + "\n").unwrap();
    let mut config = config("euclid", Role::Auto, directory);
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true, fps = 10 }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}\n\
         optics = {{ width_px = 640, height_px = 480, horizontal_fov_deg = 60, vertical_fov_deg = 46 }}\n\
         projection.sizes.default = {{ width_m = 0.5, height_m = 0.5 }}"
    );
    config.camera = Some(toml::from_str(&camera).unwrap());
    config.record.as_mut().unwrap().camera_hz = 2.0;
    config.validate().unwrap();
    let started = Instant::now();
    let node = node::start(config).await.unwrap();
    let counters = node.counters().clone();
    let looked = async {
        while counters.events(Event::FrameDetected) < 30 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), looked)
        .await
        .expect("frames are looked at");
    node.stop().await;
    (
        counters.events(Event::FrameDetected) as usize,
        started.elapsed(),
    )
}

/// From a camera with ten frames a second, the log contains the requested number of JPEG files, each with the optics
/// and the boxes of its time.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requested_pictures_are_in_log() {
    let directory = tempfile::tempdir().unwrap();
    let (frames, took) = record(directory.path()).await;
    let log = Log::read(&directory.path().join("euclid"));
    let all = |topic: &str, schema| {
        let of_topic = log
            .messages
            .iter()
            .filter(move |message| message.topic == topic && message.schema == schema);
        of_topic
            .map(|message| serde_json::from_slice(&message.json).unwrap())
            .collect::<Vec<Value>>()
    };
    let pictures = all("camera", SchemaName::CompressedImage);
    // At most two a second.
    let most = (2.0 * took.as_secs_f64()) as usize + 1;
    assert!(
        (3..=most.min(frames - 1)).contains(&pictures.len()),
        "{} of {frames} frames",
        pictures.len()
    );
    for picture in &pictures {
        let bytes = BASE64_STANDARD
            .decode(picture["data"].as_str().unwrap())
            .unwrap();
        assert!(picture["format"] == "jpeg" && bytes.starts_with(&[0xff, 0xd8, 0xff]));
    }
    let boxes = all("camera_boxes", SchemaName::ImageAnnotations);
    let optics = all("camera_calibration", SchemaName::CameraCalibration);
    assert_eq!(
        (boxes.len(), optics.len()),
        (pictures.len(), pictures.len())
    );
    for ((picture, boxes), optics) in pictures.iter().zip(&boxes).zip(&optics) {
        assert_eq!(boxes["points"][0]["timestamp"], picture["timestamp"]);
        assert_eq!(
            boxes["points"][0]["points"][2],
            serde_json::json!({ "x": 700.0, "y": 660.0 })
        );
        assert_eq!(boxes["texts"][0]["text"], "car 93 %");
        assert_eq!(
            (&optics["frame_id"], &optics["timestamp"]),
            (&picture["frame_id"], &picture["timestamp"])
        );
        assert_eq!(
            (&optics["width"], &optics["height"]),
            (&1280.into(), &960.into())
        );
        let focal_px = 640.0 / 30f64.to_radians().tan();
        let [fx, cx, cy] = [0, 2, 5].map(|place| optics["K"][place].as_f64().unwrap());
        assert!(
            (fx - focal_px).abs() < 1e-6 && cx == 640.0 && cy == 480.0,
            "{optics}"
        );
    }
    let is_optical = |transform: &Value| transform["child_frame_id"] == pictures[0]["frame_id"];
    assert!(
        all("tf", SchemaName::FrameTransform).iter().any(is_optical),
        "viewers find the frame of the pictures"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "needs packages of npm, which `make foxglove-check` installs"]
async fn viewers_find_schemas() {
    let check = std::env::var("FOXGLOVE_CHECK").unwrap();
    let directory = tempfile::tempdir().unwrap();
    record(directory.path()).await;
    let logs = files(&directory.path().join("euclid")).unwrap();
    let layout = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../packaging/foxglove/ecod.json"
    );
    let mut viewers = Command::new("node");
    print!("{}", output_of(viewers.arg(check).args(logs).arg(layout)));
}
