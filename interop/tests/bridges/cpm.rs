//! A bridge beside a real node: maps and reports go out as CPM, and those of a foreign station come in.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ecod::wire::{CellDescription, ContentHash, Encoding, encode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::transport::pki::{Authority, TlsConfig};
use ecod_client::{
    Cell, Error, Frame, GeographicOrigin, NodeName, ObjectReport, PerceivedObject, Role, Settings,
    Timestamp, Tls, now,
};
use ecod_interop::bridge::{CpmBridge, CpmRefusal};
use ecod_interop::cpm::{self, CpmCell, CpmError, ReceivedCpm, StationIds};
use ecod_testkit::node_config;
use rumqttc::{Client, Event, Incoming, MqttOptions, QoS};
use tokio::runtime::Runtime;

/// Maximum time for anything on a machine that does much else.
const SOON: Duration = Duration::from_secs(30);

const ORIGIN: GeographicOrigin = GeographicOrigin {
    latitude_deg: 52.2296756,
    longitude_deg: 21.0122287,
    height_m: 113.0,
    rotation_deg: 40.0,
};

struct Edge {
    runtime: Runtime,
    handle: Option<NodeHandle>,
    settings: Settings,
}

impl Edge {
    fn start(tls: Option<(TlsConfig, Tls)>) -> Self {
        let (server, client) = tls.unzip();
        let config = NodeConfig {
            tls: server,
            ..node_config("edge", "lot-1", Role::Edge)
        };
        config.validate().unwrap();
        let runtime = Runtime::new().unwrap();
        let handle = runtime.block_on(node::start(config)).unwrap();
        let broker = handle.listens_at().unwrap().to_string();
        let settings = Settings {
            broker,
            cell: "lot-1".into(),
            node: "edge".into(),
            tls: client,
            ..Settings::default()
        };
        Self {
            runtime,
            handle: Some(handle),
            settings,
        }
    }

    /// A client at the door that publishes and receives every topic.
    fn stranger(&self, name: &str) -> (Client, rumqttc::Connection) {
        let address: SocketAddr = self.settings.broker.parse().unwrap();
        let mut options = MqttOptions::new(name, "127.0.0.1", address.port());
        options.set_max_packet_size(1 << 20, 1 << 20);
        Client::new(options, 64)
    }

    /// Sets the cell's description, and waits until programs receive it.
    fn describe(&self, text: &str) {
        let (client, mut connection) = self.stranger("operator");
        std::thread::spawn(move || connection.iter().for_each(drop));
        let hash = ContentHash([0; 32]);
        let set_by = NodeName::from_static("edge");
        let description = CellDescription {
            schema: 1,
            version: 0,
            hash,
            set_by,
            text: text.into(),
        };
        client
            .publish(
                "ecod/v1/lot-1/cell",
                QoS::AtLeastOnce,
                false,
                encode(&description, Encoding::Json),
            )
            .unwrap();
        let cell = Cell::connect(self.settings.clone()).unwrap();
        let began = Instant::now();
        while cell.origin().unwrap().is_none() {
            assert!(began.elapsed() < SOON);
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// A bridge that runs beside the edge of the described cell.
    fn bridge(&self) -> (Arc<CpmBridge>, JoinHandle<Result<(), Error>>) {
        self.describe(DESCRIPTION);
        let bridge = Arc::new(CpmBridge::connect(self.settings.clone()).unwrap());
        let running = Arc::clone(&bridge);
        (bridge, std::thread::spawn(move || running.run()))
    }
}

impl Drop for Edge {
    fn drop(&mut self) {
        if let Some(handle) = self.handle.take() {
            self.runtime.block_on(handle.stop());
        }
    }
}

const DESCRIPTION: &str = r#"
[origin]
latitude_deg = 52.2296756
longitude_deg = 21.0122287
height_m = 113
rotation_deg = 40

[fusion.tracks]
mode = "on"

[[landmarks]]
id = "slot-0"
x_m = 200
y_m = 0
vacancy = { label = "EMPTY", x_m = 200, y_m = -0.1 }
"#;

/// A bus 12 m ahead of another station, as that station reports it.
fn foreign_cpm(at: Timestamp, station: u32) -> Vec<u8> {
    let bus = PerceivedObject {
        covariance_m2: Some([0.04, 0.0, 0.04]),
        size_m: Some([12.0, 2.5]),
        ..PerceivedObject::new("bus", 0.93, 12.0, -3.0)
    };
    let report = ObjectReport {
        objects: vec![bus],
        ..ObjectReport::new(NodeName::from_static("elsewhere"), 1, at)
    };
    let cell = CpmCell {
        origin: ORIGIN,
        vacancy_signs: BTreeSet::new(),
    };
    cpm::encode_report(&report, &cell, station).unwrap().bytes
}

#[test]
fn cpm_and_map_cross_bridge() {
    let edge = Edge::start(None);
    let (bridge, thread) = edge.bridge();
    let (client, mut connection) = edge.stranger("roadside");
    client
        .subscribe("ecod/v1/lot-1/cpm/#", QoS::AtMostOnce)
        .unwrap();
    // A vehicle without a node beside the foreign station.
    let vehicle = Cell::connect(Settings {
        node: "euclid".into(),
        part: String::new(),
        ..edge.settings.clone()
    })
    .unwrap();
    let frame = || {
        let covariance_m2 = Some([0.04, 0.0, 0.04]);
        let car = PerceivedObject {
            covariance_m2,
            ..PerceivedObject::new("car", 0.9, 4.0, 30.0)
        };
        Frame::new(vec![car, PerceivedObject::new("EMPTY", 0.9, 200.0, -0.1)])
    };
    let speaker = client.clone();
    let talking = Arc::clone(&bridge);
    let talk = std::thread::spawn(move || {
        let began = Instant::now();
        while began.elapsed() < SOON && Arc::strong_count(&talking) > 2 {
            let say = |name: &str, message: Vec<u8>| {
                speaker
                    .publish(
                        format!("ecod/v1/lot-1/cpm/received/{name}"),
                        QoS::AtMostOnce,
                        false,
                        message,
                    )
                    .unwrap();
            };
            say("obu", foreign_cpm(now(), 4711));
            say("broken", vec![2, 14, 7]);
            vehicle.report(frame()).unwrap();
            std::thread::sleep(Duration::from_millis(100));
        }
    });
    let reader = Cell::connect(edge.settings.clone()).unwrap();
    let of_bus = std::thread::spawn(move || {
        let mut maps = reader.maps().filter_map(Result::ok);
        maps.find_map(|map| {
            Some((
                map.fused_at_us,
                map.objects
                    .iter()
                    .find(|object| object.label == "bus")?
                    .clone(),
            ))
        })
    });
    let mut of_map = None::<ReceivedCpm>;
    let mut of_vehicle = None::<ReceivedCpm>;
    let echo = (NodeName::from_static("echo"), CpmRefusal::Own);
    let mut bus = None;
    let mut of_bus = Some(of_bus);
    let began = Instant::now();
    for event in connection.iter() {
        assert!(
            began.elapsed() < SOON,
            "{of_map:?} {of_vehicle:?} {bus:?} {:?}",
            bridge.refusals()
        );
        if let Some(found) = of_bus.take_if(|found| found.is_finished()) {
            bus = found.join().unwrap();
        }
        let Ok(Event::Incoming(Incoming::Publish(message))) = event else {
            continue;
        };
        match message.topic.strip_prefix("ecod/v1/lot-1/cpm/") {
            Some("global") => {
                of_map = Some(cpm::decode(&message.payload, &ORIGIN).unwrap());
                let topic = "ecod/v1/lot-1/cpm/received/echo";
                client
                    .publish(topic, QoS::AtMostOnce, false, message.payload)
                    .unwrap();
            }
            Some("euclid") => of_vehicle = Some(cpm::decode(&message.payload, &ORIGIN).unwrap()),
            Some(level) => assert!(level.starts_with("received/"), "{level}"),
            None => panic!("{}", message.topic),
        }
        let is_later = bus
            .as_ref()
            .zip(of_map.as_ref())
            .is_some_and(|((fused_at, _), map)| map.captured_at > *fused_at);
        if is_later && of_vehicle.is_some() && bridge.refusals().contains_key(&echo) {
            break;
        }
    }
    let map = of_map.unwrap();
    let vehicle = of_vehicle.unwrap();
    let (_, bus) = bus.unwrap();
    assert_ne!(map.station_id, vehicle.station_id);
    assert!(
        (bus.x_m - 12.0).abs() < 0.5 && (bus.y_m + 3.0).abs() < 0.5,
        "{bus:?}"
    );
    assert_eq!(bus.contributors, [NodeName::from_static("edge")]);
    let labels = |message: &ReceivedCpm| {
        message
            .objects
            .iter()
            .map(|object| object.label.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(
        labels(&map),
        ["car"],
        "only another station reports the bus"
    );
    assert_eq!(labels(&vehicle), ["car"], "a vacancy sign is no object");
    assert!((vehicle.objects[0].x_m - 4.0).abs() < 0.01, "{vehicle:?}");
    let broken = (
        NodeName::from_static("broken"),
        CpmRefusal::Cpm(CpmError::Malformed),
    );
    assert!(bridge.refusals()[&broken] > 0, "{:?}", bridge.refusals());
    bridge.close();
    drop(bridge);
    thread.join().unwrap().unwrap();
    talk.join().unwrap();
}

#[test]
fn station_places_are_limited() {
    let edge = Edge::start(None);
    let (bridge, thread) = edge.bridge();
    let radio = Cell::connect(edge.settings.clone()).unwrap();
    let yesterday = Timestamp(now().micros() - 86_400_000_000);
    let expected = [
        ("13", CpmRefusal::TooManyStations),
        ("1", CpmRefusal::TooOften),
        ("recorded", CpmRefusal::Time),
    ];
    let is_refused = |(receiver, refusal)| {
        bridge
            .refusals()
            .contains_key(&(NodeName::from_static(receiver), refusal))
    };
    let began = Instant::now();
    while !expected.into_iter().all(is_refused) {
        assert!(began.elapsed() < SOON, "{:?}", bridge.refusals());
        radio
            .publish_cpm("received/recorded", foreign_cpm(yesterday, 99))
            .unwrap();
        for station in 1..=13_u32 {
            radio
                .publish_cpm(&format!("received/{station}"), foreign_cpm(now(), station))
                .unwrap();
        }
        std::thread::sleep(Duration::from_millis(200));
    }
    bridge.close();
    thread.join().unwrap().unwrap();
}

#[test]
fn namesakes_reports_stay_off_map_topic() {
    let edge = Edge::start(None);
    let (bridge, thread) = edge.bridge();
    let (client, mut connection) = edge.stranger("roadside");
    client
        .subscribe("ecod/v1/lot-1/cpm/+", QoS::AtMostOnce)
        .unwrap();
    let vehicles = ["global", "euclid"].map(|node| {
        Cell::connect(Settings {
            node: node.into(),
            part: String::new(),
            ..edge.settings.clone()
        })
        .unwrap()
    });
    let is_done = Arc::new(AtomicBool::new(false));
    let until = Arc::clone(&is_done);
    let talk = std::thread::spawn(move || {
        while !until.load(Ordering::Relaxed) {
            for vehicle in &vehicles {
                vehicle.report(Frame::new(Vec::new())).unwrap();
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    });
    let of_edge = StationIds::new(NodeName::from_static("lot-1"))
        .of(&NodeName::from_static("edge"), Instant::now())
        .unwrap();
    let began = Instant::now();
    let mut stations = BTreeSet::new();
    let mut of_euclid = 0;
    for event in connection.iter() {
        assert!(began.elapsed() < SOON, "{stations:?} {of_euclid}");
        let Ok(Event::Incoming(Incoming::Publish(message))) = event else {
            continue;
        };
        match message.topic.strip_prefix("ecod/v1/lot-1/cpm/") {
            Some("global") => {
                stations.insert(cpm::decode(&message.payload, &ORIGIN).unwrap().station_id);
            }
            Some("euclid") => of_euclid += 1,
            topic => panic!("{topic:?}"),
        }
        if stations.contains(&of_edge) && of_euclid >= 10 {
            break;
        }
    }
    is_done.store(true, Ordering::Relaxed);
    talk.join().unwrap();
    assert_eq!(stations, BTreeSet::from([of_edge]));
    bridge.close();
    thread.join().unwrap().unwrap();
}

#[test]
fn missing_origin_names_remedy() {
    let edge = Edge::start(None);
    let error = CpmBridge::connect(edge.settings.clone()).err().unwrap();
    assert!(
        matches!(&error, Error::Invalid(text) if text.contains("[origin]") && text.contains("cell set")),
        "{error}"
    );
}

#[test]
fn certified_program_publishes_cpms() {
    let directory = tempfile::tempdir().unwrap();
    let time = Timestamp::default() + std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap();
    let mut authority =
        Authority::init(directory.path(), &NodeName::from_static("lot-1"), time).unwrap();
    let name = NodeName::from_static("edge");
    authority
        .issue(&name, Role::Edge, Duration::from_secs(86_400), time)
        .unwrap();
    let files = authority.tls_of(&name);
    let client = Tls::of_door(files.ca.clone(), &files.certificate, &files.key);
    let edge = Edge::start(Some((files, client)));
    let sender = Cell::connect(edge.settings.clone());
    let reader = Cell::connect(edge.settings.clone());
    let sender = sender.unwrap();
    let reader = reader.unwrap();
    let began = Instant::now();
    let mut received = reader.received_cpms().timeout(Duration::from_millis(100));
    let message = loop {
        sender.publish_cpm("received/obu", vec![2, 14]).unwrap();
        match received.next().unwrap() {
            Ok(message) => break message,
            Err(error) => assert!(
                matches!(error, Error::Silent(_)) && began.elapsed() < SOON,
                "{error}"
            ),
        }
    };
    assert_eq!(
        (message.receiver.as_str(), &message.payload[..]),
        ("obu", &[2, 14][..])
    );
}
