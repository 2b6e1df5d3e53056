//! Bytes that one certificate sends, holds back or leaves unread affect only its owner, and honest clients are not
//! limited.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::wire::{Role, Topics};
use ecod_actors::telemetry::counters::{Counters, Event, ShedReason};
use ecod_actors::transport::broker::{AccessPolicy, BrokerConfig, EmbeddedBroker, MqttBroker};
use ecod_actors::transport::pki::{BROKER_NAME, TlsConfig};
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, interval, sleep, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

use crate::fixture::{Cell, DAY, MAX_REPORT, SOON, client_config, knock, node};
use crate::packets::{packet, text};

/// A client of a new certificate that has logged in, byte by byte.
async fn log_in(cell: &mut Cell, name: &str, role: Role, flags: u8) -> TlsStream<TcpStream> {
    let files = cell.pki.issue(name, role, DAY);
    let id = format!("{name}-{}", uuid::Uuid::now_v7().simple());
    log_in_as(cell, name, &files, &id, flags).await
}

async fn log_in_as(
    cell: &Cell,
    name: &str,
    files: &TlsConfig,
    id: &str,
    flags: u8,
) -> TlsStream<TcpStream> {
    let server = ServerName::try_from(BROKER_NAME).unwrap();
    let connector = TlsConnector::from(client_config(name, files));
    let mut stream = connector
        .connect(server, knock(cell.address).await)
        .await
        .unwrap();
    greet(&mut stream, id, flags).await;
    stream
}

async fn greet(stream: &mut (impl AsyncRead + AsyncWrite + Unpin), id: &str, flags: u8) {
    stream
        .write_all(&packet(
            0x10,
            &[b"\0\x04MQTT\x04", &[flags, 0, 0], &text(id)],
        ))
        .await
        .unwrap();
    let mut answer = [0; 4];
    timeout(SOON, stream.read_exact(&mut answer))
        .await
        .expect("no answer")
        .unwrap();
    assert_eq!(answer, [0x20, 2, 0, 0]);
}

const CLEAN: u8 = 0x02;

/// The fixture's subscriber to everything, which reads only on request.
const IDLE: &str = "edge";

async fn subscribe(
    stream: &mut (impl AsyncRead + AsyncWrite + Unpin),
    filter: &str,
    qos: u8,
) -> u8 {
    stream
        .write_all(&packet(0x82, &[&[0, 1], &text(filter), &[qos]]))
        .await
        .unwrap();
    let mut answer = [0; 5];
    timeout(SOON, stream.read_exact(&mut answer))
        .await
        .expect("no answer")
        .unwrap();
    assert_eq!(answer[0], 0x90);
    answer[4]
}

fn report(node: &str, bytes: usize) -> Vec<u8> {
    packet(
        0x30,
        &[
            &text(&format!("ecod/v1/lot/detections/{node}")),
            &vec![b'x'; bytes],
        ],
    )
}

fn shed(counters: &Counters, reason: ShedReason, source: &str) -> u64 {
    let shed = counters.all_shed();
    shed.iter()
        .filter(|shed| shed.reason == reason && shed.source == source)
        .map(|shed| shed.times)
        .sum()
}

/// Reads packets until so many PUBLISHes have come; the result is their bytes.
async fn read_messages(stream: &mut (impl AsyncRead + Unpin), count: usize) -> usize {
    let mut received = 0;
    let mut bytes = 0;
    while received < count {
        let first = stream.read_u8().await.unwrap();
        let mut length = 0;
        for shift in [0, 7, 14, 21] {
            let byte = stream.read_u8().await.unwrap();
            length |= usize::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                break;
            }
        }
        stream.read_exact(&mut vec![0; length]).await.unwrap();
        if first & 0xf0 == 0x30 {
            received += 1;
            bytes += length;
        }
    }
    bytes
}

/// A vehicle, and a node that waits for its reports.
struct Honest {
    vehicle: TlsStream<TcpStream>,
    leader: TlsStream<TcpStream>,
}

impl Honest {
    async fn start(cell: &mut Cell) -> Self {
        let vehicle = log_in(cell, "v01", Role::Cav, CLEAN).await;
        let mut leader = log_in(cell, "v02", Role::Auto, CLEAN).await;
        assert_eq!(
            subscribe(&mut leader, "ecod/v1/lot/detections/v01", 0).await,
            0
        );
        Self { vehicle, leader }
    }

    /// Time from a report to its receiver.
    async fn report(&mut self) -> Duration {
        let begun = Instant::now();
        self.vehicle.write_all(&report("v01", 2000)).await.unwrap();
        timeout(SOON, read_messages(&mut self.leader, 1))
            .await
            .expect("no message arrived");
        begun.elapsed()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_readers_lose_only_theirs() {
    let mut cell = Cell::start_with(|config| config.max_clients_each = 32).await;
    let mut readers = Vec::new();
    for _ in 0..30 {
        let mut reader = log_in(&mut cell, "mallory", Role::Cav, CLEAN).await;
        assert_eq!(subscribe(&mut reader, "#", 0).await, 0);
        readers.push(reader);
    }
    let mut honest = Honest::start(&mut cell).await;
    let mut gauss = log_in(&mut cell, "gauss", Role::Cav, CLEAN).await;
    let flood = tokio::spawn(async move {
        let report = report("gauss", MAX_REPORT);
        while gauss.write_all(&report).await.is_ok() {}
    });
    let until = Instant::now() + SOON;
    while cell.counters.events(Event::ClientStalled) == 0
        || shed(&cell.counters, ShedReason::ReaderSlow, "mallory") < 1000
    {
        assert!(Instant::now() < until, "{:?}", cell.counters.all_shed());
        let took = honest.report().await;
        assert!(took < Duration::from_secs(2), "a report took {took:?}");
        sleep(Duration::from_millis(20)).await;
    }
    assert!(
        !flood.is_finished(),
        "the flood comes from another, who only waits"
    );
    flood.abort();
    assert_eq!(shed(&cell.counters, ShedReason::ReaderSlow, "v02"), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn certificate_sends_only_its_share() {
    const TIME: Duration = Duration::from_secs(6);
    let mut cell = Cell::start_with(|config| config.max_clients_each = 32).await;
    let mut honest = Honest::start(&mut cell).await;
    let mut watcher = log_in(&mut cell, "edge", Role::Edge, CLEAN).await;
    subscribe(&mut watcher, "ecod/v1/lot/detections/gauss", 0).await;
    let watcher = tokio::spawn(async move {
        let started = Instant::now();
        let mut bytes = 0;
        while started.elapsed() < TIME {
            bytes += timeout(SOON, read_messages(&mut watcher, 1))
                .await
                .expect("the flood ended");
        }
        bytes
    });
    let mut floods = JoinSet::new();
    for _ in 0..8 {
        let mut gauss = log_in(&mut cell, "gauss", Role::Cav, CLEAN).await;
        floods.spawn(async move {
            let report = report("gauss", MAX_REPORT);
            while gauss.write_all(&report).await.is_ok() {}
        });
    }
    let mut slowest = Duration::ZERO;
    while !watcher.is_finished() {
        slowest = slowest.max(honest.report().await);
        sleep(Duration::from_millis(100)).await;
    }
    let mib = watcher.await.unwrap() >> 20;
    // 2 MiB a second after a burst of 1 MiB.
    assert!((5..=15).contains(&mib), "{mib} MiB in {TIME:?}");
    assert!(
        slowest < Duration::from_secs(2),
        "a report took {slowest:?}"
    );
}

#[tokio::test]
async fn subscriptions_of_certificate_count_together() {
    let mut cell = Cell::start().await;
    let mut first = log_in(&mut cell, "gauss", Role::Cav, CLEAN).await;
    for n in 0..200 {
        assert_eq!(
            subscribe(&mut first, &format!("ecod/v1/lot/nodes/{n}"), 0).await,
            0
        );
    }
    let mut second = log_in(&mut cell, "gauss", Role::Cav, CLEAN).await;
    for n in 0..56 {
        assert_eq!(
            subscribe(&mut second, &format!("ecod/v1/lot/nodes/{n}"), 0).await,
            0
        );
    }
    assert_eq!(subscribe(&mut second, "one/more", 0).await, 0x80);
    drop(first);
    let room = async {
        while subscribe(&mut second, "one/more", 0).await != 0 {
            sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(SOON, room).await.expect("who leaves makes room");
    cell.honest_traffic_goes_on().await;
}

/// Messages are granted without acknowledgement only, and sessions end with their connections, so the broker keeps no
/// message for later.
#[tokio::test]
async fn absent_readers_have_no_queue() {
    let mut cell = Cell::start().await;
    let mut honest = Honest::start(&mut cell).await;
    let files = cell.pki.issue("gauss", Role::Cav, DAY);
    let id = "gauss-0123456789abcdef0123456789abcdef";
    for _ in 0..2 {
        // Not a clean session.
        let mut gauss = log_in_as(&cell, "gauss", &files, id, 0).await;
        assert_eq!(
            subscribe(&mut gauss, "ecod/v1/lot/detections/v01", 1).await,
            0,
            "another quality than requested"
        );
        gauss.shutdown().await.unwrap();
        drop(gauss);
        for _ in 0..10 {
            honest.report().await;
        }
    }
    let mut gauss = log_in_as(&cell, "gauss", &files, id, 0).await;
    let kept = timeout(Duration::from_millis(500), read_messages(&mut gauss, 1)).await;
    assert!(kept.is_err(), "a message was kept");
}

/// The cell of 200 vehicles that report 2 kB ten times a second.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_hundred_vehicles_lose_nothing() {
    const VEHICLES: usize = 200;
    const REPORTS: usize = 20;
    let mut cell = Cell::start_with(|config| {
        config.connect_burst = 1000;
        config.handshake_timeout_ms = 10_000;
    })
    .await;
    let mut reader = log_in(&mut cell, "gauss", Role::Auto, CLEAN).await;
    subscribe(&mut reader, "ecod/v1/lot/detections/+", 0).await;
    let reader = tokio::spawn(async move { read_messages(&mut reader, VEHICLES * REPORTS).await });
    let mut vehicles = JoinSet::new();
    for n in 0..VEHICLES {
        let name = format!("v{n}");
        let mut vehicle = log_in(&mut cell, &name, Role::Cav, CLEAN).await;
        vehicles.spawn(async move {
            let report = report(&name, 2000);
            let mut ticks = interval(Duration::from_millis(100));
            for _ in 0..REPORTS {
                ticks.tick().await;
                vehicle.write_all(&report).await.unwrap();
            }
            vehicle
        });
    }
    let vehicles = vehicles.join_all().await;
    let bytes = timeout(SOON, reader)
        .await
        .expect("reports are missing")
        .unwrap();
    assert!(bytes > VEHICLES * REPORTS * 2000);
    // A client that is cut off is among them. The idle one is, where this takes long.
    let shed: Vec<_> = cell
        .counters
        .all_shed()
        .into_iter()
        .filter(|shed| shed.source != IDLE)
        .collect();
    assert_eq!(shed, []);
    drop(vehicles);
}

/// Maps of 100 kB ten times a second to 64 readers.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_maps_reach_all_readers() {
    const READERS: usize = 64;
    const MAPS: usize = 20;
    let adjust = |config: &mut BrokerConfig| {
        config.max_packet_bytes = None;
        config.connect_burst = 1000;
        config.handshake_timeout_ms = 10_000;
        config.max_clients_each = 64;
    };
    let mut cell = Cell::start_with(adjust).await;
    let mut readers = JoinSet::new();
    for n in 0..READERS {
        let mut reader = log_in(&mut cell, &format!("v{n}"), Role::Cav, CLEAN).await;
        subscribe(&mut reader, "ecod/v1/lot/global_detections", 0).await;
        readers.spawn(async move { read_messages(&mut reader, MAPS).await });
    }
    let mut leader = log_in(&mut cell, "edge", Role::Edge, CLEAN).await;
    let map = packet(
        0x30,
        &[&text("ecod/v1/lot/global_detections"), &vec![b'x'; 100_000]],
    );
    let mut ticks = interval(Duration::from_millis(100));
    for _ in 0..MAPS {
        ticks.tick().await;
        leader.write_all(&map).await.unwrap();
    }
    let received = timeout(SOON, readers.join_all())
        .await
        .expect("maps are missing");
    assert!(received.iter().all(|bytes| *bytes > MAPS * 100_000));
    assert_eq!(cell.counters.events(Event::ClientStalled), 0);
    assert_eq!(cell.counters.all_shed(), []);
}

/// A broker for its own machine, which cannot distinguish clients.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn uncertified_slow_readers_lose_theirs() {
    let counters = Arc::<Counters>::default();
    let policy = AccessPolicy {
        credentials: None,
        topics: Topics::new(&node("lot")),
        limits: Default::default(),
        elected: Arc::new(|_| true),
        counters: Arc::clone(&counters),
    };
    let mut broker = EmbeddedBroker::protected(BrokerConfig::default(), policy);
    let address = broker
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let connect = async |id: &str| {
        let mut stream = TcpStream::connect(address).await.unwrap();
        greet(&mut stream, id, CLEAN).await;
        stream
    };
    let mut readers = Vec::new();
    for n in 0..20 {
        let mut reader = connect(&format!("reader-{n}")).await;
        subscribe(&mut reader, "flood", 0).await;
        readers.push(reader);
    }
    let mut leader = connect("leader").await;
    let mut vehicle = connect("v01").await;
    subscribe(&mut leader, "ecod/v1/lot/detections/v01", 0).await;
    let flood = tokio::spawn(async move {
        let message = packet(0x30, &[&text("flood"), &[b'x'; 200_000]]);
        // The broker may end a flood; this one comes back.
        loop {
            let mut mallory = TcpStream::connect(address).await.unwrap();
            greet(&mut mallory, "mallory", CLEAN).await;
            while mallory.write_all(&message).await.is_ok() {}
        }
    });
    let until = Instant::now() + SOON;
    while shed(&counters, ShedReason::ReaderSlow, "this machine") < 50 {
        assert!(Instant::now() < until, "{:?}", counters.all_shed());
        vehicle.write_all(&report("v01", 2000)).await.unwrap();
        timeout(SOON, read_messages(&mut leader, 1))
            .await
            .expect("no message arrived");
        sleep(Duration::from_millis(20)).await;
    }
    flood.abort();
}
