//! A page of 10,000 cells, on a real broker.

use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ecod::model::epoch::Epoch;
use ecod::model::geometry::Covariance;
use ecod::model::names::NodeName;
use ecod::model::origin::GeographicOrigin;
use ecod::model::quadkey::Quadkey;
use ecod::wire::{
    CellMap, Encoding, FusedObject, GlobalMap, NodeState, NodeStatus, RegionTopic, RegionTopicKind,
    Role, SCHEMA_VERSION, Trouble, encode,
};
use ecod_actors::platform::clock;
use ecod_testkit::{until, until_blocking};
use rumqttc::{AsyncClient, QoS};
use serde_json::Value;
use uuid::Uuid;

use crate::broker::{Broker, free_address};
use crate::page::get;

/// Cells along one side of the town, each in a tile of its own.
const SIDE: usize = 100;

/// Cells whose maps come, along one side of a square in the south-west of the town.
const READ_SIDE: usize = 40;

/// Objects in each map.
const OBJECTS: usize = 25;

/// The page as a program; ended when dropped.
struct Reader {
    child: Child,
    address: SocketAddr,
}

impl Reader {
    fn start(broker: &Broker) -> Self {
        let arguments = broker.arguments("region.reader");
        let address = free_address();
        let child = Command::new(env!("CARGO_BIN_EXE_ecod-region"))
            .args([
                "serve",
                "--broker",
                &broker.address.to_string(),
                "--listen",
                &address.to_string(),
            ])
            .args(["--user", "region.reader", "--ca"])
            .arg(arguments.ca.unwrap())
            .arg("--password-file")
            .arg(arguments.password_file.unwrap())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let reader = Self { child, address };
        until_blocking("the page listens", || {
            std::net::TcpStream::connect(address).is_ok()
        });
        reader
    }

    /// Answer to a request, its bytes and the time that it took.
    async fn view(&self, query: String) -> (Value, usize, Duration) {
        let address = self.address;
        let asked = tokio::task::spawn_blocking(move || {
            let begun = Instant::now();
            let (status, body) = get(address, &format!("/api/view?{query}"));
            let took = begun.elapsed();
            assert_eq!(status, 200, "{body}");
            (serde_json::from_str(&body).unwrap(), body.len(), took)
        });
        asked.await.unwrap()
    }

    /// Resident memory in MB.
    fn memory_mb(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let kb = status
            .lines()
            .find_map(|line| line.strip_prefix("VmRSS:"))
            .unwrap();
        kb.trim().trim_end_matches(" kB").parse::<u64>().unwrap() / 1024
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The cell at a place of the grid, of which x counts eastward and y northward.
fn cell(x: usize, y: usize) -> (NodeName, GeographicOrigin) {
    // Tiles are 0.011 degrees wide, and 0.0072 high at this latitude.
    let latitude_deg = 48.5 + 0.0075 * y as f64;
    let longitude_deg = 2.0 + 0.011 * x as f64;
    let name = NodeName::new(format!("cell-{x}-{y}")).unwrap();
    (
        name,
        GeographicOrigin {
            latitude_deg,
            longitude_deg,
            height_m: 0.0,
            rotation_deg: 0.0,
        },
    )
}

fn topic(cell: &NodeName, origin: &GeographicOrigin, kind: RegionTopicKind) -> String {
    RegionTopic {
        tile: Quadkey::of_cell(origin),
        cell: cell.clone(),
        kind,
    }
    .path()
}

/// The status of a cell's leader: one of a hundred is offline, and as many have a trouble.
fn status(number: usize) -> Vec<u8> {
    let leader = NodeName::from_static("edge");
    let state = if number % 100 == 7 {
        NodeState::Offline
    } else {
        NodeState::Aggregating
    };
    let trouble = Trouble {
        kind: "camera_stalled".into(),
        about: None,
        cause: "the camera gives no pictures".into(),
        remedy: "look at its cable".into(),
    };
    let troubles = if number % 100 == 50 {
        vec![trouble]
    } else {
        Vec::new()
    };
    let starting = NodeStatus::starting(leader.clone(), Uuid::nil(), Role::Edge, "0.1.0");
    encode(
        &NodeStatus {
            state,
            epoch: 1,
            aggregator: Some(leader),
            troubles,
            ..starting
        },
        Encoding::Json,
    )
}

fn map(cell: &NodeName, origin: GeographicOrigin, round: u64) -> Vec<u8> {
    let now = clock::now();
    let object = |number: usize| FusedObject {
        velocity_mps: Some([5.0, 1.0]),
        vehicle: (number < 5).then(|| NodeName::new(format!("car-{number}")).unwrap()),
        ..FusedObject::new(
            Uuid::from_u128(number as u128),
            "car",
            0.9,
            10.0 * number as f64 - 125.0,
            40.0 * (number as f64).sin(),
            Covariance::isotropic(0.1),
        )
    };
    let epoch = Epoch::new(1, NodeName::from_static("edge"));
    let map = GlobalMap {
        objects: (0..OBJECTS).map(object).collect(),
        ..GlobalMap::new(&epoch, round, now)
    };
    let message = CellMap {
        schema: SCHEMA_VERSION,
        cell: cell.clone(),
        sent_at_us: now,
        origin,
        map,
    };
    encode(&message, Encoding::Compact)
}

/// Publishes all statuses, and maps at 2 Hz until stopped.
async fn publish(client: AsyncClient, stop: Arc<AtomicBool>) {
    for number in 0..SIDE * SIDE {
        let (cell, origin) = cell(number % SIDE, number / SIDE);
        let topic = topic(&cell, &origin, RegionTopicKind::Status);
        client
            .publish(topic, QoS::AtMostOnce, true, status(number))
            .await
            .unwrap();
    }
    let mut due = tokio::time::interval(Duration::from_millis(500));
    for round in 1.. {
        due.tick().await;
        if stop.load(Ordering::Relaxed) {
            return;
        }
        for number in (0..READ_SIDE * READ_SIDE).filter(|number| number % 100 != 7) {
            let (cell, origin) = cell(number % READ_SIDE, number / READ_SIDE);
            let payload = map(&cell, origin, round);
            let topic = topic(&cell, &origin, RegionTopicKind::Map);
            client
                .publish(topic, QoS::AtMostOnce, false, payload)
                .await
                .unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn ten_thousand_cells_are_shown() {
    let broker = Broker::mosquitto();
    let (client, mut events) = AsyncClient::new(broker.login("town").options(), 4096);
    tokio::spawn(async move { while events.poll().await.is_ok() {} });
    let stop = Arc::new(AtomicBool::new(false));
    tokio::spawn(publish(client, Arc::clone(&stop)));
    let reader = Reader::start(&broker);
    println!("page at http://{}/", reader.address);
    let begun = Instant::now();
    let mut all = reader.view(String::new()).await.0;
    while all["region"]["cells"] != SIDE * SIDE {
        assert!(
            begun.elapsed() < Duration::from_secs(60),
            "{}",
            all["region"]
        );
        tokio::time::sleep(Duration::from_millis(200)).await;
        all = reader.view(String::new()).await.0;
    }
    println!(
        "{} cells known after {:.1} s; memory {} MB",
        SIDE * SIDE,
        begun.elapsed().as_secs_f64(),
        reader.memory_mb()
    );
    let known = ["west", "south", "east", "north"]
        .map(|side| all["known"][side].to_string())
        .join(",");
    let (all, bytes, took) = reader.view(format!("bounds={known}")).await;
    let tiles = all["tiles"].as_array().unwrap().len();
    println!(
        "whole town: {tiles} tiles, {} kB in {} ms",
        bytes / 1000,
        took.as_millis()
    );
    assert!(
        all["maps_withheld"].is_string() && all["cells"].as_array().unwrap().is_empty(),
        "{}",
        all["maps_withheld"]
    );

    // A fifth of the town, whose maps are read; then a view small enough for single cells.
    let west = 1.99;
    let south = 48.49;
    for (name, side) in [("part", READ_SIDE), ("quarter", 20)] {
        let query = format!(
            "viewer=a&bounds={west},{south},{},{}",
            2.0 + 0.011 * side as f64 - 0.006,
            48.5 + 0.0075 * side as f64 - 0.004
        );
        let begun = Instant::now();
        let live = side * side * 99 / 100;
        loop {
            let (view, bytes, took) = reader.view(query.clone()).await;
            let totals = &view["view"];
            if totals["live"].as_u64().unwrap() >= live as u64 && totals["silent"] == 0 {
                println!(
                    "{name} of {} cells: {} live, {} objects after {:.1} s; answer of {} kB in {} ms; memory {} MB",
                    totals["cells"],
                    totals["live"],
                    totals["objects"],
                    begun.elapsed().as_secs_f64(),
                    bytes / 1000,
                    took.as_millis(),
                    reader.memory_mb()
                );
                assert!(
                    view["has_maps"] == true && view["maps_withheld"].is_null(),
                    "{name}"
                );
                assert!(took < Duration::from_secs(2), "{name}: {took:?}");
                break;
            }
            assert!(
                begun.elapsed() < Duration::from_secs(60),
                "{name}: {totals}"
            );
            tokio::time::sleep(Duration::from_millis(500)).await;
        }
    }
    assert!(reader.memory_mb() < 300, "{} MB", reader.memory_mb());
    if let Ok(seconds) = std::env::var("PAGE_STAYS_S") {
        tokio::time::sleep(Duration::from_secs(seconds.parse().unwrap())).await;
    }
    stop.store(true, Ordering::Relaxed);
    until("the publisher ends", || Arc::strong_count(&stop) == 1).await;
}
