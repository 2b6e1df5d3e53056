//! A program in cells of real nodes, and at a real broker that sends arbitrary messages.

#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot continue panics at that line"
)]

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime};

use ecod::model::epoch::Epoch;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::{ContentHash, Encoding, encode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::pki::{Authority, TlsConfig};
use ecod_client::{
    BoxCamera, BoxFrame, Cell, CellDescription, Error, Frame, GeographicPose, GlobalMap, Mount,
    NodeName, NodeState, PerceivedObject, PixelBox, Pose, Role, Settings, Timestamp, Tls, WirePose,
};
use ecod_testkit::{loopback, node_config};
use rumqttc::{Client, MqttOptions, QoS};
use tokio::runtime::Runtime;

/// Maximum time for any step on a busy machine.
const SOON: Duration = Duration::from_secs(30);

fn config(name: &str, role: Role) -> NodeConfig {
    NodeConfig {
        landmarks: vec![
            LandmarkConfig::at("slot-0", 0.0, 0.0),
            LandmarkConfig::at("slot-1", 2.5, 0.0),
        ],
        ..node_config(name, "lot-1", role)
    }
}

/// A running node and its local broker.
struct Node {
    runtime: Runtime,
    handle: Option<NodeHandle>,
    door: String,
}

impl Node {
    fn start(config: NodeConfig) -> Self {
        config.validate().unwrap();
        let runtime = Runtime::new().unwrap();
        let handle = runtime.block_on(node::start(config)).unwrap();
        let door = handle.listens_at().unwrap().to_string();
        Self {
            runtime,
            handle: Some(handle),
            door,
        }
    }

    fn settings(&self, node: &str) -> Settings {
        settings(&self.door, node)
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        if let Some(handle) = self.handle.take() {
            self.runtime.block_on(handle.stop());
        }
    }
}

fn settings(broker: &str, node: &str) -> Settings {
    Settings {
        broker: broker.into(),
        cell: "lot-1".into(),
        node: node.into(),
        ..Settings::default()
    }
}

fn car() -> PerceivedObject {
    let at = PerceivedObject {
        landmark: Some("slot-0".into()),
        ..PerceivedObject::new("car", 0.9, 0.1, 0.2)
    };
    PerceivedObject {
        covariance_m2: Some([0.01, 0.0, 0.01]),
        ..at
    }
}

fn frame() -> Frame {
    let pose = Some(ecod_client::WirePose::new(1.0, 6.0, -1.57));
    Frame {
        pose,
        seen: Some(vec!["slot-0".into(), "slot-1".into()]),
        ..Frame::new(vec![car()])
    }
}

/// Reports and votes until a map shows the car, seen by this node.
fn agreed(cell: &Cell, node: &str) -> std::sync::Arc<GlobalMap> {
    let began = Instant::now();
    for map in cell.maps().timeout(SOON) {
        let map = map.unwrap();
        let [place, empty] = &map.landmarks[..] else {
            panic!("{map:?}")
        };
        let is_by = place.contributors.iter().any(|name| name.as_str() == node);
        if place.label.as_deref() == Some("car") && is_by && !empty.observers.is_empty() {
            return map;
        }
        cell.report(frame()).unwrap();
        cell.vote(Frame::new(vec![car()])).unwrap();
        assert!(began.elapsed() < SOON, "{map:?}");
    }
    panic!("closed");
}

#[test]
fn client_reports_and_reads_messages() {
    for encoding in [Encoding::Json, Encoding::Compact] {
        let mut config = config("edge", Role::Edge);
        config.mqtt.encoding = encoding;
        let node = Node::start(config);
        let cell = Cell::connect(node.settings("euclid")).unwrap();
        assert_eq!(cell.name().as_str(), "euclid--rust");
        let map = agreed(&cell, "euclid");
        assert!(map.landmarks[0].confidence > 0.5 && map.landmarks[1].label.is_none());
        let has_car =
            |verdicts: &ecod_client::Verdicts| verdicts.verdicts[0].label.as_deref() == Some("car");
        let voted = cell.verdicts().timeout(SOON).find(|verdicts| {
            cell.vote(Frame::new(vec![car()])).unwrap();
            has_car(verdicts.as_ref().unwrap())
        });
        assert!(voted.is_some());
        let reputations = cell.reputations().timeout(SOON).next().unwrap().unwrap();
        assert_eq!(reputations.aggregator, Some(NodeName::from_static("edge")));
        let status = cell.statuses().timeout(SOON).next().unwrap().unwrap();
        assert_eq!(
            (status.node.as_str(), status.role, status.state),
            ("edge", Role::Edge, NodeState::Aggregating)
        );
        assert!(cell.counts().is_empty(), "{:?}", cell.counts());
    }
}

/// A person of usual size, 5 m ahead of the camera of [`image`].
fn person() -> PixelBox {
    PixelBox {
        label: "person".into(),
        confidence: 0.9,
        x_min: 450.0,
        y_min: 320.0,
        x_max: 550.0,
        y_max: 660.0,
    }
}

/// An image of a level camera, 1.3 m above the ground, that looks from the south at slot-0.
fn image(boxes: Vec<PixelBox>) -> BoxFrame {
    let mount = Mount {
        height_m: Some(1.3),
        pan_rad: std::f64::consts::FRAC_PI_2,
        ..Mount::default()
    };
    let vehicle = Pose::from(WirePose::from_compass(0.0, -5.0, 90.0).unwrap());
    BoxFrame {
        captured_at: SystemTime::now(),
        boxes,
        camera: BoxCamera {
            width_px: 1000,
            height_px: 1000,
            fx: Some(1000.0),
            fy: Some(1000.0),
            cx: Some(500.0),
            cy: Some(400.0),
            tilt_sigma_rad: Some(0.005),
            ..BoxCamera::default()
        },
        pose: mount.stated_pose(&mount.camera_pose(&vehicle)),
        moving: None,
    }
}

#[test]
fn boxes_are_placed_on_map() {
    let node = Node::start(config("edge", Role::Edge));
    let cell = Cell::connect(node.settings("euclid")).unwrap();
    let began = Instant::now();
    for map in cell.maps().timeout(SOON) {
        let map = map.unwrap();
        let place = &map.landmarks[0];
        if place.label.as_deref() == Some("person") {
            assert!(place.x_m.hypot(place.y_m) < 0.5, "{place:?}");
            assert_eq!(place.contributors, [NodeName::from_static("euclid")]);
            return;
        }
        cell.report_boxes(image(vec![person()])).unwrap();
        assert!(began.elapsed() < SOON, "{map:?}");
    }
}

fn tls_of(authority: &mut Authority, name: &'static str, role: Role) -> (TlsConfig, Tls) {
    let name = NodeName::from_static(name);
    authority
        .issue(&name, role, Duration::from_secs(86_400), clock::now())
        .unwrap();
    let files = TlsConfig {
        revocation_list: None,
        ..authority.tls_of(&name)
    };
    let tls = Tls::of_door(files.ca.clone(), &files.certificate, &files.key);
    (files, tls)
}

#[test]
fn certified_program_serves_one_node() {
    let directory = tempfile::tempdir().unwrap();
    let mut authority = Authority::init(
        directory.path(),
        &NodeName::from_static("lot-1"),
        clock::now(),
    )
    .unwrap();
    let (edge_files, edge_tls) = tls_of(&mut authority, "edge", Role::Edge);
    let (cav_files, cav_tls) = tls_of(&mut authority, "euclid", Role::Cav);
    let edge = Node::start(NodeConfig {
        tls: Some(edge_files),
        ..config("edge", Role::Edge)
    });
    let cav = Node::start(NodeConfig {
        tls: Some(cav_files),
        ..config("euclid", Role::Cav)
    });
    let connect = |node: &Node, name: &str, tls: Option<&Tls>| {
        Cell::connect(Settings {
            tls: tls.cloned(),
            timeout: Duration::from_secs(3),
            ..node.settings(name)
        })
    };

    let beside = Cell::connect(Settings {
        tls: Some(edge_tls),
        ..edge.settings("edge")
    })
    .unwrap();
    agreed(&beside, "edge");
    let vehicle = Cell::connect(Settings {
        tls: Some(cav_tls.clone()),
        part: String::new(),
        ..edge.settings("euclid")
    });
    agreed(&vehicle.unwrap(), "euclid");
    assert!(
        connect(&cav, "euclid", Some(&cav_tls)).is_ok(),
        "the door of a node that may not lead"
    );
    let (certificate, key) = cav_tls.identity.clone().unwrap();
    let at = [
        ("ECOD_BROKER", &*cav.door),
        ("ECOD_CELL", "lot-1"),
        ("ECOD_NAME", "euclid"),
    ];
    let files = [
        ("ECOD_TLS__CA", &cav_tls.ca),
        ("ECOD_TLS__CERTIFICATE", &certificate),
        ("ECOD_TLS__KEY", &key),
    ];
    let mut planner = Command::new(example("brake_planner"));
    let mut planner = planner
        .args(["0", "0", "0", "10"])
        .envs(at)
        .envs(files)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let decided = BufReader::new(planner.stdout.take().unwrap())
        .lines()
        .next()
        .unwrap()
        .unwrap();
    assert_eq!(
        decided, "BRAKE: no map for 500ms",
        "the environment names the certificate"
    );
    planner.kill().unwrap();
    planner.wait().unwrap();
    let leading = Tls::of_cell(&cav_tls.ca, certificate, key);
    assert!(
        connect(&edge, "euclid", Some(&leading)).is_ok(),
        "the broker of a node that may lead"
    );

    let refused = connect(&edge, "gauss", Some(&cav_tls)).err().unwrap();
    let Error::Refused(text) = &refused else {
        panic!("{refused}")
    };
    assert!(
        text.contains(&edge.door) && text.contains("check node name"),
        "{text}"
    );
    let other_name = Tls {
        broker_name: Some("broker.example".into()),
        ..cav_tls.clone()
    };
    let nobody = Tls {
        identity: None,
        ..cav_tls.clone()
    };
    for (node, tls) in [
        (&edge, Some(&other_name)),
        (&edge, Some(&nobody)),
        (&edge, None),
        (&cav, Some(&leading)),
    ] {
        let error = connect(node, "euclid", tls).err().unwrap();
        assert!(
            matches!(&error, Error::Unreachable(text) if text.contains(&node.door)),
            "{error}"
        );
    }
}

#[test]
fn map_position_converts_by_origin() {
    let node = Node::start(config("edge", Role::Edge));
    let cell = Cell::connect(node.settings("edge")).unwrap();
    assert_eq!(
        (cell.origin().unwrap(), cell.description().unwrap().version),
        (None, 0)
    );
    let speaker = speaker(node.door.parse().unwrap());
    let warsaw =
        "[origin]\nlatitude_deg = 52.2296756\nlongitude_deg = 21.0122287\nheight_m = 113\n";
    speaker
        .publish(DESCRIPTION, QoS::AtLeastOnce, false, description(warsaw))
        .unwrap();
    let began = Instant::now();
    let origin = loop {
        match cell.origin().unwrap() {
            Some(origin) => break origin,
            None => assert!(began.elapsed() < SOON),
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    assert_eq!(cell.description().unwrap().set_by.as_str(), "edge");
    // By PROJ, for 12.4 m east and 3.1 m south.
    let latitude_deg = 52.22964774062;
    let longitude_deg = 21.01241017960;
    let pose = GeographicPose {
        latitude_deg,
        longitude_deg,
        height_m: None,
        azimuth_deg: 180.0,
    };
    let position = origin.pose_to_map(&pose).unwrap().position;
    assert!(
        (position.x - 12.4).abs() < 0.001 && (position.y + 3.1).abs() < 0.001,
        "{position}"
    );
    let there = origin.to_wgs84(position.x, position.y, 0.0);
    assert!(
        (there.latitude_deg - latitude_deg).abs() < 1e-9
            && (there.longitude_deg - longitude_deg).abs() < 1e-9
    );
    assert!((there.height_m - 113.0).abs() < 0.001);
}

#[test]
fn unusable_description_is_error() {
    let (_broker, address) = broker();
    let patient = settings(&address.to_string(), "euclid");
    let cell = Cell::connect(Settings {
        timeout: Duration::from_secs(3),
        ..patient.clone()
    })
    .unwrap();
    let silent = cell.origin().unwrap_err();
    assert!(
        matches!(&silent, Error::Silent(text) if text.contains(DESCRIPTION)),
        "{silent}"
    );
    let speaker = speaker(address);
    let say = |payload| {
        speaker
            .publish(DESCRIPTION, QoS::AtLeastOnce, true, payload)
            .unwrap();
    };
    for text in [
        "[origin",
        "origin = 7",
        "[origin]\nlatitude_deg = 91\nlongitude_deg = 1\n",
    ] {
        say(description(text));
        let began = Instant::now();
        while cell.description().is_ok_and(|present| present.text != text) {
            assert!(began.elapsed() < SOON);
        }
        let invalid = Cell::connect(patient.clone())
            .unwrap()
            .origin()
            .unwrap_err();
        assert!(
            matches!(&invalid, Error::Invalid(text) if text.contains("[origin]")),
            "{invalid}"
        );
    }
    say(Vec::new());
    let began = Instant::now();
    while cell.description().is_ok() {
        assert!(began.elapsed() < SOON, "it was withdrawn");
    }
    cell.close();
    assert!(
        cell.description()
            .unwrap_err()
            .to_string()
            .contains("closed")
    );
}

#[test]
fn refusal_reaches_program() {
    let node = Node::start(config("euclid", Role::Cav));
    let cell = Cell::connect(node.settings("gauss")).unwrap();
    let began = Instant::now();
    let refused = loop {
        match cell.report(frame()) {
            Err(error) => break error,
            Ok(_) => assert!(began.elapsed() < SOON),
        }
    };
    assert!(
        matches!(&refused, Error::Refused(text) if text.contains("detections/gauss--rust")),
        "{refused}"
    );
    assert!(
        cell.report(frame()).is_ok(),
        "each refusal is reported once"
    );
}

/// A broker that accepts any message, and a client that sends arbitrary messages.
fn broker() -> (EmbeddedBroker, SocketAddr) {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address = broker.start(loopback()).unwrap();
    (broker, address)
}

fn speaker(broker: SocketAddr) -> Client {
    let (client, mut connection) =
        Client::new(MqttOptions::new("speaker", "127.0.0.1", broker.port()), 64);
    std::thread::spawn(move || connection.iter().take_while(Result::is_ok).for_each(drop));
    client
}

fn map(epoch: u64, round: u64) -> Vec<u8> {
    let map = GlobalMap::new(
        &Epoch::new(epoch, NodeName::from_static("edge")),
        round,
        Timestamp(1),
    );
    encode(&map, Encoding::Json)
}

/// A request to a node, which numbers it, or the message that another broker retains.
fn description(text: &str) -> Vec<u8> {
    let set_by = NodeName::from_static("edge");
    let hash = ContentHash::default();
    encode(
        &CellDescription {
            schema: 1,
            version: 0,
            hash,
            set_by,
            text: text.to_owned(),
        },
        Encoding::Json,
    )
}

const DESCRIPTION: &str = "ecod/v1/lot-1/cell";

const MAPS: &str = "ecod/v1/lot-1/global_detections";

#[test]
fn only_newest_rounds_are_given() {
    let (_broker, address) = broker();
    let speaker = speaker(address);
    let cell = Cell::connect(settings(&address.to_string(), "euclid")).unwrap();
    let mut maps = cell.maps().timeout(Duration::from_millis(100));
    let silent = maps.next().unwrap().unwrap_err();
    assert!(
        matches!(&silent, Error::Silent(text) if text.contains(MAPS)),
        "{silent}"
    );
    let mut maps = maps.timeout(SOON);
    let say = |payload: Vec<u8>| {
        speaker
            .publish(MAPS, QoS::AtLeastOnce, false, payload)
            .unwrap();
    };
    say(map(3, 5));
    assert_eq!(maps.next().unwrap().unwrap().round, 5);
    for payload in [
        map(3, 4),
        map(3, 5),
        map(2, 9),
        b"{".to_vec(),
        map(3, 6),
        map(4, 1),
    ] {
        say(payload);
    }
    let last = maps.map(Result::unwrap).find(|map| map.epoch == 4).unwrap();
    assert_eq!(last.round, 1);
    assert_eq!(cell.counts(), [("superseded", 3), ("malformed", 1)].into());
    let reader = cell.maps();
    cell.close();
    assert_eq!(reader.count(), 0, "the loops end with the cell");
}

#[test]
fn lost_broker_is_reconnected() {
    let (mut broker, address) = broker();
    let cell = Cell::connect(settings(&address.to_string(), "euclid")).unwrap();
    let mut maps = cell.maps().timeout(SOON);
    let until_sent = |is_sent: bool| {
        let began = Instant::now();
        while cell.report(frame()).unwrap() != is_sent {
            assert!(began.elapsed() < SOON, "reports are sent: {}", !is_sent);
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    until_sent(true);
    broker.stop();
    until_sent(false);
    assert!(cell.counts()["unsent"] >= 1);
    broker.start(address).unwrap();
    until_sent(true);
    let speaker = speaker(address);
    std::thread::spawn(move || {
        (1..).try_for_each(|round| {
            std::thread::sleep(Duration::from_millis(50));
            speaker.publish(MAPS, QoS::AtMostOnce, false, map(1, round))
        })
    });
    assert!(
        maps.next().unwrap().is_ok(),
        "the client subscribed to maps again"
    );
}

#[test]
fn invalid_report_is_not_sent() {
    let (_broker, address) = broker();
    let cell = Cell::connect(settings(&address.to_string(), "euclid")).unwrap();
    let said = |outcome: Result<bool, Error>| outcome.unwrap_err().to_string();
    let wrong = PerceivedObject {
        confidence: 2.0,
        ..car()
    };
    let good = car();
    let nowhere = PerceivedObject {
        landmark: None,
        ..car()
    };
    let frame = Frame::new(vec![good.clone(), wrong]);
    assert_eq!(
        said(cell.report(frame)),
        "not sent: objects[1].confidence: is not within 0 to 1: 2.0"
    );
    let frame = Frame {
        pose: Some(WirePose::new(1.0, 6.0, -90.0)),
        ..Frame::new(vec![])
    };
    let text = said(cell.report(frame));
    assert!(
        text.starts_with("not sent: pose.heading_rad: is beyond 2π: -90.0")
            && text.contains("degrees"),
        "{text}"
    );
    let outside = PixelBox {
        x_max: 1280.0,
        ..person()
    };
    let text = said(cell.report_boxes(image(vec![outside])));
    assert!(
        text.starts_with("not sent: boxes[0]: is outside the image of 1000x1000"),
        "{text}"
    );
    let frame = Frame {
        captured_at: SystemTime::UNIX_EPOCH - Duration::from_secs(1),
        ..Frame::new(vec![])
    };
    assert!(said(cell.report(frame)).contains("captured_at"));
    assert!(
        said(cell.vote(Frame::new(vec![good, nowhere]))).contains("objects[1] names no landmark")
    );
    for (broker, node, expected) in [
        ("host:0", "euclid", "host:0"),
        ("a/b", "euclid", "a/b"),
        ("host", "a b", "a b"),
    ] {
        let error = Cell::connect(settings(broker, node)).err().unwrap();
        assert!(
            matches!(&error, Error::Invalid(text) if text.contains(expected)),
            "{error}"
        );
    }
    drop(cell);
    let missing = Tls::of_cell("missing.pem", "missing.pem", "missing.key");
    let settings = Settings {
        tls: Some(missing),
        ..settings(&address.to_string(), "euclid")
    };
    let error = Cell::connect(settings).err().unwrap();
    assert!(
        matches!(&error, Error::Invalid(text) if text.contains("missing.pem")),
        "{error}"
    );
}

#[test]
fn unreachable_address_fails_at_once() {
    let (mut broker, address) = broker();
    broker.stop();
    let began = Instant::now();
    let error = Cell::connect(settings(&address.to_string(), "euclid"))
        .err()
        .unwrap();
    assert!(
        matches!(&error, Error::Unreachable(text) if text.contains(&address.to_string())),
        "{error}"
    );
    assert!(
        began.elapsed() < Duration::from_secs(8),
        "no waiting for the timeout"
    );
}

/// The example, built with the tests.
fn example(name: &str) -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    let build = tests.parent().and_then(Path::parent).unwrap();
    build.join("examples").join(name)
}

/// True if a page of the documentation shows this example, apart from the example's first lines.
fn is_shown(page: &str, example: &str) -> bool {
    let read = |path: &str| {
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
    };
    let source = read(&format!("examples/{example}.rs"));
    let (_, program) = source.split_once("\n\n").unwrap();
    read(page).contains(&format!("```rust,no_run\n{program}```\n"))
}

#[test]
fn documented_programs_work() {
    for (page, name) in [
        ("README.md", "maps_and_reports"),
        ("README.md", "report_frames"),
    ] {
        assert!(is_shown(page, name), "{page} shows another {name}");
    }
    for (name, says) in [("maps_and_reports", true), ("report_frames", false)] {
        let mut config = config("edge", Role::Edge);
        config.landmarks.clear();
        let node = Node::start(config);
        let cell = Cell::connect(node.settings("display")).unwrap();
        let mut program = Command::new(example(name))
            .env("ECOD_BROKER", &node.door)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let began = Instant::now();
        let shows = |map: &GlobalMap| {
            let by_euclid = |object: &ecod_client::FusedObject| {
                object.contributors.iter().any(|by| by.as_str() == "euclid")
            };
            map.objects
                .iter()
                .any(|object| by_euclid(object) && (object.x_m - 12.4).abs() < 0.1)
        };
        for map in cell.maps().timeout(SOON) {
            if shows(&map.unwrap()) {
                break;
            }
            assert!(
                began.elapsed() < SOON && program.try_wait().unwrap().is_none(),
                "{name}: its report is not on the map"
            );
        }
        if says {
            let line = BufReader::new(program.stdout.take().unwrap())
                .lines()
                .next()
                .unwrap()
                .unwrap();
            assert!(line.parse::<u64>().is_ok(), "{name}: {line}");
        }
        program.kill().unwrap();
        program.wait().unwrap();
    }
}

#[test]
fn planner_brakes_for_obstacle_or_silence() {
    let mut config = config("edge", Role::Edge);
    config.landmarks.clear();
    let node = Node::start(config);
    let lidar = Cell::connect(node.settings("euclid")).unwrap();
    let mut planner = Command::new(example("brake_planner"))
        .args(["0", "0", "--azimuth", "90", "10"])
        .envs([
            ("ECOD_BROKER", &*node.door),
            ("ECOD_CELL", "lot-1"),
            ("ECOD_NAME", "gauss"),
        ])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(planner.stdout.take().unwrap())
        .lines()
        .map(Result::unwrap);
    assert!(lines.any(|line| line == "GO: nothing is in the way"));
    let (sender, stop) = std::sync::mpsc::channel::<()>();
    let reporting = std::thread::spawn(move || {
        while stop.try_recv() == Err(std::sync::mpsc::TryRecvError::Empty) {
            lidar
                .report(Frame::new(vec![PerceivedObject::new(
                    "car", 0.9, 12.0, 0.3,
                )]))
                .unwrap_or_default();
            std::thread::sleep(Duration::from_millis(100));
        }
    });
    assert!(lines.any(|line| line.starts_with("BRAKE: an object is 12.")));
    drop(sender);
    reporting.join().unwrap();
    assert!(
        lines.any(|line| line == "GO: nothing is in the way"),
        "the car is gone"
    );
    drop(node);
    assert_eq!(lines.next().as_deref(), Some("BRAKE: no map for 500ms"));
    planner.kill().unwrap();
    planner.wait().unwrap();
}
