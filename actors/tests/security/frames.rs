//! Datagrams between nodes, recorded and sent again by an attacker on the path.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use bytes::Bytes;
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::transport::gossip::{FrameEvent, MembershipEvent};
use ecod_testkit::{Member, member_config, until};
use tokio::net::UdpSocket;
use tokio::time::sleep;

use crate::fixture::node;

async fn start(name: &str, seed: Option<SocketAddr>) -> Member {
    Member::start(name, member_config(seed.as_slice()), |_| ()).await
}

/// The first byte of each payload that a node has received.
fn received_by(node: &Member) -> Vec<u8> {
    let events = node.events.lock().unwrap();
    let payloads = events.iter().filter_map(|event| match event {
        MembershipEvent::Received { payload, .. } => Some(payload[0]),
        _ => None,
    });
    payloads.collect()
}

/// Relays between two nodes and sends every datagram for the first node three times; the second node has only the
/// relay's address.
async fn repeat(towards: SocketAddr, relay: UdpSocket) {
    let behind = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    let mut there = [0; 2048];
    let mut back = [0; 2048];
    let mut client = None;
    loop {
        tokio::select! {
            Ok((length, from)) = relay.recv_from(&mut there) => {
                client = Some(from);
                for _ in 0..3 {
                    behind.send_to(&there[..length], towards).await.unwrap();
                }
            }
            Ok((length, _)) = behind.recv_from(&mut back) => {
                if let Some(client) = client {
                    relay.send_to(&back[..length], client).await.unwrap();
                }
            }
        }
    }
}

#[tokio::test]
async fn repeated_frame_is_accepted_once() {
    let relay = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    let between = relay.local_addr().unwrap();
    let edge = start("edge", None).await;
    let repeating = tokio::spawn(repeat(edge.address, relay));
    let euclid = start("euclid", Some(between)).await;
    until("both nodes are members", || {
        !edge.members.borrow().is_empty() && !euclid.members.borrow().is_empty()
    })
    .await;
    for n in 0..20u8 {
        let payload = Bytes::copy_from_slice(&[n]);
        euclid
            .actor
            .cast(MembershipMessage::Send {
                to: node("edge"),
                payload,
            })
            .unwrap();
        sleep(Duration::from_millis(5)).await;
    }
    until("all arrive", || received_by(&edge).len() >= 20).await;
    until("repetitions are counted", || {
        edge.counters.get(FrameEvent::Replayed) >= 20
    })
    .await;
    sleep(Duration::from_millis(200)).await;
    let taken = received_by(&edge);
    assert_eq!(taken, (0..20).collect::<Vec<_>>(), "each once, in order");
    assert!(
        !edge.members.borrow().is_empty(),
        "the two still know each other"
    );
    repeating.abort();
    euclid.actor.stop(None);
    edge.actor.stop(None);
}
