//! Vehicles that receive their poses, or have poses on Earth: detections are placed relative to the pose at their
//! capture, and used for votes.

use std::f64::consts::{FRAC_PI_2, PI};
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use ecod::model::geometry::wrap_angle;
use ecod::model::time::Timestamp;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{Limits, ObjectReport, Role, decode};
use ecod_actors::camera::vehicle_pose::PoseConfig;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::{PATIENCE, car_ahead, node_config, until_async as until};
use rumqttc::{AsyncClient, Event as Packets, EventLoop, MqttOptions, Packet, QoS};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpStream, UdpSocket};
use tokio::task::JoinSet;
use tokio::time::timeout;

/// How far ahead the car of [`car_ahead`] stands.
const AHEAD_M: f64 = 6.6;

const SPEED_MPS: f64 = 2.0;
const STOPS_AT_M: f64 = 4.0;

/// Where the vehicle is a time after its start.
fn x_m(started: Timestamp, at: Timestamp) -> f64 {
    (SPEED_MPS * at.since(started).as_secs_f64()).min(STOPS_AT_M)
}

fn config(name: &str, role: Role) -> NodeConfig {
    NodeConfig {
        landmarks: vec![LandmarkConfig::at("spot", STOPS_AT_M + AHEAD_M, 0.0)],
        ..node_config(name, "road", role)
    }
}

async fn edge() -> NodeHandle {
    node::start(config("edge", Role::Edge)).await.unwrap()
}

/// A vehicle that always has half a metre of car ahead.
fn vehicle(name: &str, pose: PoseConfig, directory: &Path) -> NodeConfig {
    let camera = car_ahead(&directory.join(name));
    let config = NodeConfig {
        pose,
        camera: Some(toml::from_str(&camera).unwrap()),
        ..config(name, Role::Cav)
    };
    config.validate().unwrap();
    config
}

/// A client of a broker that reads everything.
async fn onlooker(broker: SocketAddr) -> (AsyncClient, EventLoop) {
    let mut options = MqttOptions::new("onlooker", broker.ip().to_string(), broker.port());
    options.set_keep_alive(Duration::from_secs(60));
    let (client, events) = AsyncClient::new(options, 64);
    client
        .subscribe("ecod/v1/road/#", QoS::AtMostOnce)
        .await
        .unwrap();
    (client, events)
}

/// An address that was free a moment ago.
async fn free_address() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0")
        .await
        .unwrap()
        .local_addr()
        .unwrap()
}

/// The next report on a topic of a vehicle, such as `detections/euclid`.
async fn next(events: &mut EventLoop, topic: &str) -> ObjectReport {
    let topic = format!("ecod/v1/road/{topic}");
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
async fn moving_vehicle_uses_past_pose() {
    let directory = tempfile::tempdir().unwrap();
    let localisation = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let poses = free_address().await;
    let edge = edge().await;
    let broker = edge.broker_address().unwrap();
    let mut config = vehicle(
        "euclid",
        PoseConfig {
            listen: Some(poses),
            ..PoseConfig::default()
        },
        directory.path(),
    );
    config.mqtt.broker = Some(broker.into());
    let vehicle = node::start(config).await.unwrap();
    let (_client, mut events) = onlooker(broker).await;

    // The vehicle has not received a pose, so it does not report its frames.
    let unplaced = async {
        while vehicle.counters().events(Event::FrameWithoutPose) < 3 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, unplaced)
        .await
        .expect("frames are looked at");

    let started = clock::now();
    let mut tasks = JoinSet::new();
    tasks.spawn(async move {
        loop {
            let now = clock::now();
            let pose = format!(
                r#"{{"x_m":{},"y_m":0,"heading_rad":0,"captured_at_us":{}}}"#,
                x_m(started, now),
                now.0
            );
            localisation.send_to(pose.as_bytes(), poses).await.unwrap();
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    let mut distances = Vec::new();
    let mut has_stopped = false;
    while !has_stopped {
        let report = next(&mut events, "detections/euclid").await;
        let pose = report.pose.unwrap();
        let object = &report.objects[0];
        let true_x_m = x_m(started, report.captured_at_us);
        // Where it starts and stops, poses that come late on a busy machine are continued wrongly for a moment.
        if (0.5..STOPS_AT_M).contains(&true_x_m) {
            assert!((pose.x_m - true_x_m).abs() < 0.1, "{pose:?} is {true_x_m}");
            distances.push(pose.x_m);
        }
        assert!(
            (object.x_m - pose.x_m - AHEAD_M).abs() < 0.1,
            "{object:?} from {pose:?}"
        );
        has_stopped = true_x_m == STOPS_AT_M && (pose.x_m - STOPS_AT_M).abs() < 0.01;
    }
    assert!(
        distances.is_sorted() && distances.len() > 3,
        "{distances:?}"
    );

    // At the spot its report is a vote too.
    let vote = timeout(PATIENCE, async {
        loop {
            let report = next(&mut events, "vote_detections/euclid").await;
            if !report.objects.is_empty() {
                return report;
            }
        }
    });
    let vote = vote
        .await
        .expect("what stands at the spot is put to the vote");
    assert_eq!(vote.objects[0].landmark.as_deref(), Some("spot"));
    tasks.shutdown().await;
    vehicle.stop().await;
    edge.stop().await;
}

/// 12.4 m east and 3.1 m south of the origin, by PROJ.
const LATITUDE_DEG: f64 = 52.229_647_740_62;
const LONGITUDE_DEG: f64 = 21.012_410_179_60;
const ORIGIN: &str =
    "[origin]\nlatitude_deg = 52.2296756\nlongitude_deg = 21.0122287\nheight_m = 113\n";

/// `ecod-node cell set` at a node.
async fn describe(node: &NodeHandle, text: String) {
    let door = node.listens_at().unwrap().to_string();
    let set = move || {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(&file, text).unwrap();
        let mut program = Command::new(env!("CARGO_BIN_EXE_ecod-node"));
        program
            .args(["cell", "set", "--cell", "road", "--door", &door])
            .arg(file.path())
            .output()
            .unwrap()
    };
    let output = tokio::task::spawn_blocking(set).await.unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}

async fn readiness(node: &NodeHandle) -> String {
    let page = node.dashboard_address().borrow().unwrap();
    let mut stream = TcpStream::connect(page).await.unwrap();
    let request = format!("GET /readyz HTTP/1.1\r\nHost: {page}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    answer
}

/// Reads reports until one is from here.
async fn report_from(
    events: &mut EventLoop,
    topic: &str,
    x_m: f64,
    y_m: f64,
    heading_rad: f64,
) -> ObjectReport {
    let mut last = None;
    let found = timeout(PATIENCE, async {
        loop {
            let report = next(events, topic).await;
            let pose = report.pose.unwrap();
            let turned = wrap_angle(pose.heading_rad - heading_rad);
            // North at the vehicle is 2.7 microradians off north at the origin.
            if (pose.x_m - x_m).hypot(pose.y_m - y_m) < 1e-3 && turned.abs() < 1e-5 {
                return report;
            }
            last = Some(pose);
        }
    });
    let found = found.await;
    found.unwrap_or_else(|_| {
        panic!("no report on {topic} from {x_m}, {y_m}, {heading_rad}; last {last:?}")
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn earth_poses_use_cell_origin() {
    let directory = tempfile::tempdir().unwrap();
    let edge = edge().await;
    let seeds = vec![edge.gossip_address().unwrap().to_string()];
    let earth = PoseConfig {
        latitude_deg: Some(LATITUDE_DEG),
        longitude_deg: Some(LONGITUDE_DEG),
        azimuth_deg: Some(180.0),
        ..PoseConfig::default()
    };
    let mut config = vehicle("euclid", earth, directory.path());
    config.membership.seeds = seeds.clone();
    config.dashboard.enabled = true;
    config.dashboard.listen = Some("127.0.0.1:0".parse().unwrap());
    let standing = node::start(config).await.unwrap();
    let poses = free_address().await;
    let mut config = vehicle(
        "gauss",
        PoseConfig {
            listen: Some(poses),
            ..PoseConfig::default()
        },
        directory.path(),
    );
    config.membership.seeds = seeds;
    let driving = node::start(config).await.unwrap();
    let mut tasks = JoinSet::new();
    let localisation = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    tasks.spawn(async move {
        let pose = format!(
            r#"{{"latitude_deg":{LATITUDE_DEG},"longitude_deg":{LONGITUDE_DEG},"azimuth_deg":90}}"#
        );
        loop {
            let _ = localisation.send_to(pose.as_bytes(), poses).await;
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });

    // The cell has no position on Earth.
    until("poses are refused", async || {
        driving.counters().events(Event::PoseRejected) > 3
    })
    .await;
    until("frames are not placed", async || {
        standing.counters().events(Event::FrameWithoutPose) > 3
    })
    .await;
    let parts = [
        "503",
        "`pose.latitude_deg`",
        "no origin",
        "ecod-node cell set",
    ];
    until("the trouble is reported", async || {
        let answer = readiness(&standing).await;
        parts.iter().all(|part| answer.contains(part))
    })
    .await;

    let (_client, mut events) = onlooker(edge.listens_at().unwrap()).await;
    describe(&edge, ORIGIN.into()).await;
    let report = report_from(&mut events, "detections/euclid", 12.4, -3.1, -FRAC_PI_2).await;
    let object = &report.objects[0];
    assert!(
        (object.x_m - 12.4).abs() < 0.1 && (object.y_m + 3.1 + AHEAD_M).abs() < 0.1,
        "south of it: {object:?}"
    );
    report_from(&mut events, "detections/gauss", 12.4, -3.1, 0.0).await;
    until("the vehicle is ready", async || {
        readiness(&standing).await.contains("following edge")
    })
    .await;

    // The x axis is now north, and y west.
    describe(&edge, format!("{ORIGIN}rotation_deg = 90\n")).await;
    report_from(&mut events, "detections/euclid", -3.1, -12.4, PI).await;
    report_from(&mut events, "detections/gauss", -3.1, -12.4, -FRAC_PI_2).await;

    tasks.shutdown().await;
    standing.stop().await;
    driving.stop().await;
    edge.stop().await;
}
