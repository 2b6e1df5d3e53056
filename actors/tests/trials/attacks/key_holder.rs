//! A holder of the cell's key without a certificate of the cell.

use std::net::SocketAddr;
use std::sync::Arc;

use ecod::leadership::election::{Body, LifeSign, MAX_TERM};
use ecod::wire::Role;
use futures_util::future::try_join_all;
use tokio::net::UdpSocket;

use crate::attacks::cell::Target;
use crate::attacks::insider::Insider;
use crate::attacks::row::{Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "a status with the largest term",
        means: Means::CellKey,
        on_brokers: false,
        deeds: (10, "frames"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(largest_term(target)),
    },
    Row {
        attack: "claims to lead, by another CA's certificate and priority 255",
        means: Means::CellKey,
        on_brokers: false,
        deeds: (10, "frames"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(claims(target)),
    },
    Row {
        attack: "frames with the largest counter, as of the nodes themselves",
        means: Means::CellKey,
        on_brokers: false,
        deeds: (10, "frames"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(largest_counter(target)),
    },
];

/// The member name of the attacker.
pub(crate) const NAME: &str = "mallory";

async fn largest_term(target: Target) -> anyhow::Result<()> {
    let insider = Insider::join(&target, NAME, Role::Cav, None).await?;
    tokio::try_join!(
        insider.repeat(
            MAX_TERM,
            None,
            Body::Status {
                over: None,
                no_login: Vec::new()
            }
        ),
        insider.knock()
    )
    .map(drop)
}

async fn claims(target: Target) -> anyhow::Result<()> {
    let insider =
        Insider::join(&target, NAME, Role::Edge, Some(Arc::clone(&target.foreign))).await?;
    let beat = Body::Beat {
        every_ms: 50,
        round: 1,
        followers: 9,
        after: None,
        successors: Vec::new(),
        life: LifeSign::default(),
    };
    tokio::try_join!(
        insider.repeat(1 << 20, Some(insider.epoch(1 << 20)), beat),
        insider.knock()
    )
    .map(drop)
}

/// Largest datagram, and the places of kind and counter in a frame.
const MAX_DATAGRAM_BYTES: usize = 2048;
const KIND: usize = 3;
const COUNTER: std::ops::Range<usize> = 24..32;

/// Kinds of frames within a session: gossip and payloads.
const SEALED_KINDS: [u8; 2] = [3, 4];

/// Greets through sockets that see the answers: their heads name the nodes' sessions.
async fn largest_counter(target: Target) -> anyhow::Result<()> {
    let mut taps = Vec::new();
    for node in &target.gossip {
        taps.push((UdpSocket::bind((target.from, 0)).await?, *node));
    }
    let gossip = taps
        .iter()
        .map(|(socket, _)| socket.local_addr())
        .collect::<Result<_, _>>()?;
    let through = Target {
        gossip,
        deeds: Arc::default(),
        ..target.clone()
    };
    let greet = async {
        let insider = Insider::join(
            &through,
            NAME,
            Role::Edge,
            Some(Arc::clone(&target.foreign)),
        )
        .await?;
        insider.knock().await
    };
    let inject = try_join_all(
        taps.iter()
            .map(|(socket, node)| tap(socket, *node, &target)),
    );
    tokio::try_join!(greet, inject).map(drop)
}

/// Passes datagrams on between the greeter and a node, and sends the node's to all others with the largest counter.
async fn tap(socket: &UdpSocket, node: SocketAddr, target: &Target) -> anyhow::Result<()> {
    let mut frame = [0; MAX_DATAGRAM_BYTES];
    let mut greeter = None;
    loop {
        let (length, from) = socket.recv_from(&mut frame).await?;
        if from != node {
            greeter = Some(from);
            socket.send_to(&frame[..length], node).await?;
            continue;
        }
        if let Some(greeter) = greeter {
            socket.send_to(&frame[..length], greeter).await?;
        }
        frame[COUNTER].fill(u8::MAX);
        for kind in SEALED_KINDS {
            frame[KIND] = kind;
            for other in target.gossip.iter().filter(|other| **other != node) {
                socket.send_to(&frame[..length], *other).await?;
                target.did(1);
            }
        }
    }
}
