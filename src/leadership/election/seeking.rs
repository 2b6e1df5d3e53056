//! Seeking a leader: asking other nodes, and claiming leadership in turn.

use std::collections::VecDeque;
use std::time::Duration;

use crate::aggregator::round::FirstRound;
use crate::leadership::election::interface::ElectionEffect;
use crate::leadership::election::leader_clock::LeaderClock;
use crate::leadership::election::leading::Leading;
use crate::leadership::election::message::{Body, Candidacy, LifeSign};
use crate::leadership::election::{Election, State};
use crate::leadership::timers::MAX_WAITING_QUESTIONS;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;

/// State of a node without a leader.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Seeking {
    /// Time at which the first candidate in turn may claim.
    since: Timestamp,
    /// The successors named by the lost leader; other candidates come after them.
    order: Vec<NodeName>,
    /// Time of the first unanswered question about the lost leader.
    asked_at: Option<Timestamp>,
    ask_at: Timestamp,
    /// Evidence of the lost leader must be newer than this time to bring the leader back.
    pub(super) known_until: Timestamp,
}

impl Seeking {
    pub(super) fn new(since: Timestamp, order: Vec<NodeName>, ask_at: Timestamp) -> Self {
        Self {
            since,
            order,
            asked_at: None,
            ask_at,
            known_until: Timestamp::default(),
        }
    }
}

/// The latest questions that this node asked for itself. Evidence is dated from the question that it
/// answers, so stale evidence cannot circulate.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub(super) struct Questions {
    count: u64,
    recent: VecDeque<(u64, Timestamp)>,
}

impl Questions {
    const KEPT: usize = 8;

    /// Number of a question that is passed on to the leader. The leader answers it by a beat, so no
    /// evidence is dated from it.
    fn ask_for_another(&mut self) -> u64 {
        self.count += 1;
        self.count
    }

    pub(super) fn asked_at(&self, ask: u64) -> Option<Timestamp> {
        self.recent
            .iter()
            .find(|(count, _)| *count == ask)
            .map(|(_, at)| *at)
    }

    fn ask_for_itself(&mut self, now: Timestamp) -> u64 {
        self.count += 1;
        self.recent.push_back((self.count, now));
        if self.recent.len() > Self::KEPT {
            self.recent.pop_front();
        }
        self.count
    }

    /// Time of the latest question that this node asked for itself.
    pub(super) fn own_at(&self) -> Timestamp {
        self.recent
            .back()
            .map_or_else(Timestamp::default, |(_, at)| *at)
    }
}

impl Election {
    pub(super) fn seeking_deadline(&self, seeking: &Seeking) -> Timestamp {
        self.claim_at(seeking)
            .map_or(seeking.ask_at, |claim_at| claim_at.min(seeking.ask_at))
    }

    /// Runs the timers of a node without a leader: claims leadership when its turn has come, and
    /// until then repeats its question to all nodes.
    pub(super) fn seek_timers(&mut self, now: Timestamp) {
        let State::Seeking(seeking) = &self.state else {
            return;
        };
        if self.claim_at(seeking).is_some_and(|at| now >= at) {
            self.lead(self.epoch.clone(), now);
        } else if now >= seeking.ask_at {
            self.ask_all(now);
            let ask_at = now + self.config.ask_period();
            if let State::Seeking(seeking) = &mut self.state {
                seeking.ask_at = ask_at;
            }
        }
    }

    /// Starts seeking. The first candidate in `order` that can lead claims at once, the next
    /// candidate one step later.
    pub(super) fn seek(&mut self, order: Vec<NodeName>, since: Timestamp, now: Timestamp) {
        let (known_until, asked_at) = match &self.state {
            State::Following(following) => (
                following.evidence_at() + self.config.beat(),
                following.asked_at,
            ),
            State::Seeking(_) | State::Leading(_) => (now, None),
        };
        // Waits for the claim of the first candidate in turn before it asks all nodes.
        let ask_at = now + self.config.answer_time();
        self.state = State::Seeking(Seeking {
            known_until,
            asked_at,
            ..Seeking::new(since, order, ask_at)
        });
    }

    /// Sends `Ask` to all peers, under one new number.
    pub(super) fn ask_all(&mut self, now: Timestamp) {
        let ask = self.questions.ask_for_itself(now);
        self.send_all(&Body::Ask { ask }, now);
    }

    /// Asks the leader itself and its successors, which receive beats often.
    pub(super) fn ask_near(&mut self, now: Timestamp) {
        let State::Following(following) = &self.state else {
            return;
        };
        let near: Vec<_> = following
            .successors
            .iter()
            .filter(|name| **name != self.id)
            .chain([&following.epoch.leader])
            .cloned()
            .collect();
        let ask = self.questions.ask_for_itself(now);
        for peer in near {
            self.send(&peer, Body::Ask { ask }, now);
        }
    }

    /// Answers a question about the leader: states how long ago this node last received the leader,
    /// with the leader's last sign of life. An old sign of life proves too little; in that case
    /// this node asks the leader for a new one, and answers the question with it.
    pub(super) fn answer(&mut self, from: &NodeName, ask: u64, now: Timestamp) {
        let patience = self.config.response_timeout();
        let life = self
            .leader_clock
            .as_ref()
            .filter(|clock| self.current_epoch().is_some_and(|epoch| clock.is_of(epoch)));
        match &self.state {
            State::Leading(_) => return self.send_beat(from, now),
            State::Following(following) if now.since(following.evidence_at()) <= patience => {
                let leader = following.epoch.leader.clone();
                let evidence_at = following.evidence_at();
                let recent =
                    life.filter(|clock| now.since(clock.latest_at()) <= self.config.beat() * 2);
                if let Some(life) = recent.map(|clock| clock.latest().clone()) {
                    let age = now.since(evidence_at).as_micros().div_ceil(1000);
                    let age_ms = u64::try_from(age).unwrap_or(u64::MAX);
                    return self.send(from, Body::LeaderEvidence { ask, age_ms, life }, now);
                }
                self.waiting_questions.retain(|(other, _)| other != from);
                if leader != *from && self.waiting_questions.len() < MAX_WAITING_QUESTIONS {
                    self.waiting_questions.push((from.clone(), ask));
                    let ask = self.questions.ask_for_another();
                    self.send(&leader, Body::Ask { ask }, now);
                }
            }
            State::Following(_) | State::Seeking(_) => {}
        }
        self.send_status(from, now);
    }

    /// Answers the waiting questions after a sign of life of the leader has arrived.
    pub(super) fn answer_waiting(&mut self, now: Timestamp) {
        for (from, ask) in std::mem::take(&mut self.waiting_questions) {
            self.answer(&from, ask, now);
        }
    }

    /// Processes another node's evidence about the leader. The evidence is dated by the question
    /// that it answers and by the leader's own sign of life; it can keep or bring back a leader, or
    /// make this node follow a leader of a higher epoch.
    pub(super) fn on_leader_evidence(
        &mut self,
        from: &NodeName,
        epoch: Option<Epoch>,
        ask: u64,
        age_ms: u64,
        life: LifeSign,
        now: Timestamp,
    ) {
        let (Some(epoch), Some(asked_at)) = (epoch, self.questions.asked_at(ask)) else {
            return;
        };
        let is_superseded = Some(&epoch) < self.epoch.as_ref();
        if epoch.leader == self.id || epoch.leader == *from || self.is_over(&epoch) || is_superseded
        {
            return;
        }
        let clock = match self.leader_clock.take().filter(|clock| clock.is_of(&epoch)) {
            Some(clock) => self.leader_clock.insert(clock),
            None => {
                self.leader_clock
                    .insert(LeaderClock::of_beat(epoch.clone(), life.clone(), now))
            }
        };
        // Regardless of the stated age, the leader was alive when it sent its sign of life, and no
        // later time is proven.
        let heard_at = (asked_at - Duration::from_millis(age_ms)).min(clock.observe(life, now));
        let believable = heard_at + self.config.response_timeout() > now;
        let doubtful = match &mut self.state {
            State::Following(following) if following.epoch == epoch => {
                following.indirect_heard_at = following.indirect_heard_at.max(heard_at);
                return;
            }
            State::Following(following) => now >= following.direct_timeout_at(&self.config),
            State::Seeking(seeking) => {
                Some(&epoch) != self.epoch.as_ref() || heard_at > seeking.known_until
            }
            State::Leading(_) => false,
        };
        if believable && doubtful {
            self.adopt(epoch, heard_at, now);
        }
    }

    /// Starts leading in an unused term as successor of `after`, and sends a beat to all nodes.
    pub(super) fn lead(&mut self, after: Option<Epoch>, now: Timestamp) {
        let term = self.terms.seen.max(self.terms.found) + 1;
        self.persist(term);
        self.terms.seen = term;
        self.terms.found = term;
        let epoch = Epoch::new(term, self.id.clone());
        self.epoch = Some(epoch.clone());
        let successors = self.successors(now);
        let first = match &self.state {
            State::Seeking(seeking) if seeking.order.first() == Some(&self.id) => {
                FirstRound::Overdue
            }
            State::Seeking(_) => FirstRound::AfterConnects,
            State::Following(_) => FirstRound::OnTime,
            State::Leading(_) => FirstRound::InStep,
        };
        self.effects.push(ElectionEffect::Lead {
            epoch: epoch.clone(),
            first_round: self.next_round(),
            first,
        });
        let mut leading = Leading::new(epoch, after, successors, now);
        if let State::Leading(before) = &self.state {
            leading.renewed(before, self.config.given_up_timeout());
        }
        self.state = State::Leading(leading);
        self.beat_all(now);
    }

    /// Resigns leadership because broker, fuser or gateway failed, or because the node stops.
    pub(super) fn resign(&mut self, now: Timestamp) {
        let State::Leading(leading) = &mut self.state else {
            return;
        };
        let epoch = leading.epoch.clone();
        let order = std::mem::take(&mut leading.successors);
        self.close(epoch.clone());
        self.effects.push(ElectionEffect::StopPublishing {
            epoch: epoch.clone(),
        });
        self.seek(order, now + self.config.response_timeout(), now);
        self.send_all(
            &Body::Resign {
                epoch,
                last_round: self.round,
            },
            now,
        );
    }

    /// Time of this node's turn to claim; `None` if it may not lead.
    ///
    /// A node that did not answer when the leader was suspected counts as unreachable, like the
    /// leader. This node waits for it no longer than an answer takes.
    fn claim_at(&self, seeking: &Seeking) -> Option<Timestamp> {
        let turn =
            |since| seeking.since + self.config.claim_step() * self.place(&seeking.order, since);
        let in_order = turn(None);
        let among_present = seeking
            .asked_at
            .map(|at| turn(Some(at)).max(at + self.config.answer_time()));
        self.candidacy()
            .may_lead()
            .then(|| among_present.map_or(in_order, |at| at.min(in_order)))
    }

    /// Number of nodes that would claim before this node. If `since` is given, only nodes received
    /// at `since` or later count.
    ///
    /// The successors come first, in the order of the lost leader, which received messages from all
    /// nodes. A follower's own record of other nodes may be as old as their first greeting.
    fn place(&self, order: &[NodeName], since: Option<Timestamp>) -> u32 {
        let now = self.clock.now();
        let present = |name: &NodeName| since.is_none_or(|at| self.peers.received_since(name, at));
        let there = |name: &&NodeName| {
            **name == self.id || self.peers.may_succeed(name, now) && present(name)
        };
        let named: Vec<&NodeName> = order.iter().filter(there).collect();
        let before = named
            .iter()
            .position(|name| **name == self.id)
            .unwrap_or_else(|| {
                let place = |name: &NodeName, candidacy: Candidacy| {
                    (candidacy.rank(), candidacy.load, name.clone())
                };
                let own = place(&self.id, self.candidacy());
                let others = self
                    .peers
                    .candidates(now)
                    .filter(|(name, _)| !named.contains(name) && present(name));
                named.len()
                    + others
                        .filter(|&(name, other)| place(name, other) < own)
                        .count()
            });
        u32::try_from(before).unwrap_or(u32::MAX)
    }
}
