//! Access to the membership for the fuzz targets. Only built for them.

use std::collections::VecDeque;
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;

use super::config::MembershipConfig;
use super::frame::{
    FrameHeader, FrameKind, Greeting, HEADER_BYTES, Handshake, Hello, Introduction, NameClaim,
    Version,
};
use super::handshake::{Attestation, Identity, Prover, Side, SignedMessage, Transcript};
use super::key::{BROADCAST, CellKey, Cookie, SessionId, session_of};
use super::machine::{GossipMachine, GossipOutput, GossipSetup};
use super::node_id::NodeId;
use super::sessions::{decode, decode_first, encode};
use super::test_authority::TestAuthority;

/// Start time, in microseconds since 1970.
const START: u64 = 1_700_000_000_000_000;

const OWN: &str = "own";
const PEER: &str = "peer";
/// 64 hexadecimal digits, which need no stretching.
const KEY: &str = "0101010101010101010101010101010101010101010101010101010101010101";

/// Certificates of both nodes, made once.
static IDENTITIES: LazyLock<[Identity; 2]> = LazyLock::new(|| {
    let mut authority = TestAuthority::new();
    [OWN, PEER].map(|name| authority.identity(name, Role::Auto))
});

/// Changes of single bytes: place, modulo the length, and bits to turn over.
pub type Edits = Vec<(u16, u8)>;

/// A node that receives frames with arbitrary content from a peer.
pub struct Listener {
    own: GossipMachine,
    key: CellKey,
    version: Version,
    sessions: [SessionId; 2],
    now: Timestamp,
    /// Number of the peer's frames that were forged, in addition to the frames that it sent itself.
    forged: u64,
    /// The peer's certificate and key, in a cell with certificates.
    prover: Option<Prover>,
    /// The last cookie that the node sent the peer in a challenge.
    challenge: Option<Cookie>,
    /// The node's last proof to the peer: its cookie, and the transcript that an accept is bound
    /// to.
    proof: Option<(Cookie, Transcript)>,
}

/// Cookie of the peer's challenges. The peer accepts any answer.
const PEER_COOKIE: Cookie = [8; 16];

impl Listener {
    /// A node and its peer, after their handshake, in a cell with certificates or without.
    pub fn member_up(proves: bool) -> Self {
        let mut listener = Self::alone(proves);
        let mut peer = machine(PEER, 1, proves, listener.now);
        let Self { own, now, .. } = &mut listener;
        let mut under_way = VecDeque::new();
        for _ in 0..100 {
            for (index, machine) in [&mut *own, &mut peer].into_iter().enumerate() {
                if machine
                    .next_deadline()
                    .is_some_and(|deadline| deadline <= *now)
                {
                    machine.tick(*now);
                }
                while let Some(output) = machine.poll() {
                    match output {
                        GossipOutput::Send { frame, .. } | GossipOutput::Multicast { frame } => {
                            under_way.push_back((index, frame))
                        }
                        GossipOutput::Event(_) | GossipOutput::Renewal { .. } => (),
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

    /// A node that has not received any other node yet.
    pub fn alone(proves: bool) -> Self {
        let now = Timestamp(START);
        let own = machine(OWN, 2, proves, now);
        let sessions = [(OWN, [2; 16]), (PEER, [1; 16])].map(|(node, nonce)| {
            if proves {
                session_of(&name(node), &nonce)
            } else {
                nonce
            }
        });
        let version = if proves {
            Version::Certificate
        } else {
            Version::Key
        };
        let prover = proves.then(|| Prover::new(IDENTITIES[1].clone(), [1; 16]));
        let forged = 1 << 16;
        Self {
            own,
            key: key(),
            version,
            sessions,
            now,
            forged,
            prover,
            challenge: None,
            proof: None,
        }
    }

    /// Processes a datagram from the peer's address.
    pub fn receive(&mut self, frame: &[u8]) {
        self.own.receive(frame, address(1), self.now);
        self.settle();
    }

    /// Processes a body sealed by the cell's key in the peer's session, or as a frame of a cell
    /// with the other version.
    pub fn receive_sealed(&mut self, kind: u8, body: &[u8]) {
        let [own, peer] = self.sessions;
        let (kind, to, version) = match kind % 5 {
            0 => (FrameKind::Hello, BROADCAST, self.version),
            1 => (FrameKind::Handshake, own, self.version),
            2 => (FrameKind::Gossip, own, self.version),
            3 => (FrameKind::Payload, own, self.version),
            _ => (FrameKind::Hello, BROADCAST, Version::Key),
        };
        self.forged += 1;
        let head = FrameHeader {
            version,
            kind,
            sender: peer,
            counter: self.forged,
        };
        let frame = head.write(self.key.tag(), body, &self.key.seal(&peer, &to));
        self.receive(&frame);
    }

    /// Processes a greeting of the peer, which the node answers with a challenge unless it has a
    /// session with the peer.
    pub fn receive_greeting(&mut self, wants_session: bool) {
        let mut body = encode(&Hello { name: name(PEER) });
        if self.prover.is_some() {
            body.extend(encode(&Greeting { wants_session }));
        }
        self.receive_sealed(0, &body);
    }

    /// Processes a challenge of the peer, which the node answers with its proof.
    pub fn receive_challenge(&mut self, edits: &Edits) {
        let challenge = encode(&Handshake::Challenge {
            cookie: PEER_COOKIE,
            name: name(PEER),
        });
        self.receive_sealed(1, &edited(challenge, edits));
    }

    /// Processes the peer's proof with the node's last cookie. The peer signs the edited message;
    /// then the attestation is edited.
    pub fn receive_proof(&mut self, message: &Edits, attestation: &Edits) {
        let Some(echo) = self.challenge else { return };
        let proof = Handshake::Proof {
            echo,
            cookie: PEER_COOKIE,
            introduction: introduction(),
        };
        self.receive_signed(
            Side::Prover,
            OWN.as_bytes(),
            edited(encode(&proof), message),
            attestation,
        );
    }

    /// Processes the peer's accept of the node's last proof, in the same way.
    pub fn receive_accept(&mut self, message: &Edits, attestation: &Edits) {
        let Some((echo, proof)) = self.proof else {
            return;
        };
        let accept = Handshake::Accept {
            echo,
            introduction: introduction(),
        };
        self.receive_signed(
            Side::Accepter,
            &proof,
            edited(encode(&accept), message),
            attestation,
        );
    }

    fn receive_signed(&mut self, side: Side, context: &[u8], mut message: Vec<u8>, edits: &Edits) {
        let [own, peer] = self.sessions;
        // The frame that comes next.
        let counter = self.forged + 1;
        let head = FrameHeader {
            version: self.version,
            kind: FrameKind::Handshake,
            sender: peer,
            counter,
        };
        if let Some(prover) = &self.prover {
            let head = head.bytes(self.key.tag());
            let signed = SignedMessage {
                side,
                head,
                receiver: own,
                context,
                message: &message,
            };
            let ephemeral = prover.draw_ephemeral().map(|(_, public)| public);
            let Some((attestation, _)) =
                ephemeral.and_then(|public| prover.attest(&signed, public))
            else {
                return;
            };
            message.extend(edited(encode(&attestation), edits));
        }
        self.receive_sealed(1, &message);
    }

    /// Advances the clock by `ms` milliseconds and runs the timers that are due.
    pub fn wait(&mut self, ms: u64) {
        self.now = self.now + Duration::from_millis(ms);
        self.own.tick(self.now);
        self.settle();
    }

    /// Asserts that a node of a cell with certificates has only its peer as a member, after any
    /// received frames.
    pub fn assert_nobody_else(&self) {
        let strangers = self
            .own
            .members()
            .into_iter()
            .filter(|member| member.name.as_str() != PEER);
        assert!(self.version == Version::Key || strangers.count() == 0);
    }

    fn settle(&mut self) {
        while let Some(output) = self.own.poll() {
            if let GossipOutput::Send { frame, .. } = output {
                self.record_handshake(&frame);
            }
        }
    }

    /// Stores the data from the node's handshakes with the peer that the peer needs for its next
    /// step.
    fn record_handshake(&mut self, frame: &[u8]) -> Option<()> {
        let [own, peer] = self.sessions;
        let head = FrameHeader::read(frame, self.key.tag()).ok()?;
        let (open, sealed) = frame.split_at_checked(HEADER_BYTES)?;
        let body = self
            .key
            .seal(&own, &peer)
            .open(head.counter, open, sealed)?;
        let (message, rest) = decode_first::<Handshake>(&body).ok()?;
        match message {
            Handshake::Challenge { cookie, .. } => self.challenge = Some(cookie),
            Handshake::Proof { cookie, .. } if self.prover.is_some() => {
                let attestation = decode::<Attestation>(rest).ok()?;
                let head = head.bytes(self.key.tag());
                let side = Side::Prover;
                let message = body.get(..body.len() - rest.len())?;
                let signed = SignedMessage {
                    side,
                    head,
                    receiver: peer,
                    context: PEER.as_bytes(),
                    message,
                };
                self.proof = Some((cookie, signed.transcript(&attestation)));
            }
            Handshake::Proof { cookie, .. } => self.proof = Some((cookie, Transcript::default())),
            Handshake::Accept { .. } => {}
        }
        Some(())
    }
}

fn edited(mut bytes: Vec<u8>, edits: &Edits) -> Vec<u8> {
    let length = bytes.len();
    for (place, bits) in edits {
        bytes[usize::from(*place) % length] ^= bits;
    }
    bytes
}

/// The introduction of the peer.
fn introduction() -> Introduction {
    Introduction {
        id: node_id(PEER, Timestamp(START)),
        seen_at: address(0),
        claim: NameClaim::Free,
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
    let setup = GossipSetup {
        own: node_id(node, now),
        cell: name("lot-1"),
        key: key(),
        session: [nonce; 16],
        identity,
        secret: [7; 32],
        seed: 3,
        counters: Arc::default(),
    };
    GossipMachine::new(setup, &MembershipConfig::default(), now)
}

fn node_id(node: &'static str, now: Timestamp) -> NodeId {
    NodeId {
        name: name(node),
        run: now.micros(),
        life: now.micros(),
        role: Role::Auto,
        gossip: SocketAddr::from((Ipv4Addr::UNSPECIFIED, 17_884)),
        broker: None,
    }
}

fn address(index: usize) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::new(10, 0, 0, 1 + index as u8), 17_884))
}
