//! Membership actors on loopback, with real sockets.

use std::collections::BTreeSet;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::ops::Deref;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use ecod::diagnostics::TroubleKind;
use ecod::model::names::NodeName;
use ecod_actors::messages::membership::MembershipMessage;
use ecod_actors::platform::secret::Secret;
use ecod_actors::transport::gossip::{
    FrameEvent, Member as Seen, MembershipConfig, MembershipEvent, MulticastConfig,
};
use ecod_testkit::{Member, member_config};
use tokio::net::UdpSocket;
use tokio::time::{sleep, timeout};

/// Long enough for a loaded machine.
const SOON: Duration = Duration::from_secs(20);
/// The broker address that every node states.
const BROKER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::UNSPECIFIED), 1883);

/// A node's membership, as seen by its tests.
struct Node(Member);

/// A node on a free port of loopback, with a key, without multicast.
fn config(seeds: &[SocketAddr]) -> MembershipConfig {
    MembershipConfig {
        // Patient, as the machine that runs this may be busy.
        probe_ms: 200,
        reply_ms: 80,
        suspect_ms: 600,
        ..member_config(seeds)
    }
}

impl Deref for Node {
    type Target = Member;

    fn deref(&self) -> &Member {
        &self.0
    }
}

impl Node {
    async fn start(name: &str, config: MembershipConfig) -> Self {
        Self(Member::start(name, config, |arguments| arguments.broker = Some(BROKER)).await)
    }

    async fn sees(&mut self, names: &[&str]) {
        let wanted: BTreeSet<_> = names.iter().copied().collect();
        let complete = |members: &Vec<Seen>| {
            members
                .iter()
                .map(|member| member.name.as_str())
                .collect::<BTreeSet<_>>()
                == wanted
        };
        let seen = timeout(SOON, self.0.members.wait_for(complete))
            .await
            .map(|_| ());
        assert!(
            seen.is_ok(),
            "{} sees {:?}, not {names:?}",
            self.name,
            self.members.borrow()
        );
    }

    async fn counts(&self, event: FrameEvent, at_least: u64) {
        let counted = async {
            while self.counters.get(event) < at_least {
                sleep(Duration::from_millis(5)).await;
            }
        };
        assert!(
            timeout(SOON, counted).await.is_ok(),
            "{:?}",
            self.counters.snapshot()
        );
    }

    fn events(&self) -> Vec<MembershipEvent> {
        self.events.lock().unwrap().clone()
    }

    /// Events but for suspicions, which a busy machine brings about and takes back.
    fn changes(&self) -> Vec<MembershipEvent> {
        let is_change =
            |event: &MembershipEvent| !matches!(event, MembershipEvent::Suspected { .. });
        self.events().into_iter().filter(is_change).collect()
    }
}

async fn all_see_each_other(nodes: &mut [Node]) {
    let names: Vec<_> = nodes.iter().map(|node| node.name.clone()).collect();
    for node in nodes {
        let others: Vec<_> = names
            .iter()
            .filter(|name| **name != node.name)
            .map(NodeName::as_str)
            .collect();
        node.sees(&others).await;
    }
}

async fn five() -> Vec<Node> {
    let mut nodes = vec![Node::start("node-1", config(&[])).await];
    let seed = nodes[0].address;
    for name in ["node-2", "node-3", "node-4", "node-5"] {
        nodes.push(Node::start(name, config(&[seed])).await);
    }
    all_see_each_other(&mut nodes).await;
    nodes
}

#[tokio::test]
async fn stopped_membership_frees_its_address() {
    let node = Node::start("euclid", config(&[])).await;
    node.actor.stop_and_wait(None, Some(SOON)).await.unwrap();
    std::net::UdpSocket::bind(node.address).unwrap();
}

#[tokio::test]
async fn five_nodes_notice_death() {
    let mut nodes = five().await;
    let dead = nodes.remove(2);
    dead.actor.kill();
    all_see_each_other(&mut nodes).await;
    for node in &nodes {
        assert!(node.events().contains(&MembershipEvent::Down {
            name: dead.name.clone()
        }));
    }
    let back = Node::start("node-3", config(&[nodes[0].address])).await;
    nodes.push(back);
    all_see_each_other(&mut nodes).await;
}

#[tokio::test]
async fn datagrams_reach_other_nodes() {
    let mut nodes = five().await;
    let payload = Bytes::from_static(b"who leads?");
    let reached = |members: &Vec<Seen>| {
        let member = members
            .iter()
            .find(|member| member.name.as_str() == "node-2");
        member.and_then(|member| member.broker) == Some(SocketAddr::from(([127, 0, 0, 1], 1883)))
    };
    assert!(
        timeout(SOON, nodes[4].0.members.wait_for(reached))
            .await
            .is_ok()
    );
    let received = |event: &MembershipEvent| match event {
        MembershipEvent::Received {
            from,
            payload: received,
            ..
        } => from.as_str() == "node-2" && *received == payload,
        _ => false,
    };
    let arrived = async {
        // A message that waits for a session too long is lost.
        while !nodes[4].events().iter().any(received) {
            let to = nodes[4].name.clone();
            nodes[1]
                .actor
                .cast(MembershipMessage::Send {
                    to,
                    payload: payload.clone(),
                })
                .unwrap();
            sleep(Duration::from_millis(50)).await;
        }
    };
    assert!(timeout(SOON, arrived).await.is_ok());
    assert!(!nodes[3].events().iter().any(received));
}

#[tokio::test]
async fn multicast_connects_nodes() {
    let probe = std::net::UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
    let port = probe.local_addr().unwrap().port();
    drop(probe);
    let multicast = MulticastConfig {
        port,
        interface: Some(Ipv4Addr::LOCALHOST),
        ..MulticastConfig::default()
    };
    let carried = loopback_has_multicast(&multicast).await;
    assert!(
        carried,
        "loopback carries no multicast on this machine: `ip link set lo multicast on`"
    );
    let config = || MembershipConfig {
        multicast: multicast.clone(),
        ..config(&[])
    };
    let mut nodes = Vec::new();
    for name in ["node-1", "node-2", "node-3"] {
        nodes.push(Node::start(name, config()).await);
    }
    all_see_each_other(&mut nodes).await;
}

async fn loopback_has_multicast(config: &MulticastConfig) -> bool {
    let exchange = async {
        let receiver = UdpSocket::bind((config.group, config.port)).await?;
        receiver.join_multicast_v4(config.group, Ipv4Addr::LOCALHOST)?;
        let sender = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await?;
        socket2::SockRef::from(&sender).set_multicast_if_v4(&Ipv4Addr::LOCALHOST)?;
        sender.send_to(b"?", (config.group, config.port)).await?;
        let mut buffer = [0; 8];
        timeout(Duration::from_secs(2), receiver.recv_from(&mut buffer))
            .await
            .map_err(std::io::Error::other)??;
        Ok::<_, std::io::Error>(())
    };
    exchange.await.is_ok()
}

#[tokio::test]
async fn other_key_is_ignored() {
    let first = Node::start("node-1", config(&[])).await;
    let wrong = MembershipConfig {
        key: Some(Secret::new("another passphrase")),
        ..config(&[first.address])
    };
    let second = Node::start("node-2", wrong).await;
    first.counts(FrameEvent::BadSeal, 2).await;
    let kinds = |node: &Node| -> Vec<_> {
        let kind = |event| {
            if let MembershipEvent::Troubled { kind, .. } = event {
                Some(kind)
            } else {
                None
            }
        };
        node.events().into_iter().map(kind).collect()
    };
    for node in [first, second] {
        assert!(
            kinds(&node)
                .iter()
                .all(|kind| *kind == Some(TroubleKind::WrongKey)),
            "{:?}",
            node.events()
        );
    }
}

#[tokio::test]
async fn garbage_is_counted_and_ignored() {
    let mut nodes = five().await;
    let before = nodes[0].changes();
    let stranger = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
    for n in 0..2000_usize {
        let junk: Vec<u8> = (0..n % 1500).map(|at| (at * n) as u8).collect();
        stranger.send_to(&junk, nodes[0].address).await.unwrap();
        if n % 50 == 0 {
            sleep(Duration::from_millis(1)).await;
        }
    }
    nodes[0].counts(FrameEvent::Malformed, 500).await;
    nodes[0].counts(FrameEvent::Oversized, 50).await;
    all_see_each_other(&mut nodes).await;
    assert_eq!(nodes[0].changes(), before);
}

/// Two nodes that see each other only through a recorder, whose recording is then played back to both and to a third.
#[tokio::test]
async fn recorded_frames_change_nothing() {
    let mut first = Node::start("node-1", config(&[])).await;
    let recorder = Arc::new(UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap());
    let mut second = Node::start("node-2", config(&[recorder.local_addr().unwrap()])).await;
    let recording = Arc::<Mutex<Vec<Vec<u8>>>>::default();
    let one = first.address;
    let two = second.address;
    let relay = Arc::clone(&recorder);
    let tape = Arc::clone(&recording);
    let relaying = tokio::spawn(async move {
        let mut buffer = [0; 2048];
        loop {
            let (length, from) = relay.recv_from(&mut buffer).await.unwrap();
            tape.lock().unwrap().push(buffer[..length].to_vec());
            relay
                .send_to(&buffer[..length], if from == one { two } else { one })
                .await
                .unwrap();
        }
    });
    first.sees(&["node-2"]).await;
    second.sees(&["node-1"]).await;
    let third = Node::start("node-3", config(&[])).await;
    let taken = recording.lock().unwrap().clone();
    assert!(taken.len() >= 6, "{} frames recorded", taken.len());
    let changes = (first.changes(), second.changes());
    for frame in &taken {
        for to in [one, two, third.address] {
            recorder.send_to(frame, to).await.unwrap();
        }
    }
    third.counts(FrameEvent::BadSeal, 2).await;
    first.counts(FrameEvent::Replayed, 2).await;
    second.counts(FrameEvent::Replayed, 2).await;
    sleep(Duration::from_millis(500)).await;
    assert_eq!((first.changes(), second.changes()), changes);
    assert!(third.events().is_empty());
    relaying.abort();
}
