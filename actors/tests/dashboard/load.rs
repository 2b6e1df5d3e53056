//! Browsers that misbehave do not disturb the cell.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use ecod::wire::Role;
use ecod_actors::node::NodeHandle;
use ecod_actors::observe::dashboard::DashboardConfig;
use ecod_actors::platform::secret::Secret;
use ecod_actors::telemetry::counters::Event;
use ecod_testkit::until_async as until;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinSet;

use crate::cell::{Vehicles, config, start};
use crate::http::{Events, get, get_with};

/// Longest time between two maps of the node while something goes on.
async fn longest_gap<T>(node: &NodeHandle, during: impl Future<Output = T>) -> (Duration, T) {
    let mut maps = node.newest_map();
    let mut longest = Duration::ZERO;
    tokio::pin!(during);
    let mut last = Instant::now();
    loop {
        tokio::select! {
            biased;
            Ok(()) = maps.changed() => {
                longest = longest.max(last.elapsed());
                last = Instant::now();
            }
            done = &mut during => return (longest.max(last.elapsed()), done),
        }
    }
}

/// Far longer than a round's period, far shorter than the delay of a cell that waits for its browsers.
const MOST: Duration = Duration::from_secs(2);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn non_reading_browsers_are_dropped() {
    let (node, page) = start(config("edge", Role::Edge, 600)).await;
    let _vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 600);
    until("the node is ready", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    let mut deaf = Vec::new();
    for _ in 0..8 {
        let mut stream = TcpStream::connect(page).await.unwrap();
        stream
            .write_all(b"GET /api/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
            .await
            .unwrap();
        deaf.push(stream);
    }
    let viewers = || async {
        get(page, "/metrics")
            .await
            .body
            .lines()
            .any(|line| line == "ecod_dashboard_viewers 8")
    };
    until("they are there", viewers).await;
    let (gap, ()) = longest_gap(&node, async {
        let mut reader = Events::open(page).await;
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(3) {
            reader.next().await;
        }
        let alone = || async {
            get(page, "/metrics")
                .await
                .body
                .lines()
                .any(|line| line == "ecod_dashboard_viewers 1")
        };
        until("those that do not read are cut off", alone).await;
        reader.next().await;
    })
    .await;
    println!("longest time between two maps with 8 browsers that do not read: {gap:?}");
    assert!(gap < MOST, "{gap:?}");
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn browser_message_flood_is_limited() {
    let (node, page) = start(config("edge", Role::Edge, 20)).await;
    let _vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 20);
    until("the node is ready", || async {
        get(page, "/readyz").await.status == 200
    })
    .await;
    let (gap, ()) = longest_gap(&node, async {
        let mut floods: JoinSet<()> = (0..4).map(|_| flood(page, 2500)).collect();
        while let Some(flooded) = floods.join_next().await {
            flooded.unwrap();
        }
    })
    .await;
    println!("longest time between two maps with 10,000 requests: {gap:?}");
    assert!(gap < MOST, "{gap:?}");
    assert!(node.counters().events(Event::BrowserThrottled) > 1000);
    assert_eq!(
        get(page, "/healthz").await.status,
        200,
        "health is still answered"
    );
    until("pages are served again", || async {
        get(page, "/").await.status == 200
    })
    .await;
    node.stop().await;
}

/// Sends requests without a pause, each of which is answered.
async fn flood(page: SocketAddr, requests: usize) {
    for _ in 0..requests {
        assert!([200, 429].contains(&get(page, "/api/picture").await.status));
    }
}

/// Requests without the token do not take answers from requests with it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tokenless_flood_delays_no_user() {
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.token = Some(Secret::new("correct-horse-battery"));
    let (node, page) = start(config).await;
    let mut strangers = JoinSet::new();
    for _ in 0..4 {
        strangers.spawn(async move {
            loop {
                assert!([401, 429].contains(&get(page, "/metrics").await.status));
            }
        });
    }
    until("it is slowed down", || async {
        node.counters().events(Event::BrowserThrottled) > 100
    })
    .await;
    let known = [
        ("Host", "localhost"),
        ("Authorization", "Bearer correct-horse-battery"),
    ];
    for _ in 0..50 {
        assert_eq!(get_with(page, "/metrics", &known).await.status, 200);
    }
    strangers.shutdown().await;
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_connections_are_displaced() {
    let (node, page) = start(config("euclid", Role::Auto, 1)).await;
    let most = DashboardConfig::default().max_connections;
    let mut silent = Vec::new();
    for _ in 0..most + 10 {
        silent.push(TcpStream::connect(page).await.unwrap());
    }
    until("some gave way", || async {
        node.counters().events(Event::BrowserRefused) >= 10
    })
    .await;
    for path in ["/healthz", "/readyz", "/metrics", "/api/picture"] {
        assert!([200, 503].contains(&get(page, path).await.status), "{path}");
    }
    let begun = Instant::now();
    for mut stream in silent {
        assert_eq!(stream.read(&mut [0]).await.unwrap(), 0);
    }
    assert!(
        begun.elapsed() < Duration::from_secs(20),
        "{:?}",
        begun.elapsed()
    );
    node.stop().await;
}

/// A page receives live pictures and sends further requests now and then, on connections that browsers would keep.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pages_leave_room_for_scrapers() {
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.max_connections = 8;
    let (node, page) = start(config).await;
    let mut live = Vec::new();
    let mut kept = Vec::new();
    for _ in 0..4 {
        live.push(Events::open(page).await);
        live.last_mut().unwrap().next().await;
        let mut stream = TcpStream::connect(page).await.unwrap();
        stream
            .write_all(b"GET /api/history HTTP/1.1\r\nHost: localhost\r\n\r\n")
            .await
            .unwrap();
        assert!(stream.read(&mut [0; 64]).await.unwrap() > 0);
        kept.push(stream);
    }
    assert_eq!(
        get(page, "/api/events").await.status,
        503,
        "one page too many requests pictures"
    );
    let refused = node.counters().events(Event::BrowserRefused);
    for path in ["/metrics", "/healthz", "/api/picture"] {
        assert_eq!(get(page, path).await.status, 200, "{path}");
    }
    assert_eq!(node.counters().events(Event::BrowserRefused), refused);
    let mut silent = Vec::new();
    for _ in 0..20 {
        silent.push(TcpStream::connect(page).await.unwrap());
    }
    until("some gave way", || async {
        node.counters().events(Event::BrowserRefused) >= refused + 16
    })
    .await;
    for events in &mut live {
        events.next().await;
    }
    node.stop().await;
}
