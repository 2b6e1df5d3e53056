//! Cameras that do not work, and what their nodes make of it.
#![cfg(feature = "camera")]

use std::time::Duration;

use ecod_actors::node;
use ecod_actors::telemetry::counters::Event;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(60);

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

/// The end comes as frame and as status; whichever is taken first, the node says so.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_source_that_ends_is_a_trouble_each_time() {
    let photos = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/photos");
    for _ in 0..8 {
        let toml = format!(
            r#"
            name = "blind"
            dashboard = {{ enabled = false }}
            membership = {{ bind = "127.0.0.1:0", multicast = {{ enabled = false }} }}
            listen = "127.0.0.1:0"
            pose = {{ x_m = 0.0, y_m = 0.0, heading_deg = 0.0 }}
            [camera]
            source = {{ kind = "images", path = "{photos}", fps = 30.0 }}
            detector = {{ kind = "placard" }}
            optics = {{ horizontal_fov_deg = 62.2 }}
        "#
        );
        let node = node::start(toml::from_str(&toml).unwrap()).await.unwrap();
        let told = async {
            while !node.counters().troubles().present().iter().any(|trouble| trouble.cause.contains("have ended")) {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        timeout(Duration::from_secs(10), told).await.expect("the end is told");
        node.stop().await;
    }
}
