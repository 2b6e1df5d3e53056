//! Nodes that are gone although the cell expects them.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_testkit::{Cell, command, until_async as until};
use tokio::task::spawn_blocking;
use tokio::time::{Instant, sleep};

use crate::cell::config;
use crate::http::get;

/// A node with a page.
fn configured(name: &str, role: Role, _directory: &Path) -> NodeConfig {
    config(name, role, 1)
}

/// The edge, a candidate and a vehicle, led by the edge.
async fn three() -> Cell {
    let mut cell = Cell::new(configured);
    for (name, role) in [
        ("edge", Role::Edge),
        ("euclid", Role::Auto),
        ("gauss", Role::Cav),
    ] {
        cell.start(name, role).await;
    }
    cell.until("all see each other", |cell| {
        let complete = |(_, node): (&str, &ecod_actors::node::NodeHandle)| {
            node.members().borrow().len() == 2 && node.dashboard_address().borrow().is_some()
        };
        cell.nodes().all(complete).then_some(())
    })
    .await;
    cell.served_by("edge").await;
    cell
}

fn page(cell: &Cell, node: &str) -> SocketAddr {
    cell.node(node).dashboard_address().borrow().unwrap()
}

/// Names of the nodes that a node's `/readyz` lists as missing.
async fn missing(page: SocketAddr) -> Vec<String> {
    let answer = get(page, "/readyz").await.json();
    let list = answer["missing"].as_array().cloned().unwrap_or_default();
    let name = |node: serde_json::Value| node["node"].as_str().unwrap_or_default().to_owned();
    list.into_iter().map(name).collect()
}

/// Causes of the troubles about missing nodes on a page, with the missing node.
async fn troubles(page: SocketAddr) -> Vec<[String; 2]> {
    let picture = get(page, "/api/picture").await.json();
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let all = picture["troubles"].as_array().unwrap().iter();
    all.filter(|trouble| trouble["kind"] == "node_missing")
        .map(|trouble| ["about", "cause"].map(|key| text(&trouble[key])))
        .collect()
}

/// A node that crashed is named on every page, in health and metrics, with the time at which it was last seen, until an
/// operator dismisses it at one node.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn crashed_node_stays_missing() {
    let mut cell = three().await;
    let pages = ["edge", "euclid"].map(|node| page(&cell, node));
    let early = cell.node("edge").listens_at().unwrap();
    let refused = dismiss(early, "gauss").await;
    assert!(!refused.0 && refused.1.contains("answers"), "{refused:?}");
    cell.kill("gauss");
    for page in pages {
        until("gauss is missing", || async {
            missing(page).await == ["gauss"]
        })
        .await;
        let ready = get(page, "/readyz").await;
        assert_eq!(ready.status, 200, "the cell works on: {}", ready.body);
        let picture = get(page, "/api/picture").await.json();
        let nodes = picture["nodes"].as_array().unwrap();
        let gauss = nodes.iter().find(|node| node["name"] == "gauss").unwrap();
        assert!(
            gauss["missing"] == true && gauss["alive"] == false && gauss["last_seen_us"].is_u64(),
            "{gauss}"
        );
        let metrics = get(page, "/metrics").await.body;
        assert!(
            metrics.contains("ecod_member_missing_seconds{member=\"gauss\"}"),
            "{metrics}"
        );
    }
    for page in pages {
        until("it is a trouble", || async {
            let listed = troubles(page).await;
            matches!(&listed[..], [[about, cause]] if about == "gauss"
                && cause.starts_with("gone for 1") && cause.contains(", last seen 2"))
        })
        .await;
    }
    let door = cell.node("edge").listens_at().unwrap();
    let (succeeded, said) = dismiss(door, "gauss").await;
    assert!(
        succeeded && said.contains("gauss is not expected any more"),
        "{said}"
    );
    for page in pages {
        until("no node is missing", || async {
            missing(page).await.is_empty()
        })
        .await;
        until("the trouble has ended", || async {
            troubles(page).await.is_empty()
        })
        .await;
    }
    cell.stop().await;
}

/// `ecod-node cell dismiss` at a node's door: whether it succeeded, and its output.
async fn dismiss(door: SocketAddr, node: &'static str) -> (bool, String) {
    let run = move || {
        let mut program = command(env!("CARGO_BIN_EXE_ecod-node"));
        program.args(["cell", "dismiss", node, "--cell", "lot", "--door"]);
        program.arg(door.to_string()).output().unwrap()
    };
    let output = spawn_blocking(run).await.unwrap();
    let text = [output.stdout, output.stderr].concat();
    (
        output.status.success(),
        String::from_utf8_lossy(&text).into_owned(),
    )
}

/// A node that is stopped in order has left and is not missing.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stopped_node_is_not_missing() {
    let (edge, edge_page) = crate::cell::start(config("edge", Role::Edge, 1)).await;
    let (cav, _) = crate::cell::join(config("euclid", Role::Cav, 1), &edge).await;
    until("the edge has a member", || async {
        get(edge_page, "/metrics")
            .await
            .body
            .contains("ecod_members 2")
    })
    .await;
    cav.stop().await;
    until("the edge is alone", || async {
        get(edge_page, "/metrics")
            .await
            .body
            .contains("ecod_members 1")
    })
    .await;
    let until = Instant::now() + Duration::from_secs(1);
    while Instant::now() < until {
        assert_eq!(missing(edge_page).await, <[String; 0]>::default());
        sleep(Duration::from_millis(50)).await;
    }
    edge.stop().await;
}
