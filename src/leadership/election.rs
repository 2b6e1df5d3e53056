//! The election of the cell's leader, without clocks or sockets.
//!
//! # Call order
//!
//! Call [`Election::new`] with the persisted term. Then call [`Election::handle`] for every input
//! and [`Election::tick`] at [`Election::next_deadline`]. Both return [`ElectionEffect`]s that the
//! caller carries out in order. After a stall, the caller handles all waiting messages before it
//! calls `tick`. Equal inputs give equal effects.
//!
//! # Kinds of methods
//!
//! - *Machine*: [`Election::new`], [`Election::handle`], [`Election::tick`],
//!   [`Election::next_deadline`].
//! - *Queries*, which don't change the state: [`Election::epoch`], [`Election::leader`],
//!   [`Election::is_leading`], [`Election::standby`], [`Election::term`].
//!
//! # States
//!
//! *Seeking* (without a leader, `seeking.rs`), *following* (`following.rs`, `liveness.rs`),
//! *leading* (`leading.rs`, `handover.rs`). See `docs/election.md` for messages, timings and
//! sequences.
//!
//! # Invariants
//!
//! 1. Every leadership has its own [`Epoch`]: a node uses a term once, and the epoch contains the
//!    node's name. The term is written to disk first; [`ElectionEffect::Lead`] describes what
//!    happens if the disk fails.
//! 2. The epoch that a node follows or leads never decreases while the node runs, and it does not
//!    fall below the saved term after a restart. One exception: a node without a term of its own
//!    drops a first term that the other candidates have not reached.
//! 3. A group of nodes whose links all work in both directions settles on exactly one leader: the
//!    best candidate by role and priority, if any candidate is fit.
//! 4. A leader that is alive, fit and reachable for its followers is only replaced by a better
//!    candidate, through a handover.
//! 5. A node does not count its own stall time toward a peer's timeout.
//! 6. A node whose broker, fuser or gateway is broken does not lead.
//!
//! There are no votes and no majority: every side of a split network serves its vehicles. When two
//! leaders receive each other's beats, their rank (role, priority) and number of followers decide
//! which leader stays. If the remaining leader has the lower epoch, it continues in a term above
//! both. Epochs distinguish the earlier rounds of the two leaders.
//!
//! # Why the leader sends its own beats
//!
//! Time until all other nodes detected a leader killed with `kill -9`, in a cell of five nodes on
//! one machine: with a beat every 40 ms and a timeout of 160 ms, 140 ms (median) and 164 ms
//! (maximum); with SWIM gossip (foca, 40 ms period), 155 and 251 ms. A silent leader has to be
//! replaced within 400 ms, a period of 100 ms included, and 251 ms leaves no room for a lost
//! packet. The beat also carries the data that a successor needs (the round number and the list of
//! successors), and proves that the leader's *election* is alive, not just its process. Gossip is
//! the better way to *find* nodes, because its cost per node does not grow with the cell; its
//! results enter as [`ElectionInput::PeerAlive`] and [`ElectionInput::PeerDown`]. To limit a
//! leader's packets, only its standby gets every beat. Other successors, and better candidates that
//! are not yet fit, get every eighth beat, and all other nodes get one every `idle_beat_ms`.

#![deny(clippy::indexing_slicing)]

mod awake_clock;
mod clock_stamps;
mod following;
mod handover;
mod interface;
mod leader_clock;
mod leading;
mod liveness;
mod logins;
mod message;
mod peers;
mod seeking;

pub use crate::leadership::config::ElectionConfig;
pub use awake_clock::AwakeClock;
pub use clock_stamps::{AnsweredStamps, ClockStamps};
pub use interface::{ElectionEffect, ElectionInput, Health};
pub(crate) use message::MAX_FIRST_TERM;
use message::MAX_ROUND_STEP;
pub use message::{
    Body, Candidacy, ElectionMessage, LifeSign, MAX_MESSAGE_BYTES, MAX_NO_LOGIN, MAX_ROUND,
    MAX_SUCCESSORS, MAX_TERM, MAX_TERM_STEP,
};

use crate::leadership::timers::TERM_WINDOW;
use crate::model::epoch::Epoch;
use crate::model::names::NodeName;
use crate::model::time::Timestamp;
use crate::wire::{Role, SCHEMA_VERSION};
use leader_clock::LeaderClock;
use leading::Leading;
use liveness::Following;
use peers::Peers;
use seeking::{Questions, Seeking};

/// The election's state machine on one node.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Election {
    config: ElectionConfig,
    id: NodeName,
    run: u64,
    seq: u64,
    clock: AwakeClock,
    terms: Terms,
    /// The highest epoch followed or led.
    epoch: Option<Epoch>,
    /// Highest epoch that has ended, as far as this node has been informed.
    over: Option<Epoch>,
    /// Number of the last round that was reported or published.
    round: u64,
    health: Health,
    load: u8,
    /// Other candidates at whose brokers this node cannot log in.
    no_login: Vec<NodeName>,
    peers: Peers,
    questions: Questions,
    /// Clock of the leader that was followed last.
    leader_clock: Option<LeaderClock>,
    /// Questions about the leader that wait for the leader's next sign of life: the name of the
    /// node that sent the question, and the number of the question.
    waiting_questions: Vec<(NodeName, u64)>,
    state: State,
    effects: Vec<ElectionEffect>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum State {
    Seeking(Seeking),
    Following(Following),
    Leading(Leading),
}

/// Terms that nodes of the cell have used.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Terms {
    /// Highest term that any node has stated or used.
    seen: u64,
    /// Highest term that counts as this node's own: read from its disk, led in, or stated by peers
    /// for `contact_timeout`.
    found: u64,
    /// Term handed to the disk.
    persisted: u64,
    /// Value of `seen` at the beginning of the current [`TERM_WINDOW`], and the time when the
    /// window began.
    window: (u64, Timestamp),
}

impl Terms {
    /// True if this node has a term of its own. A term of 1 on disk, from a first run in which the
    /// node led alone, does not count.
    fn has_own(&self) -> bool {
        self.found > 1
    }
}

impl Election {
    /// Creates the election of a node that starts; it listens for `join_ms` before it leads.
    /// `persisted_term` is the term of the last [`ElectionEffect::PersistTerm`] of earlier runs, or
    /// 0.
    pub fn new(config: ElectionConfig, id: NodeName, persisted_term: u64, now: Timestamp) -> Self {
        let clock = AwakeClock::new(now, std::time::Duration::from_millis(config.stall_ms));
        let persisted = persisted_term.min(MAX_TERM);
        let join = std::time::Duration::from_millis(config.join_ms);
        Self {
            id,
            run: now.micros(),
            seq: 0,
            clock,
            terms: Terms {
                seen: persisted.saturating_sub(1),
                found: persisted,
                persisted,
                window: (persisted.saturating_sub(1), now),
            },
            epoch: None,
            over: None,
            round: 0,
            health: Health::default(),
            load: 0,
            no_login: Vec::new(),
            peers: Peers::new(&config),
            questions: Questions::default(),
            leader_clock: None,
            waiting_questions: Vec::new(),
            state: State::Seeking(Seeking::new(now + join, Vec::new(), now)),
            effects: Vec::new(),
            config,
        }
    }

    /// Processes one input and returns its effects.
    pub fn handle(&mut self, input: ElectionInput, now: Timestamp) -> Vec<ElectionEffect> {
        let now = self.advance(now);
        match input {
            ElectionInput::Receive { message } => self.receive(message, now),
            ElectionInput::PeerAlive { peer } => self.peer_alive(&peer, now),
            ElectionInput::PeerSuspected { peer } => self.peer_suspected(&peer, now),
            ElectionInput::PeerDown { peer } => self.peer_down(&peer, now),
            ElectionInput::PeerGone { peer } => self.peer_gone(&peer, now),
            ElectionInput::Health { health } => self.set_health(health, now),
            ElectionInput::Round { epoch, round } => self.record_round(&epoch, round, now),
            ElectionInput::NoLogin { at } => self.set_no_login(at, now),
            ElectionInput::Prepared => self.prepared(now),
            ElectionInput::Greet => self.greet(now),
            ElectionInput::Leave => self.leave(now),
        }
        self.run_timers(now);
        self.finish()
    }

    /// Runs the timers that are due.
    pub fn tick(&mut self, now: Timestamp) -> Vec<ElectionEffect> {
        let now = self.advance(now);
        self.run_timers(now);
        self.finish()
    }

    /// Time of the next call of [`Self::tick`], on the caller's clock.
    pub fn next_deadline(&self) -> Timestamp {
        self.clock.outside(self.deadline())
    }

    /// Name of the node on which this election runs.
    pub fn name(&self) -> &NodeName {
        &self.id
    }

    /// The highest epoch followed or led so far.
    pub fn epoch(&self) -> Option<&Epoch> {
        self.epoch.as_ref()
    }

    /// The node's current leader; `None` while it seeks.
    pub fn leader(&self) -> Option<&NodeName> {
        self.current_epoch().map(|epoch| &epoch.leader)
    }

    /// True if this node leads.
    pub fn is_leading(&self) -> bool {
        matches!(self.state, State::Leading(_))
    }

    /// True if this leader has yielded: its standby publishes the next round.
    pub fn is_yielding(&self) -> bool {
        matches!(&self.state, State::Leading(leading) if leading.is_yielding())
    }

    /// The next leader, as announced by the current leader.
    pub fn standby(&self) -> Option<&NodeName> {
        match &self.state {
            State::Seeking(_) => None,
            State::Following(following) => following.successors.first(),
            State::Leading(leading) => leading.successors.first(),
        }
    }

    /// The highest term that any node has stated or used.
    pub fn term(&self) -> u64 {
        self.terms.seen
    }

    /// Begins each input: advances the node's awake clock to `now` and returns its time. Time beyond
    /// the deadline plus the tolerance does not count, so a stalled node gives up no leader.
    fn advance(&mut self, now: Timestamp) -> Timestamp {
        self.clock.advance(now, self.deadline())
    }

    fn deadline(&self) -> Timestamp {
        match &self.state {
            State::Seeking(seeking) => self.seeking_deadline(seeking),
            State::Following(following) => self.following_deadline(following),
            State::Leading(leading) => leading.deadline(),
        }
    }

    /// Removes peers that were given up, then carries out what is due in the current state. A
    /// follower that loses its leader starts to seek, and may claim leadership in the same call.
    fn run_timers(&mut self, now: Timestamp) {
        self.peers.drop_silent(now);
        if let State::Following(_) = self.state {
            self.follow_timers(now);
        }
        match self.state {
            State::Seeking(_) => self.seek_timers(now),
            State::Leading(_) => self.lead_timers(now),
            State::Following(_) => {}
        }
    }

    /// Ends an input: requests the term after the highest used one on disk, and returns the
    /// collected effects.
    fn finish(&mut self) -> Vec<ElectionEffect> {
        // The next term is written to disk before it is needed, so that taking the lead does not
        // have to wait for the disk.
        self.persist(self.terms.seen + 1);
        std::mem::take(&mut self.effects)
    }

    fn persist(&mut self, term: u64) {
        if term > self.terms.persisted {
            self.terms.persisted = term;
            self.effects.push(ElectionEffect::PersistTerm { term });
        }
    }

    /// Processes an authenticated message: checks its term and sequence number, records the
    /// sender's state, and passes the body to the handler of its kind. Messages that are repeated,
    /// overtaken or implausible are dropped before they change any state. For example, a `Beat`
    /// reaches `on_beat` only if the sender itself leads the stated epoch.
    ///
    /// # Example
    /// In term 4, a beat with term 9 and epoch 9 arrives from `gauss`. The term is plausible and
    /// the sequence number is new: the highest used term becomes 9, `gauss` counts as a candidate
    /// that is in contact, and `on_beat` decides whether to follow it. The same beat over a second
    /// path is dropped by its sequence number.
    fn receive(&mut self, mut message: ElectionMessage, now: Timestamp) {
        if message.from == self.id {
            return;
        }
        if message.term != self.terms.seen && !self.is_plausible(&mut message, now) {
            return;
        }
        if !self.peers.is_in_sequence(&message, now) {
            self.effects
                .push(ElectionEffect::CountImplausible { from: message.from });
            return;
        }
        if !self.peers.record(&message, now) {
            return;
        }
        self.observe_term(message.term);
        if self.terms.window.0 == 0 {
            self.terms.window = (self.terms.seen, now);
        }
        self.on_other_leadership(&message, now);
        let ElectionMessage {
            from,
            epoch,
            hears_you,
            ..
        } = message;
        match message.body {
            Body::Status { over, no_login } => {
                self.on_status(&from, over.as_ref(), no_login, now);
            }
            Body::Ask { ask } => self.answer(&from, ask, now),
            Body::LeaderEvidence { ask, age_ms, life } => {
                self.on_leader_evidence(&from, epoch, ask, age_ms, life, now);
            }
            Body::Beat {
                every_ms,
                round,
                followers,
                after,
                successors,
                life,
            } => {
                if let Some(epoch) = epoch.filter(|epoch| epoch.leader == from) {
                    let beat = Beat {
                        epoch,
                        hears_us: hears_you,
                        every_ms,
                        round,
                        followers,
                        after,
                        successors,
                        life,
                    };
                    self.on_beat(beat, now);
                }
            }
            Body::Offer => self.on_offer(&from, epoch.as_ref(), now),
            Body::Ready => self.on_ready(&from, now),
            Body::Yield { last_round } => self.on_yield(&from, epoch.as_ref(), last_round, now),
            Body::Resign { epoch, last_round } => self.on_resign(&epoch, last_round, now),
        }
    }

    /// Checks the term of a message. If only the term is implausible, replaces it by a plausible
    /// term, so that a node that adopted a wrong term from elsewhere can still communicate.
    fn is_plausible(&mut self, message: &mut ElectionMessage, now: Timestamp) -> bool {
        if !self.terms.has_own()
            && message.candidacy.role != Role::Cav
            && (1..=MAX_FIRST_TERM).contains(&message.term)
        {
            self.peers.record_term(&message.from, message.term);
        }
        let limit = self.term_limit(message.candidacy.role, now);
        self.drop_first_term(limit, now);
        if message.term > limit {
            self.effects.push(ElectionEffect::CountImplausible {
                from: message.from.clone(),
            });
            if message.highest_epoch() > limit {
                return false;
            }
            message.term = self.terms.seen.max(message.highest_epoch());
        }
        true
    }

    /// Highest term that a node of this role may state now. A node without a term of its own
    /// accepts the lowest term stated by any possible leader, so that one false claim does not
    /// separate it from the cell.
    fn term_limit(&mut self, role: Role, now: Timestamp) -> u64 {
        let contact_timeout = self.config.contact_timeout();
        let Terms {
            seen,
            found,
            window: (before, since),
            ..
        } = &mut self.terms;
        if *before > 0 && now.since(*since) >= contact_timeout {
            *found = (*found).max(*seen);
        }
        if *before == 0 || now.since(*since) >= TERM_WINDOW {
            *before = *seen;
            *since = now;
        }
        let has_own = self.terms.has_own();
        let stated = if has_own {
            None
        } else {
            self.peers.lowest_term()
        };
        match stated
            .into_iter()
            .chain([self.terms.window.0])
            .filter(|term| *term > 0)
            .min()
        {
            None if role != Role::Cav => MAX_FIRST_TERM,
            lowest => (lowest.unwrap_or(0) + MAX_TERM_STEP).min(MAX_TERM),
        }
    }

    /// Drops a first term that the other candidates have not reached. Only a node without a term of
    /// its own does so.
    fn drop_first_term(&mut self, limit: u64, now: Timestamp) {
        if self.terms.has_own() || self.terms.seen <= limit {
            return;
        }
        let is_beyond = |epoch: &mut Epoch| epoch.term > limit;
        self.terms = Terms {
            seen: 0,
            persisted: 0,
            window: (0, now),
            ..self.terms
        };
        self.epoch.take_if(is_beyond);
        self.over.take_if(is_beyond);
        if self.current_epoch().is_some_and(|epoch| epoch.term > limit) {
            self.seek(Vec::new(), now + self.config.response_timeout(), now);
        }
    }

    /// Raises the highest used term to `term`.
    fn observe_term(&mut self, term: u64) {
        self.terms.seen = self.terms.seen.max(term);
    }

    /// Records the last round of a leadership as stated by a node.
    fn observe_round(&mut self, from: &NodeName, round: u64) {
        let limit = if self.round == 0 {
            MAX_ROUND
        } else {
            self.round.saturating_add(MAX_ROUND_STEP)
        };
        if round <= limit.min(MAX_ROUND) {
            self.round = self.round.max(round);
        } else {
            self.effects
                .push(ElectionEffect::CountImplausible { from: from.clone() });
        }
    }

    /// Number of the first round of a new leadership. Rounds start over well before the largest
    /// number that receivers accept.
    fn next_round(&self) -> u64 {
        if self.round < MAX_ROUND / 2 {
            self.round + 1
        } else {
            1
        }
    }

    /// Handles a node that the membership found: adds the peer and sends it this leader's beat, or
    /// this node's status.
    fn peer_alive(&mut self, peer: &NodeName, now: Timestamp) {
        if *peer == self.id {
            return;
        }
        self.peers.add(peer);
        if self.is_leading() {
            self.send_beat(peer, now);
        } else {
            self.send_status(peer, now);
        }
    }

    /// Handles a change of the node's own parts. A change of load alone is only advertised. A
    /// leader that becomes unfit resigns; a follower reports its changed fitness to its leader at
    /// once.
    ///
    /// # Example
    /// The fuser of the leader `edge` hangs after round 88. `edge` stops publishing, sends `Resign`
    /// to all nodes and seeks. Its standby `gauss` leads from round 89 on.
    fn set_health(&mut self, health: Health, now: Timestamp) {
        let was_fit = self.health.is_fit();
        self.health = health;
        if health.load_percent.abs_diff(self.load * LOAD_QUARTER) > LOAD_QUARTER {
            self.load = (health.load_percent.min(100) + LOAD_QUARTER / 2) / LOAD_QUARTER;
        }
        if was_fit == health.is_fit() {
            return;
        }
        match &self.state {
            State::Leading(_) => self.resign(now),
            State::Following(following) => {
                let leader = following.epoch.leader.clone();
                self.send_status(&leader, now);
            }
            State::Seeking(_) => {}
        }
    }

    /// Informs the other nodes immediately that this node is neither leader nor candidate any more.
    fn leave(&mut self, now: Timestamp) {
        let Health { load_percent, .. } = self.health;
        self.set_health(
            Health {
                load_percent,
                ..Health::default()
            },
            now,
        );
    }

    fn candidacy(&self) -> Candidacy {
        Candidacy {
            role: self.config.role,
            priority: self.config.priority,
            load: self.load,
            fit: self.health.is_fit(),
        }
    }

    /// The epoch that this node currently follows or leads.
    fn current_epoch(&self) -> Option<&Epoch> {
        match &self.state {
            State::Seeking(_) => None,
            State::Following(following) => Some(&following.epoch),
            State::Leading(leading) => Some(&leading.epoch),
        }
    }

    fn is_over(&self, epoch: &Epoch) -> bool {
        self.over.as_ref().is_some_and(|over| epoch <= over)
    }

    fn close(&mut self, epoch: Epoch) {
        self.over = self.over.take().max(Some(epoch));
    }

    /// Announces this node without waiting for a question: a vehicle that cannot lead sends its
    /// status to its leader, every other node sends it to all peers.
    fn greet(&mut self, now: Timestamp) {
        let leader = self.leader().filter(|leader| **leader != self.id).cloned();
        match leader {
            Some(leader) if self.config.role == Role::Cav => self.send_status(&leader, now),
            _ => self.send_all(
                &Body::Status {
                    over: self.over.clone(),
                    no_login: self.no_login.clone(),
                },
                now,
            ),
        }
    }

    /// Sends this node's state to one peer: a greeting, the answer to a beat, or a refusal by the
    /// highest epoch that is over.
    fn send_status(&mut self, to: &NodeName, now: Timestamp) {
        self.send(
            to,
            Body::Status {
                over: self.over.clone(),
                no_login: self.no_login.clone(),
            },
            now,
        );
    }

    /// Queues one message to a peer. Every message contains this node's candidacy, highest term and
    /// current epoch, and whether the peer's messages arrive here.
    fn send(&mut self, to: &NodeName, body: Body, now: Timestamp) {
        self.seq += 1;
        let hears_you = self.peers.record_sent(to, now);
        let message = ElectionMessage {
            schema: SCHEMA_VERSION,
            from: self.id.clone(),
            run: self.run,
            seq: self.seq,
            candidacy: self.candidacy(),
            term: self.terms.seen,
            epoch: self.current_epoch().cloned(),
            hears_you,
            body,
            clock: None,
            description: None,
        };
        self.effects.push(ElectionEffect::Send {
            to: to.clone(),
            message,
        });
    }

    fn send_all(&mut self, body: &Body, now: Timestamp) {
        for peer in self.peers.names().cloned().collect::<Vec<_>>() {
            self.send(&peer, body.clone(), now);
        }
    }
}

/// Content of a received beat.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Beat {
    epoch: Epoch,
    hears_us: bool,
    every_ms: u64,
    round: u64,
    followers: u8,
    after: Option<Epoch>,
    successors: Vec<NodeName>,
    life: LifeSign,
}

/// One step of advertised load, in percent.
const LOAD_QUARTER: u8 = 25;

#[cfg(test)]
mod tests;
