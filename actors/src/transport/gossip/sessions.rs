//! Authenticated sessions with other nodes, and the handshake that establishes them. No clock, no socket.
//!
//! A session is one run of a node's membership. Each pair of sessions has keys of its own: a frame that was recorded
//! before a restart, or meant for another node, does not decrypt. The sender's counter never repeats in a session, and
//! the receiver accepts each value once. A node is admitted only when it returns a cookie just issued to its address: a
//! recorded handshake admits nobody.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::counters::{FrameCounters, FrameEvent};
use super::frame::{FrameHeader, FrameKind, HEADER_BYTES, Handshake, Hello, Introduction, NameClaim};
use super::key::{BROADCAST, CellKey, Cookie, CookieFactory, FrameCipher, SessionId};
use super::node_id::NodeId;
use super::replay_window::ReplayWindow;
use super::reply_throttle::ReplyThrottle;
use crate::platform::throttle::TokenBucket;

/// All sessions of a node.
pub(crate) struct Sessions {
    key: CellKey,
    own: SessionId,
    cookies: CookieFactory,
    everybody: FrameCipher,
    /// Counter of the last frame sent to any node.
    counter: u64,
    peers: HashMap<SessionId, PeerSession>,
    /// The session that is accepted for a name.
    session_by_name: HashMap<NodeName, SessionId>,
    /// Throttles of answers to greetings, of answers to challenges, and of own greetings.
    challenges: ReplyThrottle,
    proofs: ReplyThrottle,
    greetings: TokenBucket,
    max_peers: usize,
    other_key_seen: bool,
    counters: Arc<FrameCounters>,
}

struct PeerSession {
    name: NodeName,
    run: u64,
    address: SocketAddr,
    to: FrameCipher,
    from: FrameCipher,
    window: ReplayWindow,
    heard: Timestamp,
    /// Time since which another session is accepted for the name.
    superseded: Option<Timestamp>,
}

/// State of a name in the gossip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct KnownMember {
    pub(crate) life: u64,
    pub(crate) alive: bool,
}

/// Circumstances of a datagram's arrival.
pub(crate) struct Arrival<'a> {
    pub(crate) from: SocketAddr,
    pub(crate) now: Timestamp,
    /// This node's identity.
    pub(crate) own: &'a NodeId,
    /// State of a name in this node's gossip.
    pub(crate) known: &'a dyn Fn(&NodeName) -> Option<KnownMember>,
}

/// Content of an authentic frame.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum FrameContent {
    /// A step of a handshake, with the answer to send.
    Answer(Vec<u8>),
    /// A node was admitted. The answer tells it so, unless it knows already.
    Met {
        introduction: Introduction,
        answer: Option<Vec<u8>>,
        /// Whether its session is accepted for its name.
        speaks: bool,
    },
    /// A message of the SWIM protocol.
    Gossip { from: NodeName, body: Vec<u8> },
    /// A datagram of the sender's other actors.
    Payload { from: NodeName, body: Vec<u8> },
    /// A frame of a session that is not established: greet its sender.
    Stranger,
    /// Two running nodes have this name.
    NameTaken(NodeName),
    /// Nothing that needs an answer.
    Nothing,
}

impl Sessions {
    pub(crate) fn new(
        key: CellKey,
        own: SessionId,
        secret: &[u8; 32],
        max_peers: usize,
        counters: Arc<FrameCounters>,
        now: Timestamp,
    ) -> Self {
        Self {
            everybody: key.seal(&own, &BROADCAST),
            key,
            own,
            cookies: CookieFactory::new(secret),
            counter: 0,
            peers: HashMap::new(),
            session_by_name: HashMap::new(),
            challenges: ReplyThrottle::new(now),
            proofs: ReplyThrottle::new(now),
            greetings: TokenBucket::new(HELLO_BURST, HELLO_INTERVAL, now),
            max_peers,
            other_key_seen: false,
            counters,
        }
    }

    /// A greeting frame for any node of the cell.
    pub(crate) fn hello(&mut self, own: &NodeId) -> Vec<u8> {
        let head = self.head(FrameKind::Hello);
        head.write(self.key.tag(), &encode(&Hello { name: own.name.clone() }), &self.everybody)
    }

    /// A frame for the node of a name, and its address.
    pub(crate) fn seal(&mut self, to: &NodeName, kind: FrameKind, body: &[u8]) -> Option<(SocketAddr, Vec<u8>)> {
        let head = self.head(kind);
        let peer = self.peer(to)?;
        Some((peer.address, head.write(self.key.tag(), body, &peer.to)))
    }

    /// Address of the node of a name.
    pub(crate) fn address(&self, name: &NodeName) -> Option<SocketAddr> {
        Some(self.peer(name)?.address)
    }

    /// Address of the node of a name, if it was heard lately.
    pub(crate) fn heard_at(&self, name: &NodeName, now: Timestamp) -> Option<SocketAddr> {
        let peer = self.peer(name)?;
        (now.since(peer.heard) < SESSION_IDLE_TIMEOUT).then_some(peer.address)
    }

    /// Whether a single node may be greeted now.
    pub(crate) fn may_send_hello(&mut self, now: Timestamp) -> bool {
        self.greetings.allow(now) || self.throttled()
    }

    /// Ends the session of an earlier run of a node; false when there is none.
    pub(crate) fn end_earlier_run(&mut self, name: &NodeName, run: u64, now: Timestamp) -> bool {
        let speaker = self.session_by_name.get(name).and_then(|session| self.peers.get_mut(session));
        let Some(peer) = speaker.filter(|peer| peer.run != run) else { return false };
        peer.superseded = Some(now);
        self.session_by_name.remove(name);
        true
    }

    /// Processes a datagram. An error means junk, which changed nothing.
    pub(crate) fn open(&mut self, frame: &[u8], arrival: &Arrival<'_>) -> Result<FrameContent, FrameEvent> {
        let head = FrameHeader::read(frame, self.key.tag())?;
        if head.sender == self.own {
            return if head.kind == FrameKind::Hello { Ok(FrameContent::Nothing) } else { Err(FrameEvent::Replayed) };
        }
        let Some(body) = self.unseal(&head, frame) else {
            self.note_other_key(head.kind, arrival.from);
            return Err(FrameEvent::BadSeal);
        };
        if head.kind == FrameKind::Hello {
            return self.handle_hello(&head, &decode(&body)?, arrival);
        }
        let known = self.peers.get_mut(&head.sender).map(|peer| {
            let new = peer.window.take(head.counter);
            peer.heard = if new { arrival.now } else { peer.heard };
            new
        });
        if known == Some(false) {
            return Err(FrameEvent::Replayed);
        }
        match head.kind {
            FrameKind::Handshake => self.handle_handshake(&head, decode(&body)?, arrival),
            _ if known.is_none() => {
                self.counters.count(FrameEvent::Unestablished);
                Ok(FrameContent::Stranger)
            }
            kind => self.handle_body(&head.sender, kind, body, arrival.now),
        }
    }

    /// Warns of a greeting under another key. Once only, as greetings are repeated for ever.
    fn note_other_key(&mut self, kind: FrameKind, from: SocketAddr) {
        if kind == FrameKind::Hello && !std::mem::replace(&mut self.other_key_seen, true) {
            tracing::warn!(%from, "a node of this cell has another key, or none; its frames are ignored");
        }
    }

    fn peer(&self, name: &NodeName) -> Option<&PeerSession> {
        self.peers.get(self.session_by_name.get(name)?)
    }

    fn unseal(&self, head: &FrameHeader, frame: &[u8]) -> Option<Vec<u8>> {
        let (open, sealed) = frame.split_at(HEADER_BYTES);
        match self.peers.get(&head.sender) {
            _ if head.kind == FrameKind::Hello => {
                self.key.seal(&head.sender, &BROADCAST).open(head.counter, open, sealed)
            }
            Some(peer) => peer.from.open(head.counter, open, sealed),
            None => self.key.seal(&head.sender, &self.own).open(head.counter, open, sealed),
        }
    }

    /// Answers a greeting with a challenge. A known living node at its known address needs no handshake.
    fn handle_hello(
        &mut self,
        head: &FrameHeader,
        hello: &Hello,
        arrival: &Arrival<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let is_accepted = self.session_by_name.get(&hello.name) == Some(&head.sender);
        let is_there = self.peers.get(&head.sender).is_some_and(|peer| peer.address == arrival.from);
        if is_accepted && is_there && (arrival.known)(&hello.name).is_some_and(|known| known.alive) {
            return Ok(FrameContent::Nothing);
        }
        if !self.challenges.allow(&head.sender, arrival.now) && !self.throttled() {
            return Ok(FrameContent::Nothing);
        }
        let cookie = self.cookies.issue(&head.sender, arrival.from, slot(arrival.now));
        let challenge = Handshake::Challenge { cookie, name: arrival.own.name.clone() };
        Ok(FrameContent::Answer(self.handshake(&head.sender, &challenge)))
    }

    fn handle_handshake(
        &mut self,
        head: &FrameHeader,
        message: Handshake,
        arrival: &Arrival<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let Arrival { from, now, own, known } = *arrival;
        let (echo, cookie, introduction) = match message {
            Handshake::Challenge { cookie: echo, name } => {
                if !self.proofs.allow(&head.sender, now) && !self.throttled() {
                    return Ok(FrameContent::Nothing);
                }
                let cookie = self.cookies.issue(&head.sender, from, slot(now));
                let over = known(&name).filter(|known| !known.alive);
                let claim = over.map_or(NameClaim::Free, |known| NameClaim::After(known.life));
                let introduction = Introduction { id: own.clone(), seen_at: from, claim };
                let proof = Handshake::Proof { echo, cookie, introduction };
                return Ok(FrameContent::Answer(self.handshake(&head.sender, &proof)));
            }
            Handshake::Proof { echo, cookie, introduction } => (echo, Some(cookie), introduction),
            Handshake::Accept { echo, introduction } => (echo, None, introduction),
        };
        if !self.is_fresh(&head.sender, from, &echo, now) {
            return Err(FrameEvent::Replayed);
        }
        if introduction.id.name == own.name {
            return Ok(FrameContent::NameTaken(introduction.id.name));
        }
        let claim = self.admit(head, &introduction.id, from, now, known(&introduction.id.name))?;
        let answer = cookie.map(|echo| {
            let introduction = Introduction { id: own.clone(), seen_at: from, claim };
            self.handshake(&head.sender, &Handshake::Accept { echo, introduction })
        });
        Ok(FrameContent::Met { introduction, answer, speaks: claim != NameClaim::Taken })
    }

    /// Whether the cookie was issued to this session at this address a moment ago.
    fn is_fresh(&self, session: &SessionId, from: SocketAddr, echo: &Cookie, now: Timestamp) -> bool {
        let slot = slot(now);
        [slot, slot.wrapping_sub(1)].iter().any(|slot| self.cookies.issue(session, from, *slot) == *echo)
    }

    /// Stores a session that has just proven its reachability, and decides whether it is accepted for its name.
    fn admit(
        &mut self,
        head: &FrameHeader,
        id: &NodeId,
        address: SocketAddr,
        now: Timestamp,
        known: Option<KnownMember>,
    ) -> Result<NameClaim, FrameEvent> {
        let speaker = self.session_by_name.get(&id.name).copied();
        let claim = match known {
            Some(known) if known.alive && known.life > id.life && speaker != Some(head.sender) => NameClaim::Taken,
            Some(known) if !known.alive && known.life >= id.life => NameClaim::After(known.life),
            _ => NameClaim::Free,
        };
        if !self.peers.contains_key(&head.sender) {
            self.make_room(now)?;
            let peer = PeerSession {
                name: id.name.clone(),
                run: id.run,
                address,
                to: self.key.seal(&self.own, &head.sender),
                from: self.key.seal(&head.sender, &self.own),
                window: ReplayWindow::after(head.counter),
                heard: now,
                superseded: None,
            };
            self.peers.insert(head.sender, peer);
        }
        let taken = claim == NameClaim::Taken;
        if let Some(peer) = self.peers.get_mut(&head.sender) {
            peer.address = address;
            peer.superseded = taken.then_some(now);
        }
        if !taken {
            self.session_by_name.insert(id.name.clone(), head.sender);
            if let Some(former) = speaker.filter(|former| *former != head.sender)
                && let Some(peer) = self.peers.get_mut(&former)
            {
                peer.superseded = Some(now);
            }
        }
        let keep = |session: &SessionId| *session == head.sender || Some(*session) == speaker;
        self.peers.retain(|session, peer| peer.name != id.name || keep(session));
        Ok(claim)
    }

    /// Removes the longest idle session when there are too many and it is idle for long enough.
    fn make_room(&mut self, now: Timestamp) -> Result<(), FrameEvent> {
        if self.peers.len() < self.max_peers {
            return Ok(());
        }
        let longest_idle = self.peers.iter().min_by_key(|(_, peer)| peer.heard);
        let may_go = longest_idle.filter(|(_, peer)| now.since(peer.heard) >= SESSION_IDLE_TIMEOUT);
        let session = may_go.map(|(session, _)| *session).ok_or(FrameEvent::TooManyPeers)?;
        if let Some(peer) = self.peers.remove(&session)
            && self.session_by_name.get(&peer.name) == Some(&session)
        {
            self.session_by_name.remove(&peer.name);
        }
        Ok(())
    }

    fn handle_body(
        &self,
        session: &SessionId,
        kind: FrameKind,
        body: Vec<u8>,
        now: Timestamp,
    ) -> Result<FrameContent, FrameEvent> {
        let Some(peer) = self.peers.get(session) else { return Err(FrameEvent::BadSeal) };
        let from = peer.name.clone();
        match peer.superseded {
            Some(since) if now.since(since) > MAX_TRANSIT => {
                self.counters.count(FrameEvent::Superseded);
                Ok(FrameContent::NameTaken(from))
            }
            Some(_) => Err(FrameEvent::Superseded),
            None if kind == FrameKind::Gossip => Ok(FrameContent::Gossip { from, body }),
            None => Ok(FrameContent::Payload { from, body }),
        }
    }

    fn handshake(&mut self, to: &SessionId, message: &Handshake) -> Vec<u8> {
        let head = self.head(FrameKind::Handshake);
        head.write(self.key.tag(), &encode(message), &self.key.seal(&self.own, to))
    }

    /// Counts a frame that is not sent; always false.
    fn throttled(&self) -> bool {
        self.counters.count(FrameEvent::Throttled);
        false
    }

    fn head(&mut self, kind: FrameKind) -> FrameHeader {
        self.counter += 1;
        FrameHeader { kind, sender: self.own, counter: self.counter }
    }
}

/// Burst of greetings to single nodes, and time until one more.
const HELLO_BURST: u32 = 256;
const HELLO_INTERVAL: Duration = Duration::from_millis(10);

/// Idle time after which a session may be replaced. It is then sent to only if the gossip holds the node alive.
const SESSION_IDLE_TIMEOUT: Duration = Duration::from_secs(10);

/// Time for which frames of a node's earlier run may still arrive.
const MAX_TRANSIT: Duration = Duration::from_millis(500);

/// Time slot of a cookie, which is valid in its slot and the next.
fn slot(now: Timestamp) -> u64 {
    now.micros() / 2_000_000
}

#[expect(clippy::expect_used, reason = "writing to memory does not fail")]
fn encode(message: &impl Serialize) -> Vec<u8> {
    postcard::to_allocvec(message).expect("plain values are always written")
}

fn decode<T: DeserializeOwned>(body: &[u8]) -> Result<T, FrameEvent> {
    postcard::from_bytes(body).map_err(|_| FrameEvent::Malformed)
}

#[cfg(test)]
mod tests;
