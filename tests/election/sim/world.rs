//! A cell in simulated time: nodes, and a network that loses, delays, repeats and cuts.
//!
//! Each node runs the machines that a real one does, and carries out their effects as the actors do.

use std::cmp::{Ordering, Reverse};
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque};

use ecod::leadership::election::{ElectionConfig, ElectionMessage};
use ecod::leadership::links::LinkState;
use ecod::leadership::node::{Effect, Input, SeenMember};
use ecod::leadership::{Position, Rights};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{Encoding, Role};

use crate::sim::evidence::{PUBLISH_PERIOD, Votes};
use crate::sim::node::{Arrival, Event, Fault, Node, address_of, broker_of};
use crate::sim::random::Random;

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
    /// Text to print when a check fails.
    pub(crate) history: Vec<String>,
    pub(crate) votes: Votes,
    cuts: BTreeSet<(usize, usize)>,
    /// Nodes that cannot log in, each with the broker's node.
    pub(crate) refusals: BTreeSet<(usize, usize)>,
    pub(crate) loss_percent: u64,
    queue: BinaryHeap<Planned>,
    events: u64,
    owners: BTreeMap<Epoch, (usize, u64)>,
}

/// An event and when it happens; of two at one time the first planned comes first.
struct Planned {
    at: u64,
    number: u64,
    event: Event,
}

impl PartialEq for Planned {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Planned {}

impl PartialOrd for Planned {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Planned {
    fn cmp(&self, other: &Self) -> Ordering {
        (other.at, other.number).cmp(&(self.at, self.number))
    }
}

impl World {
    pub(crate) fn new(seed: u64, configs: Vec<ElectionConfig>) -> Self {
        let nodes = configs
            .into_iter()
            .enumerate()
            .map(|(index, config)| Node::new(index, config))
            .collect();
        let mut world = Self {
            now: START,
            nodes,
            random: Random::new(seed),
            led: Vec::new(),
            packets: 0,
            lateness: 2 * MS,
            history: Vec::new(),
            votes: Votes::default(),
            cuts: BTreeSet::new(),
            refusals: BTreeSet::new(),
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
        while self.queue.peek().is_some_and(|next| next.at <= end) {
            let Some(Planned { at, event, .. }) = self.queue.pop() else {
                break;
            };
            self.now = at;
            self.happen(event);
        }
        self.now = end;
    }

    pub(crate) fn alive(&self) -> impl Iterator<Item = (usize, &Node)> {
        self.nodes
            .iter()
            .enumerate()
            .filter(|(_, node)| node.machine.is_some())
    }

    pub(crate) fn leaders(&self) -> Vec<usize> {
        self.alive()
            .filter(|(_, node)| node.leads())
            .map(|(index, _)| index)
            .collect()
    }

    /// The nodes of which one should lead when all is well: candidates of the best role and priority.
    pub(crate) fn best(&self) -> Vec<usize> {
        let rank = |node: &Node| {
            (
                node.config.role != Role::Edge,
                Reverse(node.config.priority),
            )
        };
        let candidates = || {
            self.alive()
                .filter(|(_, node)| node.config.role != Role::Cav)
        };
        let best = candidates().map(|(_, node)| rank(node)).min();
        candidates()
            .filter(|(_, node)| Some(rank(node)) == best)
            .map(|(index, _)| index)
            .collect()
    }

    fn push(&mut self, after: u64, event: Event) {
        self.events += 1;
        self.queue.push(Planned {
            at: self.now + after,
            number: self.events,
            event,
        });
    }

    /// Lets something reach the present run of a node `after` µs from now.
    pub(crate) fn push_to(&mut self, node: usize, after: u64, arrival: Arrival) {
        let life = self.nodes[node].life;
        self.push(
            after,
            Event::At {
                node,
                life,
                arrival,
            },
        );
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Fault(fault) => self.strike(&fault),
            Event::Gossip => self.gossip(),
            Event::Resume { node } => {
                for arrival in std::mem::take(&mut self.nodes[node].waiting) {
                    self.reach(node, arrival);
                }
                self.arm(node);
            }
            Event::At {
                node: index,
                life,
                arrival,
            } => {
                let node = &mut self.nodes[index];
                if node.life != life || node.machine.is_none() {
                    return;
                }
                if node.paused_until > self.now {
                    node.waiting.push(arrival);
                } else {
                    self.reach(index, arrival);
                }
            }
        }
    }

    fn reach(&mut self, to: usize, arrival: Arrival) {
        match arrival {
            Arrival::Packet { from, bytes } => {
                let message =
                    ElectionMessage::decode(&bytes).expect("nodes send what nodes can read");
                let from = self.nodes[from].name.clone();
                self.handle(
                    to,
                    Input::Receive {
                        from,
                        rights: Rights::ALL,
                        message,
                    },
                );
            }
            Arrival::Relay { from, map } => self.relay(to, from, &map),
            Arrival::Map { map } => self.accept(to, &map),
            Arrival::Share { share } => self.take_share(to, &share),
            // A membership reports its events in order.
            Arrival::Membership {
                about,
                about_life,
                is_there,
            } if self.nodes[to].known.get(&about) != is_there.then_some(&about_life) => {}
            Arrival::Membership {
                about,
                about_life,
                is_there: true,
            } => {
                self.nodes[to].members.insert(about, about_life);
                self.handle(
                    to,
                    Input::MemberAlive {
                        member: self.member(about, about_life),
                    },
                );
            }
            Arrival::Membership { about, .. } => {
                self.nodes[to].members.remove(&about);
                self.handle(
                    to,
                    Input::MemberDown {
                        name: self.nodes[about].name.clone(),
                    },
                );
            }
            Arrival::Connect { broker } => self.connect(to, broker),
            Arrival::Refused { broker } => {
                if self.nodes[to].links.contains_key(&broker) {
                    self.set_link(to, broker, LinkState::Down);
                    self.set_link(to, broker, LinkState::Refused);
                    self.plan_connect(to, broker, 80 * MS);
                }
            }
            Arrival::Answered => self.handle(
                to,
                Input::PartsAnswered {
                    sample: self.nodes[to].sample(),
                },
            ),
            Arrival::Broker { works } => {
                self.nodes[to].broker_works = works;
                if !works && self.nodes[to].links.contains_key(&to) {
                    self.set_link(to, to, LinkState::Down);
                }
                self.plan_connect(to, to, 0);
            }
            Arrival::Timer { armed } if armed == self.nodes[to].armed => {
                self.handle(to, Input::Wake);
            }
            Arrival::Timer { .. } => {}
            Arrival::Publish { term } => self.publish(to, term),
            Arrival::Keep => self.keep(to),
        }
    }

    fn strike(&mut self, fault: &Fault) {
        self.history
            .push(format!("{:>10} µs {fault:?}", self.now - START));
        match *fault {
            Fault::Start(index) => self.start(index),
            Fault::Kill { node, seen } => self.kill(node, seen),
            Fault::Leave(node) => {
                self.handle(node, Input::Leave);
                self.kill(node, false);
            }
            Fault::Pause { node, micros } => {
                self.nodes[node].paused_until = self.now + micros;
                self.push(micros, Event::Resume { node });
            }
            Fault::Mute { node, micros } => self.nodes[node].mute_until = self.now + micros,
            Fault::SetClock { node, micros } => self.nodes[node].clock += micros,
            Fault::Cut { from, to } => {
                self.cuts.insert((from, to));
            }
            Fault::Heal => {
                self.cuts.clear();
                self.refusals.clear();
            }
            Fault::NoLogin { node, broker } => {
                self.refusals.insert((node, broker));
                if self.nodes[node].links.contains_key(&broker) {
                    self.set_link(node, broker, LinkState::Down);
                    self.plan_connect(node, broker, 0);
                }
            }
            Fault::Loss(percent) => self.loss_percent = percent,
            Fault::Broker { node, works } => self.push_to(node, 0, Arrival::Broker { works }),
            Fault::Fuser { node, works } => self.nodes[node].set_fuser(works, self.now),
            Fault::Gateway { node, works } => self.nodes[node].gateway_works = works,
        }
    }

    fn start(&mut self, index: usize) {
        if self.nodes[index].machine.is_some() {
            return;
        }
        self.nodes[index].start(self.now);
        let after = self.random.between(0, PUBLISH_PERIOD);
        self.push_to(index, after, Arrival::Keep);
        self.handle(
            index,
            Input::OwnBroker {
                address: Some(broker_of(index)),
            },
        );
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
                if self.linked(to, index)
                    && self.nodes[to].links.get(&index) == Some(&LinkState::Up)
                {
                    let after = self.random.between(MS, 6 * MS);
                    self.push_to(to, after, Arrival::Refused { broker: index });
                }
            }
        }
    }

    /// Gives the nodes the news of a membership, a while later and node by node.
    fn gossip(&mut self) {
        for to in 0..self.nodes.len() {
            for about in 0..self.nodes.len() {
                let is_there = self.nodes[about].machine.is_some()
                    && self.nodes[about].paused_until < self.now + 300 * MS
                    && self.linked(to, about);
                let about_life = self.nodes[about].life;
                let known = self.nodes[to].known.get(&about);
                let is_news = if is_there {
                    known != Some(&about_life)
                } else {
                    known.is_some()
                };
                if to == about
                    || !is_news
                    || self.nodes[to].machine.is_none()
                    || self.random.chance(50)
                {
                    continue;
                }
                let after = self.random.between(20 * MS, 300 * MS);
                let node = &mut self.nodes[to];
                if is_there {
                    node.known.insert(about, about_life);
                } else {
                    node.known.remove(&about);
                }
                self.push_to(
                    to,
                    after,
                    Arrival::Membership {
                        about,
                        about_life,
                        is_there,
                    },
                );
            }
        }
        self.push(100 * MS, Event::Gossip);
    }

    /// Number of packets that were sent to a node, there or not.
    pub(crate) fn packets_to(&self, index: usize) -> u64 {
        self.nodes[index].packets
    }

    /// True if a connection between two nodes works, which needs both directions.
    pub(crate) fn linked(&self, a: usize, b: usize) -> bool {
        !self.cuts.contains(&(a, b)) && !self.cuts.contains(&(b, a))
    }

    fn clock_of(&self, index: usize) -> Timestamp {
        Timestamp(self.now).shifted(self.nodes[index].clock)
    }

    fn member(&self, about: usize, run: u64) -> SeenMember {
        let name = self.nodes[about].name.clone();
        SeenMember {
            name,
            run,
            broker: Some(address_of(about)),
            is_on_this_machine: false,
        }
    }

    /// Passes an event to the machine and carries out the effects, like the actors.
    pub(crate) fn handle(&mut self, index: usize, input: Input) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            let now = self.clock_of(index);
            let Some(machine) = &mut self.nodes[index].machine else {
                return;
            };
            for effect in machine.handle(input, now) {
                inputs.extend(self.carry_out(index, effect));
            }
        }
        self.arm(index);
    }

    /// Carries out an effect of the machine; returns the inputs that follow at once.
    fn carry_out(&mut self, index: usize, effect: Effect) -> Option<Input> {
        match effect {
            Effect::PersistTerm { term } => self.nodes[index].persisted = term,
            Effect::Send { to, message } => self.send(index, &to, &message),
            Effect::PublishLeadership { leadership } => {
                let follows = matches!(
                    leadership.position,
                    Position::Following | Position::StandingBy
                );
                assert!(
                    !follows || self.nodes[index].publishing.is_none(),
                    "follows and still publishes"
                );
                self.nodes[index].leadership = leadership;
            }
            Effect::Lead {
                epoch,
                first_round,
                first,
            } => {
                assert!(
                    epoch.term <= self.nodes[index].persisted,
                    "led in a term that is not on disk"
                );
                assert!(
                    self.nodes[index].leadership.is_leading(),
                    "leads before the machine reports it"
                );
                let owner = self
                    .owners
                    .insert(epoch.clone(), (index, self.nodes[index].life));
                assert_eq!(owner, None, "two leaderships share {epoch}");
                self.led.push((self.now, epoch.clone()));
                self.history
                    .push(format!("{:>10} µs {epoch} leads", self.now - START));
                self.nodes[index].resync.lead(epoch.clone());
                self.nodes[index].lane.get_or_insert_with(|| epoch.clone());
                self.begin_to_publish(index, epoch, first_round, first);
                self.share_all(index);
            }
            Effect::HoldRound => self.nodes[index].rounds.hold(),
            Effect::StopPublishing { .. } => {
                self.nodes[index].publishing = None;
                self.nodes[index].lane = None;
                self.nodes[index].resync.step_down();
            }
            Effect::SendSnapshot { .. } => self.share_all(index),
            Effect::SetLinks { links } => self.set_links(index, &links),
            Effect::Observe => {
                let node = &self.nodes[index];
                let members = node
                    .members
                    .iter()
                    .map(|(about, run)| self.member(*about, *run))
                    .collect();
                let rounds_due = node.rounds_due(self.now);
                return Some(Input::Observed {
                    rounds_due,
                    load_percent: LOAD,
                    members,
                });
            }
            Effect::AskParts => {
                let answers = self.nodes[index].gateway_works;
                let after = if answers {
                    self.random.between(MS, 20 * MS)
                } else {
                    1000 * MS
                };
                self.push_to(index, after, Arrival::Answered);
            }
            Effect::PublishStatus { .. } | Effect::CountImplausible { .. } | Effect::Log { .. } => {
            }
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
        let armed = node.armed;
        self.push_to(index, after, Arrival::Timer { armed });
    }

    fn send(&mut self, from: usize, to: &NodeName, message: &ElectionMessage) {
        self.packets += 1;
        let Some(to) = self.nodes.iter().position(|node| node.name == *to) else {
            return;
        };
        self.nodes[to].packets += 1;
        let is_mute = |node: usize| self.nodes[node].mute_until > self.now;
        if self.cuts.contains(&(from, to))
            || is_mute(from)
            || is_mute(to)
            || self.random.chance(self.loss_percent)
        {
            return;
        }
        let bytes = message.encode(Encoding::Cbor);
        let copies = if self.random.chance(self.loss_percent / 4) {
            2
        } else {
            1
        };
        for _ in 0..copies {
            let after = self.random.between(200, 3 * MS);
            self.push_to(
                to,
                after,
                Arrival::Packet {
                    from,
                    bytes: bytes.clone(),
                },
            );
        }
    }
}
