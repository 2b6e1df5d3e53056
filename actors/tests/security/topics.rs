//! Topics and filters that would take the broker's stack or memory.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use ecod_actors::telemetry::counters::Event;
use ecod_actors::transport::broker::{BrokerConfig, EmbeddedBroker, MqttBroker};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::fixture::{Cell, SOON, secure};
use crate::packets::{packet, text};

const CONNACK: [u8; 4] = [0x20, 2, 0, 0];
const CONNACK_NOT_AUTHORIZED: [u8; 4] = [0x20, 2, 0, 5];
const SUBACK_FAILURE: [u8; 5] = [0x90, 3, 0, 1, 0x80];
const UNSUBACK: [u8; 4] = [0xb0, 2, 0, 2];
const PUBACK: [u8; 4] = [0x40, 2, 0, 3];

fn login(will: Option<&str>) -> Vec<u8> {
    let will_topic = will.map(text).unwrap_or_default();
    let will_payload = will.map(|_| text("gone")).unwrap_or_default();
    // Clean session; with a will, that is to be retained.
    let flags = if will.is_some() { 0x26 } else { 0x02 };
    packet(
        0x10,
        &[
            b"\0\x04MQTT\x04",
            &[flags, 0, 60],
            &text(""),
            &will_topic,
            &will_payload,
        ],
    )
}

/// Sends a packet and asserts the answer.
async fn ask(stream: &mut (impl AsyncRead + AsyncWrite + Unpin), packet: &[u8], expected: &[u8]) {
    stream.write_all(packet).await.unwrap();
    let mut answer = vec![0; expected.len()];
    timeout(SOON, stream.read_exact(&mut answer))
        .await
        .expect("no answer")
        .expect("cut off");
    assert_eq!(answer, expected);
}

async fn subscribe(
    stream: &mut (impl AsyncRead + AsyncWrite + Unpin),
    filter: &str,
    expected: &[u8],
) {
    ask(
        stream,
        &packet(0x82, &[&[0, 1], &text(filter), &[0]]),
        expected,
    )
    .await;
}

fn too_deep(levels: usize) -> String {
    vec!["a"; levels].join("/")
}

#[tokio::test]
async fn oversized_topics_are_refused() {
    let mut cell = Cell::start().await;
    for topic in [too_deep(15_000), too_deep(40), "a".repeat(60_000)] {
        let mut stream = secure(&mut cell).await;
        ask(&mut stream, &login(None), &CONNACK).await;
        subscribe(&mut stream, &topic, &SUBACK_FAILURE).await;
        ask(
            &mut stream,
            &packet(0xa2, &[&[0, 2], &text(&topic)]),
            &UNSUBACK,
        )
        .await;
        ask(
            &mut stream,
            &packet(0x32, &[&text(&topic), &[0, 3], b"payload"]),
            &PUBACK,
        )
        .await;
        cell.honest_traffic_goes_on().await;
    }
    for will in [too_deep(7_000), too_deep(40), "a".repeat(15_000)] {
        let mut stream = secure(&mut cell).await;
        ask(&mut stream, &login(Some(&will)), &CONNACK_NOT_AUTHORIZED).await;
        cell.honest_traffic_goes_on().await;
    }
    assert_eq!(cell.counters.events(Event::ClientDenied), 3 * 3 + 3);
}

#[tokio::test]
async fn subscriptions_without_number_are_refused() {
    let mut cell = Cell::start().await;
    let mut stream = secure(&mut cell).await;
    ask(&mut stream, &login(None), &CONNACK).await;
    for n in 0..256 {
        subscribe(
            &mut stream,
            &format!("ecod/v1/lot/nodes/{n}"),
            &[0x90, 3, 0, 1, 0],
        )
        .await;
    }
    subscribe(&mut stream, "one/more", &SUBACK_FAILURE).await;
    cell.honest_traffic_goes_on().await;
}

/// The broker sends a client one copy of a message per filter that matches the topic.
#[tokio::test]
async fn overlapping_filters_have_limit() {
    let mut cell = Cell::start().await;
    let mut stream = secure(&mut cell).await;
    ask(&mut stream, &login(None), &CONNACK).await;
    let levels = ["ecod", "v1", "lot", "detections", "euclid"];
    let mut filters = Vec::new();
    for mask in 1..1 << levels.len() {
        let filter: Vec<_> = (0..levels.len())
            .map(|level| match mask >> level & 1 {
                1 => "+",
                _ => levels[level],
            })
            .collect();
        filters.extend(text(&filter.join("/")));
        filters.push(0);
    }
    let request = packet(0x82, &[&[0, 1], &filters]);
    ask(&mut stream, &request, &[0x90, 33, 0, 1]).await;
    let mut granted = [0; 31];
    stream.read_exact(&mut granted).await.unwrap();
    cell.honest_traffic_goes_on().await;
    let mut received = Vec::new();
    let mut chunk = [0; 4096];
    while let Ok(count) = timeout(Duration::from_millis(500), stream.read(&mut chunk)).await {
        received.extend_from_slice(&chunk[..count.unwrap()]);
    }
    let copies = received
        .windows(b"report 1".len())
        .filter(|window| window == b"report 1")
        .count();
    assert!((1..=9).contains(&copies), "{copies} copies of a report");
}

#[tokio::test]
async fn packet_with_many_filters_refused() {
    let mut cell = Cell::start_with(|config| config.max_packet_bytes = Some(1 << 20)).await;
    let mut stream = secure(&mut cell).await;
    ask(&mut stream, &login(None), &CONNACK).await;
    let filters = [&text("nodes/+")[..], &[0]].concat().repeat(7000);
    // The broker may cut it off before the last byte.
    stream
        .write_all(&packet(0x82, &[&[0, 1], &filters]))
        .await
        .ok();
    let ended = timeout(SOON, stream.read(&mut [0]))
        .await
        .expect("it is not cut off");
    assert!(matches!(ended, Ok(0) | Err(_)), "{ended:?}");
    cell.counted(Event::ClientMalformed, 1).await;
    cell.honest_traffic_goes_on().await;
}

/// The broker without a guard has no access check, and must survive all the same.
#[tokio::test]
async fn unguarded_broker_survives_endless_topics() {
    let mut broker = EmbeddedBroker::new(BrokerConfig::default());
    let address = broker
        .start(SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))
        .unwrap();
    let deep = too_deep(15_000);
    for will in [None, Some(deep.as_str())] {
        let mut stream = TcpStream::connect(address).await.unwrap();
        ask(&mut stream, &login(will), &CONNACK).await;
        subscribe(&mut stream, &deep, &SUBACK_FAILURE).await;
        // To be retained.
        ask(
            &mut stream,
            &packet(0x33, &[&text(&deep), &[0, 3], b"payload"]),
            &PUBACK,
        )
        .await;
    }
    let mut stream = TcpStream::connect(address).await.unwrap();
    ask(&mut stream, &login(None), &CONNACK).await;
    subscribe(&mut stream, "still/here", &[0x90, 3, 0, 1, 0]).await;
}
