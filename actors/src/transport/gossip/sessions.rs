//! With whom this node shares keys, and the handshake that comes before.
//!
//! Nothing in here reads a clock or a socket. A session is one run of a node's membership; frames between two sessions
//! have keys of their own, so that a frame recorded before either restarted, or meant for another, opens nowhere. The
//! sender's counter never repeats in a session and the receiver takes each once. A session is admitted only when its
//! bearer has just returned a cookie baked for it: a recorded handshake admits nobody.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ecod::names::NodeName;
use ecod::time::Timestamp;
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::counters::{FrameCounters, FrameEvent};
use super::frame::{FrameHeader, FrameKind, HEADER_BYTES, Handshake, HeadError, Hello, Introduction, NameClaim};
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
    /// The counter of the last frame sent, to whomever.
    counter: u64,
    peers: HashMap<SessionId, PeerSession>,
    /// The session that speaks for a name.
    session_by_name: HashMap<NodeName, SessionId>,
    /// Answers to greetings, to challenges, and greetings of strangers.
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
    /// Since when another session speaks for the name.
    superseded: Option<Timestamp>,
}

/// What the gossip knows of a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct KnownMember {
    pub(crate) life: u64,
    pub(crate) alive: bool,
}

/// This node and what its gossip knows, for a handshake.
pub(crate) struct LocalView<'a> {
    pub(crate) own: &'a NodeId,
    pub(crate) known: &'a dyn Fn(&NodeName) -> Option<KnownMember>,
}

/// What a frame turned out to be.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum FrameContent {
    /// A step of a handshake: this is the answer.
    Answer(Vec<u8>),
    /// A node was admitted; it is told so by the answer, unless it knows.
    Met {
        introduction: Introduction,
        answer: Option<Vec<u8>>,
        /// Whether its session speaks for its name.
        speaks: bool,
    },
    /// Words of the gossip protocol.
    Gossip { from: NodeName, body: Vec<u8> },
    /// A datagram of the sender's other parts.
    Payload { from: NodeName, body: Vec<u8> },
    /// A session that is not established speaks: greet it.
    Stranger,
    /// Two running nodes bear this name.
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

    /// A greeting for whoever gets it.
    pub(crate) fn hello(&mut self, own: &NodeId) -> Vec<u8> {
        let head = self.head(FrameKind::Hello);
        head.write(self.key.tag(), &encode(&Hello { name: own.name.clone() }), &self.everybody)
    }

    /// A frame for whoever speaks for a name, and where it goes.
    pub(crate) fn seal(&mut self, to: &NodeName, kind: FrameKind, body: &[u8]) -> Option<(SocketAddr, Vec<u8>)> {
        let head = self.head(kind);
        let peer = self.peers.get(self.session_by_name.get(to)?)?;
        Some((peer.address, head.write(self.key.tag(), body, &peer.to)))
    }

    /// Where the speaker for a name is.
    pub(crate) fn address(&self, name: &NodeName) -> Option<SocketAddr> {
        Some(self.peers.get(self.session_by_name.get(name)?)?.address)
    }

    /// Where the speaker for a name is, if it was heard lately.
    pub(crate) fn heard_at(&self, name: &NodeName, now: Timestamp) -> Option<SocketAddr> {
        let peer = self.peers.get(self.session_by_name.get(name)?)?;
        (now.since(peer.heard) < SESSION_IDLE_TIMEOUT).then_some(peer.address)
    }

    /// Whether a node may be greeted now that was heard of or from.
    pub(crate) fn may_send_hello(&mut self, now: Timestamp) -> bool {
        self.greetings.allow(now) || self.throttled()
    }

    /// Forgets who spoke for a name in an earlier run; whether it did.
    pub(crate) fn end_earlier_run(&mut self, name: &NodeName, run: u64, now: Timestamp) -> bool {
        let speaker = self.session_by_name.get(name).and_then(|session| self.peers.get_mut(session));
        let Some(peer) = speaker.filter(|peer| peer.run != run) else { return false };
        peer.superseded = Some(now);
        self.session_by_name.remove(name);
        true
    }

    /// Takes a datagram. An error is junk, and changed nothing.
    pub(crate) fn open(
        &mut self,
        frame: &[u8],
        from: SocketAddr,
        now: Timestamp,
        view: &LocalView<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let head = FrameHeader::read(frame, self.key.tag())?;
        if head.sender == self.own {
            return if head.kind == FrameKind::Hello { Ok(FrameContent::Nothing) } else { Err(FrameEvent::Replayed) };
        }
        let Some(body) = self.unseal(&head, frame) else {
            self.note_other_key(head.kind, from);
            return Err(FrameEvent::BadSeal);
        };
        if head.kind == FrameKind::Hello {
            return self.handle_hello(&head, &decode(&body)?, from, now, view);
        }
        let known = self.peers.get_mut(&head.sender).map(|peer| {
            let new = peer.window.take(head.counter);
            peer.heard = if new { now } else { peer.heard };
            new
        });
        if known == Some(false) {
            return Err(FrameEvent::Replayed);
        }
        match head.kind {
            FrameKind::Handshake => self.handle_handshake(&head, decode(&body)?, from, now, view),
            _ if known.is_none() => {
                self.counters.count(FrameEvent::Unestablished);
                Ok(FrameContent::Stranger)
            }
            kind => self.handle_body(&head.sender, kind, body, now),
        }
    }

    /// A greeting, which all with the key can read, is in another key: said once, as it goes on for ever.
    fn note_other_key(&mut self, kind: FrameKind, from: SocketAddr) {
        if kind == FrameKind::Hello && !std::mem::replace(&mut self.other_key_seen, true) {
            tracing::warn!(%from, "a node of this cell has another key, or none; it is not heard");
        }
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

    /// Whoever is known, alive and where it was needs no handshake; a greeting proves nothing else.
    fn handle_hello(
        &mut self,
        head: &FrameHeader,
        hello: &Hello,
        from: SocketAddr,
        now: Timestamp,
        view: &LocalView<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let speaks = self.session_by_name.get(&hello.name) == Some(&head.sender);
        let there = self.peers.get(&head.sender).is_some_and(|peer| peer.address == from);
        if speaks && there && (view.known)(&hello.name).is_some_and(|known| known.alive) {
            return Ok(FrameContent::Nothing);
        }
        if !self.challenges.allow(&head.sender, now) {
            self.throttled();
            return Ok(FrameContent::Nothing);
        }
        let cookie = self.cookies.issue(&head.sender, from, slot(now));
        let challenge = Handshake::Challenge { cookie, name: view.own.name.clone() };
        Ok(FrameContent::Answer(self.handshake(&head.sender, &challenge)))
    }

    fn handle_handshake(
        &mut self,
        head: &FrameHeader,
        message: Handshake,
        from: SocketAddr,
        now: Timestamp,
        view: &LocalView<'_>,
    ) -> Result<FrameContent, FrameEvent> {
        let (echo, cookie, introduction) = match message {
            Handshake::Challenge { cookie: echo, name } => {
                if !self.proofs.allow(&head.sender, now) {
                    self.throttled();
                    return Ok(FrameContent::Nothing);
                }
                let cookie = self.cookies.issue(&head.sender, from, slot(now));
                let over = (view.known)(&name).filter(|known| !known.alive);
                let claim = over.map_or(NameClaim::Free, |known| NameClaim::After(known.life));
                let introduction = Introduction { id: view.own.clone(), seen_at: from, claim };
                return Ok(FrameContent::Answer(
                    self.handshake(&head.sender, &Handshake::Proof { echo, cookie, introduction }),
                ));
            }
            Handshake::Proof { echo, cookie, introduction } => (echo, Some(cookie), introduction),
            Handshake::Accept { echo, introduction } => (echo, None, introduction),
        };
        if !self.is_fresh(&head.sender, from, &echo, now) {
            return Err(FrameEvent::Replayed);
        }
        if introduction.id.name == view.own.name {
            return Ok(FrameContent::NameTaken(introduction.id.name));
        }
        let claim = self.admit(head, &introduction.id, from, now, (view.known)(&introduction.id.name))?;
        let answer = cookie.map(|echo| {
            let introduction = Introduction { id: view.own.clone(), seen_at: from, claim };
            self.handshake(&head.sender, &Handshake::Accept { echo, introduction })
        });
        Ok(FrameContent::Met { introduction, answer, speaks: claim != NameClaim::Taken })
    }

    /// Whether the cookie was given to this session at this address a moment ago.
    fn is_fresh(&self, session: &SessionId, from: SocketAddr, echo: &Cookie, now: Timestamp) -> bool {
        let slot = slot(now);
        [slot, slot.wrapping_sub(1)].iter().any(|slot| self.cookies.issue(session, from, *slot) == *echo)
    }

    /// Remembers a session that has just proven itself, and decides whether it speaks for its name.
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
            let (to, from) = (self.key.seal(&self.own, &head.sender), self.key.seal(&head.sender, &self.own));
            let window = ReplayWindow::after(head.counter);
            let name = id.name.clone();
            let run = id.run;
            self.peers.insert(
                head.sender,
                PeerSession { name, run, address, to, from, window, heard: now, superseded: None },
            );
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

    /// Forgets whom it has not heard for longest, if for long enough, should there be too many.
    fn make_room(&mut self, now: Timestamp) -> Result<(), FrameEvent> {
        if self.peers.len() < self.max_peers {
            return Ok(());
        }
        let silent = self.peers.iter().min_by_key(|(_, peer)| peer.heard).map(|(session, peer)| (*session, peer.heard));
        let Some((session, _)) = silent.filter(|(_, heard)| now.since(*heard) >= SESSION_IDLE_TIMEOUT) else {
            return Err(FrameEvent::TooManyPeers);
        };
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

    fn throttled(&self) -> bool {
        self.counters.count(FrameEvent::Throttled);
        false
    }

    fn head(&mut self, kind: FrameKind) -> FrameHeader {
        self.counter += 1;
        FrameHeader { kind, sender: self.own, counter: self.counter }
    }
}

impl From<HeadError> for FrameEvent {
    fn from(error: HeadError) -> Self {
        match error {
            HeadError::Oversized => Self::Oversized,
            HeadError::Malformed => Self::Malformed,
            HeadError::WrongCell => Self::WrongCell,
        }
    }
}

/// Most greetings of single nodes at once, and time until one more.
const HELLO_BURST: u32 = 256;
const HELLO_INTERVAL: Duration = Duration::from_millis(10);

/// A session that has been silent for so long gives way to a new one, and is sent to only if the gossip holds it alive.
const SESSION_IDLE_TIMEOUT: Duration = Duration::from_secs(10);

/// How long frames of a node that was restarted may be under way.
const MAX_TRANSIT: Duration = Duration::from_millis(500);

/// A cookie is good during its slot of time and the next.
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
