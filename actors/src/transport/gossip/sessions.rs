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

use super::answers::Answers;
use super::counters::{FrameCounters, FrameEvent};
use super::frame::{HEAD_BYTES, Handshake, Head, HeadError, Hello, Kind, NameStanding, Word};
use super::key::{CellKey, Cookie, CookieJar, EVERYBODY, Seal, SessionId};
use super::node_id::NodeId;
use super::replay_window::ReplayWindow;
use crate::platform::throttle::Throttle;

/// All sessions of a node.
pub(crate) struct Sessions {
    key: CellKey,
    own: SessionId,
    cookies: CookieJar,
    everybody: Seal,
    /// The counter of the last frame sent, to whomever.
    counter: u64,
    peers: HashMap<SessionId, Peer>,
    /// The session that speaks for a name.
    speakers: HashMap<NodeName, SessionId>,
    /// Answers to greetings, to challenges, and greetings of strangers.
    challenges: Answers,
    proofs: Answers,
    greetings: Throttle,
    max_peers: usize,
    other_key_seen: bool,
    counters: Arc<FrameCounters>,
}

struct Peer {
    name: NodeName,
    run: u64,
    address: SocketAddr,
    to: Seal,
    from: Seal,
    window: ReplayWindow,
    heard: Timestamp,
    /// Since when another session speaks for the name.
    superseded: Option<Timestamp>,
}

/// What the gossip knows of a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Known {
    pub(crate) life: u64,
    pub(crate) alive: bool,
}

/// This node and what its gossip knows, for a handshake.
pub(crate) struct Roster<'a> {
    pub(crate) own: &'a NodeId,
    pub(crate) known: &'a dyn Fn(&NodeName) -> Option<Known>,
}

/// What a frame turned out to be.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Opened {
    /// A step of a handshake: this is the answer.
    Answer(Vec<u8>),
    /// A node was admitted; it is told so by the answer, unless it knows.
    Met {
        word: Word,
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
            everybody: key.seal(&own, &EVERYBODY),
            key,
            own,
            cookies: CookieJar::new(secret),
            counter: 0,
            peers: HashMap::new(),
            speakers: HashMap::new(),
            challenges: Answers::new(now),
            proofs: Answers::new(now),
            greetings: Throttle::new(GREETINGS, STEADY, now),
            max_peers,
            other_key_seen: false,
            counters,
        }
    }

    /// A greeting for whoever gets it.
    pub(crate) fn hello(&mut self, own: &NodeId) -> Vec<u8> {
        let head = self.head(Kind::Hello);
        head.write(self.key.tag(), &encode(&Hello { name: own.name.clone() }), &self.everybody)
    }

    /// A frame for whoever speaks for a name, and where it goes.
    pub(crate) fn seal(&mut self, to: &NodeName, kind: Kind, body: &[u8]) -> Option<(SocketAddr, Vec<u8>)> {
        let head = self.head(kind);
        let peer = self.peers.get(self.speakers.get(to)?)?;
        Some((peer.address, head.write(self.key.tag(), body, &peer.to)))
    }

    /// Where the speaker for a name is.
    pub(crate) fn address(&self, name: &NodeName) -> Option<SocketAddr> {
        Some(self.peers.get(self.speakers.get(name)?)?.address)
    }

    /// Where the speaker for a name is, if it was heard lately.
    pub(crate) fn heard_at(&self, name: &NodeName, now: Timestamp) -> Option<SocketAddr> {
        let peer = self.peers.get(self.speakers.get(name)?)?;
        (now.since(peer.heard) < FORGET_AFTER).then_some(peer.address)
    }

    /// Whether a node may be greeted now that was heard of or from.
    pub(crate) fn may_greet(&mut self, now: Timestamp) -> bool {
        self.greetings.allow(now) || self.throttled()
    }

    /// Forgets who spoke for a name in an earlier run; whether it did.
    pub(crate) fn outdate(&mut self, name: &NodeName, run: u64, now: Timestamp) -> bool {
        let speaker = self.speakers.get(name).and_then(|session| self.peers.get_mut(session));
        let Some(peer) = speaker.filter(|peer| peer.run != run) else { return false };
        peer.superseded = Some(now);
        self.speakers.remove(name);
        true
    }

    /// Takes a datagram. An error is junk, and changed nothing.
    pub(crate) fn open(
        &mut self,
        frame: &[u8],
        from: SocketAddr,
        now: Timestamp,
        roster: &Roster<'_>,
    ) -> Result<Opened, FrameEvent> {
        let head = Head::read(frame, self.key.tag())?;
        if head.sender == self.own {
            return if head.kind == Kind::Hello { Ok(Opened::Nothing) } else { Err(FrameEvent::Replayed) };
        }
        let Some(body) = self.unseal(&head, frame) else {
            self.note_other_key(head.kind, from);
            return Err(FrameEvent::BadSeal);
        };
        if head.kind == Kind::Hello {
            return self.greeted(&head, &decode(&body)?, from, now, roster);
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
            Kind::Handshake => self.shake_hands(&head, decode(&body)?, from, now, roster),
            _ if known.is_none() => {
                self.counters.count(FrameEvent::Unestablished);
                Ok(Opened::Stranger)
            }
            kind => self.hear(&head.sender, kind, body, now),
        }
    }

    /// A greeting, which all with the key can read, is in another key: said once, as it goes on for ever.
    fn note_other_key(&mut self, kind: Kind, from: SocketAddr) {
        if kind == Kind::Hello && !std::mem::replace(&mut self.other_key_seen, true) {
            tracing::warn!(%from, "a node of this cell has another key, or none; it is not heard");
        }
    }

    fn unseal(&self, head: &Head, frame: &[u8]) -> Option<Vec<u8>> {
        let (open, sealed) = frame.split_at(HEAD_BYTES);
        match self.peers.get(&head.sender) {
            _ if head.kind == Kind::Hello => self.key.seal(&head.sender, &EVERYBODY).open(head.counter, open, sealed),
            Some(peer) => peer.from.open(head.counter, open, sealed),
            None => self.key.seal(&head.sender, &self.own).open(head.counter, open, sealed),
        }
    }

    /// Whoever is known, alive and where it was needs no handshake; a greeting proves nothing else.
    fn greeted(
        &mut self,
        head: &Head,
        hello: &Hello,
        from: SocketAddr,
        now: Timestamp,
        roster: &Roster<'_>,
    ) -> Result<Opened, FrameEvent> {
        let speaks = self.speakers.get(&hello.name) == Some(&head.sender);
        let there = self.peers.get(&head.sender).is_some_and(|peer| peer.address == from);
        if speaks && there && (roster.known)(&hello.name).is_some_and(|known| known.alive) {
            return Ok(Opened::Nothing);
        }
        if !self.challenges.allow(&head.sender, now) {
            self.throttled();
            return Ok(Opened::Nothing);
        }
        let cookie = self.cookies.bake(&head.sender, from, slot(now));
        let challenge = Handshake::Challenge { cookie, name: roster.own.name.clone() };
        Ok(Opened::Answer(self.handshake(&head.sender, &challenge)))
    }

    fn shake_hands(
        &mut self,
        head: &Head,
        message: Handshake,
        from: SocketAddr,
        now: Timestamp,
        roster: &Roster<'_>,
    ) -> Result<Opened, FrameEvent> {
        let (echo, cookie, word) = match message {
            Handshake::Challenge { cookie: echo, name } => {
                if !self.proofs.allow(&head.sender, now) {
                    self.throttled();
                    return Ok(Opened::Nothing);
                }
                let cookie = self.cookies.bake(&head.sender, from, slot(now));
                let over = (roster.known)(&name).filter(|known| !known.alive);
                let standing = over.map_or(NameStanding::Free, |known| NameStanding::After(known.life));
                let word = Word { id: roster.own.clone(), seen_at: from, standing };
                return Ok(Opened::Answer(self.handshake(&head.sender, &Handshake::Proof { echo, cookie, word })));
            }
            Handshake::Proof { echo, cookie, word } => (echo, Some(cookie), word),
            Handshake::Accept { echo, word } => (echo, None, word),
        };
        if !self.is_fresh(&head.sender, from, &echo, now) {
            return Err(FrameEvent::Replayed);
        }
        if word.id.name == roster.own.name {
            return Ok(Opened::NameTaken(word.id.name));
        }
        let standing = self.admit(head, &word.id, from, now, (roster.known)(&word.id.name))?;
        let answer = cookie.map(|echo| {
            let word = Word { id: roster.own.clone(), seen_at: from, standing };
            self.handshake(&head.sender, &Handshake::Accept { echo, word })
        });
        Ok(Opened::Met { word, answer, speaks: standing != NameStanding::Taken })
    }

    /// Whether the cookie was given to this session at this address a moment ago.
    fn is_fresh(&self, session: &SessionId, from: SocketAddr, echo: &Cookie, now: Timestamp) -> bool {
        let slot = slot(now);
        [slot, slot.wrapping_sub(1)].iter().any(|slot| self.cookies.bake(session, from, *slot) == *echo)
    }

    /// Remembers a session that has just proven itself, and decides whether it speaks for its name.
    fn admit(
        &mut self,
        head: &Head,
        id: &NodeId,
        address: SocketAddr,
        now: Timestamp,
        known: Option<Known>,
    ) -> Result<NameStanding, FrameEvent> {
        let speaker = self.speakers.get(&id.name).copied();
        let standing = match known {
            Some(known) if known.alive && known.life > id.life && speaker != Some(head.sender) => NameStanding::Taken,
            Some(known) if !known.alive && known.life >= id.life => NameStanding::After(known.life),
            _ => NameStanding::Free,
        };
        if !self.peers.contains_key(&head.sender) {
            self.make_room(now)?;
            let (to, from) = (self.key.seal(&self.own, &head.sender), self.key.seal(&head.sender, &self.own));
            let window = ReplayWindow::after(head.counter);
            let name = id.name.clone();
            let run = id.run;
            self.peers.insert(head.sender, Peer { name, run, address, to, from, window, heard: now, superseded: None });
        }
        let taken = standing == NameStanding::Taken;
        if let Some(peer) = self.peers.get_mut(&head.sender) {
            peer.address = address;
            peer.superseded = taken.then_some(now);
        }
        if !taken {
            self.speakers.insert(id.name.clone(), head.sender);
            if let Some(former) = speaker.filter(|former| *former != head.sender)
                && let Some(peer) = self.peers.get_mut(&former)
            {
                peer.superseded = Some(now);
            }
        }
        let keep = |session: &SessionId| *session == head.sender || Some(*session) == speaker;
        self.peers.retain(|session, peer| peer.name != id.name || keep(session));
        Ok(standing)
    }

    /// Forgets whom it has not heard for longest, if for long enough, should there be too many.
    fn make_room(&mut self, now: Timestamp) -> Result<(), FrameEvent> {
        if self.peers.len() < self.max_peers {
            return Ok(());
        }
        let silent = self.peers.iter().min_by_key(|(_, peer)| peer.heard).map(|(session, peer)| (*session, peer.heard));
        let Some((session, _)) = silent.filter(|(_, heard)| now.since(*heard) >= FORGET_AFTER) else {
            return Err(FrameEvent::TooManyPeers);
        };
        if let Some(peer) = self.peers.remove(&session)
            && self.speakers.get(&peer.name) == Some(&session)
        {
            self.speakers.remove(&peer.name);
        }
        Ok(())
    }

    fn hear(&self, session: &SessionId, kind: Kind, body: Vec<u8>, now: Timestamp) -> Result<Opened, FrameEvent> {
        let Some(peer) = self.peers.get(session) else { return Err(FrameEvent::BadSeal) };
        let from = peer.name.clone();
        match peer.superseded {
            Some(since) if now.since(since) > UNDERWAY => {
                self.counters.count(FrameEvent::Superseded);
                Ok(Opened::NameTaken(from))
            }
            Some(_) => Err(FrameEvent::Superseded),
            None if kind == Kind::Gossip => Ok(Opened::Gossip { from, body }),
            None => Ok(Opened::Payload { from, body }),
        }
    }

    fn handshake(&mut self, to: &SessionId, message: &Handshake) -> Vec<u8> {
        let head = self.head(Kind::Handshake);
        head.write(self.key.tag(), &encode(message), &self.key.seal(&self.own, to))
    }

    fn throttled(&self) -> bool {
        self.counters.count(FrameEvent::Throttled);
        false
    }

    fn head(&mut self, kind: Kind) -> Head {
        self.counter += 1;
        Head { kind, sender: self.own, counter: self.counter }
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
const GREETINGS: u32 = 256;
const STEADY: Duration = Duration::from_millis(10);

/// A session that has been silent for so long gives way to a new one, and is sent to only if the gossip holds it alive.
const FORGET_AFTER: Duration = Duration::from_secs(10);

/// How long frames of a node that was restarted may be under way.
const UNDERWAY: Duration = Duration::from_millis(500);

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
