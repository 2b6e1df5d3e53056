//! Processor time and memory of a node with a page, by its own metrics.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use ecod::wire::Role;
use ecod_testkit::until_async as until;

use crate::cell::Vehicles;
use crate::http::{Events, get, try_request};
use crate::processes::{free_places, start};

const SPAN: Duration = Duration::from_secs(10);

/// Memory in bytes and processor time in seconds.
async fn usage(page: SocketAddr) -> [f64; 2] {
    let metrics = get(page, "/metrics").await.body;
    ["process_resident_memory_bytes", "process_cpu_seconds_total"].map(|name| {
        let line = metrics
            .lines()
            .find(|line| line.starts_with(&format!("{name} ")))
            .unwrap();
        line.rsplit_once(' ').unwrap().1.parse().unwrap()
    })
}

/// An edge without camera that receives 32 reports of each kind ten times a second, without a browser and with one
/// browser. Only the figures of an optimised build are useful.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a measurement: make test-dashboard"]
async fn cost_with_32_vehicles() {
    let directory = tempfile::tempdir().unwrap();
    let places = free_places::<1>();
    let [place] = places;
    let _edge = start("edge", Role::Edge, place, &places, directory.path());
    let _vehicles = Vehicles::start(&[place.broker], 32, 12);
    until("the edge is ready", || async {
        let answer = try_request(place.page, "GET", "/readyz", &[("Host", "localhost")], "").await;
        answer.is_ok_and(|answer| answer.status == 200)
    })
    .await;
    let first = Instant::now();
    Events::open(place.page).await.next().await;
    println!("first picture {:?} after the request", first.elapsed());
    tokio::time::sleep(Duration::from_secs(3)).await;
    for looked_at in [false, true] {
        let mut events = if looked_at {
            Some(Events::open(place.page).await)
        } else {
            None
        };
        let [_, before] = usage(place.page).await;
        let begun = Instant::now();
        while begun.elapsed() < SPAN {
            match &mut events {
                Some(events) => drop(events.next().await),
                None => tokio::time::sleep(SPAN).await,
            }
        }
        let [bytes, after] = usage(place.page).await;
        let percent = 100.0 * (after - before) / begun.elapsed().as_secs_f64();
        println!(
            "32 vehicles, looked at: {looked_at}: {:.1} MB resident, {percent:.1} % of a core",
            bytes / 1e6
        );
    }
}
