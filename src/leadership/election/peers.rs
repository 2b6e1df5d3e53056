//! The other nodes as this one knows them, and their rank as candidates.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::time::Duration;

use crate::leadership::config::ElectionConfig;
use crate::leadership::election::message::{Candidacy, ElectionMessage};
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::Role;

/// Rank of a candidate; the lesser value is the higher rank: edge before auto, then the higher priority.
pub(super) type Rank = (bool, Reverse<u8>);

impl Candidacy {
    pub(super) fn rank(&self) -> Rank {
        (self.role != Role::Edge, Reverse(self.priority))
    }

    pub(super) fn may_lead(&self) -> bool {
        self.fit && self.role != Role::Cav
    }
}

/// Another node.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub(super) struct Peer {
    pub(super) candidacy: Option<Candidacy>,
    /// Epoch that it follows or leads, by its own message.
    pub(super) epoch: Option<Epoch>,
    /// True if our last message to it said that we hear it.
    pub(super) told: bool,
    /// Set while it refuses this node's leadership.
    refuses: bool,
    /// Candidates at whose brokers it cannot log in, by its own word.
    no_login: Vec<NodeName>,
    /// Leadership of this node that the peer was last told to be over.
    corrected: Option<Epoch>,
    /// Lowest term that it stated, if it may lead; 0 before any.
    term: u64,
    run: u64,
    seq: u64,
    heard_at: Option<Timestamp>,
    /// Time since when it has been heard without a gap, fit, and of one rank.
    fit_since: Option<Timestamp>,
    /// Time until which it counts as gone although its messages may still be under way.
    gone_until: Option<Timestamp>,
    /// Time at which the membership gave it up, if it was not heard since.
    given_up_at: Option<Timestamp>,
}

/// Largest step of the sequence numbers of a node that is heard. A leader of 200 nodes sends 4000 messages a second.
pub(super) const MAX_SEQ_STEP: u64 = 1 << 16;

/// All other nodes that were ever heard of and not given up.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Peers {
    table: BTreeMap<NodeName, Peer>,
    /// True if any peer cannot log in somewhere.
    lacks_logins: bool,
    contact_timeout: Duration,
    response_timeout: Duration,
    given_up_timeout: Duration,
    standby_silence: Duration,
    /// Time of the next look for peers that were given up and not heard since.
    forget_at: Option<Timestamp>,
}

impl Peers {
    /// No peers; timeouts are those of `config`.
    pub(super) fn new(config: &ElectionConfig) -> Self {
        Self {
            table: BTreeMap::new(),
            lacks_logins: false,
            contact_timeout: config.contact_timeout(),
            response_timeout: config.response_timeout(),
            given_up_timeout: config.given_up_timeout(),
            standby_silence: config.standby_silence(),
            forget_at: None,
        }
    }

    pub(super) fn add(&mut self, name: &NodeName) {
        self.table.entry(name.clone()).or_default();
    }

    /// Notes a term above 0 that a possible leader states.
    pub(super) fn note_term(&mut self, name: &NodeName, term: u64) {
        let lowest = &mut self.table.entry(name.clone()).or_default().term;
        *lowest = if *lowest == 0 {
            term
        } else {
            term.min(*lowest)
        };
    }

    /// The lowest term that a possible leader states; none while no node knows of any.
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

    /// Notes that a peer is sent a message, which says whether it is heard; gives that.
    pub(super) fn tell(&mut self, name: &NodeName, now: Timestamp) -> bool {
        let Some(peer) = self.table.get_mut(name) else {
            return false;
        };
        peer.told = peer
            .heard_at
            .is_some_and(|at| now.since(at) <= self.contact_timeout);
        peer.told
    }

    /// True if a peer follows a leadership of `leader` that is over, and has not been told so: each is told of once, as its
    /// answer is answered too.
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

    /// Notes whether a peer refuses this node's leadership.
    pub(super) fn note_refusal(&mut self, name: &NodeName, refuses: bool) {
        if let Some(peer) = self.table.get_mut(name) {
            peer.refuses = refuses;
        }
    }

    /// True if a peer heard lately refuses this node's leadership.
    pub(super) fn any_refuses(&self, now: Timestamp) -> bool {
        self.table
            .iter()
            .any(|(name, peer)| peer.refuses && self.hears(name, now))
    }

    /// Notes at whose brokers a peer cannot log in.
    pub(super) fn note_no_login(&mut self, name: &NodeName, at: Vec<NodeName>) {
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

    /// Number of followers of `leader`, without `at`, that cannot log in at the broker of `at`, and number of all.
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

    /// True if a message's number can be that of its sender's next: messages are sent to each node, and some are lost.
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

    /// Notes what every message says about its sender; false for one that is repeated or overtaken.
    pub(super) fn note(&mut self, message: &ElectionMessage, now: Timestamp) -> bool {
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
        // A new run, or one out of touch, has to be told again that it is heard.
        peer.told &= !silent && message.run == peer.run;
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

    /// Forgets a peer that the membership gave up: at once if it has been silent, else if it stays so.
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
            self.forget_at.get_or_insert(now + self.given_up_timeout);
        }
    }

    /// Forgets who was given up and not heard since.
    pub(super) fn forget_silent(&mut self, now: Timestamp) {
        if self.forget_at.is_none_or(|at| now < at) {
            return;
        }
        let wait = self.given_up_timeout;
        self.table
            .retain(|_, peer| peer.given_up_at.is_none_or(|at| now < at + wait));
        self.forget_at = self
            .table
            .values()
            .filter_map(|peer| peer.given_up_at)
            .min()
            .map(|at| at + wait);
    }

    /// True if a peer has been heard and fit for `stable`.
    pub(super) fn is_stable(&self, name: &NodeName, stable: Duration, now: Timestamp) -> bool {
        let since = self.table.get(name).and_then(|peer| peer.fit_since);
        self.hears(name, now) && since.is_some_and(|since| now >= since + stable)
    }

    /// Lets a peer prove itself anew before it is handed the lead.
    pub(super) fn restart_trial(&mut self, name: &NodeName, now: Timestamp) {
        if let Some(peer) = self.table.get_mut(name) {
            peer.fit_since = peer.fit_since.map(|_| now);
        }
    }

    /// True if a peer was heard lately.
    pub(super) fn hears(&self, name: &NodeName, now: Timestamp) -> bool {
        self.table
            .get(name)
            .and_then(|peer| peer.heard_at)
            .is_some_and(|at| now.since(at) <= self.contact_timeout)
    }

    /// True if a peer was heard at `since` or later.
    pub(super) fn heard_since(&self, name: &NodeName, since: Timestamp) -> bool {
        self.table
            .get(name)
            .and_then(|peer| peer.heard_at)
            .is_some_and(|at| at >= since)
    }

    /// Number of nodes heard lately that follow a leader, by their own word. Parts share the certificate of their node, which
    /// counts once.
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
        self.table
            .iter()
            .filter(move |(name, peer)| follows(peer) && is_node(name) && self.hears(name, now))
    }

    /// True if a peer could lead, as far as is known without having heard it lately.
    pub(super) fn may_lead(&self, name: &NodeName, now: Timestamp) -> bool {
        self.table.get(name).is_some_and(|peer| {
            peer.candidacy.is_some_and(|candidacy| candidacy.may_lead())
                && peer.gone_until.is_none_or(|until| now >= until)
        })
    }

    /// True if a peer that a leader named its successor could still lead: the leader's word outweighs what the peer
    /// said of itself long ago.
    pub(super) fn may_succeed(&self, name: &NodeName, now: Timestamp) -> bool {
        let unfit = |peer: &Peer| {
            peer.candidacy
                .is_some_and(|candidacy| !candidacy.may_lead())
                && self.hears(name, now)
        };
        self.table
            .get(name)
            .is_some_and(|peer| peer.gone_until.is_none_or(|until| now >= until) && !unfit(peer))
    }

    /// Everyone who could lead, in no order of preference.
    pub(super) fn candidates(
        &self,
        now: Timestamp,
    ) -> impl Iterator<Item = (&NodeName, Candidacy)> {
        self.table
            .iter()
            .filter(move |(name, _)| self.may_lead(name, now))
            .filter_map(|(name, peer)| Some((name, peer.candidacy?)))
    }

    /// The leader's successors: heard lately and fit, the best first. The membership may hear less than the election does.
    /// So a peer that it gave up remains a successor if it was heard within the beats that a standby may miss. Those that
    /// are `out_of_reach` come last.
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
                && !self.heard_since(name, now - silence)
        };
        let mut fit: Vec<_> = self
            .candidates(now)
            .filter(|(name, _)| self.hears(name, now) && !given_up(name))
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

    /// The best peer of a higher rank than `ours`, and the time at which it has been fit for `stable`.
    ///
    /// Neither load nor name takes the lead from a living leader: leading is load, and a move among equals serves nobody.
    /// Waits for a better candidate that is more than halfway through `stable`; otherwise the lead moves twice.
    pub(super) fn challenger(
        &self,
        ours: Rank,
        stable: Duration,
        out_of_reach: impl Fn(&NodeName) -> bool,
        now: Timestamp,
    ) -> Option<(NodeName, Timestamp)> {
        self.candidates(now)
            .filter(|(name, other)| {
                self.hears(name, now) && other.rank() < ours && !out_of_reach(name)
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
