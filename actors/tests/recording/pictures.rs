//! Pictures of the camera in a log.

use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use ecod::wire::Role;
use ecod_actors::node;
use ecod_actors::observe::recorder::SchemaName;
use ecod_actors::telemetry::counters::Event;
use serde_json::Value;

use crate::cell::{Log, config, free_address};

/// Of a camera that is looked at ten times a second, as many as were asked for are JPEG files in the log.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_of_the_camera_are_in_the_log_when_they_are_asked_for() {
    let directory = tempfile::tempdir().unwrap();
    let [frames, detections] = ["frames", "detections.jsonl"].map(|name| directory.path().join(name));
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(frames.join("0.ppm"), [b"P6 640 480 255\n".as_slice(), &[128; 640 * 480 * 3]].concat()).unwrap();
    std::fs::write(&detections, "[]\n").unwrap();
    let address = free_address();
    let mut config = config("euclid", Role::Auto, Some(address), address, directory.path());
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true, fps = 10 }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}\n\
         projection.sizes.default = {{ width_m = 0.5, height_m = 0.5 }}"
    );
    config.camera = Some(toml::from_str(&camera).unwrap());
    config.record.as_mut().unwrap().camera_hz = 2.0;
    config.validate().unwrap();
    let started = std::time::Instant::now();
    let node = node::start(config).await.unwrap();
    let counters = node.counters().clone();
    let looked = async {
        while counters.events(Event::FrameDetected) < 30 {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(30), looked).await.expect("frames are looked at");
    node.stop().await;
    let log = Log::read(&directory.path().join("euclid"));
    let pictures = log.messages.iter().filter(|message| message.schema == SchemaName::CompressedImage);
    let pictures: Vec<Value> = pictures.map(|message| serde_json::from_slice(&message.json).unwrap()).collect();
    let frames = counters.events(Event::FrameDetected) as usize;
    // At most two a second.
    let most = (2.0 * started.elapsed().as_secs_f64()) as usize + 1;
    assert!((3..=most.min(frames - 1)).contains(&pictures.len()), "{} of {frames} frames", pictures.len());
    for picture in &pictures {
        let bytes = BASE64_STANDARD.decode(picture["data"].as_str().unwrap()).unwrap();
        assert!(picture["format"] == "jpeg" && bytes.starts_with(&[0xff, 0xd8, 0xff]));
    }
}
