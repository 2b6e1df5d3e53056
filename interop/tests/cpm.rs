//! A bridge beside a real node: maps and reports go out as CPM, and those of a foreign station come in.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says where")]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use ecod::wire::{CellDescription, ContentHash, Encoding, encode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::transport::pki::{Authority, TlsConfig};
use ecod_client::{
    Cell, Error, Frame, GeographicOrigin, NodeName, ObjectReport, PerceivedObject, Role, Settings, Timestamp, Tls, now,
};
use ecod_interop::bridge::{CpmBridge, CpmRefusal};
use ecod_interop::cpm::{self, CpmError, ReceivedCpm};
use rumqttc::{Client, Event, Incoming, MqttOptions, QoS};
use tokio::runtime::Runtime;

/// Maximum time for anything on a machine that does much else.
const SOON: Duration = Duration::from_secs(30);

const ORIGIN: GeographicOrigin =
    GeographicOrigin { latitude_deg: 52.2296756, longitude_deg: 21.0122287, height_m: 113.0, rotation_deg: 40.0 };

/// A running edge.
struct Edge {
    runtime: Runtime,
    handle: Option<NodeHandle>,
    settings: Settings,
}

impl Edge {
    fn start(tls: Option<(TlsConfig, Tls)>) -> Self {
        let loopback = SocketAddr::from(([127, 0, 0, 1], 0));
        let (server, client) = tls.unzip();
        let mut config = NodeConfig {
            name: Some(NodeName::from_static("edge")),
            cell: NodeName::from_static("lot-1"),
            role: Role::Edge,
            listen: Some(loopback),
            tls: server,
            ..NodeConfig::default()
        };
        config.membership.bind = Some(loopback);
        config.membership.multicast.enabled = false;
        config.dashboard.enabled = false;
        config.validate().unwrap();
        let runtime = Runtime::new().unwrap();
        let handle = runtime.block_on(node::start(config)).unwrap();
        let broker = handle.listens_at().unwrap().to_string();
        let settings =
            Settings { broker, cell: "lot-1".into(), node: "edge".into(), tls: client, ..Settings::default() };
        Self { runtime, handle: Some(handle), settings }
    }

    /// A client at the door that says and hears anything.
    fn stranger(&self, name: &str) -> (Client, rumqttc::Connection) {
        let address: SocketAddr = self.settings.broker.parse().unwrap();
        let mut options = MqttOptions::new(name, "127.0.0.1", address.port());
        options.set_max_packet_size(1 << 20, 1 << 20);
        Client::new(options, 64)
    }

    /// Sets the cell's description, and waits until programs are told so.
    fn describe(&self, text: &str) {
        let (client, mut connection) = self.stranger("operator");
        std::thread::spawn(move || connection.iter().for_each(drop));
        let (hash, set_by) = (ContentHash([0; 32]), NodeName::from_static("edge"));
        let description = CellDescription { schema: 1, version: 0, hash, set_by, text: text.into() };
        client.publish("ecod/v1/lot-1/cell", QoS::AtLeastOnce, false, encode(&description, Encoding::Json)).unwrap();
        let cell = Cell::connect(self.settings.clone()).unwrap();
        let began = Instant::now();
        while cell.origin().unwrap().is_none() {
            assert!(began.elapsed() < SOON);
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Edge {
    fn drop(&mut self) {
        if let Some(handle) = self.handle.take() {
            self.runtime.block_on(handle.stop());
        }
    }
}

const DESCRIPTION: &str =
    "[origin]\nlatitude_deg = 52.2296756\nlongitude_deg = 21.0122287\nheight_m = 113\nrotation_deg = 40\n";

/// A bus 12 m ahead of a foreign station, as that station says it.
fn foreign_cpm(at: Timestamp) -> Vec<u8> {
    let bus = PerceivedObject {
        covariance_m2: Some([0.04, 0.0, 0.04]),
        size_m: Some([12.0, 2.5]),
        ..PerceivedObject::new("bus", 0.93, 12.0, -3.0)
    };
    let report = ObjectReport { objects: vec![bus], ..ObjectReport::new(NodeName::from_static("elsewhere"), 1, at) };
    cpm::encode_report(&report, &ORIGIN, 4711).unwrap().bytes
}

#[test]
fn a_map_goes_out_as_cpm_and_a_foreign_cpm_becomes_an_object_on_the_map() {
    let edge = Edge::start(None);
    edge.describe(DESCRIPTION);
    let bridge = Arc::new(CpmBridge::connect(edge.settings.clone()).unwrap());
    let running = Arc::clone(&bridge);
    let thread = std::thread::spawn(move || running.run());
    let (client, mut connection) = edge.stranger("roadside");
    client.subscribe("ecod/v1/lot-1/cpm/#", QoS::AtMostOnce).unwrap();
    // A vehicle without a node beside the foreign station.
    let vehicle =
        Cell::connect(Settings { node: "euclid".into(), part: String::new(), ..edge.settings.clone() }).unwrap();
    let car = || {
        let covariance_m2 = Some([0.04, 0.0, 0.04]);
        Frame::new(vec![PerceivedObject { covariance_m2, ..PerceivedObject::new("car", 0.9, 4.0, 30.0) }])
    };
    let speaker = client.clone();
    let talking = Arc::clone(&bridge);
    let talk = std::thread::spawn(move || {
        let began = Instant::now();
        while began.elapsed() < SOON && Arc::strong_count(&talking) > 2 {
            speaker.publish("ecod/v1/lot-1/cpm/received/obu", QoS::AtMostOnce, false, foreign_cpm(now())).unwrap();
            speaker.publish("ecod/v1/lot-1/cpm/received/broken", QoS::AtMostOnce, false, [2, 14, 7]).unwrap();
            vehicle.report(car()).unwrap();
            std::thread::sleep(Duration::from_millis(100));
        }
    });
    let (mut of_map, mut of_vehicle) = (None::<ReceivedCpm>, None::<ReceivedCpm>);
    let began = Instant::now();
    for event in connection.iter() {
        assert!(began.elapsed() < SOON, "{of_map:?} {of_vehicle:?}");
        let Ok(Event::Incoming(Incoming::Publish(message))) = event else { continue };
        match message.topic.strip_prefix("ecod/v1/lot-1/cpm/") {
            Some("map") => of_map = Some(cpm::decode(&message.payload, &ORIGIN).unwrap()),
            Some("vehicles/euclid") => of_vehicle = Some(cpm::decode(&message.payload, &ORIGIN).unwrap()),
            Some(level) => assert!(level.starts_with("received/"), "{level}"),
            None => panic!("{}", message.topic),
        }
        let has_both = of_map.as_ref().is_some_and(|map| map.objects.len() == 2);
        if has_both && of_vehicle.is_some() {
            break;
        }
    }
    let (map, vehicle) = (of_map.unwrap(), of_vehicle.unwrap());
    assert_ne!(map.station_id, vehicle.station_id);
    let bus = map.objects.iter().find(|object| object.label == "bus").unwrap();
    assert!((bus.x_m - 12.0).abs() < 0.5 && (bus.y_m + 3.0).abs() < 0.5, "{bus:?}");
    assert!((vehicle.objects[0].x_m - 4.0).abs() < 0.01 && vehicle.objects[0].label == "car", "{vehicle:?}");
    let broken = (NodeName::from_static("broken"), CpmRefusal::Cpm(CpmError::Malformed));
    assert!(bridge.refusals()[&broken] > 0, "{:?}", bridge.refusals());
    bridge.close();
    drop(bridge);
    thread.join().unwrap().unwrap();
    talk.join().unwrap();
}

#[test]
fn without_an_origin_the_bridge_says_how_to_set_one() {
    let edge = Edge::start(None);
    let error = CpmBridge::connect(edge.settings.clone()).err().unwrap();
    assert!(
        matches!(&error, Error::Invalid(text) if text.contains("[origin]") && text.contains("cell set")),
        "{error}"
    );
}

#[test]
fn with_certificates_a_program_of_the_node_publishes_cpms() {
    let directory = tempfile::tempdir().unwrap();
    let time = Timestamp::default() + std::time::SystemTime::UNIX_EPOCH.elapsed().unwrap();
    let mut authority = Authority::init(directory.path(), &NodeName::from_static("lot-1"), time).unwrap();
    let name = NodeName::from_static("edge");
    authority.issue(&name, Role::Edge, Duration::from_secs(86_400), time).unwrap();
    let (certificate, key) = authority.files_of(&name);
    let client = Tls::of_door(authority.ca(), &certificate, &key);
    let edge = Edge::start(Some((
        TlsConfig { ca: authority.ca(), certificate, key, revocation_list: None, city: None },
        client,
    )));
    let (sender, reader) = (Cell::connect(edge.settings.clone()), Cell::connect(edge.settings.clone()));
    let (sender, reader) = (sender.unwrap(), reader.unwrap());
    let began = Instant::now();
    let mut received = reader.received_cpms().timeout(Duration::from_millis(100));
    let message = loop {
        sender.publish_cpm("received/obu", vec![2, 14]).unwrap();
        match received.next().unwrap() {
            Ok(message) => break message,
            Err(error) => assert!(matches!(error, Error::Silent(_)) && began.elapsed() < SOON, "{error}"),
        }
    };
    assert_eq!((message.receiver.as_str(), &message.payload[..]), ("obu", &[2, 14][..]));
}
