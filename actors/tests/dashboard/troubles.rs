//! Troubles, as nodes name them.

use std::f64::consts::FRAC_PI_2;
use std::net::SocketAddr;
#[cfg(feature = "camera")]
use std::path::Path;
use std::time::{Duration, Instant};

use ecod::aggregator::Algorithms;
use ecod::model::names::NodeName;
use ecod::wire::{ObjectReport, PerceivedObject, Role, WirePose};
#[cfg(feature = "camera")]
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::node::NodeHandle;
#[cfg(feature = "camera")]
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::clock;
use ecod_testkit::{PATIENCE, until_async as until};
use rumqttc::{AsyncClient, MqttOptions, QoS};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use uuid::Uuid;

use crate::cell::{config, join, start};
use crate::http::get;

/// A client that sends reports one after the other, each made from its number; it ends when dropped. Its id has the
/// form of a node's run.
fn send(
    broker: SocketAddr,
    node: &'static str,
    report: impl Fn(u64) -> String + Send + 'static,
) -> JoinSet<()> {
    let id = format!("{node}-{}", Uuid::from_u128(7).simple());
    let options = MqttOptions::new(id, broker.ip().to_string(), broker.port());
    let (client, mut events) = AsyncClient::new(options, 16);
    let mut tasks = JoinSet::new();
    tasks.spawn(async move { while events.poll().await.is_ok() {} });
    tasks.spawn(async move {
        let topic = format!("ecod/v1/lot/detections/{node}");
        for seq in 1.. {
            let sent = client
                .publish(&topic, QoS::AtMostOnce, false, report(seq))
                .await;
            sent.expect("the broker is there");
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    tasks
}

fn report(node: &str, seq: u64, ahead_s: u64, x_m: &str) -> String {
    let captured = (clock::now() + Duration::from_secs(ahead_s)).micros();
    let object = format!(r#"{{"label":"car","confidence":0.9,"x_m":{x_m},"y_m":0}}"#);
    format!(
        r#"{{"schema":1,"node":"{node}","seq":{seq},"captured_at_us":{captured},"objects":[{object}]}}"#
    )
}

/// Troubles on the page of a node: subject, kind and cause, each with the reporting node.
async fn reported(page: SocketAddr) -> Vec<[String; 4]> {
    let picture = get(page, "/api/picture").await.json();
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let all = picture["troubles"].as_array().unwrap().iter();
    all.map(|trouble| ["told_by", "about", "kind", "cause"].map(|key| text(&trouble[key])))
        .collect()
}

async fn until_reported(page: SocketAddr, expected: [&str; 3], cause: &str) {
    until(&format!("{expected:?} {cause}"), || async {
        reported(page)
            .await
            .iter()
            .any(|[by, about, kind, said]| [by, about, kind] == expected && said.contains(cause))
    })
    .await;
}

/// A client whose reports cannot be read and a client whose clock is off are named with field and figure, on every page
/// of the cell and in the metrics. Their entries disappear after the clients have left.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn leader_troubles_reach_every_page() {
    let (edge, edge_page) = start(config("edge", Role::Edge, 2)).await;
    let (cav, page) = join(config("euclid", Role::Cav, 2), &edge).await;
    let broker = edge.broker_address().unwrap();
    let watson = send(broker, "watson", |seq| report("watson", seq, 0, "NaN"));
    let late = send(broker, "late", |seq| report("late", seq, 5, "1"));
    for page in [edge_page, page] {
        until_reported(
            page,
            ["edge", "watson", "malformed"],
            "report rejected: objects[0].x_m: is NaN",
        )
        .await;
        until_reported(
            page,
            ["edge", "late", "clock_off"],
            "its clock is 5.0 s ahead",
        )
        .await;
    }
    let metrics = get(edge_page, "/metrics").await.body;
    assert!(
        metrics.contains("ecod_troubles{trouble=\"malformed\",of=\"other\"} 1"),
        "{metrics}"
    );
    drop((watson, late));
    until("both entries are removed", || async {
        reported(edge_page).await.is_empty() && reported(page).await.is_empty()
    })
    .await;
    stop([cav, edge]).await;
}

/// Objects that move on circles, in metres, at this time.
fn walkers() -> impl Iterator<Item = [f64; 2]> {
    let seconds = (clock::now().micros() % 1_000_000_000) as f64 * 1e-6;
    let centres = [
        [12.0, -6.0],
        [17.0, 9.0],
        [22.0, -1.0],
        [27.0, 13.0],
        [30.0, -9.0],
        [14.0, 3.0],
    ];
    (0_u32..).zip(centres).map(move |(number, [x, y])| {
        let (sin, cos) = (0.5 * seconds + f64::from(number)).sin_cos();
        [x + 3.0 * cos, y + 3.0 * sin]
    })
}

fn report_of_walkers(
    node: &str,
    pose: [f64; 3],
    place: impl Fn([f64; 2]) -> [f64; 2],
) -> ObjectReport {
    let now = clock::now();
    let [x_m, y_m, heading_rad] = pose;
    ObjectReport {
        pose: Some(WirePose::new(x_m, y_m, heading_rad)),
        objects: walkers()
            .map(place)
            .map(|[x, y]| PerceivedObject::new("person", 0.9, x, y))
            .collect(),
        ..ObjectReport::new(node.parse().unwrap(), now.micros(), now)
    }
}

/// A camera that looks west, whose azimuth of 270° was entered as its heading: its objects are turned by 90° about its
/// position.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn compass_heading_names_angle() {
    let (edge, page) = start(config("edge", Role::Edge, 2)).await;
    let broker = edge.broker_address().unwrap();
    let json = |report: ObjectReport| serde_json::to_string(&report).unwrap();
    let right = send(broker, "euclid", move |_| {
        json(report_of_walkers("euclid", [0.0, 0.0, 0.5], |place| place))
    });
    let turned = send(broker, "watson", move |_| {
        let pose = [40.0, 10.0, -FRAC_PI_2];
        json(report_of_walkers("watson", pose, |[x, y]| {
            [40.0 - (y - 10.0), 10.0 + x - 40.0]
        }))
    });
    // Three windows of ten seconds, and as long again.
    let deadline = Instant::now() + PATIENCE;
    let of_kind = || async {
        let mut reported = reported(page).await;
        reported.retain(|[_, _, kind, _]| kind == "orientation");
        reported
    };
    let mut reported = of_kind().await;
    while reported.is_empty() {
        assert!(Instant::now() < deadline, "the heading is not named");
        tokio::time::sleep(Duration::from_millis(100)).await;
        reported = of_kind().await;
    }
    let cause = "its objects agree with the objects of euclid after a turn by about -90° at its position, as if its \
        heading were clockwise from north; if its pose and camera are right, check euclid";
    assert_eq!(
        reported,
        [["edge", "watson", "orientation", cause].map(str::to_owned)]
    );
    drop((right, turned));
    stop([edge]).await;
}

/// A vehicle whose reports the leader refuses reports this trouble, and is not ready.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn refused_reports_make_vehicle_unready() {
    let (edge, _) = start(config("edge", Role::Edge, 2)).await;
    let (cav, page) = join(config("euclid", Role::Cav, 2), &edge).await;
    until("it follows", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    let broken = send(edge.broker_address().unwrap(), "euclid", |seq| {
        report("euclid", seq, 0, "1e99")
    });
    until_reported(
        page,
        ["euclid", "", "reports_refused"],
        "reported by edge: report rejected: objects[0].x_m",
    )
    .await;
    let ready = get(page, "/readyz").await;
    assert_eq!(ready.status, 503);
    assert!(
        ready.json()["reason"]
            .as_str()
            .unwrap()
            .starts_with("reported by edge"),
        "{}",
        ready.body
    );
    drop(broken);
    until("it is ready again", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    stop([cav, edge]).await;
}

/// A node that finds no other node shows the datagrams that it received instead, also to a service manager.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_alone_says_why() {
    let (edge, _) = start(config("edge", Role::Edge, 1)).await;
    let mut misspelt = config("euclid", Role::Cav, 1);
    misspelt.cell = NodeName::from_static("lott");
    let (cav, page) = join(misspelt, &edge).await;
    // The edge receives the greetings of a seed without greeting others.
    until("the edge names the other cell", || async {
        let troubles = edge.troubles();
        troubles.iter().any(|(_, trouble)| {
            trouble.cause
                == "received a datagram of another cell from 127.0.0.1; this node is in lot and finds no other node"
        })
    })
    .await;
    let mut unresolved = config("gauss", Role::Cav, 1);
    unresolved.membership.seeds = vec!["no-such-host.invalid:17884".into()];
    let (other, other_page) = start(unresolved).await;
    until_reported(
        other_page,
        ["gauss", "no-such-host.invalid:17884", "unresolved"],
        "cannot be resolved",
    )
    .await;
    let reason = get(other_page, "/readyz").await.json()["reason"]
        .as_str()
        .unwrap()
        .to_owned();
    assert!(
        reason.starts_with("no leader known: cannot be resolved"),
        "{reason}"
    );
    let mut without_broker = config("hertz", Role::Cav, 1);
    without_broker.mqtt.broker = Some("no-such-host.invalid:1883".parse().unwrap());
    let (last, last_page) = start(without_broker).await;
    until_reported(
        last_page,
        ["hertz", "no-such-host.invalid:1883", "broker_unreachable"],
        "broker not reached",
    )
    .await;
    assert_eq!(get(page, "/readyz").await.status, 503);
    stop([last, other, cav, edge]).await;
}

/// The leader names the sender of reports that it does not take: of the other algorithm, or too many.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn refused_reports_name_sender() {
    let mut voting = config("edge", Role::Edge, 1);
    voting.fusion.algorithms = Algorithms::Vote;
    voting.mqtt.max_report_hz = 4;
    let (edge, page) = start(voting).await;
    let broker = edge.broker_address().unwrap();
    let watson = send(broker, "watson", |seq| report("watson", seq, 0, "1"));
    until_reported(
        page,
        ["edge", "watson", "not_fused"],
        "for an algorithm that the cell does not run",
    )
    .await;
    until_reported(
        page,
        ["edge", "watson", "overload"],
        "sends more than is taken",
    )
    .await;
    drop(watson);
    edge.stop().await;
}

/// A broker that is there and refuses the login.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn refusing_broker_is_named() {
    let broker = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = broker.local_addr().unwrap().to_string();
    let mut refused = config("euclid", Role::Cav, 1);
    refused.mqtt.broker = Some(address.parse().unwrap());
    let mut refusing = JoinSet::new();
    refusing.spawn(async move {
        loop {
            let (mut client, _) = broker.accept().await.unwrap();
            // CONNACK of MQTT 3.1.1 with return code 5, not authorised; the client reads it before the end.
            client.read_u8().await.ok();
            client.write_all(&[0x20, 2, 0, 5]).await.ok();
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    let (node, page) = start(refused).await;
    until_reported(
        page,
        ["euclid", &address, "broker_refuses"],
        "broker refuses this node",
    )
    .await;
    node.stop().await;
}

/// A vehicle that receives gray frames of this size, and detects the recorded objects in each frame; `more` are further
/// keys of its camera.
#[cfg(feature = "camera")]
fn watching(
    name: &str,
    directory: &Path,
    [width, height]: [usize; 2],
    detections: &str,
    more: &str,
) -> NodeConfig {
    let frames = directory.join("frames");
    let recorded = directory.join("detections.jsonl");
    std::fs::create_dir_all(&frames).unwrap();
    let gray = [
        format!("P6 {width} {height} 255\n").as_bytes(),
        &vec![128; width * height * 3],
    ]
    .concat();
    std::fs::write(frames.join("0.ppm"), gray).unwrap();
    std::fs::write(&recorded, detections).unwrap();
    let camera = format!(
        "source = {{ kind = \"images\", path = {frames:?}, looping = true }}\n{more}\n\
         detector = {{ kind = \"recorded\", path = {recorded:?}, looping = true }}"
    );
    NodeConfig {
        camera: Some(toml::from_str(&camera).unwrap()),
        ..config(name, Role::Cav, 1)
    }
}

/// An absent camera, a camera without a pose, and a camera that detects objects without a size.
#[cfg(feature = "camera")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missing_camera_settings_are_named() {
    let directory = tempfile::tempdir().unwrap();
    let seen = r#"[{"label":"dragon","confidence":0.9,"bounding_box":{"x_min":30,"y_min":20,"x_max":34,"y_max":24}}]"#;
    let with_camera = |name: &str| watching(name, directory.path(), [64, 48], seen, "");
    let (seeing, page) = start(with_camera("euclid")).await;
    until_reported(page, ["euclid", "", "no_size"], "dragon").await;
    let mut moving = with_camera("gauss");
    moving.pose.listen = Some("127.0.0.1:0".parse().unwrap());
    let (lost, page) = start(moving).await;
    until_reported(page, ["gauss", "", "no_pose"], "no pose is available").await;
    let mut gone = with_camera("hertz");
    let path = directory.path().join("none");
    gone.camera.as_mut().unwrap().source = SourceConfig::Images {
        path,
        fps: 10.0,
        looping: true,
    };
    let (blind, page) = start(gone).await;
    until_reported(page, ["hertz", "", "camera"], "the camera gives no frames").await;
    stop([blind, lost, seeing]).await;
}

/// A camera so near that the image's edge cuts whatever it sees.
#[cfg(feature = "camera")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn unplaced_detections_name_reason() {
    let directory = tempfile::tempdir().unwrap();
    let seen = r#"[{"label":"person","confidence":0.9,"bounding_box":{"x_min":0,"y_min":0,"x_max":64,"y_max":48}}]"#;
    let near = watching(
        "euclid",
        directory.path(),
        [64, 48],
        seen,
        "mount = { height_m = 1.5 }",
    );
    let (node, page) = start(near).await;
    until_reported(
        page,
        ["euclid", "", "not_placed"],
        "the image's edge or a mask cuts the box",
    )
    .await;
    node.stop().await;
}

/// A camera whose real pitch is 6° above its configured mount, and people 4 to 15 m away.
#[cfg(feature = "camera")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn turned_camera_names_angle() {
    let directory = tempfile::tempdir().unwrap();
    let focal_px = 530.0;
    let camera_m = 1.5;
    let person_m = 1.7;
    let turned = 6f64.to_radians();
    let row_px = |slope: f64| 240.0 + focal_px * (slope.atan() + turned).tan();
    let people = (4..16).map(|distance| {
        let distance_m = f64::from(distance);
        let x_px = 40.0 * f64::from(distance) - 130.0;
        let [y_min, y_max] = [camera_m - person_m, camera_m].map(|below_m| row_px(below_m / distance_m));
        let bounding_box = serde_json::json!({"x_min": x_px, "x_max": x_px + 20.0, "y_min": y_min, "y_max": y_max});
        serde_json::json!({"label": "person", "confidence": 0.9, "bounding_box": bounding_box})
    });
    let people = serde_json::Value::from_iter(people).to_string();
    let mount = format!("mount = {{ height_m = {camera_m} }}");
    let (node, page) = start(watching(
        "euclid",
        directory.path(),
        [640, 480],
        &people,
        &mount,
    ))
    .await;
    until_reported(
        page,
        ["euclid", "", "mount_mismatch"],
        "the camera looks 6° higher",
    )
    .await;
    node.stop().await;
}

/// Counts of nodes leave out an observer, also as a missing node after it was killed.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_observer_is_no_node() {
    let (edge, page) = start(config("edge", Role::Edge, 1)).await;
    let mut looking = config("euclid", Role::Cav, 1).observing("top").unwrap();
    looking.membership.seeds = vec![edge.gossip_address().unwrap().to_string()];
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let observer = runtime
        .spawn(ecod_actors::node::start(looking))
        .await
        .unwrap()
        .unwrap();
    until("the observer follows the edge", || async {
        observer.newest_map().borrow().is_some()
    })
    .await;
    let is_alone = || async {
        let picture = get(page, "/api/picture").await.json();
        let ready = get(page, "/readyz").await.json();
        let metrics = get(page, "/metrics").await.body;
        picture["nodes"].as_array().unwrap().len() == 1
            && ready.get("missing").is_none()
            && metrics.contains("ecod_members 1")
    };
    assert!(is_alone().await, "while it observes");
    runtime.shutdown_background();
    until("the observer is gone", || async {
        edge.members().borrow().is_empty()
    })
    .await;
    assert!(is_alone().await, "after it was killed");
    edge.stop().await;
}

async fn stop(nodes: impl IntoIterator<Item = NodeHandle>) {
    for node in nodes {
        node.stop().await;
    }
}
