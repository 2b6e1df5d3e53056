//! The election's records of the other nodes, and their rank as candidates.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::Duration;

use crate::leadership::config::ElectionConfig;
use crate::leadership::election::message::{Candidacy, ElectionMessage};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::Role;

/// Rank of a candidate. A smaller value is a higher rank: edge before auto, then the higher
/// priority.
pub(super) type Rank = (bool, Reverse<u8>);

impl Candidacy {
    pub(super) fn rank(&self) -> Rank {
        (self.role != Role::Edge, Reverse(self.priority))
    }

    pub(super) fn may_lead(&self) -> bool {
        self.fit && self.role != Role::Cav
    }
}

/// State of another node.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub(super) struct Peer {
    pub(super) candidacy: Option<Candidacy>,
    /// Epoch that the peer follows or leads, according to its last message.
    pub(super) epoch: Option<Epoch>,
    /// True if the last message to the peer confirmed that this node receives it.
    pub(super) is_confirmed: bool,
    /// True while the peer refuses this node's leadership.
    refuses: bool,
    /// Candidates at whose brokers the peer reports that it cannot log in.
    no_login: Vec<NodeName>,
    /// Leadership of this node of which the peer was last notified that it is over.
    corrected: Option<Epoch>,
    /// Lowest term stated by the peer, if it may lead; 0 before any.
    term: u64,
    run: u64,
    seq: u64,
    heard_at: Option<Timestamp>,
    /// Time since which the peer has been reachable without a gap, fit, and of one rank.
    fit_since: Option<Timestamp>,
    /// Time until which the peer counts as gone although delayed messages of it may still arrive.
    gone_until: Option<Timestamp>,
    /// Time at which the membership gave up the peer, if no message of it arrived since.
    given_up_at: Option<Timestamp>,
}

/// Maximum step of the sequence numbers of a reachable node. A leader of 200 nodes sends 4000
/// messages a second.
pub(super) const MAX_SEQ_STEP: u64 = 1 << 16;

/// All other nodes that were discovered and not given up.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Peers {
    table: BTreeMap<NodeName, Peer>,
    /// True if any peer cannot log in somewhere.
    lacks_logins: bool,
    contact_timeout: Duration,
    response_timeout: Duration,
    given_up_timeout: Duration,
    standby_silence: Duration,
    /// Time of the next check for peers that were given up and have been silent since.
    drop_at: Option<Timestamp>,
}

impl Peers {
    /// Creates an empty set with the timeouts of `config`.
    pub(super) fn new(config: &ElectionConfig) -> Self {
        Self {
            table: BTreeMap::new(),
            lacks_logins: false,
            contact_timeout: config.contact_timeout(),
            response_timeout: config.response_timeout(),
            given_up_timeout: config.given_up_timeout(),
            standby_silence: config.standby_silence(),
            drop_at: None,
        }
    }

    pub(super) fn add(&mut self, name: &NodeName) {
        self.table.entry(name.clone()).or_default();
    }

    /// Records a term above 0 that a possible leader states.
    pub(super) fn record_term(&mut self, name: &NodeName, term: u64) {
        let lowest = &mut self.table.entry(name.clone()).or_default().term;
        *lowest = if *lowest == 0 {
            term
        } else {
            term.min(*lowest)
        };
    }

    /// The lowest term stated by a possible leader; `None` while no possible leader has stated one.
    pub(super) fn lowest_term(&self) -> Option<u64> {
        self.table
            .values()
            .map(|peer| peer.term)
            .filter(|term| *term > 0)
            .min()
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &NodeName> {
        self.table.keys()
    }

    pub(super) fn get(&self, name: &NodeName) -> Option<&Peer> {
        self.table.get(name)
    }

    /// Records that a message is sent to a peer. Returns the `hears_you` flag for that message.
    pub(super) fn record_sent(&mut self, name: &NodeName, now: Timestamp) -> bool {
        let Some(peer) = self.table.get_mut(name) else {
            return false;
        };
        peer.is_confirmed = peer
            .heard_at
            .is_some_and(|at| now.since(at) <= self.contact_timeout);
        peer.is_confirmed
    }

    /// True if a peer follows a leadership of `leader` that is over and has not been notified of
    /// it. The peer is notified once per leadership, because its answer is answered too.
    pub(super) fn correct(
        &mut self,
        name: &NodeName,
        leader: &NodeName,
        current: Option<&Epoch>,
    ) -> bool {
        let Some(peer) = self.table.get_mut(name) else {
            return false;
        };
        let over = peer
            .epoch
            .clone()
            .filter(|epoch| epoch.leader == *leader && Some(epoch) != current);
        let is_news = over.is_some() && over != peer.corrected;
        if is_news {
            peer.corrected = over;
        }
        is_news
    }

    /// Records whether a peer refuses this node's leadership.
    pub(super) fn record_refusal(&mut self, name: &NodeName, refuses: bool) {
        if let Some(peer) = self.table.get_mut(name) {
            peer.refuses = refuses;
        }
    }

    /// True if a recently received peer refuses this node's leadership.
    pub(super) fn any_refuses(&self, now: Timestamp) -> bool {
        self.table
            .iter()
            .any(|(name, peer)| peer.refuses && self.receives_from(name, now))
    }

    /// Records at whose brokers a peer cannot log in.
    pub(super) fn record_no_login(&mut self, name: &NodeName, at: Vec<NodeName>) {
        if at.is_empty() && !self.lacks_logins {
            return;
        }
        if let Some(peer) = self.table.get_mut(name) {
            peer.no_login = at;
        }
        self.lacks_logins = self.table.values().any(|peer| !peer.no_login.is_empty());
    }

    /// True if any peer cannot log in somewhere.
    pub(super) fn lacks_logins(&self) -> bool {
        self.lacks_logins
    }

    /// Number of followers of `leader`, except `at`, that cannot log in at the broker of `at`, and
    /// number of all followers.
    pub(super) fn without_login(
        &self,
        leader: &NodeName,
        at: &NodeName,
        now: Timestamp,
    ) -> (usize, usize) {
        let concerned = || {
            self.followers_of(leader, now)
                .filter(|(name, _)| *name != at)
        };
        (
            concerned()
                .filter(|(_, peer)| peer.no_login.contains(at))
                .count(),
            concerned().count(),
        )
    }

    /// True if a peer cannot log in at the broker of `at`.
    pub(super) fn has_no_login(&self, name: &NodeName, at: &NodeName) -> bool {
        self.table
            .get(name)
            .is_some_and(|peer| peer.no_login.contains(at))
    }

    /// True if a message's sequence number is plausible as the sender's next. Gaps occur because
    /// the sender also sends to other nodes and messages are lost.
    pub(super) fn is_in_sequence(&self, message: &ElectionMessage, now: Timestamp) -> bool {
        let known = self
            .table
            .get(&message.from)
            .filter(|peer| peer.run == message.run);
        known.is_none_or(|peer| {
            let is_silent = peer
                .heard_at
                .is_none_or(|at| now.since(at) > self.contact_timeout);
            is_silent || message.seq <= peer.seq.saturating_add(MAX_SEQ_STEP)
        })
    }

    /// Records the sender's state from the fields that every message has. Returns false for a
    /// repeated or overtaken message.
    pub(super) fn record(&mut self, message: &ElectionMessage, now: Timestamp) -> bool {
        let contact_timeout = self.contact_timeout;
        let peer = self.table.entry(message.from.clone()).or_default();
        let silent = peer
            .heard_at
            .is_none_or(|at| now.since(at) > contact_timeout);
        let newer = (message.run, message.seq) > (peer.run, peer.seq);
        if !newer && (message.run == peer.run || !silent) {
            return false;
        }
        let same = peer
            .candidacy
            .is_some_and(|candidacy| candidacy.rank() == message.candidacy.rank());
        if !message.candidacy.fit {
            peer.fit_since = None;
        } else if silent || !same || message.run != peer.run || peer.fit_since.is_none() {
            peer.fit_since = Some(now);
        }
        // A new run, or a peer that was out of contact, has to be informed again that this node
        // receives it.
        peer.is_confirmed &= !silent && message.run == peer.run;
        peer.run = message.run;
        peer.seq = message.seq;
        peer.heard_at = Some(now);
        peer.given_up_at = None;
        peer.candidacy = Some(message.candidacy);
        peer.epoch = message.epoch.clone();
        true
    }

    /// Marks a peer whose process is gone.
    pub(super) fn gone(&mut self, name: &NodeName, now: Timestamp) {
        if let Some(peer) = self.table.get_mut(name) {
            peer.gone_until = Some(now + self.response_timeout);
            peer.fit_since = None;
            peer.heard_at = None;
        }
    }

    /// Removes a peer that the membership gave up: at once if the peer has been silent, otherwise
    /// when it stays silent.
    pub(super) fn down(&mut self, name: &NodeName, now: Timestamp) {
        let Some(peer) = self.table.get_mut(name) else {
            return;
        };
        if peer
            .heard_at
            .is_none_or(|at| now.since(at) > self.given_up_timeout)
        {
            self.table.remove(name);
        } else {
            peer.given_up_at = Some(now);
            self.drop_at.get_or_insert(now + self.given_up_timeout);
        }
    }

    /// Removes the peers that were given up and have been silent since.
    pub(super) fn drop_silent(&mut self, now: Timestamp) {
        if self.drop_at.is_none_or(|at| now < at) {
            return;
        }
        let wait = self.given_up_timeout;
        self.table
            .retain(|_, peer| peer.given_up_at.is_none_or(|at| now < at + wait));
        self.drop_at = self
            .table
            .values()
            .filter_map(|peer| peer.given_up_at)
            .min()
            .map(|at| at + wait);
    }

    /// True if a peer has been reachable and fit for `stable`.
    pub(super) fn is_stable(&self, name: &NodeName, stable: Duration, now: Timestamp) -> bool {
        let since = self.table.get(name).and_then(|peer| peer.fit_since);
        self.receives_from(name, now) && since.is_some_and(|since| now >= since + stable)
    }

    /// Restarts the time for which a peer must be stable before leadership is handed to it.
    pub(super) fn restart_stability(&mut self, name: &NodeName, now: Timestamp) {
        if let Some(peer) = self.table.get_mut(name) {
            peer.fit_since = peer.fit_since.map(|_| now);
        }
    }

    /// True if a message of the peer was received recently.
    pub(super) fn receives_from(&self, name: &NodeName, now: Timestamp) -> bool {
        self.table
            .get(name)
            .and_then(|peer| peer.heard_at)
            .is_some_and(|at| now.since(at) <= self.contact_timeout)
    }

    /// True if a message of the peer was received at `since` or later.
    pub(super) fn received_since(&self, name: &NodeName, since: Timestamp) -> bool {
        self.table
            .get(name)
            .and_then(|peer| peer.heard_at)
            .is_some_and(|at| at >= since)
    }

    /// Number of recently received nodes that report that they follow `leader`. The parts of a node
    /// share its certificate, so a node counts once.
    pub(super) fn followers(&self, leader: &NodeName, now: Timestamp) -> usize {
        self.followers_of(leader, now).count()
    }

    fn followers_of(
        &self,
        leader: &NodeName,
        now: Timestamp,
    ) -> impl Iterator<Item = (&NodeName, &Peer)> {
        let follows = move |peer: &Peer| {
            peer.epoch
                .as_ref()
                .is_some_and(|epoch| epoch.leader == *leader)
        };
        let is_node = move |name: &NodeName| name != leader && name.vehicle() == *name;
        self.table.iter().filter(move |(name, peer)| {
            follows(peer) && is_node(name) && self.receives_from(name, now)
        })
    }

    /// True if a peer could lead, judged by its last messages even if they are old.
    pub(super) fn may_lead(&self, name: &NodeName, now: Timestamp) -> bool {
        self.table.get(name).is_some_and(|peer| {
            peer.candidacy.is_some_and(|candidacy| candidacy.may_lead())
                && peer.gone_until.is_none_or(|until| now >= until)
        })
    }

    /// True if a peer that a leader named as successor could still lead. The leader's list is more
    /// recent than an old message of the peer.
    pub(super) fn may_succeed(&self, name: &NodeName, now: Timestamp) -> bool {
        let unfit = |peer: &Peer| {
            peer.candidacy
                .is_some_and(|candidacy| !candidacy.may_lead())
                && self.receives_from(name, now)
        };
        self.table
            .get(name)
            .is_some_and(|peer| peer.gone_until.is_none_or(|until| now >= until) && !unfit(peer))
    }

    /// All nodes that could lead, in no particular order.
    pub(super) fn candidates(
        &self,
        now: Timestamp,
    ) -> impl Iterator<Item = (&NodeName, Candidacy)> {
        self.table
            .iter()
            .filter(move |(name, _)| self.may_lead(name, now))
            .filter_map(|(name, peer)| Some((name, peer.candidacy?)))
    }

    /// The leader's successors: recently received and fit, the best first. The membership may have
    /// less information than the election, so a peer that the membership gave up stays a successor
    /// if a message of it arrived within the beats that a standby may miss. Peers that are
    /// `out_of_reach` come last.
    pub(super) fn successors(
        &self,
        limit: usize,
        out_of_reach: impl Fn(&NodeName) -> bool,
        now: Timestamp,
    ) -> Vec<NodeName> {
        let silence = self.standby_silence;
        let given_up = |name: &NodeName| {
            self.table
                .get(name)
                .is_some_and(|peer| peer.given_up_at.is_some())
                && !self.received_since(name, now - silence)
        };
        let mut fit: Vec<_> = self
            .candidates(now)
            .filter(|(name, _)| self.receives_from(name, now) && !given_up(name))
            .collect();
        fit.sort_by_key(|&(name, candidacy)| (candidacy.rank(), candidacy.load, name.clone()));
        if self.lacks_logins {
            fit.sort_by_cached_key(|(name, _)| out_of_reach(name));
        }
        fit.into_iter()
            .take(limit)
            .map(|(name, _)| name.clone())
            .collect()
    }

    /// The best peer of a higher rank than `ours`, and the time at which it has been fit for
    /// `stable`.
    ///
    /// Load and name don't move leadership away from a living leader: leading itself causes load,
    /// and a move among equals has no benefit. If a better candidate is more than halfway through
    /// `stable`, the method waits for it, because leadership would otherwise move twice.
    pub(super) fn challenger(
        &self,
        ours: Rank,
        stable: Duration,
        out_of_reach: impl Fn(&NodeName) -> bool,
        now: Timestamp,
    ) -> Option<(NodeName, Timestamp)> {
        self.candidates(now)
            .filter(|(name, other)| {
                self.receives_from(name, now) && other.rank() < ours && !out_of_reach(name)
            })
            .filter_map(|(name, other)| {
                Some((name, other, self.table.get(name)?.fit_since? + stable))
            })
            .min_by_key(|&(name, other, from)| {
                (from > now + stable / 2, other.rank(), name.clone())
            })
            .map(|(name, _, from)| (name.clone(), from))
    }
}
