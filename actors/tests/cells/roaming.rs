//! Vehicles that drive from one cell into the next, with real nodes, brokers and localisation.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ecod::model::origin::GeographicOrigin;
use ecod::model::time::Timestamp;
use ecod::wire::{Limits, ObjectReport, Role, decode};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::roaming::Roamer;
use ecod_actors::node::{self, NodeHandle};
use ecod_actors::platform::clock;
use ecod_actors::transport::pki::{Authority, CityTlsConfig, TlsConfig};
use ecod_testkit::{car_ahead, loopback, name, node_config};
use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS};
use tempfile::TempDir;
use tokio::net::UdpSocket;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

const PATIENCE: Duration = Duration::from_secs(40);

/// Middles of the cells: 300 m apart, from west to east.
fn middle(cell: usize) -> GeographicOrigin {
    let first = GeographicOrigin {
        latitude_deg: 52.2,
        longitude_deg: 21.0,
        height_m: 0.0,
        rotation_deg: 0.0,
    };
    let place = first.to_wgs84(300.0 * cell as f64, 0.0, 0.0);
    GeographicOrigin {
        latitude_deg: place.latitude_deg,
        longitude_deg: place.longitude_deg,
        ..first
    }
}

/// A node of a cell on this machine alone.
fn config(cell: usize, name: &str, role: Role) -> NodeConfig {
    node_config(name, &format!("lot-{cell}"), role)
}

/// Number of cells on the road.
const CELLS: usize = 2;

/// The CA of a city, and the CAs of its cells.
struct City {
    city: Authority,
    cells: Vec<Authority>,
}

const DAY: Duration = Duration::from_secs(86_400);

impl City {
    fn new(directory: &Path) -> Self {
        let mut city =
            Authority::init_city(&directory.join("city"), &name("town"), clock::now()).unwrap();
        let cell = |cell: usize| {
            let cell = format!("lot-{cell}");
            city.init_cell(&directory.join(&cell), &name(&cell), clock::now())
                .unwrap()
        };
        let cells = (0..CELLS).map(cell).collect();
        Self { city, cells }
    }

    fn files(&self, cell: usize, issuer: &Authority, node: &str) -> TlsConfig {
        let (certificate, key) = issuer.files_of(&name(node));
        let city = CityTlsConfig {
            ca: self.city.ca(),
            revocation_list: Some(self.city.revocation_list()),
        };
        let ca = self.cells[cell].ca();
        let list = self.cells[cell].revocation_list();
        TlsConfig {
            ca,
            certificate,
            key,
            revocation_list: Some(list),
            city: Some(city),
        }
    }

    /// Files of a cell's edge.
    fn edge(&mut self, cell: usize) -> TlsConfig {
        let edge = format!("edge-{cell}");
        self.cells[cell]
            .issue(&name(&edge), Role::Edge, DAY, clock::now())
            .unwrap();
        self.files(cell, &self.cells[cell], &edge)
    }

    /// Files of a vehicle of all cells.
    fn vehicle(&mut self) -> TlsConfig {
        self.city
            .issue(&name("euclid"), Role::Cav, DAY, clock::now())
            .unwrap();
        self.files(0, &self.city, "euclid")
    }
}

/// Reports of the vehicle that a cell's broker carries, with their time of receipt.
#[derive(Clone, Default)]
struct Reports(Arc<Mutex<Vec<(Timestamp, ObjectReport)>>>);

impl Reports {
    /// Reads a cell's broker until the test ends.
    async fn of(cell: usize, edge: &NodeHandle, readers: &mut JoinSet<()>) -> Self {
        let broker = edge.broker_address().unwrap();
        let mut options = MqttOptions::new("onlooker", broker.ip().to_string(), broker.port());
        options.set_keep_alive(Duration::from_secs(60));
        let (client, mut events) = AsyncClient::new(options, 64);
        client
            .subscribe(
                format!("ecod/v1/lot-{cell}/detections/euclid"),
                QoS::AtMostOnce,
            )
            .await
            .unwrap();
        let reports = Self::default();
        let heard = reports.clone();
        readers.spawn(async move {
            let _client = client;
            while let Ok(event) = events.poll().await {
                if let Event::Incoming(Packet::Publish(message)) = event {
                    let report = decode(&message.payload, &Limits::default()).unwrap();
                    heard.0.lock().unwrap().push((clock::now(), report));
                }
            }
        });
        reports
    }

    fn count(&self) -> usize {
        self.0.lock().unwrap().len()
    }

    /// Waits until there are more.
    async fn more(&self) {
        let before = self.count();
        let more = async {
            while self.count() < before + 5 {
                sleep(Duration::from_millis(20)).await;
            }
        };
        timeout(PATIENCE, more).await.expect("the vehicle reports");
    }

    /// The vehicle's place in each report, in metres east of the cell's origin.
    fn places_m(&self) -> Vec<f64> {
        self.0
            .lock()
            .unwrap()
            .iter()
            .map(|(_, report)| report.pose.unwrap().x_m)
            .collect()
    }

    fn times(&self) -> Vec<Timestamp> {
        self.0.lock().unwrap().iter().map(|(at, _)| *at).collect()
    }
}

/// Cells of a moving vehicle, and their files for the vehicle.
struct Town {
    /// By cell; a cell may have no entry.
    edges: BTreeMap<usize, NodeHandle>,
    readers: JoinSet<()>,
    directory: TempDir,
    city: Option<City>,
    /// Where the vehicle is, in metres east of the first cell's middle.
    x_m: Arc<Mutex<f64>>,
    poses: SocketAddr,
}

impl Town {
    /// A town with edges in these cells.
    async fn new(edges: &[usize]) -> Self {
        Self::with(edges, tempfile::tempdir().unwrap(), None).await
    }

    /// The same, with certificates of a city.
    async fn certified(edges: &[usize]) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let city = City::new(directory.path());
        Self::with(edges, directory, Some(city)).await
    }

    async fn with(with_edge: &[usize], directory: TempDir, mut city: Option<City>) -> Self {
        let mut edges = BTreeMap::new();
        let mut readers = JoinSet::new();
        for &cell in with_edge {
            let edge = format!("edge-{cell}");
            let description = directory.path().join(format!("{edge}.toml"));
            let GeographicOrigin {
                latitude_deg,
                longitude_deg,
                ..
            } = middle(cell);
            let text = format!(
                "[origin]\nlatitude_deg = {latitude_deg}\nlongitude_deg = {longitude_deg}\n"
            );
            std::fs::write(&description, text).unwrap();
            let config = NodeConfig {
                description: Some(description),
                ..config(cell, &edge, Role::Edge)
            };
            let tls = city.as_mut().map(|city| city.edge(cell));
            edges.insert(
                cell,
                node::start(NodeConfig { tls, ..config }).await.unwrap(),
            );
        }
        let poses = UdpSocket::bind("127.0.0.1:0")
            .await
            .unwrap()
            .local_addr()
            .unwrap();
        let x_m = Arc::new(Mutex::new(0.0));
        readers.spawn(localise(poses, Arc::clone(&x_m)));
        Self {
            edges,
            readers,
            directory,
            city,
            x_m,
            poses,
        }
    }

    async fn reports(&mut self, cell: usize) -> Reports {
        Reports::of(cell, &self.edges[&cell], &mut self.readers).await
    }

    fn seeds(&self, cell: usize) -> Vec<String> {
        self.edges
            .get(&cell)
            .map(|edge| edge.gossip_address().unwrap().to_string())
            .into_iter()
            .collect()
    }

    /// Times and rounds of the maps that the vehicle accepted of a cell's edge.
    fn accepted(&self, cell: usize) -> Vec<(Timestamp, u64)> {
        let text = std::fs::read_to_string(self.directory.path().join("maps")).unwrap();
        let maps = text
            .lines()
            .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
        let of_cell = maps.filter(|map| map["map"]["aggregator"] == format!("edge-{cell}"));
        of_cell
            .map(|map| {
                (
                    Timestamp(map["received_at_us"].as_u64().unwrap()),
                    map["map"]["round"].as_u64().unwrap(),
                )
            })
            .collect()
    }

    /// Cells in the order of their maps in the vehicle's log, each run once.
    fn logged_cells(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.directory.path().join("maps")).unwrap();
        let lines = text
            .lines()
            .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
        let mut cells: Vec<_> = lines
            .map(|line| line["cell"].as_str().unwrap().to_owned())
            .collect();
        cells.dedup();
        cells
    }

    fn drive_to(&self, x_m: f64) {
        *self.x_m.lock().unwrap() = x_m;
    }

    /// A vehicle of the first cell that always has half a metre of car ahead.
    fn vehicle(&mut self, role: Role) -> NodeConfig {
        let directory = self.directory.path();
        let mut cells = String::new();
        for cell in 0..CELLS {
            let GeographicOrigin {
                latitude_deg,
                longitude_deg,
                ..
            } = middle(cell);
            let seeds = self.seeds(cell);
            cells += &format!(
                "[[cells]]\nname = \"lot-{cell}\"\nlatitude_deg = {latitude_deg}\nlongitude_deg = {longitude_deg}\nseeds = {seeds:?}\n"
            );
            // Relative to the file, as `ecod-node pki` makes them.
            if self.city.is_some() {
                cells += &format!(
                    "ca = \"lot-{cell}/ca.pem\"\nrevocation_list = \"lot-{cell}/revoked.pem\"\n"
                );
            }
        }
        // A cell elsewhere, the key of which is missing.
        cells += "[[cells]]\nname = \"lot-9\"\nlatitude_deg = 0\nlongitude_deg = 0\nkey_file = \"lot-9.key\"\n";
        std::fs::write(directory.join("cells.toml"), cells).unwrap();
        let camera = car_ahead(directory);
        let mut config = config(0, "euclid", role);
        config.cells = Some(directory.join("cells.toml"));
        config.map_log = Some(directory.join("maps"));
        config.pose.listen = Some(self.poses);
        config.membership.seeds = self.seeds(0);
        config.origin = Some(middle(0));
        config.camera = Some(toml::from_str(&camera).unwrap());
        config.tls = self.city.as_mut().map(City::vehicle);
        config.validate().unwrap();
        config
    }

    async fn stop(self) {
        for edge in self.edges.into_values() {
            edge.stop().await;
        }
    }
}

/// Sends the vehicle's pose at 20 Hz, heading east.
async fn localise(poses: SocketAddr, x_m: Arc<Mutex<f64>>) {
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    loop {
        let place = middle(0).to_wgs84(*x_m.lock().unwrap(), 0.0, 0.0);
        let pose = serde_json::json!({
            "latitude_deg": place.latitude_deg, "longitude_deg": place.longitude_deg, "azimuth_deg": 90.0,
        });
        // Before the vehicle listens, the address is refused.
        let _ = socket.send_to(pose.to_string().as_bytes(), poses).await;
        sleep(Duration::from_millis(50)).await;
    }
}

/// A vehicle that drives by itself until the test stops it.
struct Driving(
    tokio::task::JoinHandle<Roamer>,
    tokio::sync::oneshot::Sender<()>,
);

impl Driving {
    fn start(mut vehicle: Roamer) -> Self {
        let (stop, stopped) = tokio::sync::oneshot::channel();
        let driving = tokio::spawn(async move {
            tokio::select! {
                failed = vehicle.drive() => panic!("the vehicle gave up: {:?}", failed.err()),
                _ = stopped => vehicle,
            }
        });
        Self(driving, stop)
    }

    async fn stop(self) -> Roamer {
        let _ = self.1.send(());
        self.0.await.unwrap()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn vehicle_reports_in_one_cell() {
    let mut town = Town::new(&[0, 1]).await;
    let first = town.reports(0).await;
    let second = town.reports(1).await;
    let vehicle = Driving::start(Roamer::start(town.vehicle(Role::Cav)).await.unwrap());
    first.more().await;
    assert_eq!(second.count(), 0);
    town.drive_to(200.0);
    second.more().await;
    let gap = second.times()[0].since(*first.times().last().unwrap());
    println!("reports pause for {} ms", gap.as_millis());
    assert!(
        first.times().iter().all(|at| *at <= second.times()[0]),
        "it reports in one cell at a time"
    );
    // Poses after its jump are extrapolated. In the other cell's frame they would differ by 300 m.
    for (reports, places_m) in [(&first, -0.5..1000.0), (&second, -100.5..-99.5)] {
        let reported_m = reports.places_m();
        assert!(
            reported_m.iter().all(|x_m| places_m.contains(x_m)),
            "in the frame of its cell: {reported_m:?}"
        );
    }
    let logged = town.logged_cells();
    assert_eq!(logged, ["lot-0", "lot-1"], "one cell's maps at a time");
    let maps = [0, 1].map(|cell| town.accepted(cell));
    let last = maps[0].last().unwrap().0;
    let next = maps[1][0].0;
    let seam = next.since(last);
    println!("maps pause for {} ms", seam.as_millis());
    // Two periods, and a busy machine.
    assert!(seam < Duration::from_millis(400), "{seam:?}");
    let missed: u64 = maps
        .iter()
        .flat_map(|maps| maps.windows(2))
        .map(|pair| pair[1].1 - pair[0].1 - 1)
        .sum();
    assert!(missed <= 1, "{missed} maps missed");
    let left = first.count();
    second.more().await;
    assert_eq!(
        first.count(),
        left,
        "the former cell receives no more reports"
    );
    town.drive_to(0.0);
    first.more().await;
    let vehicle = vehicle.stop().await;
    assert_eq!(vehicle.cell().as_str(), "lot-0");
    vehicle.stop().await;
    town.stop().await;
}

/// Waits until the maps of a node are made of the vehicle's reports, or of others alone.
async fn counts(node: &NodeHandle, is_expected: bool) {
    let mut maps = node.newest_map();
    let expected = maps.wait_for(|newest| {
        newest.as_ref().is_some_and(|newest| {
            newest
                .map
                .objects
                .iter()
                .flat_map(|object| &object.contributors)
                .any(|node| node.as_str() == "euclid")
                == is_expected
        })
    });
    timeout(PATIENCE, expected)
        .await
        .expect("the map changes")
        .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn city_certificate_opens_all_cells() {
    let mut town = Town::certified(&[0, 1]).await;
    let vehicle = Driving::start(Roamer::start(town.vehicle(Role::Cav)).await.unwrap());
    counts(&town.edges[&0], true).await;
    town.drive_to(200.0);
    counts(&town.edges[&1], true).await;
    counts(&town.edges[&0], false).await;
    vehicle.stop().await.stop().await;
    town.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn vehicle_leads_only_at_home() {
    let mut town = Town::new(&[1]).await;
    let elsewhere = town.reports(1).await;
    let config = town.vehicle(Role::Auto);
    let vehicle = Driving::start(Roamer::start(config).await.unwrap());
    sleep(Duration::from_secs(2)).await;
    town.drive_to(200.0);
    elsewhere.more().await;
    let vehicle = vehicle.stop().await;
    assert!(!vehicle.present().leadership().borrow().is_leading());
    let door = vehicle.present().listens_at();
    let vehicle = Driving::start(vehicle);
    town.drive_to(0.0);
    counts(&town.edges[&1], false).await;
    let vehicle = vehicle.stop().await;
    counts(vehicle.present(), true).await;
    assert!(vehicle.present().leadership().borrow().is_leading());
    assert_eq!(
        vehicle.present().listens_at(),
        door,
        "programs find it where it was"
    );
    vehicle.stop().await;
    town.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn vehicle_without_position_reports_trouble() {
    let mut town = Town::new(&[0]).await;
    let mut config = town.vehicle(Role::Cav);
    config.pose.listen = Some(loopback());
    config.camera = None;
    let mut vehicle = Roamer::start(config).await.unwrap();
    let outcome = timeout(Duration::from_secs(3), vehicle.drive()).await;
    assert!(outcome.is_err(), "it drives on");
    let troubles = vehicle.present().counters().troubles().present();
    let trouble = troubles
        .iter()
        .find(|trouble| trouble.remedy.contains("`latitude_deg`"));
    assert!(
        trouble.is_some_and(|trouble| trouble.kind == "no_pose"),
        "{troubles:?}"
    );
    let left_out = troubles
        .iter()
        .find(|trouble| trouble.kind == "cell_left_out");
    assert!(
        left_out.is_some_and(|trouble| trouble.cause.contains("lot-9.key")),
        "{troubles:?}"
    );
    vehicle.stop().await;
    town.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_next_cell_keeps_vehicle() {
    let mut town = Town::new(&[0]).await;
    let reports = town.reports(0).await;
    let vehicle = Driving::start(Roamer::start(town.vehicle(Role::Cav)).await.unwrap());
    reports.more().await;
    town.drive_to(200.0);
    // It gives up after 15 s.
    sleep(Duration::from_secs(17)).await;
    reports.more().await;
    let times = reports.times();
    let longest = times
        .windows(2)
        .map(|pair| pair[1].since(pair[0]))
        .max()
        .unwrap();
    assert!(
        longest < Duration::from_secs(2),
        "it reports all the time: {longest:?}"
    );
    let vehicle = vehicle.stop().await;
    assert_eq!(vehicle.cell().as_str(), "lot-0");
    let sequence: Vec<_> = reports
        .0
        .lock()
        .unwrap()
        .iter()
        .map(|(_, report)| report.seq)
        .collect();
    assert!(sequence.is_sorted(), "its camera ran on: {sequence:?}");
    vehicle.stop().await;
    town.stop().await;
}
