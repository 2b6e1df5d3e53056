//! Table of the sessions with other nodes.

use std::collections::HashMap;
use std::net::SocketAddr;
use std::time::Duration;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use super::{RECENT_TIME, SESSION_IDLE_TIMEOUT};
use crate::platform::throttle::TokenBucket;
use crate::transport::gossip::counters::FrameEvent;
use crate::transport::gossip::frame::FrameHeader;
use crate::transport::gossip::handshake::Proven;
use crate::transport::gossip::key::SessionId;
use crate::transport::gossip::node_id::NodeId;
use crate::transport::gossip::session_keys::KeyRing;

/// Sessions by their number, and the accepted session of each name.
pub(super) struct PeerTable {
    peers: HashMap<SessionId, PeerSession>,
    session_by_name: HashMap<NodeName, SessionId>,
    max_peers: usize,
}

/// An established session.
pub(super) struct PeerSession {
    /// The node as it introduced itself.
    pub(super) id: NodeId,
    /// Its certificate, in a cell that has them.
    pub(super) proven: Option<Proven>,
    pub(super) address: SocketAddr,
    pub(super) keys: KeyRing,
    /// Limit of its frames: the election handles each one, and answers some.
    pub(super) frames: TokenBucket,
    /// Counter of the frame with its last proof: no earlier one is accepted.
    pub(super) proof_counter: u64,
    pub(super) received_at: Timestamp,
    /// Time of the first frame sent to the node after its last frame was received.
    pub(super) unanswered_since: Option<Timestamp>,
    /// Time since which another session is accepted for the name.
    pub(super) superseded: Option<Timestamp>,
}

/// Maximum sessions by one certificate: a node, its former run, and observers that share its
/// certificate.
const MAX_SESSIONS_EACH: usize = 16;

/// Number of frames that a session may send at once. A leader in an election sends about 100 a
/// second.
const FRAMES: u32 = 1000;

/// Time after which a session may send one more.
const FRAME_INTERVAL: Duration = Duration::from_millis(2);

impl PeerSession {
    /// The limit of a new session.
    pub(super) fn frames(now: Timestamp) -> TokenBucket {
        TokenBucket::new(FRAMES, FRAME_INTERVAL, now)
    }

    pub(super) fn record_received(&mut self, now: Timestamp) {
        self.received_at = now;
        self.unanswered_since = None;
    }
}

impl PeerTable {
    pub(super) fn new(max_peers: usize) -> Self {
        Self {
            peers: HashMap::new(),
            session_by_name: HashMap::new(),
            max_peers,
        }
    }

    pub(super) fn get(&self, session: &SessionId) -> Option<&PeerSession> {
        self.peers.get(session)
    }

    pub(super) fn get_mut(&mut self, session: &SessionId) -> Option<&mut PeerSession> {
        self.peers.get_mut(session)
    }

    /// Number of the session that is accepted for a name.
    pub(super) fn speaker_id(&self, name: &NodeName) -> Option<SessionId> {
        self.session_by_name.get(name).copied()
    }

    /// The session that is accepted for a name.
    pub(super) fn speaker(&self, name: &NodeName) -> Option<&PeerSession> {
        self.peers.get(self.session_by_name.get(name)?)
    }

    pub(super) fn speaker_mut(&mut self, name: &NodeName) -> Option<&mut PeerSession> {
        self.peers.get_mut(self.session_by_name.get(name)?)
    }

    /// Addresses of all nodes.
    pub(super) fn addresses(&self) -> Vec<SocketAddr> {
        self.peers.values().map(|peer| peer.address).collect()
    }

    /// Processes the counter of a handshake's frame in a cell without certificates. It may be far
    /// ahead, because the handshake itself proves that it is fresh. A session that is active at one
    /// address cannot be taken over from another, unless the frame itself states (`stated`) that
    /// its sender has moved there.
    pub(super) fn accept_counter(
        &mut self,
        head: &FrameHeader,
        from: SocketAddr,
        stated: Option<SocketAddr>,
        now: Timestamp,
    ) -> Result<(), FrameEvent> {
        let Some(peer) = self.peers.get_mut(&head.sender) else {
            return Ok(());
        };
        let is_taken_over = peer.address != from && now.since(peer.received_at) < RECENT_TIME;
        if is_taken_over && stated != Some(from) {
            return Err(FrameEvent::Replayed);
        }
        match peer.keys.accept(head.counter) {
            // A node that has moved a moment ago is not far ahead.
            Err(event) if is_taken_over || event == FrameEvent::Replayed => Err(event),
            _ => {
                peer.record_received(now);
                Ok(())
            }
        }
    }

    /// Adds a session, if there is room; the session that has been idle for longest is replaced if
    /// it has been idle for long enough.
    pub(super) fn insert(
        &mut self,
        session: SessionId,
        peer: PeerSession,
    ) -> Result<(), FrameEvent> {
        let holder = |peer: &PeerSession| peer.proven.as_ref().map(|proven| proven.holder.clone());
        if let Some(own) = holder(&peer) {
            let is_own = |peer: &PeerSession| holder(peer).as_ref() == Some(&own);
            if self.peers.values().filter(|peer| is_own(peer)).count() >= MAX_SESSIONS_EACH {
                self.make_room(peer.received_at, is_own)?;
            }
        }
        if self.peers.len() >= self.max_peers {
            self.make_room(peer.received_at, |_| true)?;
        }
        self.peers.insert(session, peer);
        Ok(())
    }

    /// Removes the longest idle of some sessions, when it is idle for long enough.
    fn make_room(
        &mut self,
        now: Timestamp,
        may_go: impl Fn(&PeerSession) -> bool,
    ) -> Result<(), FrameEvent> {
        let some = self.peers.iter().filter(|(_, peer)| may_go(peer));
        let longest_idle = some.min_by_key(|(_, peer)| peer.received_at);
        let idle =
            longest_idle.filter(|(_, idle)| now.since(idle.received_at) >= SESSION_IDLE_TIMEOUT);
        let session = idle
            .map(|(session, _)| *session)
            .ok_or(FrameEvent::TooManyPeers)?;
        self.remove(&session);
        Ok(())
    }

    /// Accepts a session for its name, or records that another one is accepted.
    pub(super) fn settle(
        &mut self,
        session: SessionId,
        name: &NodeName,
        is_accepted: bool,
        now: Timestamp,
    ) {
        let former = self.speaker_id(name);
        if is_accepted {
            self.session_by_name.insert(name.clone(), session);
            if let Some(peer) = former
                .filter(|former| *former != session)
                .and_then(|former| self.get_mut(&former))
            {
                peer.superseded = Some(now);
            }
        }
        if let Some(peer) = self.get_mut(&session) {
            peer.superseded = (!is_accepted).then_some(now);
        }
        let keep = |known: &SessionId| *known == session || Some(*known) == former;
        self.peers
            .retain(|known, peer| peer.id.name != *name || keep(known));
    }

    /// Ends the session of an earlier run of a node; returns false without such a session.
    pub(super) fn end_earlier_run(&mut self, name: &NodeName, run: u64, now: Timestamp) -> bool {
        let Some(peer) = self.speaker_mut(name).filter(|peer| peer.id.run != run) else {
            return false;
        };
        peer.superseded = Some(now);
        self.session_by_name.remove(name);
        true
    }

    /// Ends sessions; returns the nodes whose accepted session ended.
    pub(super) fn expel(
        &mut self,
        mut is_expelled: impl FnMut(&PeerSession) -> bool,
    ) -> Vec<NodeName> {
        let expelled: Vec<_> = self
            .peers
            .iter()
            .filter(|(_, peer)| is_expelled(peer))
            .map(|(session, _)| *session)
            .collect();
        expelled
            .iter()
            .filter_map(|session| self.remove(session))
            .collect()
    }

    /// Removes a session; its node's name if it was accepted for it.
    fn remove(&mut self, session: &SessionId) -> Option<NodeName> {
        let name = self.peers.remove(session)?.id.name;
        (self.session_by_name.get(&name) == Some(session))
            .then(|| self.session_by_name.remove(&name))?;
        Some(name)
    }

    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.peers.len()
    }

    #[cfg(test)]
    pub(super) fn clear(&mut self) {
        self.peers.clear();
    }
}
