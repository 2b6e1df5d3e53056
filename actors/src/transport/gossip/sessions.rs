//! Authenticated sessions with other nodes, and the handshake that establishes them. No clock, no
//! socket.
//!
//! A session is one run of a node's membership. Each pair of sessions has its own keys: a frame
//! that was recorded before a restart, or addressed to another node, does not decrypt. The sender's
//! counter does not repeat within a session, and the receiver accepts each value once. A node is
//! admitted only when it returns a cookie just issued to its address, so a recorded handshake
//! cannot admit a node.
//!
//! In a cell with certificates a node also proves its certificate in the handshake, and the
//! session's keys are derived from it. With the cell's key alone, an attacker can then only read
//! and forge handshakes that fail.

mod admission;
mod peers;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::diagnostics::TroubleKind;
use ecod::leadership::Rights;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::counters::{FrameCounters, FrameEvent};
use super::frame::{FrameHeader, FrameKind, Greeting, HEADER_BYTES, Hello, Introduction, Version};
use super::handshake::{Identity, Proven, Prover};
use super::key::{
    BROADCAST, CellKey, CookieFactory, FrameCipher, SessionId, SessionNonce, session_of,
};
use super::node_id::NodeId;
use super::notices::{GossipNotice, Notices};
use super::reply_throttle::ReplyThrottle;
use crate::platform::throttle::TokenBucket;
use peers::PeerTable;

/// All sessions of a node.
pub(crate) struct Sessions {
    key: CellKey,
    own: SessionId,
    cookies: CookieFactory,
    everybody: FrameCipher,
    /// Counter of the last frame sent to any node.
    counter: u64,
    peers: PeerTable,
    /// The proof of this node's certificate, in a cell with certificates.
    prover: Option<Prover>,
    /// Throttles of answers to greetings, of answers to challenges, of verifications, and of own
    /// greetings.
    challenges: ReplyThrottle,
    proofs: ReplyThrottle,
    verifications: ReplyThrottle,
    greetings: TokenBucket,
    cell: NodeName,
    notices: Notices,
    counters: Arc<FrameCounters>,
}

/// Arguments of [`Sessions::new`].
pub(crate) struct SessionsSetup<'a> {
    pub(crate) cell: NodeName,
    pub(crate) key: CellKey,
    /// The node's own name.
    pub(crate) name: &'a NodeName,
    /// The node's session itself in a cell without certificates.
    pub(crate) nonce: SessionNonce,
    /// The node's certificates, in a cell with certificates.
    pub(crate) identity: Option<Identity>,
    /// Secret from which cookies are derived.
    pub(crate) secret: &'a [u8; 32],
    pub(crate) max_peers: usize,
    pub(crate) counters: Arc<FrameCounters>,
}

/// State of a name in the gossip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct KnownMember {
    pub(crate) run: u64,
    pub(crate) life: u64,
    pub(crate) alive: bool,
}

/// Circumstances of a datagram's arrival.
pub(crate) struct Arrival<'a> {
    pub(crate) from: SocketAddr,
    pub(crate) now: Timestamp,
    pub(crate) own: &'a NodeId,
    /// True if this node has been greeting for about ten seconds and has not found another node.
    pub(crate) is_alone: bool,
    /// State of a name in this node's gossip.
    pub(crate) known: &'a dyn Fn(&NodeName) -> Option<KnownMember>,
}

/// Content of an authentic frame.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum FrameContent {
    /// A step of a handshake, with the answer to send.
    Answer(Vec<u8>),
    /// A node was admitted. The answer informs the node, unless it already has the session.
    Introduced {
        introduction: Introduction,
        answer: Option<Vec<u8>>,
        /// True if its session is accepted for its name.
        speaks: bool,
        /// True if its session was at another address before.
        has_moved: bool,
    },
    /// A message of the SWIM protocol.
    Gossip { from: NodeName, body: Vec<u8> },
    /// A datagram of the sender's other actors.
    Payload {
        from: NodeName,
        rights: Rights,
        body: Vec<u8>,
    },
    /// A message about a renewed certificate, with the certificate that the sender has proven.
    Renewal {
        from: NodeName,
        certificate: Arc<[u8]>,
        body: Vec<u8>,
    },
    /// A frame of a session that is not established, or not any more: greet its sender.
    Stranger,
    /// Two running nodes have this name.
    NameTaken(NodeName),
    /// A running node that has this node's name. The answer informs it; without an answer, it is
    /// the other node that states the conflict.
    Namesake { id: NodeId, answer: Option<Vec<u8>> },
    /// Content that needs no answer.
    Nothing,
}

impl Sessions {
    pub(crate) fn new(setup: SessionsSetup<'_>, now: Timestamp) -> Self {
        let SessionsSetup {
            cell,
            key,
            name,
            nonce,
            identity,
            secret,
            max_peers,
            counters,
        } = setup;
        let own = if identity.is_some() {
            session_of(name, &nonce)
        } else {
            nonce
        };
        Self {
            everybody: key.seal(&own, &BROADCAST),
            key,
            own,
            cookies: CookieFactory::new(secret),
            counter: 0,
            peers: PeerTable::new(max_peers),
            prover: identity.map(|identity| Prover::new(identity, nonce)),
            challenges: ReplyThrottle::new(now),
            proofs: ReplyThrottle::new(now),
            verifications: ReplyThrottle::new(now),
            greetings: TokenBucket::new(HELLO_BURST, HELLO_INTERVAL, now),
            cell,
            notices: Notices::default(),
            counters,
        }
    }

    /// True if sessions prove certificates.
    pub(crate) fn prove_certificates(&self) -> bool {
        self.prover.is_some()
    }

    /// A greeting frame for any node of the cell; with `wants_session` for a node that must prove
    /// itself again.
    pub(crate) fn hello(&mut self, own: &NodeId, wants_session: bool) -> Vec<u8> {
        let head = self.head(FrameKind::Hello);
        let mut body = encode(&Hello {
            name: own.name.clone(),
        });
        if self.prove_certificates() {
            body.extend(encode(&Greeting { wants_session }));
        }
        head.write(self.key.tag(), &body, &self.everybody)
    }

    /// A frame for the node of a name, and its address.
    pub(crate) fn seal(
        &mut self,
        to: &NodeName,
        kind: FrameKind,
        body: &[u8],
        now: Timestamp,
    ) -> Option<(SocketAddr, Vec<u8>)> {
        let head = self.head(kind);
        let peer = self.peers.speaker_mut(to)?;
        peer.unanswered_since.get_or_insert(now);
        Some((
            peer.address,
            head.write(self.key.tag(), body, peer.keys.to()?),
        ))
    }

    /// Address of a node that has not answered for a while and must be greeted for a new session.
    pub(crate) fn silent_address(&mut self, name: &NodeName, now: Timestamp) -> Option<SocketAddr> {
        let proves = self.prove_certificates();
        let peer = self.peers.speaker_mut(name).filter(|_| proves)?;
        let since = peer
            .unanswered_since
            .filter(|since| now.since(*since) >= ANSWER_TIMEOUT)?;
        peer.unanswered_since = Some(now.max(since));
        Some(peer.address)
    }

    /// Address of the node of a name.
    pub(crate) fn address(&self, name: &NodeName) -> Option<SocketAddr> {
        Some(self.peers.speaker(name)?.address)
    }

    /// Identity of a node according to itself, and the proof of its certificate; `None` in a cell
    /// without certificates.
    pub(crate) fn proven(&self, name: &NodeName) -> Option<(&NodeId, &Proven)> {
        let peer = self.peers.speaker(name)?;
        Some((&peer.id, peer.proven.as_ref()?))
    }

    /// True if a frame of the node was received a moment ago.
    pub(crate) fn has_received(&self, name: &NodeName, now: Timestamp) -> bool {
        self.peers
            .speaker(name)
            .is_some_and(|peer| now.since(peer.received_at) < RECENT_TIME)
    }

    /// Address of the node of a name, if a frame of it was received recently.
    pub(crate) fn recent_address(&self, name: &NodeName, now: Timestamp) -> Option<SocketAddr> {
        let peer = self.peers.speaker(name)?;
        (now.since(peer.received_at) < SESSION_IDLE_TIMEOUT).then_some(peer.address)
    }

    /// True if a single node may be greeted now.
    pub(crate) fn may_send_hello(&mut self, now: Timestamp) -> bool {
        let may_send = self.greetings.allow(now);
        if !may_send {
            self.counters.count(FrameEvent::Throttled);
        }
        may_send
    }

    /// Ends the session of an earlier run of a node; returns false without such a session. For a node
    /// that proves its certificate, only its own handshake can do so.
    pub(crate) fn end_earlier_run(&mut self, name: &NodeName, run: u64, now: Timestamp) -> bool {
        !self.prove_certificates() && self.peers.end_earlier_run(name, run, now)
    }

    /// Sets changed certificates and the time. Ends all sessions whose certificate has become
    /// invalid. Returns their nodes, and the addresses of nodes that must receive this node's new
    /// certificate.
    pub(crate) fn set_identity(&mut self, identity: Identity) -> (Vec<NodeName>, Vec<SocketAddr>) {
        let Some(prover) = &mut self.prover else {
            return Default::default();
        };
        let certificate = prover.certificate().to_vec();
        let has_changed = prover.set_identity(identity);
        let is_renewed = prover.certificate() != certificate;
        let expelled = self.peers.expel(|peer| {
            peer.proven.as_ref().is_none_or(|proven| {
                let expired = prover.has_expired(proven);
                expired
                    || has_changed
                        && prover
                            .verify(&peer.id.name, &proven.certificate, peer.address)
                            .is_none()
            })
        });
        expelled
            .iter()
            .for_each(|_| self.counters.count(FrameEvent::Expelled));
        let greeted = if is_renewed {
            self.peers.addresses()
        } else {
            Vec::new()
        };
        (expelled, greeted)
    }

    /// Addresses of all nodes.
    pub(crate) fn addresses(&self) -> Vec<SocketAddr> {
        self.peers.addresses()
    }

    /// Removes all sessions, as if other sessions had replaced them.
    #[cfg(test)]
    pub(crate) fn drop_all(&mut self) {
        self.peers.expel(|_| true);
    }

    /// Processes a datagram. An error means junk, which did not change the state.
    pub(crate) fn open(
        &mut self,
        frame: &[u8],
        arrival: &Arrival<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let head = FrameHeader::read(frame, self.key.tag()).inspect_err(|reason| {
            if *reason == FrameEvent::WrongCell {
                self.record_other_cell(arrival);
            }
        })?;
        if head.version != self.version() {
            return Err(self.refuse_version(&head, frame, arrival.from));
        }
        if head.sender == self.own {
            return if head.kind == FrameKind::Hello {
                Ok(FrameContent::Nothing)
            } else {
                Err(FrameEvent::Replayed)
            };
        }
        match head.kind {
            FrameKind::Hello => {
                let Some(body) = self.unseal(&head, &BROADCAST, frame) else {
                    self.record_other_key(arrival.from);
                    return Err(FrameEvent::BadSeal);
                };
                let (hello, rest) = decode_first::<Hello>(&body)?;
                let wants_session =
                    self.prove_certificates() && decode::<Greeting>(rest)?.wants_session;
                self.handle_hello(&head, &hello, wants_session, arrival)
            }
            FrameKind::Handshake => {
                let body = self
                    .unseal(&head, &self.own, frame)
                    .ok_or(FrameEvent::BadSeal)?;
                self.handle_handshake(&head, &body, arrival)
            }
            kind => self.open_body(&head, kind, frame, arrival.now),
        }
    }

    /// Opens a frame of an established session.
    fn open_body(
        &mut self,
        head: &FrameHeader,
        kind: FrameKind,
        frame: &[u8],
        now: Timestamp,
    ) -> Result<FrameContent, FrameEvent> {
        let Some(peer) = self.peers.get_mut(&head.sender) else {
            // Without certificates the keys can be derived, although the node itself is unknown.
            // With certificates the node greets when it gets no answer.
            let unsealed = if self.prove_certificates() {
                None
            } else {
                self.unseal(head, &self.own, frame)
            };
            return unsealed
                .map(|_| self.stranger(FrameEvent::Unestablished))
                .ok_or(FrameEvent::BadSeal);
        };
        let Some((body, taken)) = peer.keys.open(head, frame) else {
            return Err(FrameEvent::BadSeal);
        };
        match taken {
            Ok(()) if !peer.frames.allow(now) => return Err(FrameEvent::Throttled),
            Ok(()) => peer.record_received(now),
            Err(FrameEvent::CounterJump) => return Ok(self.stranger(FrameEvent::CounterJump)),
            Err(reason) => return Err(reason),
        }
        let from = peer.id.name.clone();
        match peer.superseded {
            Some(since) if now.since(since) > MAX_TRANSIT => {
                self.counters.count(FrameEvent::Superseded);
                Ok(FrameContent::NameTaken(from))
            }
            Some(_) => Err(FrameEvent::Superseded),
            None if kind == FrameKind::Gossip => Ok(FrameContent::Gossip { from, body }),
            None if kind == FrameKind::Renewal => match &peer.proven {
                Some(proven) if proven.holder == from => Ok(FrameContent::Renewal {
                    from,
                    certificate: Arc::clone(&proven.certificate),
                    body,
                }),
                _ => Err(FrameEvent::Uncertified),
            },
            None => {
                let rights = peer
                    .proven
                    .as_ref()
                    .map_or(Rights::ALL, |proven| proven.rights);
                Ok(FrameContent::Payload { from, rights, body })
            }
        }
    }

    fn stranger(&self, event: FrameEvent) -> FrameContent {
        self.counters.count(event);
        FrameContent::Stranger
    }

    /// Troubles with other hosts since the last call.
    pub(crate) fn take_notices(&mut self) -> Vec<GossipNotice> {
        let mut notices = self.notices.take();
        notices.extend(self.prover.iter_mut().flat_map(Prover::take_notices));
        notices
    }

    /// Records a greeting under another key.
    fn record_other_key(&mut self, from: SocketAddr) {
        let cause = format!(
            "received a datagram of cell {} with another key or none from {}",
            self.cell,
            from.ip()
        );
        self.notices.add(&from.ip(), TroubleKind::WrongKey, cause);
    }

    /// Records a datagram of another cell at a node that finds no other node: the names of the cells
    /// may be meant to be equal. The datagram identifies its cell only by a hash.
    fn record_other_cell(&mut self, arrival: &Arrival<'_>) {
        if arrival.is_alone {
            let cause = format!(
                "received a datagram of another cell from {}; this node is in {} and finds no other node",
                arrival.from.ip(),
                self.cell
            );
            self.notices
                .add(&arrival.from.ip(), TroubleKind::OtherCell, cause);
        }
    }

    /// Refuses a frame of a node with certificates if this node has none, or the reverse; a
    /// greeting contains the node's name.
    fn refuse_version(&mut self, head: &FrameHeader, frame: &[u8], from: SocketAddr) -> FrameEvent {
        let greeting = if head.kind == FrameKind::Hello {
            self.unseal(head, &BROADCAST, frame)
        } else {
            None
        };
        let hello =
            greeting.and_then(|body| decode_first::<Hello>(&body).ok().map(|(hello, _)| hello));
        if let Some(Hello { name }) = hello {
            let has = "not admitted: it shows a certificate, and this node has no `[tls]`";
            match &mut self.prover {
                Some(prover) => {
                    prover.refuse(&name, from, "it shows no certificate; it has no `[tls]`");
                }
                None => self.notices.add(&name, TroubleKind::NotAdmitted, has),
            }
        }
        FrameEvent::Uncertified
    }

    /// The body of a frame that the cell's key sealed.
    fn unseal(&self, head: &FrameHeader, receiver: &SessionId, frame: &[u8]) -> Option<Vec<u8>> {
        let (open, sealed) = frame.split_at_checked(HEADER_BYTES)?;
        self.key
            .seal(&head.sender, receiver)
            .open(head.counter, open, sealed)
    }

    /// Counts a frame that is not sent; always false.
    fn version(&self) -> Version {
        if self.prove_certificates() {
            Version::Certificate
        } else {
            Version::Key
        }
    }

    fn head(&mut self, kind: FrameKind) -> FrameHeader {
        self.counter += 1;
        FrameHeader {
            version: self.version(),
            kind,
            sender: self.own,
            counter: self.counter,
        }
    }
}

/// Burst of greetings to single nodes, and time until one more.
const HELLO_BURST: u32 = 256;
const HELLO_INTERVAL: Duration = Duration::from_millis(10);

/// Idle time after which a session may be replaced. Frames are then sent to it only if the gossip
/// considers the node alive.
const SESSION_IDLE_TIMEOUT: Duration = Duration::from_secs(10);

/// Time after a frame of a node during which other nodes' statements that it is down or elsewhere
/// are ignored. It is about as long as the gossip takes to detect that a node is down.
const RECENT_TIME: Duration = Duration::from_millis(400);

/// Time for which frames of a node's earlier run may still arrive.
const MAX_TRANSIT: Duration = Duration::from_millis(500);

/// Time without an answer after which a new session is requested from a node: it may have lost the
/// keys.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);

#[expect(clippy::expect_used, reason = "writing to memory does not fail")]
pub(super) fn encode(message: &impl Serialize) -> Vec<u8> {
    postcard::to_allocvec(message).expect("plain values are always written")
}

pub(super) fn decode<T: DeserializeOwned>(body: &[u8]) -> Result<T, FrameEvent> {
    postcard::from_bytes(body).map_err(|_| FrameEvent::Malformed)
}

/// Decodes the beginning of a body; also returns the rest.
pub(super) fn decode_first<T: DeserializeOwned>(body: &[u8]) -> Result<(T, &[u8]), FrameEvent> {
    postcard::take_from_bytes(body).map_err(|_| FrameEvent::Malformed)
}

#[cfg(test)]
mod tests;
