//! A stranger on the network, who reaches the cell's ports and holds no secret.

use std::collections::VecDeque;
use std::time::Duration;

use rand::RngExt as _;
use tokio::net::UdpSocket;
use tokio::time::interval;

use crate::attacks::cell::Target;
use crate::attacks::client::knock;
use crate::attacks::row::{Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "connections by the hundred",
        means: Means::Stranger,
        on_brokers: true,
        deeds: (300, "connections"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(connections(target)),
    },
    Row {
        attack: "datagrams by the thousand",
        means: Means::Stranger,
        on_brokers: false,
        deeds: (50_000, "datagrams"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(datagrams(target)),
    },
];

/// Bytes of a datagram: as many as an Ethernet frame takes.
const DATAGRAM_BYTES: usize = 1400;

/// Opens 500 connections a second and holds the latest thousand.
async fn connections(target: Target) -> anyhow::Result<()> {
    let mut held = VecDeque::new();
    let mut ticks = interval(Duration::from_millis(2));
    loop {
        ticks.tick().await;
        held.extend(knock(&target).await.inspect(|_| target.did(1)));
        if held.len() > 1000 {
            held.pop_front();
        }
    }
}

/// Sends each node 4,000 datagrams a second, which begin as frames of every kind do.
async fn datagrams(target: Target) -> anyhow::Result<()> {
    let socket = UdpSocket::bind((target.from, 0)).await?;
    let mut datagram = [0; DATAGRAM_BYTES];
    let mut ticks = interval(Duration::from_millis(1));
    loop {
        ticks.tick().await;
        rand::rng().fill(&mut datagram[..]);
        for kind in 1..=4 {
            datagram[..4].copy_from_slice(&[0xec, 0x0d, 2, kind]);
            for node in &target.gossip {
                target.did(usize::from(socket.send_to(&datagram, node).await.is_ok()));
            }
        }
    }
}
