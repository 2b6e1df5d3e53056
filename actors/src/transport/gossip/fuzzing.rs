//! Access to the membership for the fuzz targets. Only built for them.

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;

use super::config::MembershipConfig;
use super::frame::{FrameHeader, FrameKind, Version};
use super::handshake::Identity;
use super::key::{BROADCAST, CellKey, SessionId, session_of};
use super::machine::{GossipMachine, GossipOutput, GossipSetup};
use super::node_id::NodeId;
use super::trial_authority::TrialAuthority;

const OWN: &str = "own";
const PEER: &str = "peer";
/// 64 hexadecimal digits, which need no stretching.
const KEY: &str = "0101010101010101010101010101010101010101010101010101010101010101";

/// Certificates of both nodes, made once.
static IDENTITIES: LazyLock<[Identity; 2]> = LazyLock::new(|| {
    let mut authority = TrialAuthority::new();
    [OWN, PEER].map(|name| authority.identity(name, Role::Auto))
});

/// A node that hears a peer, whose frames can say anything.
pub struct Listener {
    own: GossipMachine,
    key: CellKey,
    version: Version,
    sessions: [SessionId; 2],
    now: Timestamp,
    /// Frames of the peer that were forged; beyond those that it sent itself.
    forged: u64,
}

impl Listener {
    /// A node and its peer, after their handshake, in a cell with certificates or without.
    pub fn meet(proves: bool) -> Self {
        let mut listener = Self::alone(proves);
        let mut peer = machine(PEER, 1, proves, listener.now);
        let Self { own, now, .. } = &mut listener;
        let mut under_way = VecDeque::new();
        for _ in 0..100 {
            for (index, machine) in [&mut *own, &mut peer].into_iter().enumerate() {
                if machine.next_deadline().is_some_and(|deadline| deadline <= *now) {
                    machine.tick(*now);
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
            *now = *now + Duration::from_millis(10);
            for (from, frame) in under_way.drain(..) {
                let to = if from == 0 { &mut peer } else { &mut *own };
                to.receive(&frame, address(from), *now);
            }
            if !own.members().is_empty() && !peer.members().is_empty() {
                break;
            }
        }
        assert!(!own.members().is_empty(), "the nodes have met");
        listener
    }

    /// A node that has met nobody yet.
    pub fn alone(proves: bool) -> Self {
        let now = Timestamp(1_700_000_000_000_000);
        let own = machine(OWN, 2, proves, now);
        let sessions = [(OWN, [2; 16]), (PEER, [1; 16])]
            .map(|(node, nonce)| if proves { session_of(&name(node), &nonce) } else { nonce });
        let version = if proves { Version::Certificate } else { Version::Key };
        Self { own, key: key(), version, sessions, now, forged: 1 << 16 }
    }

    /// Processes a datagram from the peer's address.
    pub fn hear(&mut self, frame: &[u8]) {
        self.own.receive(frame, address(1), self.now);
        self.settle();
    }

    /// Processes a body sealed by the cell's key in the peer's session, or as a frame of a cell of the other kind.
    pub fn hear_sealed(&mut self, kind: u8, body: &[u8]) {
        let [own, peer] = self.sessions;
        let (kind, to, version) = match kind % 5 {
            0 => (FrameKind::Hello, BROADCAST, self.version),
            1 => (FrameKind::Handshake, own, self.version),
            2 => (FrameKind::Gossip, own, self.version),
            3 => (FrameKind::Payload, own, self.version),
            _ => (FrameKind::Hello, BROADCAST, Version::Key),
        };
        self.forged += 1;
        let head = FrameHeader { version, kind, sender: peer, counter: self.forged };
        let frame = head.write(self.key.tag(), body, &self.key.seal(&peer, &to));
        self.hear(&frame);
    }

    /// Lets time pass.
    pub fn wait(&mut self, ms: u64) {
        self.now = self.now + Duration::from_millis(ms);
        self.own.tick(self.now);
        self.settle();
    }

    /// Asserts that a node of a cell with certificates knows its peer only, whatever it heard.
    pub fn assert_nobody_else(&self) {
        let strangers = self.own.members().into_iter().filter(|member| member.name.as_str() != PEER);
        assert!(self.version == Version::Key || strangers.count() == 0);
    }

    fn settle(&mut self) {
        while self.own.poll().is_some() {}
    }
}

fn name(text: &'static str) -> NodeName {
    NodeName::from_static(text)
}

fn key() -> CellKey {
    CellKey::new(KEY, &name("lot-1"))
}

fn machine(node: &'static str, nonce: u8, proves: bool, now: Timestamp) -> GossipMachine {
    let identity = proves.then(|| IDENTITIES[usize::from(node == PEER)].clone());
    let own = NodeId {
        name: name(node),
        run: now.micros(),
        life: now.micros(),
        role: Role::Auto,
        gossip: SocketAddr::from((Ipv4Addr::UNSPECIFIED, 17_884)),
        broker: None,
    };
    let setup = GossipSetup {
        own,
        key: key(),
        session: [nonce; 16],
        identity,
        secret: [7; 32],
        seed: 3,
        counters: Arc::default(),
    };
    GossipMachine::new(setup, &MembershipConfig::default(), now)
}

fn address(index: usize) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::new(10, 0, 0, 1 + index as u8), 17_884))
}
