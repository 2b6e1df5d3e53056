//! A cell in simulated time: nodes, links that lose, delay, repeat and cut, and a data plane that carries rounds.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};

use ecod::epoch::{Epoch, EpochGate};
use ecod::leadership::election::{Effect, Election, ElectionConfig, ElectionMessage, Health, Input};
use ecod::names::NodeName;
use ecod::round::FirstRound;
use ecod::time::Timestamp;
use ecod::wire::{Encoding, Role};

use crate::node::{Accepted, Event, Fault, News, Node};
use crate::random::Random;

/// Microseconds in a millisecond.
pub(crate) const MS: u64 = 1000;
/// All parts work.
pub(crate) const FIT: Health = Health { broker: true, fuser: true, gateway: true, load_percent: 10 };

/// The cell and everything under way in it.
pub(crate) struct World {
    pub(crate) now: u64,
    pub(crate) nodes: Vec<Node>,
    pub(crate) random: Random,
    /// When who began to lead.
    pub(crate) led: Vec<(u64, Epoch)>,
    pub(crate) packets: u64,
    /// Largest extra delay of every timer in µs: a busy machine.
    pub(crate) lateness: u64,
    /// What to print when a check fails.
    pub(crate) history: Vec<String>,
    cuts: BTreeSet<(usize, usize)>,
    loss_percent: u64,
    queue: BinaryHeap<Reverse<(u64, u64, Event)>>,
    events: u64,
    owners: BTreeMap<Epoch, (usize, u64)>,
}

impl World {
    pub(crate) fn new(seed: u64, configs: Vec<ElectionConfig>) -> Self {
        let nodes = configs.into_iter().enumerate().map(|(index, config)| Node::new(index, config)).collect();
        let mut world = Self {
            now: 1_732_154_400_000_000,
            nodes,
            random: Random::new(seed),
            led: Vec::new(),
            packets: 0,
            lateness: 2 * MS,
            history: Vec::new(),
            cuts: BTreeSet::new(),
            loss_percent: 0,
            queue: BinaryHeap::new(),
            events: 0,
            owners: BTreeMap::new(),
        };
        world.push(50 * MS, Event::Gossip);
        world
    }

    /// Lets something happen `after` µs from now.
    pub(crate) fn plan(&mut self, after: u64, fault: Fault) {
        self.push(after, Event::Fault(fault));
    }

    pub(crate) fn run_for(&mut self, micros: u64) {
        let end = self.now + micros;
        while let Some(Reverse((at, _, _))) = self.queue.peek()
            && *at <= end
        {
            let Some(Reverse((at, _, event))) = self.queue.pop() else { break };
            self.now = at;
            self.happen(event);
        }
        self.now = end;
    }

    pub(crate) fn alive(&self) -> impl Iterator<Item = (usize, &Node)> {
        self.nodes.iter().enumerate().filter(|(_, node)| node.election.is_some())
    }

    pub(crate) fn leaders(&self) -> Vec<usize> {
        self.alive().filter(|(_, node)| node.leads()).map(|(index, _)| index).collect()
    }

    /// The node that should lead when all is well.
    pub(crate) fn best(&self) -> Option<usize> {
        self.alive()
            .filter(|(_, node)| node.config.role != Role::Cav)
            .min_by_key(|(_, node)| (node.config.role != Role::Edge, Reverse(node.config.priority), node.name.clone()))
            .map(|(index, _)| index)
    }

    fn push(&mut self, after: u64, event: Event) {
        self.events += 1;
        self.queue.push(Reverse((self.now + after, self.events, event)));
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Fault(fault) => self.strike(&fault),
            Event::Gossip => self.gossip(),
            Event::Resume { to } => {
                for event in std::mem::take(&mut self.nodes[to].waiting) {
                    self.reach(to, event);
                }
                self.arm(to);
            }
            Event::Packet { to, life, .. }
            | Event::Map { to, life, .. }
            | Event::Tell { to, life, .. }
            | Event::Prepared { to, life }
            | Event::Broker { to, life, .. }
            | Event::Timer { to, life, .. }
            | Event::Publish { to, life, .. } => {
                let node = &mut self.nodes[to];
                if node.life != life || node.election.is_none() {
                    return;
                }
                if node.paused_until > self.now {
                    node.waiting.push(event);
                } else {
                    self.reach(to, event);
                }
            }
        }
    }

    fn reach(&mut self, to: usize, event: Event) {
        match event {
            Event::Packet { bytes, .. } => {
                let message = ElectionMessage::decode(&bytes).expect("nodes send what nodes can read");
                self.handle(to, Input::Receive { message });
            }
            Event::Map { epoch, round, .. } => self.accept(to, &epoch, round),
            Event::Tell { about, news, .. } => {
                let peer = self.nodes[about].name.clone();
                self.handle(
                    to,
                    match news {
                        News::Alive => Input::PeerAlive { peer },
                        News::Down => Input::PeerDown { peer },
                        News::Gone => Input::PeerGone { peer },
                    },
                );
            }
            Event::Prepared { .. } => self.handle(to, Input::Prepared),
            Event::Broker { works, .. } => {
                self.handle(to, Input::Health { health: Health { broker: works, ..FIT } });
            }
            Event::Timer { armed, .. } if armed == self.nodes[to].armed => {
                let now = self.clock_of(to);
                let effects = self.nodes[to].election.as_mut().map(|election| election.tick(now));
                self.carry_out(to, effects.unwrap_or_default());
            }
            Event::Publish { term, .. } => self.publish(to, term),
            Event::Timer { .. } | Event::Resume { .. } | Event::Gossip | Event::Fault(_) => {}
        }
    }

    fn strike(&mut self, fault: &Fault) {
        self.history.push(format!("{:>10} µs {fault:?}", self.now - 1_732_154_400_000_000));
        match *fault {
            Fault::Start(index) => self.start(index),
            Fault::Kill { node, seen } => self.kill(node, seen),
            Fault::Leave(node) => {
                self.handle(node, Input::Leave);
                self.kill(node, false);
            }
            Fault::Pause { node, micros } => {
                self.nodes[node].paused_until = self.now + micros;
                self.push(micros, Event::Resume { to: node });
            }
            Fault::SetClock { node, micros } => self.nodes[node].clock += micros,
            Fault::Cut { from, to } => {
                self.cuts.insert((from, to));
            }
            Fault::Heal => self.cuts.clear(),
            Fault::Loss(percent) => self.loss_percent = percent,
            Fault::Broker { node, works } => {
                let life = self.nodes[node].life;
                self.push(0, Event::Broker { to: node, life, works });
            }
        }
    }

    fn start(&mut self, index: usize) {
        if self.nodes[index].election.is_some() {
            return;
        }
        let now = self.clock_of(index);
        let node = &mut self.nodes[index];
        node.life += 1;
        node.known.clear();
        node.paused_until = 0;
        let election = Election::new(node.config.clone(), node.name.clone(), node.persisted, now);
        node.gate = EpochGate::new(election.floor());
        node.election = Some(election);
        let life = node.life;
        self.arm(index);
        // A node is met by others before it has found its own parts fit.
        let after = self.random.between(5 * MS, 300 * MS);
        self.push(after, Event::Broker { to: index, life, works: true });
    }

    fn kill(&mut self, index: usize, seen: bool) {
        let node = &mut self.nodes[index];
        node.election = None;
        node.publishing = None;
        node.waiting.clear();
        if seen {
            for to in 0..self.nodes.len() {
                if self.linked(to, index) {
                    let (life, after) = (self.nodes[to].life, self.random.between(MS, 6 * MS));
                    self.push(after, Event::Tell { to, life, about: index, news: News::Gone });
                }
            }
        }
    }

    /// What a membership would find out, a while later and node by node.
    fn gossip(&mut self) {
        for to in 0..self.nodes.len() {
            for about in 0..self.nodes.len() {
                let there = self.nodes[about].election.is_some()
                    && self.nodes[about].paused_until < self.now + 300 * MS
                    && self.linked(to, about);
                let known = self.nodes[to].known.contains(&about);
                if to == about || there == known || self.nodes[to].election.is_none() || self.random.chance(50) {
                    continue;
                }
                let (life, after) = (self.nodes[to].life, self.random.between(20 * MS, 300 * MS));
                let node = &mut self.nodes[to];
                let news = if there { News::Alive } else { News::Down };
                if there {
                    node.known.insert(about)
                } else {
                    node.known.remove(&about)
                };
                self.push(after, Event::Tell { to, life, about, news });
            }
        }
        self.push(100 * MS, Event::Gossip);
    }

    /// How many packets were sent to a node, there or not.
    pub(crate) fn packets_to(&self, index: usize) -> u64 {
        self.nodes[index].packets
    }

    /// Whether a connection between two nodes works, which needs both directions.
    pub(crate) fn linked(&self, a: usize, b: usize) -> bool {
        !self.cuts.contains(&(a, b)) && !self.cuts.contains(&(b, a))
    }

    fn clock_of(&self, index: usize) -> Timestamp {
        Timestamp(self.now).shifted(self.nodes[index].clock)
    }

    fn handle(&mut self, to: usize, input: Input) {
        let now = self.clock_of(to);
        if let Some(election) = &mut self.nodes[to].election {
            let effects = election.handle(input, now);
            self.carry_out(to, effects);
        }
    }

    fn carry_out(&mut self, index: usize, effects: impl IntoIterator<Item = Effect>) {
        let life = self.nodes[index].life;
        for effect in effects {
            match effect {
                Effect::PersistTerm { term } => self.nodes[index].persisted = term,
                Effect::Send { to, message } => self.send(index, &to, &message),
                Effect::Lead { epoch, first_round, first } => {
                    assert!(epoch.term <= self.nodes[index].persisted, "led in a term that is not on disk");
                    let owner = self.owners.insert(epoch.clone(), (index, life));
                    assert_eq!(owner, None, "two leaderships share {epoch}");
                    self.led.push((self.now, epoch.clone()));
                    self.history.push(format!("{:>10} µs {epoch} leads", self.now - 1_732_154_400_000_000));
                    self.begin_to_publish(index, epoch, first_round, first);
                }
                Effect::StopPublishing { .. } => self.nodes[index].publishing = None,
                Effect::Follow { epoch, .. } => {
                    assert!(self.nodes[index].publishing.is_none(), "follows {epoch} and still publishes");
                }
                Effect::Prepare { .. } => {
                    let after = self.random.between(5 * MS, 120 * MS);
                    self.push(after, Event::Prepared { to: index, life });
                }
                Effect::Seek | Effect::AnnounceStandby { .. } | Effect::SendState { .. } => {}
            }
        }
        self.arm(index);
    }

    fn arm(&mut self, index: usize) {
        let now = self.clock_of(index);
        let late = self.random.between(0, self.lateness);
        let node = &mut self.nodes[index];
        let Some(election) = &node.election else { return };
        let after = election.next_deadline().since(now).as_micros() as u64 + late;
        node.armed += 1;
        let event = Event::Timer { to: index, life: node.life, armed: node.armed };
        self.push(after, event);
    }

    fn send(&mut self, from: usize, to: &NodeName, message: &ElectionMessage) {
        self.packets += 1;
        let Some(to) = self.nodes.iter().position(|node| node.name == *to) else { return };
        self.nodes[to].packets += 1;
        if self.cuts.contains(&(from, to)) || self.random.chance(self.loss_percent) {
            return;
        }
        let bytes = message.encode(Encoding::Cbor);
        let copies = if self.random.chance(self.loss_percent / 4) { 2 } else { 1 };
        for _ in 0..copies {
            let (life, after) = (self.nodes[to].life, self.random.between(200, 3 * MS));
            self.push(after, Event::Packet { to, life, bytes: bytes.clone() });
        }
    }

    fn begin_to_publish(&mut self, index: usize, epoch: Epoch, first_round: u64, first: FirstRound) {
        let node = &mut self.nodes[index];
        let term = epoch.term;
        node.publishing = Some((epoch, first_round));
        node.rounds.start(first, Timestamp(self.now));
        self.plan_round(index, term);
    }

    fn plan_round(&mut self, index: usize, term: u64) {
        let node = &self.nodes[index];
        let (life, after) = (node.life, node.rounds.deadline().since(Timestamp(self.now)));
        self.push(after.as_micros() as u64, Event::Publish { to: index, life, term });
    }

    fn publish(&mut self, index: usize, term: u64) {
        let node = &mut self.nodes[index];
        let Some((epoch, next)) = &mut node.publishing else { return };
        if epoch.term != term {
            return;
        }
        let (epoch, round) = (epoch.clone(), *next);
        *next += 1;
        node.rounds.tick(Timestamp(self.now));
        self.plan_round(index, term);
        for to in 0..self.nodes.len() {
            if to != index && self.linked(index, to) {
                let retry = if self.random.chance(self.loss_percent) { 30 * MS } else { 0 };
                let (life, after) = (self.nodes[to].life, retry + self.random.between(300, 3 * MS));
                self.push(after, Event::Map { to, life, epoch: epoch.clone(), round });
            }
        }
        self.accept(index, &epoch, round);
    }

    fn accept(&mut self, to: usize, epoch: &Epoch, round: u64) {
        let now = self.now;
        let node = &mut self.nodes[to];
        let is_elected = node.election.as_ref().and_then(Election::epoch) == Some(epoch);
        if node.gate.admit(epoch, round).is_err() {
            node.stale_refused += 1;
            // As the gate of a real node: the elected is not refused for ever.
            let since = is_elected.then(|| *node.elected_refused_since.get_or_insert(now));
            if since.is_none_or(|since| now - since < 500 * MS) {
                return;
            }
            node.gate = EpochGate::default();
            node.gate.admit(epoch, round).expect("the first");
        }
        node.accepted.push(Accepted { at: now, round });
        // As in a real node: rounds of others prove nothing.
        if is_elected {
            node.elected_refused_since = None;
            self.handle(to, Input::Round { epoch: epoch.clone(), round });
        }
    }
}
