//! A vehicle that drives: what it sees is placed from where it was, and put to the vote.
#![cfg(feature = "camera")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on says where")]

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{Limits, ObjectReport, Role, decode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use rumqttc::{AsyncClient, Event as Packets, EventLoop, MqttOptions, Packet, QoS};
use tokio::net::UdpSocket;
use tokio::task::JoinSet;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(30);

/// Half a metre of car, 40 pixels high: 6.6 m ahead of the default camera.
const DETECTIONS: &str =
    r#"[{"label":"car","confidence":0.9,"bounding_box":{"x_min":300,"y_min":200,"x_max":340,"y_max":240}}]"#;
const AHEAD_M: f64 = 6.6;

const SPEED_MPS: f64 = 2.0;
const STOPS_AT_M: f64 = 4.0;

/// Where the vehicle is a time after its start.
fn x_m(started: Timestamp, at: Timestamp) -> f64 {
    (SPEED_MPS * at.since(started).as_secs_f64()).min(STOPS_AT_M)
}

fn cell() -> NodeConfig {
    let mut config = NodeConfig {
        cell: NodeName::from_static("road"),
        landmarks: vec![LandmarkConfig::at("spot", STOPS_AT_M + AHEAD_M, 0.0)],
        ..NodeConfig::default()
    };
    config.membership.bind = Some("127.0.0.1:0".parse().unwrap());
    config.membership.multicast.enabled = false;
    config.dashboard.enabled = false;
    config
}

async fn edge() -> NodeHandle {
    let name = Some(NodeName::from_static("edge"));
    let listen = Some("127.0.0.1:0".parse().unwrap());
    node::start(NodeConfig { name, role: Role::Edge, listen, ..cell() }).await.unwrap()
}

async fn vehicle(broker: SocketAddr, poses: SocketAddr, directory: &Path) -> NodeHandle {
    let frames = directory.join("frames");
    std::fs::create_dir(&frames).unwrap();
    std::fs::write(frames.join("0.ppm"), [b"P6 640 480 255\n".as_slice(), &[128; 640 * 480 * 3]].concat()).unwrap();
    let detections = directory.join("detections.jsonl");
    std::fs::write(&detections, DETECTIONS).unwrap();
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true }}\n\
         detector = {{ kind = \"recorded\", path = {detections:?}, looping = true }}\n\
         projection = {{ ranging = \"box_height\", sizes.default = {{ width_m = 0.5, height_m = 0.5 }} }}"
    );
    let camera = Some(toml::from_str(&camera).unwrap());
    let mut config = NodeConfig { name: Some(NodeName::from_static("euclid")), role: Role::Cav, camera, ..cell() };
    config.mqtt.broker = Some(broker.into());
    config.pose.listen = Some(poses);
    config.validate().unwrap();
    node::start(config).await.unwrap()
}

/// The next report on a topic of the vehicle.
async fn next(events: &mut EventLoop, kind: &str) -> ObjectReport {
    let topic = format!("ecod/v1/road/{kind}/euclid");
    let next = async {
        loop {
            if let Packets::Incoming(Packet::Publish(message)) = events.poll().await.unwrap()
                && message.topic == topic.as_str()
            {
                return decode(&message.payload, &Limits::default()).unwrap();
            }
        }
    };
    timeout(PATIENCE, next).await.expect("no report")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_vehicle_that_drives_sees_from_where_it_was() {
    let directory = tempfile::tempdir().unwrap();
    let localisation = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let poses = {
        let free = UdpSocket::bind("127.0.0.1:0").await.unwrap();
        free.local_addr().unwrap()
    };
    let edge = edge().await;
    let broker = edge.broker_address().unwrap();
    let vehicle = vehicle(broker, poses, directory.path()).await;
    let mut options = MqttOptions::new("onlooker", broker.ip().to_string(), broker.port());
    options.set_keep_alive(Duration::from_secs(60));
    let (client, mut events) = AsyncClient::new(options, 64);
    client.subscribe("ecod/v1/road/#", QoS::AtMostOnce).await.unwrap();

    // Nobody has told it where it is: its frames say nothing.
    let unplaced = async {
        while vehicle.counters().events(Event::FrameWithoutPose) < 3 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, unplaced).await.expect("frames are looked at");

    let started = clock::now();
    let mut tasks = JoinSet::new();
    tasks.spawn(async move {
        loop {
            let now = clock::now();
            let pose = format!(r#"{{"x_m":{},"y_m":0,"heading_rad":0,"captured_at_us":{}}}"#, x_m(started, now), now.0);
            localisation.send_to(pose.as_bytes(), poses).await.unwrap();
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    let mut distances = Vec::new();
    let mut has_stopped = false;
    while !has_stopped {
        let report = next(&mut events, "detections").await;
        let (pose, object) = (report.pose.unwrap(), &report.objects[0]);
        let true_x_m = x_m(started, report.captured_at_us);
        // Where it starts and stops, poses that come late on a busy machine are continued wrongly for a moment.
        if (0.5..STOPS_AT_M).contains(&true_x_m) {
            assert!((pose.x_m - true_x_m).abs() < 0.1, "{pose:?} is {true_x_m}");
            distances.push(pose.x_m);
        }
        assert!((object.x_m - pose.x_m - AHEAD_M).abs() < 0.1, "{object:?} from {pose:?}");
        has_stopped = true_x_m == STOPS_AT_M && (pose.x_m - STOPS_AT_M).abs() < 0.01;
    }
    assert!(distances.is_sorted() && distances.len() > 3, "{distances:?}");

    // At the spot its report is a vote too.
    let vote = timeout(PATIENCE, async {
        loop {
            let report = next(&mut events, "vote_detections").await;
            if !report.objects.is_empty() {
                return report;
            }
        }
    });
    let vote = vote.await.expect("what stands at the spot is put to the vote");
    assert_eq!(vote.objects[0].landmark.as_deref(), Some("spot"));
    tasks.shutdown().await;
    vehicle.stop().await;
    edge.stop().await;
}
