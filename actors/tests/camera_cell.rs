//! A vehicle that sees for real: rendered frames, decoded placards, a fused map, and parts that are killed on the way.
#![cfg(feature = "camera")]

use std::path::PathBuf;
use std::time::Duration;

use ecod::testbed::Testbed;
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::telemetry::counters::Event;
use ecod_actors::testbed::setup;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(60);
const SCENE: &str = "setup1-lot1";

/// Waits until the vehicle has got a newer map that holds the plate.
async fn plate_on_a_new_map(vehicle: &NodeHandle, plate: &str) {
    let mut newest = vehicle.newest_map();
    let last = newest.borrow_and_update().as_ref().map(|received| received.map.round);
    let seen = newest.wait_for(|received| {
        received.as_ref().is_some_and(|received| {
            Some(received.map.round) != last
                && received.map.landmarks.iter().any(|state| state.label.as_deref() == Some(plate))
        })
    });
    timeout(PATIENCE, seen).await.expect("the plate never came back").expect("the follower lives on");
}

/// Waits until the vehicle has looked at more frames.
async fn more_frames(vehicle: &NodeHandle) {
    let wanted = vehicle.counters().events(Event::FrameDetected) + 3;
    let looked = async {
        while vehicle.counters().events(Event::FrameDetected) < wanted {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, looked).await.expect("the camera stopped");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_plate_goes_from_pixels_to_the_map_though_detector_and_projector_are_killed() {
    let file = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../examples/testbed/pace_setup1.json");
    let testbed = Testbed::from_json(&std::fs::read_to_string(&file).unwrap()).unwrap();
    let scene = testbed.scene(SCENE).unwrap();
    let mut edge = setup::edge(&testbed, scene);
    edge.listen = Some("127.0.0.1:0".parse().unwrap());
    let edge = node::start(edge).await.unwrap();

    let euclid = scene.cavs.iter().find(|cav| cav.name.as_str() == "euclid").unwrap();
    let source = SourceConfig::Testbed { scenes: file, scene: SCENE.into(), cav: euclid.name.clone(), seed: 7 };
    let mut config = setup::cav(&testbed, scene, euclid, source);
    config.mqtt.broker = edge.broker_address().map(Into::into);
    config.validate().unwrap();
    let vehicle = node::start(config).await.unwrap();

    let plate = scene.spots[0].truth.as_deref().unwrap();
    plate_on_a_new_map(&vehicle, plate).await;
    let detector = vehicle.slots().detector.get().unwrap().get_cell();
    let projector = vehicle.slots().projector.get().unwrap().get_cell();
    for part in [detector, projector] {
        part.kill();
        more_frames(&vehicle).await;
        plate_on_a_new_map(&vehicle, plate).await;
    }
    vehicle.stop().await;
    edge.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_camera_that_is_missing_is_counted_each_time_and_the_node_lives_on() {
    let toml = r#"
        name = "blind"
        dashboard = { enabled = false }
        membership = { bind = "127.0.0.1:0", multicast = { enabled = false } }
        listen = "127.0.0.1:0"
        [camera]
        source = { kind = "v4l2", device = "/dev/no-such-camera" }
        detector = { kind = "placard" }
        capture = { retry_min_s = 0.05, retry_max_s = 0.05 }
    "#;
    let node = node::start(toml::from_str(toml).unwrap()).await.unwrap();
    let failures = node.counters().events(Event::SourceFailed);
    let counted = async {
        while node.counters().events(Event::SourceFailed) < failures + 2 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, counted).await.expect("it is tried again and counted");
    let mut newest = node.newest_map();
    timeout(PATIENCE, newest.wait_for(Option::is_some)).await.expect("it serves itself").unwrap();
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_whose_detector_cannot_be_built_says_why() {
    let toml = r#"
        name = "blind"
        role = "cav"
        [mqtt]
        broker = "127.0.0.1:1"
        [camera]
        source = { kind = "images", path = "frames" }
        detector = { kind = "recorded", path = "no-such-recording.jsonl" }
    "#;
    let error = node::start(toml::from_str(toml).unwrap()).await.err().expect("there is no recording").to_string();
    assert!(error.contains("no-such-recording.jsonl") && error.contains("No such file"), "{error}");
}
