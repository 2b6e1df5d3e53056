//! The owner of a vehicle's certificate, which may report and read everything, but not lead.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use ecod::leadership::election::Body;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::transport::pki::Credentials;
use futures_util::future::{join_all, try_join_all};
use futures_util::{SinkExt, StreamExt};
use rustls::ClientConfig;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::sleep;
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::client_async;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

use crate::attacks::cell::{CELL, LEADER, NODES, Target, VEHICLE, VEHICLES};
use crate::attacks::client::{log_in, log_in_as, publish, secure, send_for_ever, subscribe};
use crate::attacks::insider::Insider;
use crate::attacks::row::{Bar, Means, Row, UNHARMED};
use crate::packets::{packet, text};

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "three of five followers say that they cannot log in at the leader's broker",
        means: Means::Vehicle,
        on_brokers: false,
        deeds: (100, "messages"),
        // These attacks may change the leader, but must not cost a map.
        bar: Bar {
            is_replaced: None,
            ..UNHARMED
        },
        quick: false,
        run: |target| Box::pin(no_login(target, &[LEADER])),
    },
    Row {
        attack: "the same of all candidates",
        means: Means::Vehicle,
        on_brokers: false,
        deeds: (100, "messages"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(no_login(target, &[LEADER, NODES[1].0])),
    },
    Row {
        attack: "30 connections flood with 255 kB",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (20_000_000, "bytes"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(flood(target, 0)),
    },
    Row {
        attack: "30 readers of everything read nothing, beside a flood",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (20_000_000, "bytes"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(flood(target, 30)),
    },
    Row {
        attack: "packets that never end",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (1_000_000, "bytes"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(unfinished_packets(target)),
    },
    Row {
        attack: "retained messages asked for again and again",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (500_000, "bytes"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(repeated_subscriptions(target)),
    },
    Row {
        attack: "sessions left behind with full queues",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (5, "sessions"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(abandoned_sessions(target)),
    },
    Row {
        attack: "filters of 15,000 levels",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (5, "packets"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(deep_filters(target)),
    },
    Row {
        attack: "client ids and topics of others",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (5, "refusals"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(claims(target)),
    },
    Row {
        attack: "30 WebSockets flood with empty frames",
        means: Means::Vehicle,
        on_brokers: true,
        deeds: (20_000_000, "bytes"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(websockets(target)),
    },
];

/// Clients of one certificate, fewer than the broker takes.
const CONNECTIONS: usize = 30;

fn detections(node: &str) -> String {
    format!("ecod/v1/{CELL}/detections/{node}")
}

fn report() -> Vec<u8> {
    publish(&detections(VEHICLE), &vec![b'x'; 255_000])
}

/// Every connection sends as much as possible; some connections also subscribe to everything without reading.
async fn flood(target: Target, readers: usize) -> anyhow::Result<()> {
    let reading = [subscribe("#"), report()];
    let connection = |index| {
        let opening = if index < readers {
            &reading[0][..]
        } else {
            &[]
        };
        send_for_ever(&target, &target.vehicle, VEHICLE, opening, &reading[1])
    };
    join_all((0..CONNECTIONS).map(connection)).await;
    Ok(())
}

/// Every connection sends all but the last byte of the largest packet that it may begin.
async fn unfinished_packets(target: Target) -> anyhow::Result<()> {
    let packet = publish(&detections(VEHICLE), &vec![b'x'; 8 * 1024 * 1024]);
    let send = |_| async {
        loop {
            if let Ok(mut stream) = log_in(&target, &target.vehicle, VEHICLE).await {
                let mut parts = packet[..packet.len() - 1].chunks(64 * 1024);
                while let Some(part) = parts.next()
                    && stream.write_all(part).await.is_ok()
                {
                    target.did(part.len());
                }
                // Until the broker ends it.
                stream.read_u8().await.ok();
            }
            sleep(Duration::from_millis(100)).await;
        }
    };
    join_all((0..CONNECTIONS).map(send)).await;
    Ok(())
}

/// Fills the places for retained statuses, and subscribes to all of them as often as one packet can.
async fn repeated_subscriptions(target: Target) -> anyhow::Result<()> {
    let mut stream = log_in(&target, &target.vehicle, VEHICLE).await?;
    for observer in 0..64 {
        let topic = format!("ecod/v1/{CELL}/nodes/{VEHICLE}--{observer}");
        stream
            .write_all(&packet(0x31, &[&text(&topic), &vec![b'x'; 16 * 1024]]))
            .await?;
    }
    let filter = [&text("ecod/v1/+/nodes/#")[..], &[0]].concat();
    // As many as the broker takes, and more than that.
    let packets = [(64 * 1024 - 2) / filter.len(), 10_000]
        .map(|filters| packet(0x82, &[&[0, 1], &filter.repeat(filters)]));
    let packets = &packets;
    let target = &target;
    let ask = |number: usize| async move {
        let packet = &packets[number % 2];
        loop {
            if let Ok(mut stream) = log_in(target, &target.vehicle, VEHICLE).await {
                while stream.write_all(packet).await.is_ok() {
                    target.did(packet.len());
                }
            }
            sleep(Duration::from_millis(100)).await;
        }
    };
    join_all((0..CONNECTIONS).map(ask)).await;
    Ok(())
}

/// Leaves sessions behind that are to be kept, one after the other, while reports come.
async fn abandoned_sessions(target: Target) -> anyhow::Result<()> {
    let leave = async {
        loop {
            match leave_session(&target, &target.vehicle).await {
                Ok(()) => target.did(1),
                Err(_) => sleep(Duration::from_millis(100)).await,
            }
        }
    };
    tokio::join!(
        flood(
            Target {
                deeds: Arc::default(),
                ..target.clone()
            },
            0
        ),
        leave
    )
    .0
}

async fn leave_session(target: &Target, tls: &Arc<ClientConfig>) -> anyhow::Result<()> {
    let mut stream = secure(target, tls).await?;
    let id = format!("{VEHICLE}-{}", uuid::Uuid::now_v7().simple());
    // Not a clean session.
    stream
        .write_all(&packet(0x10, &[b"\0\x04MQTT\x04\x00\0\0", &text(&id)]))
        .await?;
    stream
        .write_all(&packet(0x82, &[&[0, 1], &text("#"), &[1]]))
        .await?;
    sleep(Duration::from_millis(50)).await;
    Ok(stream.shutdown().await?)
}

async fn deep_filters(target: Target) -> anyhow::Result<()> {
    let filter = vec!["a"; 15_000].join("/");
    loop {
        if let Ok(mut stream) = log_in(&target, &target.vehicle, VEHICLE).await {
            for packet in [subscribe(&filter), publish(&filter, b"payload")] {
                target.did(usize::from(stream.write_all(&packet).await.is_ok()));
            }
        }
        sleep(Duration::from_millis(100)).await;
    }
}

/// Takes the names of honest nodes, and publishes in them.
async fn claims(target: Target) -> anyhow::Result<()> {
    loop {
        let run = uuid::Uuid::now_v7().simple().to_string();
        for name in ["edge", "v01", "v02"] {
            match log_in_as(&target, &target.vehicle, &format!("{name}-{run}")).await {
                Ok(_) => anyhow::bail!("logged in as {name}"),
                Err(error) => target.did(usize::from(error.to_string().contains("login"))),
            }
        }
        if let Ok(mut stream) = log_in(&target, &target.vehicle, VEHICLE).await {
            for topic in [
                "detections/v01",
                "nodes/v01",
                "global_detections",
                "reputations",
                "ledger/v01",
            ] {
                stream
                    .write_all(&publish(&format!("ecod/v1/{CELL}/{topic}"), b"{}"))
                    .await
                    .ok();
            }
        }
        sleep(Duration::from_millis(50)).await;
    }
}

/// Pings of the greatest length over WebSockets, and a ping of MQTT now and then.
async fn websockets(target: Target) -> anyhow::Result<()> {
    // No bit is changed by a mask of zeros.
    let ping = [&[0x89, 0x80 | 125, 0, 0, 0, 0][..], &[b'x'; 125]].concat();
    let frames = [ping.repeat(60), vec![0x82, 0x82, 0, 0, 0, 0, 0xc0, 0]].concat();
    let send = |_| async {
        loop {
            if let Ok(mut stream) = log_in_by_websocket(&target).await {
                while stream.write_all(&frames).await.is_ok() {
                    target.did(frames.len());
                }
            }
            sleep(Duration::from_millis(100)).await;
        }
    };
    join_all((0..CONNECTIONS).map(send)).await;
    Ok(())
}

async fn log_in_by_websocket(target: &Target) -> anyhow::Result<TlsStream<TcpStream>> {
    let mut request = "wss://broker.ecod.internal/".into_client_request()?;
    request
        .headers_mut()
        .insert("sec-websocket-protocol", "mqtt".parse()?);
    let (mut socket, _) = client_async(request, secure(target, &target.vehicle).await?).await?;
    let id = format!("{VEHICLE}-{}", uuid::Uuid::now_v7().simple());
    let login = packet(0x10, &[b"\0\x04MQTT\x04\x02\0\0", &text(&id)]);
    socket.send(Message::binary(login)).await?;
    let answer = socket.next().await.context("no answer to the login")??;
    anyhow::ensure!(
        answer.into_data()[..] == [0x20, 2, 0, 0],
        "the login was refused"
    );
    Ok(socket.into_inner())
}

/// Vehicles follow the leader, and report that its broker, or other brokers, cannot be reached.
async fn no_login(target: Target, at: &'static [&'static str]) -> anyhow::Result<()> {
    let say = |(name, credentials): (&'static str, &Arc<Credentials>)| {
        let target = target.clone();
        let credentials = Arc::clone(credentials);
        async move {
            let insider = Insider::join(&target, name, Role::Cav, Some(credentials)).await?;
            let no_login = at.iter().copied().map(NodeName::from_static).collect();
            let followed = Epoch::new(1, NodeName::from_static(LEADER));
            insider
                .repeat(
                    1,
                    Some(followed),
                    Body::Status {
                        over: None,
                        no_login,
                    },
                )
                .await
        }
    };
    try_join_all(VEHICLES.into_iter().zip(&target.vehicles).map(say))
        .await
        .map(drop)
}
