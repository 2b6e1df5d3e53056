//! Reactions of nodes to cameras that fail or end.

use std::path::Path;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::node;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::telemetry::counters::Event;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(30);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missing_camera_is_counted() {
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
    timeout(PATIENCE, counted)
        .await
        .expect("it is tried again and counted");
    let mut newest = node.newest_map();
    timeout(PATIENCE, newest.wait_for(Option::is_some))
        .await
        .expect("the node produces maps without another node")
        .unwrap();
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unbuildable_detector_names_reason() {
    let toml = r#"
        name = "blind"
        role = "cav"
        [mqtt]
        broker = "127.0.0.1:1"
        [camera]
        source = { kind = "images", path = "frames" }
        detector = { kind = "recorded", path = "no-such-recording.jsonl" }
    "#;
    let error = node::start(toml::from_str(toml).unwrap())
        .await
        .err()
        .expect("there is no recording")
        .to_string();
    assert!(
        error.contains("no-such-recording.jsonl") && error.contains("No such file"),
        "{error}"
    );
}

/// Two cameras back to back report as one witness: the map contains the objects in front of the vehicle and behind it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_cameras_make_one_witness() {
    let folder = tempfile::tempdir().unwrap();
    let detections = folder.path().join("detections.jsonl");
    let box_ = r#"{"x_min":300,"y_min":220,"x_max":340,"y_max":260}"#;
    let line = format!(r#"[{{"label":"crate","confidence":0.9,"bounding_box":{box_}}}]"#);
    std::fs::write(&detections, line + "\n").unwrap();
    let photos = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/photos");
    let frames = folder.path().join("frames");
    let photo = std::fs::read_dir(photos)
        .unwrap()
        .map(|entry| entry.unwrap().path());
    let photo = photo
        .filter(|path| path.extension().is_some_and(|extension| extension == "jpg"))
        .min()
        .unwrap();
    std::fs::create_dir(&frames).unwrap();
    std::fs::copy(photo, frames.join("frame.jpg")).unwrap();
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, fps = 10.0, looping = true }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}\n\
         projection.sizes.default = {{ width_m = 0.5, height_m = 0.5 }}\n\
         optics = {{ horizontal_fov_deg = 62.2 }}\n"
    );
    let toml = format!(
        "name = \"euclid\"\ndashboard = {{ enabled = false }}\nlisten = \"127.0.0.1:0\"\n\
         membership = {{ bind = \"127.0.0.1:0\", multicast = {{ enabled = false }} }}\n\
         [camera]\n{camera}[[cameras]]\nname = \"rear\"\n{camera}mount = {{ pan_deg = 180.0 }}\n"
    );
    let config: NodeConfig = toml::from_str(&toml).unwrap();
    config.validate().unwrap();
    let node = node::start(config).await.unwrap();
    let mut newest = node.newest_map();
    let both_ways = |received: &Option<ReceivedMap>| {
        let objects = received.iter().flat_map(|received| &received.map.objects);
        let of = |side: f64| {
            objects
                .clone()
                .filter(move |object| object.x_m * side > 1.0)
                .count()
        };
        (of(1.0), of(-1.0)) == (1, 1)
            && objects
                .clone()
                .all(|object| object.contributors == ["euclid"].map(NodeName::from_static))
    };
    let seen = timeout(PATIENCE, newest.wait_for(both_ways))
        .await
        .map(drop);
    let map = newest
        .borrow()
        .as_ref()
        .map(|received| received.map.objects.clone());
    assert!(
        seen.is_ok(),
        "one object on each side: {map:?}, {:?}",
        node.counters().troubles().present()
    );
    node.stop().await;
}

/// A source reports its end as a frame error and as a status; the trouble appears whichever arrives
/// first.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_ended_source_is_trouble() {
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
        let trouble_is_reported = async {
            while !node
                .counters()
                .troubles()
                .present()
                .iter()
                .any(|trouble| trouble.cause.contains("have ended"))
            {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        timeout(Duration::from_secs(10), trouble_is_reported)
            .await
            .expect("the end is reported");
        node.stop().await;
    }
}
