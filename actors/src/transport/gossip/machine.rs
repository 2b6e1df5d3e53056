//! State machine of the membership: datagrams and time in, datagrams and events out. No socket, no
//! clock.
//!
//! # Call order
//!
//! [`GossipMachine::new`], then [`GossipMachine::receive`] for every datagram,
//! [`GossipMachine::tick`] at [`GossipMachine::next_deadline`], and the commands at any time. After
//! each call, [`GossipMachine::poll`] until it returns `None`. A caller that was stalled passes all
//! waiting datagrams before it ticks; the time of the stall does not count.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ecod::diagnostics::TroubleKind;
use ecod::leadership::election::AwakeClock;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::config::MembershipConfig;
use super::counters::{FrameCounters, FrameEvent};
use super::frame::{FrameKind, Introduction, NameClaim};
use super::handshake::Identity;
use super::key::{CellKey, SessionNonce};
use super::node_id::{MAX_CLAIMED_LIFE, NodeId};
use super::notices::GossipNotice;
use super::sessions::{Arrival, FrameContent, Sessions, SessionsSetup};
use super::swim::{Swim, SwimOutput};
use super::{Member, MembershipEvent};
use crate::platform::throttle::TokenBucket;

/// An action for the caller.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum GossipOutput {
    /// Send a datagram to a node.
    Send { to: SocketAddr, frame: Vec<u8> },
    /// Send a datagram to the multicast group.
    Multicast { frame: Vec<u8> },
    /// Deliver an event.
    Event(MembershipEvent),
    /// Answer a message about a renewed certificate.
    Renewal {
        from: NodeName,
        /// The certificate that the sender has proven, in DER.
        certificate: Arc<[u8]>,
        body: Vec<u8>,
    },
}

/// Arguments of [`GossipMachine::new`].
pub(crate) struct GossipSetup {
    pub(crate) own: NodeId,
    pub(crate) cell: NodeName,
    pub(crate) key: CellKey,
    /// Random for each start, and unpredictable.
    pub(crate) session: SessionNonce,
    /// The node's certificates; `None` in a cell without.
    pub(crate) identity: Option<Identity>,
    /// Secret of the cookies; random for each start.
    pub(crate) secret: [u8; 32],
    /// Seed of random numbers that need not be secret.
    pub(crate) seed: u64,
    pub(crate) counters: Arc<FrameCounters>,
}

/// The membership of one node.
pub(crate) struct GossipMachine {
    sessions: Sessions,
    gossip: Swim,
    clock: AwakeClock,
    started_at: Timestamp,
    hello: Duration,
    hello_at: Timestamp,
    hello_count: u64,
    /// Greetings since this node last had another member.
    unanswered: u32,
    /// Seeds from which readable datagrams have arrived since then, including this node's own
    /// address.
    answered: BTreeSet<SocketAddr>,
    seeds: Vec<SocketAddr>,
    /// Frames that wait for a session with their addressee.
    pending: HashMap<NodeName, PendingFrames>,
    /// Nodes that were only mentioned by other nodes, and the time of the last greeting to them.
    unproven: HashMap<NodeName, Timestamp>,
    /// Names that a second run claims, up to [`MAX_TAKEN`].
    taken: BTreeMap<NodeName, TakenName>,
    /// Time since which all other nodes report that this node's name belongs to another node.
    excluded_since: Option<Timestamp>,
    /// Throttle of reports about other hosts.
    notices: TokenBucket,
    /// True if the node has to discover its address from other nodes.
    learns_address: bool,
    left: bool,
    rng: ChaCha8Rng,
    outputs: VecDeque<GossipOutput>,
    counters: Arc<FrameCounters>,
}

/// Two runs that claim one name.
struct TakenName {
    since: Timestamp,
    last: Timestamp,
    reported: Timestamp,
}

struct PendingFrames {
    since: Timestamp,
    frames: Vec<(FrameKind, Vec<u8>)>,
}

impl GossipMachine {
    pub(crate) fn new(setup: GossipSetup, config: &MembershipConfig, now: Timestamp) -> Self {
        let GossipSetup {
            own,
            cell,
            key,
            session,
            identity,
            secret,
            seed,
            counters,
        } = setup;
        let proves = identity.is_some();
        let clock = AwakeClock::new(now, STALL);
        Self {
            learns_address: own.gossip.ip().is_unspecified(),
            sessions: Sessions::new(
                SessionsSetup {
                    cell,
                    key,
                    name: &own.name,
                    nonce: session,
                    identity,
                    secret: &secret,
                    max_peers: config.max_peers,
                    counters: Arc::clone(&counters),
                },
                now,
            ),
            gossip: Swim::new(own, config, proves, seed),
            clock,
            started_at: now,
            hello: config.hello(),
            hello_at: now,
            hello_count: 0,
            unanswered: 0,
            answered: BTreeSet::new(),
            seeds: Vec::new(),
            pending: HashMap::new(),
            unproven: HashMap::new(),
            taken: BTreeMap::new(),
            excluded_since: None,
            notices: TokenBucket::new(NOTICE_BURST, NOTICE_INTERVAL, now),
            left: false,
            rng: ChaCha8Rng::seed_from_u64(seed.wrapping_add(1)),
            outputs: VecDeque::new(),
            counters,
        }
    }

    /// The next action for the caller.
    pub(crate) fn poll(&mut self) -> Option<GossipOutput> {
        self.outputs.pop_front()
    }

    /// Time at which [`Self::tick`] is next needed; `None` after leaving.
    pub(crate) fn next_deadline(&self) -> Option<Timestamp> {
        (!self.left).then(|| self.clock.outside(self.due()))
    }

    /// All living nodes except this one, by name.
    pub(crate) fn members(&self) -> Vec<Member> {
        self.gossip
            .alive()
            .values()
            .map(|id| self.member(id))
            .collect()
    }

    /// Handles a datagram: opens and checks the frame, and handles its content. A refused frame is
    /// counted by its reason. Outputs are available from [`Self::poll`].
    ///
    /// # Example
    /// `Hello` of the new node `gauss` arrives: the output is a challenge with a cookie. `Proof`
    /// with this cookie arrives: the outputs are `Accept` and the event that `gauss` is alive. A
    /// `Proof` with another cookie is counted as [`FrameEvent::Replayed`].
    pub(crate) fn receive(&mut self, datagram: &[u8], from: SocketAddr, now: Timestamp) {
        let at = self.advance(now);
        self.counters.count(FrameEvent::Received);
        if self.left {
            return;
        }
        let gossip = &self.gossip;
        let arrival = Arrival {
            from,
            now: at,
            own: gossip.own(),
            is_alone: self.unanswered >= ALONE_HELLOS,
            known: &|name| gossip.known(name),
        };
        let taken = match self.sessions.open(datagram, &arrival) {
            Ok(opened) => {
                if self.seeds.contains(&from) {
                    self.answered.insert(from);
                }
                self.on_opened_frame(opened, from, at, now)
            }
            Err(reason) => Err(reason),
        };
        if let Err(reason) = taken {
            self.counters.count(reason);
            tracing::debug!(%from, reason = reason.as_str(), "gossip frame refused");
        }
        for GossipNotice { about, kind, cause } in self.sessions.take_notices() {
            if self.notices.allow(at) {
                let event = MembershipEvent::Troubled { about, kind, cause };
                self.outputs.push_back(GossipOutput::Event(event));
            }
        }
        self.flush_swim(at);
    }

    /// Runs the timers that are due.
    pub(crate) fn tick(&mut self, now: Timestamp) {
        let at = self.advance(now);
        if self.left {
            return;
        }
        self.gossip.tick(at);
        if self.hello_at <= at {
            self.send_hellos();
            self.schedule_hello(at);
        }
        self.pending
            .retain(|_, pending| at.since(pending.since) < SESSION_TIMEOUT);
        self.flush_swim(at);
    }

    /// Sends a datagram to a node, once. Datagrams are also sent for a while to a node that the
    /// gossip has just declared down.
    pub(crate) fn send(&mut self, to: &NodeName, payload: &[u8], now: Timestamp) {
        self.send_as(FrameKind::Payload, to, payload, now);
    }

    /// Sends a message about a renewed certificate, once.
    pub(crate) fn send_renewal(&mut self, to: &NodeName, body: &[u8], now: Timestamp) {
        self.send_as(FrameKind::Renewal, to, body, now);
    }

    /// Sends a frame of this kind to a living or recently active node, or queues it until the
    /// handshake with the node is complete. Without an address it is counted as
    /// [`FrameEvent::NoSession`].
    fn send_as(&mut self, kind: FrameKind, to: &NodeName, payload: &[u8], now: Timestamp) {
        let at = self.advance(now);
        let address = self
            .gossip
            .alive()
            .get(to)
            .map(|id| id.gossip)
            .or_else(|| self.sessions.recent_address(to, at));
        match address {
            Some(address) if !self.left => {
                self.send_or_queue(to, address, kind, payload, at);
            }
            _ => self.counters.count(FrameEvent::NoSession),
        }
    }

    /// Replaces the addresses that are greeted in addition to the multicast group.
    pub(crate) fn set_seeds(&mut self, seeds: Vec<SocketAddr>) {
        if self.seeds != seeds {
            self.hello_count = 0;
            self.hello_at = self.clock.now();
            self.seeds = seeds;
        }
    }

    /// Sets changed certificates and the time. Nodes whose certificate has become invalid are down
    /// at once.
    pub(crate) fn set_identity(&mut self, identity: Identity, now: Timestamp) {
        let at = self.advance(now);
        let (expelled, greeted) = self.sessions.set_identity(identity);
        for name in expelled {
            tracing::warn!(node = %name, "session ended: its certificate was revoked or has expired");
            self.gossip.remove(&name, at);
            self.outputs
                .push_back(GossipOutput::Event(MembershipEvent::Expelled { name }));
        }
        for address in greeted {
            self.send_hello(address, true, at);
        }
        self.flush_swim(at);
    }

    /// This node's address as it states it; unspecified until it is discovered.
    pub(crate) fn own_address(&self) -> SocketAddr {
        self.gossip.own().gossip
    }

    /// Continues at another address of this machine, and greets all nodes from there.
    pub(crate) fn move_to(&mut self, ip: IpAddr, now: Timestamp) {
        let at = self.advance(now);
        self.gossip.change(at, |own| own.gossip.set_ip(ip));
        for address in self.sessions.addresses() {
            self.send_hello(address, true, at);
        }
        self.outputs
            .push_back(GossipOutput::Event(MembershipEvent::Moved));
        self.flush_swim(at);
    }

    /// Spreads a true or false statement about a node.
    #[cfg(test)]
    pub(crate) fn spread(&mut self, about: foca::Member<NodeId>, now: Timestamp) {
        let at = self.advance(now);
        self.gossip.spread(about, at);
        self.flush_swim(at);
    }

    /// Announces to all nodes that this one leaves. Afterwards the machine sends and processes no
    /// datagrams.
    pub(crate) fn leave(&mut self, now: Timestamp) {
        let at = self.advance(now);
        if !self.left {
            self.gossip.leave(at);
            self.flush_swim(at);
            self.left = true;
        }
    }

    /// Handles the content of an authentic frame: answers and greetings are queued, gossip goes to
    /// SWIM, payloads and renewals become outputs.
    ///
    /// # Errors
    /// Returns the event under which refused gossip is counted.
    fn on_opened_frame(
        &mut self,
        opened: FrameContent,
        from: SocketAddr,
        at: Timestamp,
        now: Timestamp,
    ) -> Result<(), FrameEvent> {
        match opened {
            FrameContent::Answer(frame) => self
                .outputs
                .push_back(GossipOutput::Send { to: from, frame }),
            FrameContent::Introduced {
                introduction,
                answer,
                speaks,
                has_moved,
            } => {
                let greeter = answer.is_none();
                self.outputs
                    .extend(answer.map(|frame| GossipOutput::Send { to: from, frame }));
                let name = introduction.id.name.clone();
                self.on_introduction(introduction, from, speaks, greeter, at);
                let moved = self.gossip.alive().get(&name).filter(|_| has_moved);
                if let Some(id) = moved {
                    let member = self.member(id);
                    let event = MembershipEvent::Changed { member };
                    self.outputs.push_back(GossipOutput::Event(event));
                }
            }
            FrameContent::Gossip { from, body } => {
                let has_received = |name: &NodeName| self.sessions.has_received(name, at);
                self.gossip.receive(&from, &body, &has_received, at)?;
            }
            FrameContent::Payload { from, rights, body } => {
                let event = MembershipEvent::Received {
                    from,
                    rights,
                    payload: Bytes::from(body),
                    received_at: now,
                };
                self.outputs.push_back(GossipOutput::Event(event));
            }
            FrameContent::Renewal {
                from,
                certificate,
                body,
            } => self.outputs.push_back(GossipOutput::Renewal {
                from,
                certificate,
                body,
            }),
            FrameContent::Stranger => self.send_hello(from, true, at),
            FrameContent::NameTaken(name) => self.report_taken(&name, second_run(from), at),
            FrameContent::Namesake { id, answer } => self.on_namesake(&id, answer, from, at),
            FrameContent::Nothing => (),
        }
        Ok(())
    }

    /// Processes the handshake of an admitted node: its claims to this node's name, then its
    /// identity. `speaks` is true if its session is accepted for its name, `greeter` if this node
    /// began the handshake.
    fn on_introduction(
        &mut self,
        introduction: Introduction,
        from: SocketAddr,
        speaks: bool,
        greeter: bool,
        at: Timestamp,
    ) {
        let Introduction { id, seen_at, claim } = introduction;
        match claim {
            NameClaim::Free => (),
            NameClaim::After(life) if life <= MAX_CLAIMED_LIFE => {
                self.gossip.start_life_after(life, at);
            }
            NameClaim::After(_) => (),
            NameClaim::Taken => return self.step_back(from, at),
        }
        self.excluded_since = None;
        let own = self.gossip.own().gossip.ip();
        if self.learns_address
            && (own.is_unspecified() || own.is_loopback() && !seen_at.ip().is_loopback())
        {
            self.gossip.change(at, |own| own.gossip = seen_at);
        }
        if !speaks {
            return self.report_taken(&id.name, second_run(from), at);
        }
        self.gossip.record_member(&id);
        for (kind, body) in self
            .pending
            .remove(&id.name)
            .map(|pending| pending.frames)
            .unwrap_or_default()
        {
            self.send_or_queue(&id.name, seen_at, kind, &body, at);
        }
        let alive = self
            .gossip
            .known(&id.name)
            .is_some_and(|known| known.alive && known.life >= id.life);
        if greeter || !alive {
            self.gossip.member_up(id, at);
        }
    }

    /// Sends the messages of SWIM and delivers its events.
    fn flush_swim(&mut self, at: Timestamp) {
        while let Some(rumour) = self.gossip.poll() {
            let event = match rumour {
                SwimOutput::Send { to, body } => {
                    self.send_or_queue(&to.name, to.gossip, FrameKind::Gossip, &body, at);
                    continue;
                }
                SwimOutput::Alive(id) => {
                    if self.sessions.end_earlier_run(&id.name, id.run, at) {
                        self.send_hello(id.gossip, false, at);
                    }
                    MembershipEvent::Alive {
                        member: self.member(&id),
                    }
                }
                SwimOutput::Changed(id) => MembershipEvent::Changed {
                    member: self.member(&id),
                },
                SwimOutput::Unproven(id) => {
                    self.greet_unproven(id, at);
                    continue;
                }
                SwimOutput::Suspected(name) => MembershipEvent::Suspected { name },
                SwimOutput::Down(name) => MembershipEvent::Down { name },
            };
            self.outputs.push_back(GossipOutput::Event(event));
        }
    }

    /// Sends to a node, or queues a few frames until there is a session with it.
    fn send_or_queue(
        &mut self,
        to: &NodeName,
        address: SocketAddr,
        kind: FrameKind,
        body: &[u8],
        at: Timestamp,
    ) {
        if let Some((address, frame)) = self.sessions.seal(to, kind, body, at) {
            self.outputs
                .push_back(GossipOutput::Send { to: address, frame });
            if let Some(address) = self.sessions.silent_address(to, at) {
                self.send_hello(address, true, at);
            }
            return;
        }
        if !self.pending.contains_key(to) {
            if self.pending.len() >= MAX_PENDING || address.ip().is_unspecified() {
                return self.counters.count(FrameEvent::NoSession);
            }
            self.pending.insert(
                to.clone(),
                PendingFrames {
                    since: at,
                    frames: Vec::new(),
                },
            );
            self.send_hello(address, true, at);
        }
        match self.pending.get_mut(to) {
            Some(pending) if pending.frames.len() < MAX_PENDING_FRAMES => {
                pending.frames.push((kind, body.to_vec()));
            }
            _ => self.counters.count(FrameEvent::NoSession),
        }
    }

    /// Greets a node that other nodes mention and whose certificate this node has not seen.
    fn greet_unproven(&mut self, id: NodeId, at: Timestamp) {
        self.unproven
            .retain(|_, greeted| at.since(*greeted) < UNPROVEN_INTERVAL);
        let is_new = self.unproven.len() < MAX_UNPROVEN && !self.unproven.contains_key(&id.name);
        if is_new && !id.gossip.ip().is_unspecified() {
            self.unproven.insert(id.name, at);
            self.send_hello(id.gossip, true, at);
        }
    }

    fn send_hello(&mut self, to: SocketAddr, wants_session: bool, at: Timestamp) {
        if self.sessions.may_send_hello(at) {
            let frame = self.sessions.hello(self.gossip.own(), wants_session);
            self.outputs.push_back(GossipOutput::Send { to, frame });
        }
    }

    /// Greets all seeds that do not belong to a living node, so that a returning seed discovers its
    /// cell before it leads on its own. Greets the multicast group too, less often once other nodes
    /// are alive.
    fn send_hellos(&mut self) {
        let frame = self.sessions.hello(self.gossip.own(), false);
        let known: Vec<_> = self.members().iter().map(|member| member.gossip).collect();
        let missing = self.seeds.iter().filter(|seed| !known.contains(seed));
        self.outputs.extend(missing.map(|seed| GossipOutput::Send {
            to: *seed,
            frame: frame.clone(),
        }));
        if self.gossip.alive().is_empty() || self.hello_count.is_multiple_of(MULTICAST_EVERY) {
            self.outputs.push_back(GossipOutput::Multicast { frame });
        }
        self.hello_count += 1;
        self.report_silent_seeds();
    }

    /// Reports the seeds that have not answered several greetings of a node without other members.
    /// Only the other side can detect which side's key or cell is wrong.
    fn report_silent_seeds(&mut self) {
        self.unanswered = if self.gossip.alive().is_empty() {
            self.unanswered + 1
        } else {
            0
        };
        if self.unanswered <= 1 {
            self.answered.clear();
        } else if self.unanswered.is_multiple_of(ALONE_HELLOS) {
            let silent = self
                .seeds
                .iter()
                .filter(|seed| !self.answered.contains(*seed));
            self.outputs.extend(silent.map(|seed| {
                let cause =
                    "this seed does not answer: it does not run, its cell or key is another, or UDP does not pass";
                let about = seed.to_string();
                let kind = TroubleKind::SeedSilent;
                GossipOutput::Event(MembershipEvent::Troubled { about, kind, cause: cause.into() })
            }));
        }
    }

    fn schedule_hello(&mut self, at: Timestamp) {
        let percent = self.rng.random_range(75..=125);
        self.hello_at = at + self.hello * percent / 100;
    }

    /// Reports a second node of a name as a trouble, once it has been there for [`TAKEN_TIME`], and
    /// then at most once per [`REPORT_INTERVAL`].
    fn report_taken(&mut self, name: &NodeName, cause: String, at: Timestamp) {
        self.taken
            .retain(|_, taken| at.since(taken.last) < NAME_PATIENCE);
        if self.taken.len() >= MAX_TAKEN && !self.taken.contains_key(name) {
            return;
        }
        let taken = self.taken.entry(name.clone()).or_insert(TakenName {
            since: at,
            last: at,
            reported: Timestamp(0),
        });
        taken.last = at;
        let is_due =
            at.since(taken.since) >= TAKEN_TIME && at.since(taken.reported) >= REPORT_INTERVAL;
        if is_due {
            taken.reported = at;
            let about = name.to_string();
            let kind = TroubleKind::NameTaken;
            self.outputs
                .push_back(GossipOutput::Event(MembershipEvent::Troubled {
                    about,
                    kind,
                    cause,
                }));
        }
    }

    /// Handles another node with this node's name: informs it that it is the second one, or accepts
    /// that this node is. A node that has just started is the second one; if the two discover each
    /// other late, it is the node that started later.
    fn on_namesake(
        &mut self,
        id: &NodeId,
        answer: Option<Vec<u8>>,
        from: SocketAddr,
        at: Timestamp,
    ) {
        let is_new = at.since(self.started_at) < NAME_PATIENCE || self.excluded_since.is_some();
        match answer {
            Some(frame) if !is_new => {
                self.outputs
                    .push_back(GossipOutput::Send { to: from, frame });
                self.report_taken(&id.name, second_run(from), at);
            }
            None if is_new || self.gossip.own().run > id.run => self.step_back(from, at),
            _ => {}
        }
    }

    /// Handles a node's statement that another run has this node's name. The other run may just
    /// have ended.
    fn step_back(&mut self, informant: SocketAddr, at: Timestamp) {
        let since = *self.excluded_since.get_or_insert(at);
        if at.since(since) >= NAME_PATIENCE && self.gossip.alive().is_empty() {
            self.outputs
                .push_back(GossipOutput::Event(MembershipEvent::Excluded));
        }
        let cause = format!(
            "the node at {informant} reports that another running node has this name; this node does not join"
        );
        let name = self.gossip.own().name.clone();
        self.report_taken(&name, cause, at);
    }

    /// A node as reported to other actors: with its own proven data if nodes of the cell prove
    /// certificates, instead of other nodes' statements.
    fn member(&self, id: &NodeId) -> Member {
        let address = self.sessions.address(&id.name);
        let Some((stated, proven)) = self.sessions.proven(&id.name) else {
            return id.member(address);
        };
        let member = stated.member(address);
        let role = proven.rights.limit_role(member.role);
        Member {
            role,
            certificate: Some(Arc::clone(&proven.certificate)),
            ..member
        }
    }

    fn due(&self) -> Timestamp {
        self.gossip
            .next_due()
            .map_or(self.hello_at, |due| due.min(self.hello_at))
    }

    /// Begins each input: advances the node's awake clock to `now` and returns its time. Time beyond
    /// the next due timer plus [`STALL`] does not count, so a stalled node declares no peer down.
    fn advance(&mut self, now: Timestamp) -> Timestamp {
        self.clock.advance(now, self.due())
    }
}

/// Delay of a timer above which the process was stalled. Only this much of the delay counts as
/// time.
const STALL: Duration = Duration::from_millis(40);

/// Time for which frames wait for a session before they are dropped.
const SESSION_TIMEOUT: Duration = Duration::from_millis(200);

/// Maximum nodes for which frames wait, and maximum frames of each.
const MAX_PENDING: usize = 64;
const MAX_PENDING_FRAMES: usize = 4;

/// Number of greetings without another node, equivalent to ten seconds by default, after which a
/// node is alone: it reports silent seeds, repeatedly, and other cells.
const ALONE_HELLOS: u32 = 20;

/// Greetings of seeds for each greeting of the multicast group, once other nodes are alive.
const MULTICAST_EVERY: u64 = 10;

/// Minimum time between two greetings of a node that was only mentioned by other nodes, and maximum
/// number of such nodes in that time.
const UNPROVEN_INTERVAL: Duration = Duration::from_secs(1);
const MAX_UNPROVEN: usize = 256;

/// Time after which a node whose name belongs to another node gives up: well above the time in
/// which a run that ended is detected as down.
const NAME_PATIENCE: Duration = Duration::from_secs(5);

/// Burst of reports about other hosts, and time until one more.
const NOTICE_BURST: u32 = 16;
const NOTICE_INTERVAL: Duration = Duration::from_millis(250);

/// Time for which two runs must claim a name before it is reported: a node that was killed and
/// returns at another address has the name of a run that is detected as down a moment later.
const TAKEN_TIME: Duration = Duration::from_secs(3);

/// Most names that are observed at once.
const MAX_TAKEN: usize = 8;

/// Minimum time between two reports of the same taken name.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

/// The trouble of a second run at an address, as text.
fn second_run(at: SocketAddr) -> String {
    format!("a second node of this name at {at} is refused; the first one remains")
}

#[cfg(test)]
mod tests;
