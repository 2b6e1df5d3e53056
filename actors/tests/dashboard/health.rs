//! Health checks for machines are correct.

use std::net::TcpListener;

use ecod::wire::Role;
use ecod_actors::observe::dashboard::{DEFAULT_ADDRESS, DashboardConfig};
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until_async as until;

use crate::cell::{config, join, start};
use crate::http::{get, try_request};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn vehicle_is_ready_behind_leader() {
    let (cav, page) = start(config("euclid", Role::Cav, 2)).await;
    assert_eq!(
        (
            get(page, "/healthz").await.status,
            get(page, "/healthz").await.body.as_str()
        ),
        (200, "ok\n")
    );
    let alone = get(page, "/readyz").await;
    assert_eq!(
        (alone.status, alone.json()["reason"].as_str()),
        (503, Some("no leader known"))
    );

    let (edge, edge_page) = join(config("edge", Role::Edge, 2), &cav).await;
    until("the edge is ready", || async {
        get(edge_page, "/readyz").await.json()["reason"] == "leading"
    })
    .await;
    until("the vehicle is ready", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    assert_eq!(
        get(page, "/readyz").await.json()["reason"],
        "following edge"
    );

    edge.stop().await;
    until("the vehicle is not ready", || async {
        get(page, "/readyz").await.status == 503
    })
    .await;
    assert_eq!(
        get(page, "/healthz").await.status,
        200,
        "it lives all the same"
    );
    cav.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn busy_page_port_is_retried() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.listen = Some(address);
    let node = ecod_actors::node::start(config).await.unwrap();
    until("it is counted", || async {
        node.counters().events(Event::DashboardNotBound) > 0
    })
    .await;
    until("the node leads all the same", || async {
        node.leadership().borrow().is_leading()
    })
    .await;
    assert_eq!(*node.dashboard_address().borrow(), None);
    drop(taken);
    until("the page is served", || async {
        node.dashboard_address().borrow().is_some()
    })
    .await;
    assert_eq!(get(address, "/healthz").await.status, 200);
    node.stop().await;
    assert!(
        TcpListener::bind(address).is_ok(),
        "a stopped node leaves its port"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn default_pages_are_loopback_only() {
    let unplaced = |name| {
        let mut config = config(name, Role::Cav, 1);
        config.dashboard = DashboardConfig::default();
        config
    };
    let (one, first) = start(unplaced("euclid")).await;
    let (other, second) = start(unplaced("gauss")).await;
    assert!(first.ip().is_loopback() && second.ip().is_loopback());
    for (node, page) in [("euclid", first), ("gauss", second)] {
        assert_eq!(
            get(page, "/api/picture").await.json()["node"]["name"],
            node,
            "{first} {second}"
        );
    }
    assert_ne!(
        second, DEFAULT_ADDRESS,
        "the first node has the port, or its former user"
    );
    assert_eq!(other.counters().events(Event::DashboardNotBound), 0);
    one.stop().await;
    other.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn disabled_page_does_not_listen() {
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.enabled = false;
    let node = ecod_actors::node::start(config).await.unwrap();
    until("the node leads", || async {
        node.leadership().borrow().is_leading()
    })
    .await;
    assert!(node.slots().dashboard.get().is_none());
    assert_eq!(*node.dashboard_address().borrow(), None);
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killed_page_keeps_its_address() {
    let (node, page) = start(config("euclid", Role::Auto, 1)).await;
    node.slots().dashboard.get().unwrap().kill();
    until("it answers again", || async {
        let answer = try_request(page, "GET", "/healthz", &[("Host", "localhost")], "").await;
        answer.is_ok_and(|answer| answer.status == 200)
    })
    .await;
    node.stop().await;
}
