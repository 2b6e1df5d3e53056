//! Browsers that behave badly cost the cell nothing.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use ecod::wire::Role;
use ecod_actors::counters::Event;
use ecod_actors::node::NodeHandle;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::cell::{Vehicles, config, start, until};
use crate::http::{Events, get};

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

/// Far more than a round's period, far less than what a cell that waits for its browsers would take.
const MOST: Duration = Duration::from_secs(2);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn browsers_that_never_read_are_left_behind() {
    let (node, page) = start(config("edge", Role::Edge, 600)).await;
    let _vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 600);
    until("the node is ready", || async { get(page, "/readyz").await.status == 200 }).await;
    let mut deaf = Vec::new();
    for _ in 0..8 {
        let mut stream = TcpStream::connect(page).await.unwrap();
        stream.write_all(b"GET /api/events HTTP/1.1\r\nHost: localhost\r\n\r\n").await.unwrap();
        deaf.push(stream);
    }
    let viewers = || async { get(page, "/metrics").await.body.lines().any(|line| line == "ecod_dashboard_viewers 8") };
    until("they are there", viewers).await;
    let (gap, ()) = longest_gap(&node, async {
        let mut reader = Events::open(page).await;
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(3) {
            reader.next().await;
        }
        let alone =
            || async { get(page, "/metrics").await.body.lines().any(|line| line == "ecod_dashboard_viewers 1") };
        until("those that do not read are cut off", alone).await;
        reader.next().await;
    })
    .await;
    println!("longest time between two maps beside 8 browsers that never read: {gap:?}");
    assert!(gap < MOST, "{gap:?}");
    node.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_thousand_messages_from_a_browser_are_slowed_down_and_counted() {
    let (node, page) = start(config("edge", Role::Edge, 20)).await;
    let _vehicles = Vehicles::start(&[node.broker_address().unwrap()], 4, 20);
    until("the node is ready", || async { get(page, "/readyz").await.status == 200 }).await;
    let (gap, answers) = longest_gap(&node, async {
        let floods = (0..4).map(|_| tokio::spawn(flood(page, 2500)));
        let mut answers = 0;
        for task in floods.collect::<Vec<_>>() {
            answers += task.await.unwrap();
        }
        answers
    })
    .await;
    println!("longest time between two maps beside 10,000 requests: {gap:?}");
    assert_eq!(answers, 10_000);
    assert!(gap < MOST, "{gap:?}");
    assert!(node.counters().events(Event::BrowserThrottled) > 1000);
    assert_eq!(get(page, "/healthz").await.status, 200, "health is told all the same");
    until("pages are served again", || async { get(page, "/").await.status == 200 }).await;
    node.stop().await;
}

/// Sends all requests at once on one connection and counts the answers.
async fn flood(page: SocketAddr, requests: usize) -> usize {
    let stream = TcpStream::connect(page).await.unwrap();
    let (mut read, mut write) = stream.into_split();
    let writing = tokio::spawn(async move {
        for _ in 1..requests {
            write.write_all(b"GET /api/picture HTTP/1.1\r\nHost: localhost\r\n\r\n").await.unwrap();
        }
        write.write_all(b"GET /api/picture HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").await.unwrap();
        write
    });
    let mut bytes = Vec::new();
    read.read_to_end(&mut bytes).await.unwrap();
    writing.await.unwrap();
    String::from_utf8_lossy(&bytes).matches("HTTP/1.1 ").count()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn connections_beyond_the_most_are_closed_and_those_that_are_open_go_on() {
    let mut config = config("euclid", Role::Auto, 1);
    config.dashboard.max_connections = 4;
    let (node, page) = start(config).await;
    let mut first = TcpStream::connect(page).await.unwrap();
    let mut others = Vec::new();
    for _ in 0..10 {
        others.push(TcpStream::connect(page).await.unwrap());
    }
    until("some are refused", || async { node.counters().events(Event::BrowserRefused) == 7 }).await;
    first.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").await.unwrap();
    let mut text = String::new();
    first.read_to_string(&mut text).await.unwrap();
    assert!(text.starts_with("HTTP/1.1 200"), "{text}");
    drop(others);
    node.stop().await;
}
