//! Datagrams between nodes, recorded and sent again by somebody on the way.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use ecod::wire::Role;
use ecod_actors::actors::membership::{Membership, MembershipArguments};
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::clock;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::{
    FrameCounters, FrameEvent, MembershipConfig, MembershipEvent,
};
use ractor::{Actor, ActorRef, call_t};
use tokio::net::UdpSocket;
use tokio::sync::watch;
use tokio::time::{Instant, sleep};

use crate::fixture::{SOON, node};

struct Node {
    actor: ActorRef<MembershipMessage>,
    address: SocketAddr,
    payloads: Arc<Mutex<Vec<Bytes>>>,
    counters: Arc<FrameCounters>,
    members: watch::Receiver<Vec<ecod_actors::transport::gossip::Member>>,
}

async fn start(name: &str, seed: Option<SocketAddr>) -> Node {
    let mut config = MembershipConfig {
        key: Some(Secret::new("5e".repeat(32))),
        bind: Some(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))),
        seeds: seed.iter().map(ToString::to_string).collect(),
        ..MembershipConfig::default()
    };
    config.multicast.enabled = false;
    let (payloads, counters) = (
        Arc::<Mutex<Vec<Bytes>>>::default(),
        Arc::<FrameCounters>::default(),
    );
    let (sink, (sender, members)) = (Arc::clone(&payloads), watch::channel(Vec::new()));
    let arguments = MembershipArguments {
        name: node(name),
        cell: node("lot"),
        run: clock::now().micros(),
        role: Role::Auto,
        broker: None,
        credentials: None,
        config,
        events: Arc::new(move |event| {
            if let MembershipEvent::Received { payload, .. } = event {
                sink.lock().unwrap().push(payload);
            }
        }),
        members: sender,
        counters: Arc::clone(&counters),
    };
    let (actor, _) = Actor::spawn(None, Membership, arguments).await.unwrap();
    let address = call_t!(actor, |reply| MembershipMessage::Address { reply }, 5000).unwrap();
    Node {
        actor,
        address,
        payloads,
        counters,
        members,
    }
}

async fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let deadline = Instant::now() + SOON;
    while !holds() {
        assert!(Instant::now() < deadline, "{what}");
        sleep(Duration::from_millis(10)).await;
    }
}

/// Stands between two nodes and sends every datagram for the first three times; the second knows the first by its
/// address only.
async fn repeat(towards: SocketAddr, relay: UdpSocket) {
    let behind = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    let (mut there, mut back) = ([0; 2048], [0; 2048]);
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
async fn a_repeated_frame_is_taken_once_and_counted() {
    let relay = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    let between = relay.local_addr().unwrap();
    let edge = start("edge", None).await;
    let repeating = tokio::spawn(repeat(edge.address, relay));
    let euclid = start("euclid", Some(between)).await;
    until("they meet", || {
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
    until("all arrive", || edge.payloads.lock().unwrap().len() >= 20).await;
    until("repetitions are counted", || {
        edge.counters.get(FrameEvent::Replayed) >= 20
    })
    .await;
    sleep(Duration::from_millis(200)).await;
    let taken = edge
        .payloads
        .lock()
        .unwrap()
        .iter()
        .map(|payload| payload[0])
        .collect::<Vec<_>>();
    assert_eq!(taken, (0..20).collect::<Vec<_>>(), "each once, in order");
    assert!(
        !edge.members.borrow().is_empty(),
        "the two still know each other"
    );
    repeating.abort();
    euclid.actor.stop(None);
    edge.actor.stop(None);
}
