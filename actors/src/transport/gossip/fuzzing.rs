//! Access to the membership for the fuzz targets. Only built for them.

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;

use super::config::MembershipConfig;
use super::frame::{FrameHeader, FrameKind};
use super::key::{BROADCAST, CellKey, SessionId};
use super::machine::{GossipMachine, GossipOutput, GossipSetup};
use super::node_id::NodeId;

const OWN: SessionId = [2; 16];
const PEERS: SessionId = [1; 16];
/// 64 hexadecimal digits, which need no stretching.
const KEY: &str = "0101010101010101010101010101010101010101010101010101010101010101";

/// A node that has met a peer, whose frames can then say anything.
pub struct Listener {
    own: GossipMachine,
    key: CellKey,
    now: Timestamp,
    /// Frames of the peer that were forged; beyond those that it sent itself.
    forged: u64,
}

impl Listener {
    /// A node and its peer, after their handshake.
    pub fn meet() -> Self {
        let mut now = Timestamp(1_700_000_000_000_000);
        let (mut own, mut peer) = (machine("own", OWN, now), machine("peer", PEERS, now));
        let mut under_way = VecDeque::new();
        for _ in 0..100 {
            for (index, machine) in [&mut own, &mut peer].into_iter().enumerate() {
                if machine.next_deadline().is_some_and(|deadline| deadline <= now) {
                    machine.tick(now);
                }
                while let Some(output) = machine.poll() {
                    match output {
                        GossipOutput::Send { frame, .. } | GossipOutput::Multicast { frame } => {
                            under_way.push_back((index, frame))
                        }
                        GossipOutput::Tell(_) => (),
                    }
                }
            }
            now = now + Duration::from_millis(10);
            for (from, frame) in under_way.drain(..) {
                let to = if from == 0 { &mut peer } else { &mut own };
                to.receive(&frame, address(from), now);
            }
            if !own.members().is_empty() && !peer.members().is_empty() {
                break;
            }
        }
        assert!(!own.members().is_empty(), "the nodes have met");
        Self { own, key: key(), now, forged: 1 << 32 }
    }

    /// Processes a datagram from the peer's address.
    pub fn hear(&mut self, frame: &[u8]) {
        self.own.receive(frame, address(1), self.now);
        self.settle();
    }

    /// Processes a body sealed by the peer.
    pub fn hear_sealed(&mut self, kind: u8, body: &[u8]) {
        let (kind, to) = match kind % 4 {
            0 => (FrameKind::Hello, BROADCAST),
            1 => (FrameKind::Handshake, OWN),
            2 => (FrameKind::Gossip, OWN),
            _ => (FrameKind::Payload, OWN),
        };
        self.forged += 1;
        let head = FrameHeader { kind, sender: PEERS, counter: self.forged };
        let frame = head.write(self.key.tag(), body, &self.key.seal(&PEERS, &to));
        self.hear(&frame);
    }

    /// Lets time pass.
    pub fn wait(&mut self, ms: u64) {
        self.now = self.now + Duration::from_millis(ms);
        self.own.tick(self.now);
        self.settle();
    }

    fn settle(&mut self) {
        while self.own.poll().is_some() {}
    }
}

fn key() -> CellKey {
    CellKey::new(KEY, &NodeName::from_static("lot-1"))
}

fn machine(name: &'static str, session: SessionId, now: Timestamp) -> GossipMachine {
    let own = NodeId {
        name: NodeName::from_static(name),
        run: now.micros(),
        life: now.micros(),
        role: Role::Auto,
        gossip: SocketAddr::from((Ipv4Addr::UNSPECIFIED, 17_884)),
        broker: None,
    };
    let setup = GossipSetup { own, key: key(), session, secret: [7; 32], seed: 3, counters: Arc::default() };
    GossipMachine::new(setup, &MembershipConfig::default(), now)
}

fn address(index: usize) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::new(10, 0, 0, 1 + index as u8), 17_884))
}
