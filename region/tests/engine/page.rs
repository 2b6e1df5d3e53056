//! The page in numbers, metrics and exports.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use ecod::wire::{NodeState, RegionTopicKind};
use ecod_region::page::RegionPage;
use ecod_region::reader::{self, RegionState};
use ecod_testkit::until;
use serde_json::Value;

use crate::broker::{Broker, FAR, LOT};
use crate::cell::Cell;

/// Status and body of an answer.
pub(crate) fn get(address: SocketAddr, path: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream
        .set_read_timeout(Some(Duration::from_secs(10)))
        .unwrap();
    write!(
        stream,
        "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (
        head.split(' ').nth(1).unwrap().parse().unwrap(),
        body.to_owned(),
    )
}

fn view(address: SocketAddr, bounds: &str) -> Value {
    let (status, body) = get(address, &format!("/api/view?bounds={bounds}"));
    assert_eq!(status, 200, "{body}");
    serde_json::from_str(&body).unwrap()
}

/// Both cells: one is alive, the other has gone offline.
fn publish(lot: &Cell, far: &Cell, round: u64) {
    lot.publish_map(round, 3);
    if round == 1 {
        lot.publish(
            &lot.topic(RegionTopicKind::Status),
            true,
            lot.status(NodeState::Aggregating),
        );
        far.publish(
            &far.topic(RegionTopicKind::Status),
            true,
            far.status(NodeState::Offline),
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn page_counts_cells_in_view() {
    let broker = Broker::nats();
    let lot = Cell::connect(&broker, LOT);
    let far = Cell::connect(&broker, FAR);
    let state = Arc::new(RegionState::default());
    let page = RegionPage::listen(
        "127.0.0.1:0".parse().unwrap(),
        None,
        Vec::new(),
        Arc::clone(&state),
    )
    .await
    .unwrap();
    let address = page.address();
    assert!(matches!(page.address().port(), 1..));
    tokio::spawn(page.serve());
    let login = broker.login("region.reader");
    let read = Arc::clone(&state);
    tokio::spawn(async move { reader::read(&login, &read, |_| ()).await });
    let look =
        move |bounds: &'static str| tokio::task::spawn_blocking(move || view(address, bounds));

    // About the first cell, without the second.
    let near = "2.28,48.85,2.31,48.87";
    let mut round = 0;
    let shown = loop {
        round += 1;
        assert!(round < 300, "the map is not shown");
        publish(&lot, &far, round);
        tokio::time::sleep(Duration::from_millis(100)).await;
        let shown = look(near).await.unwrap();
        if shown["view"]["live"] == 1 && shown["region"]["offline"] == 1 {
            break shown;
        }
    };
    assert_eq!(
        shown["region"]["cells"], 2,
        "statuses of all cells are read"
    );
    assert_eq!(
        (&shown["view"]["cells"], &shown["has_maps"]),
        (&1.into(), &true.into())
    );
    assert_eq!(
        (&shown["view"]["objects"], &shown["view"]["vehicles"]),
        (&3.into(), &1.into())
    );
    let cell = &shown["cells"][0];
    assert_eq!(
        (&cell["cell"], &cell["leader"], &cell["page"]),
        (&"lot-1".into(), &"edge".into(), &"10.0.0.3:8080".into())
    );
    assert!(
        cell["age_s"].as_f64().unwrap() < 1.0 && cell["latitude_deg"] == 48.8584,
        "{cell}"
    );
    let object = shown["objects"]
        .as_array()
        .unwrap()
        .iter()
        .find(|object| object["vehicle"] == "euclid")
        .unwrap();
    // 5 m north of the origin; the frame is not turned.
    assert!(
        (object["latitude_deg"].as_f64().unwrap() - 48.8584 - 5.0 / 111_200.0).abs() < 1e-6,
        "{object}"
    );
    assert_eq!(object["velocity_mps"], serde_json::json!([1.0, 2.0]));

    // Nobody looks at the second cell: its maps are not read.
    let before = state.town().counts().maps;
    far.publish_map(1, 1);
    far.publish_map(2, 1);
    publish(&lot, &far, round + 1);
    until("the first cell's next map is read", || {
        state.town().counts().maps > before
    })
    .await;
    assert_eq!(state.town().counts().maps, before + 1);

    let metrics = tokio::task::spawn_blocking(move || get(address, "/metrics"))
        .await
        .unwrap()
        .1;
    for line in [
        "ecod_region_broker_up 1",
        "ecod_region_cells{state=\"offline\"} 1",
        "process_start_time_seconds",
    ] {
        assert!(metrics.contains(line), "{line} in\n{metrics}");
    }
    let answers = tokio::task::spawn_blocking(move || {
        [
            "/",
            "/region.js",
            "/style.css",
            "/healthz",
            "/api/view?bounds=1",
            "/nothing",
        ]
        .map(|path| get(address, path).0)
    });
    assert_eq!(answers.await.unwrap(), [200, 200, 200, 200, 400, 404]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_town_is_exported() {
    let broker = Broker::nats();
    let lot = Arc::new(Cell::connect(&broker, LOT));
    let publishing = tokio::spawn({
        let lot = Arc::clone(&lot);
        async move {
            for round in 1.. {
                lot.publish_map(round, 2);
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    });
    let export = |file: &str| {
        let out = broker.directory().join(file);
        let arguments = broker.arguments("region.reader");
        let mut command = Command::new(env!("CARGO_BIN_EXE_ecod-region"));
        command.args([
            "export",
            "--broker",
            &broker.address.to_string(),
            "--user",
            "region.reader",
            "--ca",
        ]);
        command
            .arg(arguments.ca.unwrap())
            .arg("--password-file")
            .arg(arguments.password_file.unwrap());
        command
            .args(["--tile", "12022", "--seconds", "3", "--out"])
            .arg(&out);
        tokio::task::spawn_blocking(move || {
            let output = command.output().unwrap();
            assert!(
                output.status.success(),
                "{}",
                String::from_utf8_lossy(&output.stderr)
            );
            std::fs::read(out).unwrap()
        })
    };
    let town: Value = serde_json::from_slice(&export("town.geojson").await.unwrap()).unwrap();
    let kinds = |kind: &str| {
        town["features"]
            .as_array()
            .unwrap()
            .iter()
            .filter(|feature| feature["properties"]["kind"] == kind)
            .count()
    };
    assert_eq!((kinds("cell"), kinds("tile"), kinds("object")), (1, 1, 2));
    let log = export("town.mcap").await.unwrap();
    let messages: Vec<_> = mcap::MessageStream::new(&log)
        .unwrap()
        .map(Result::unwrap)
        .collect();
    assert!(messages.len() >= 10, "{}", messages.len());
    let map: Value = serde_json::from_slice(&messages[0].data).unwrap();
    assert_eq!(
        (&map["cell"], &*messages[0].channel.topic),
        (&"lot-1".into(), &*lot.topic(RegionTopicKind::Map))
    );
    publishing.abort();
}

#[test]
fn reachable_page_needs_token() {
    let output = Command::new(env!("CARGO_BIN_EXE_ecod-region"))
        .args(["serve", "--broker", "127.0.0.1:1", "--listen", "0.0.0.0:0"])
        .output()
        .unwrap();
    assert_eq!(
        output.status.code(),
        Some(2),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
}
