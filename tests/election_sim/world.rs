//! A cell in simulated time: nodes, links that lose, delay, repeat and cut, and a data plane that carries rounds.
//!
//! Each node runs the machines that a real one does, and carries out their effects as the actors do.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque};

use ecod::epoch::Epoch;
use ecod::leadership::Position;
use ecod::leadership::election::{ElectionConfig, ElectionMessage};
use ecod::leadership::links::{LinkState, WantedLinks};
use ecod::leadership::node::{Effect, Input, Member};
use ecod::names::NodeName;
use ecod::round::FirstRound;
use ecod::time::Timestamp;
use ecod::wire::{Encoding, GlobalMap, Role, SCHEMA_VERSION};

use crate::node::{Accepted, Event, Fault, Map, Node, address_of, broker_of};
use crate::random::Random;

/// Microseconds in a millisecond.
pub(crate) const MS: u64 = 1000;

/// Start of the simulation, in Unix microseconds.
const START: u64 = 1_732_154_400_000_000;

/// Processor load of every node, in percent.
const LOAD: u8 = 10;

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
            now: START,
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
        self.nodes.iter().enumerate().filter(|(_, node)| node.machine.is_some())
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
            | Event::Connect { to, life, .. }
            | Event::Refused { to, life, .. }
            | Event::Answered { to, life }
            | Event::Broker { to, life, .. }
            | Event::Timer { to, life, .. }
            | Event::Publish { to, life, .. } => {
                let node = &mut self.nodes[to];
                if node.life != life || node.machine.is_none() {
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
            Event::Packet { from, bytes, .. } => {
                let message = ElectionMessage::decode(&bytes).expect("nodes send what nodes can read");
                let from = self.nodes[from].name.clone();
                self.handle(to, Input::Receive { from, message });
            }
            Event::Map { map, .. } => self.accept(to, &map),
            Event::Tell { about, about_life, is_there: true, .. } => {
                self.nodes[to].members.insert(about, about_life);
                self.handle(to, Input::MemberAlive { member: self.member(about, about_life) });
            }
            Event::Tell { about, .. } => {
                self.nodes[to].members.remove(&about);
                self.handle(to, Input::MemberDown { name: self.nodes[about].name.clone() });
            }
            Event::Connect { broker, .. } => self.connect(to, broker),
            Event::Refused { broker, .. } => {
                if self.nodes[to].links.contains_key(&broker) {
                    self.set_link(to, broker, LinkState::Down);
                    self.set_link(to, broker, LinkState::Refused);
                    self.plan_connect(to, broker, 80 * MS);
                }
            }
            Event::Answered { .. } => self.handle(to, Input::PartsAnswered { sample: self.nodes[to].sample() }),
            Event::Broker { works, .. } => {
                self.nodes[to].broker_works = works;
                if !works && self.nodes[to].links.contains_key(&to) {
                    self.set_link(to, to, LinkState::Down);
                }
                self.plan_connect(to, to, 0);
            }
            Event::Timer { armed, .. } if armed == self.nodes[to].armed => self.handle(to, Input::Wake),
            Event::Publish { term, .. } => self.publish(to, term),
            Event::Timer { .. } | Event::Resume { .. } | Event::Gossip | Event::Fault(_) => {}
        }
    }

    fn strike(&mut self, fault: &Fault) {
        self.history.push(format!("{:>10} µs {fault:?}", self.now - START));
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
        if self.nodes[index].machine.is_some() {
            return;
        }
        self.nodes[index].start(self.now);
        self.handle(index, Input::OwnBroker { address: Some(broker_of(index)) });
        for to in 0..self.nodes.len() {
            if to != index && self.nodes[to].links.contains_key(&index) {
                self.plan_connect(to, index, 0);
            }
        }
    }

    fn kill(&mut self, index: usize, seen: bool) {
        let node = &mut self.nodes[index];
        node.machine = None;
        node.publishing = None;
        node.waiting.clear();
        if seen {
            for to in 0..self.nodes.len() {
                if self.linked(to, index) && self.nodes[to].links.get(&index) == Some(&LinkState::Up) {
                    let (life, after) = (self.nodes[to].life, self.random.between(MS, 6 * MS));
                    self.push(after, Event::Refused { to, life, broker: index });
                }
            }
        }
    }

    /// Makes the links what the machine wants.
    fn set_links(&mut self, index: usize, wanted: &WantedLinks) {
        let is_wanted = |broker: &usize| wanted.brokers.contains(&address_of(*broker));
        self.nodes[index].links.retain(|broker, _| is_wanted(broker));
        for broker in (0..self.nodes.len()).filter(is_wanted) {
            if !self.nodes[index].links.contains_key(&broker) {
                self.nodes[index].links.insert(broker, LinkState::Down);
                self.plan_connect(index, broker, 0);
            }
        }
    }

    fn plan_connect(&mut self, to: usize, broker: usize, pause: u64) {
        let (life, after) = (self.nodes[to].life, pause + self.random.between(MS, 20 * MS));
        self.push(after, Event::Connect { to, life, broker });
    }

    /// Tries to connect, and goes on trying.
    fn connect(&mut self, to: usize, broker: usize) {
        let Some(state) = self.nodes[to].links.get(&broker) else { return };
        let there = &self.nodes[broker];
        let serves = there.machine.is_some() && there.broker_works && there.paused_until <= self.now;
        if serves && self.linked(to, broker) {
            self.set_link(to, broker, LinkState::Up);
        } else if *state != LinkState::Up {
            self.plan_connect(to, broker, 80 * MS);
        }
    }

    fn set_link(&mut self, to: usize, broker: usize, state: LinkState) {
        self.nodes[to].links.insert(broker, state);
        self.handle(to, Input::LinkChanged { broker: address_of(broker), state });
    }

    /// What a membership would find out, a while later and node by node.
    fn gossip(&mut self) {
        for to in 0..self.nodes.len() {
            for about in 0..self.nodes.len() {
                let is_there = self.nodes[about].machine.is_some()
                    && self.nodes[about].paused_until < self.now + 300 * MS
                    && self.linked(to, about);
                let about_life = self.nodes[about].life;
                let known = self.nodes[to].known.get(&about);
                let is_news = if is_there { known != Some(&about_life) } else { known.is_some() };
                if to == about || !is_news || self.nodes[to].machine.is_none() || self.random.chance(50) {
                    continue;
                }
                let (life, after) = (self.nodes[to].life, self.random.between(20 * MS, 300 * MS));
                let node = &mut self.nodes[to];
                if is_there {
                    node.known.insert(about, about_life);
                } else {
                    node.known.remove(&about);
                }
                self.push(after, Event::Tell { to, life, about, about_life, is_there });
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

    fn member(&self, about: usize, run: u64) -> Member {
        let name = self.nodes[about].name.clone();
        Member { name, run, broker: Some(address_of(about)), is_on_this_machine: false }
    }

    /// Hands in what happened and carries out what comes of it, as the actors do.
    fn handle(&mut self, index: usize, input: Input) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            let now = self.clock_of(index);
            let Some(machine) = &mut self.nodes[index].machine else { return };
            for effect in machine.handle(input, now) {
                inputs.extend(self.carry_out(index, effect));
            }
        }
        self.arm(index);
    }

    /// Does what the machine wants; returns what it is to be told at once.
    fn carry_out(&mut self, index: usize, effect: Effect) -> Option<Input> {
        let life = self.nodes[index].life;
        match effect {
            Effect::PersistTerm { term } => self.nodes[index].persisted = term,
            Effect::Send { to, message } => self.send(index, &to, &message),
            Effect::TellLeadership { leadership } => {
                let follows = matches!(leadership.position, Position::Following | Position::StandingBy);
                assert!(!follows || self.nodes[index].publishing.is_none(), "follows and still publishes");
                self.nodes[index].leadership = leadership;
            }
            Effect::Lead { epoch, first_round, first } => {
                assert!(epoch.term <= self.nodes[index].persisted, "led in a term that is not on disk");
                assert!(self.nodes[index].leadership.is_leading(), "leads before it is told");
                let owner = self.owners.insert(epoch.clone(), (index, life));
                assert_eq!(owner, None, "two leaderships share {epoch}");
                self.led.push((self.now, epoch.clone()));
                self.history.push(format!("{:>10} µs {epoch} leads", self.now - START));
                self.begin_to_publish(index, epoch, first_round, first);
            }
            Effect::HoldRound => self.nodes[index].rounds.hold(),
            Effect::StopPublishing { .. } => self.nodes[index].publishing = None,
            Effect::SetLinks { links } => self.set_links(index, &links),
            Effect::Look => {
                let node = &self.nodes[index];
                let members = node.members.iter().map(|(about, run)| self.member(*about, *run)).collect();
                let rounds_closed = node.rounds_closed(self.now);
                return Some(Input::Looked { rounds_closed, load_percent: LOAD, members });
            }
            Effect::AskParts => {
                let after = self.random.between(MS, 20 * MS);
                self.push(after, Event::Answered { to: index, life });
            }
            Effect::PublishStatus { .. } | Effect::SendSnapshot { .. } | Effect::Log { .. } => {}
        }
        None
    }

    fn arm(&mut self, index: usize) {
        let now = self.clock_of(index);
        let late = self.random.between(0, self.lateness);
        let node = &mut self.nodes[index];
        let Some(machine) = &node.machine else { return };
        let after = machine.next_deadline().since(now).as_micros() as u64 + late;
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
            self.push(after, Event::Packet { from, to, life, bytes: bytes.clone() });
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
        let map = Map { epoch: epoch.clone(), round: *next, fused_at: Timestamp(self.now).shifted(node.steady_clock) };
        *next += 1;
        node.rounds.tick(Timestamp(self.now));
        self.plan_round(index, term);
        for to in 0..self.nodes.len() {
            if to != index && self.linked(index, to) {
                let retry = if self.random.chance(self.loss_percent) { 30 * MS } else { 0 };
                let (life, after) = (self.nodes[to].life, retry + self.random.between(300, 3 * MS));
                self.push(after, Event::Map { to, life, map: map.clone() });
            }
        }
        self.accept(index, &map);
    }

    fn accept(&mut self, to: usize, map: &Map) {
        let node = &mut self.nodes[to];
        let received_at = Timestamp(self.now).shifted(node.steady_clock);
        let Map { epoch, round, fused_at } = map.clone();
        let map = GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: epoch.leader,
            epoch: epoch.term,
            round,
            fused_at_us: fused_at,
            oldest_capture_us: None,
            landmarks: Vec::new(),
            objects: Vec::new(),
            pose_corrections: Default::default(),
        };
        let Ok(accepted) = node.filter.accept_map(&map, received_at, &node.leadership) else {
            node.refused += 1;
            return;
        };
        node.accepted.push(Accepted { at: self.now, round });
        if accepted.is_sign_of_life {
            self.handle(to, Input::RoundAccepted { epoch: accepted.epoch, round });
        }
    }
}
