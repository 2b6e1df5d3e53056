//! A model check of the election: every order of deliveries, losses, repeats, timers, crashes and restarts, to a bound.
//!
//! Breadth first over everything that three nodes can do from a cold start, a settled cell, a split one and a handover;
//! then long random walks over four nodes. Every node's clock runs at its own pace, so every timeout may come too
//! early.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use ecod::leadership::election::{Election, ElectionConfig, ElectionMessage};
use ecod::leadership::health::HealthSample;
use ecod::leadership::links::{DataPlane, LinkState};
use ecod::leadership::node::{Effect, Input, LeadershipNode, NodeSettings, SeenMember};
use ecod::leadership::round_filter::{Origin, RoundFilter};
use ecod::leadership::timers::EPOCH_MEMORY;
use ecod::leadership::{Leadership, Rights};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, NodeStatus, Role};
use stateright::{Checker, HasDiscoveries, Model, Property, UniformChooser};
use uuid::Uuid;

/// Packets under way; beyond that the oldest are lost.
const MAX_PACKETS: usize = 6;

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Action {
    Deliver {
        packet: usize,
        again: bool,
    },
    Tick(usize),
    /// The node's timer fires, its first effect is done, and it crashes.
    TornTick(usize),
    Publish(usize),
    Crash(usize),
    Restart(usize),
    /// A node sees that another one's process is gone.
    Gone {
        to: usize,
        about: usize,
    },
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
enum Packet {
    Election(usize, ElectionMessage),
    Map(usize, Map),
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Map {
    epoch: Epoch,
    round: u64,
    fused_at: Timestamp,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Node {
    machine: Option<LeadershipNode>,
    leadership: Leadership,
    filter: RoundFilter,
    clock: Timestamp,
    persisted: u64,
    publishing: Option<(Epoch, u64)>,
    /// The highest term accepted in any run.
    accepted: u64,
    /// The last round accepted in this run, and when.
    last: Option<(Epoch, u64, Timestamp)>,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Cell {
    nodes: Vec<Node>,
    packets: Vec<Packet>,
    /// Number of leaderships of each epoch.
    led: BTreeMap<Epoch, usize>,
    crashes_left: usize,
    went_back: bool,
    accepted_twice: bool,
    led_unwritten: bool,
    steps: usize,
}

struct CellModel {
    initial: Vec<Cell>,
    depth: usize,
    /// Share of the states of the last depth, one in this many, from which the model runs until it is stable.
    sample: u64,
}

fn name(index: usize) -> NodeName {
    NodeName::new(format!("n{index}")).expect("valid name")
}

fn config(index: usize) -> ElectionConfig {
    let role = [Role::Edge, Role::Auto, Role::Auto, Role::Cav][index];
    ElectionConfig {
        role,
        stable_ms: 200,
        join_ms: 100,
        handover_ms: 900,
        ..ElectionConfig::default()
    }
}

fn settings(index: usize) -> NodeSettings {
    let election = config(index);
    NodeSettings {
        plane: DataPlane {
            external: None,
            embedded: true,
        },
        round_period: Duration::from_millis(100),
        keeps_reputations: false,
        status: NodeStatus::starting(name(index), Uuid::nil(), election.role, ""),
        election,
    }
}

fn broker(index: usize) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, 1], 1883 + index as u16))
}

fn member(index: usize) -> SeenMember {
    SeenMember {
        name: name(index),
        run: 1,
        broker: Some(broker(index).into()),
        is_on_this_machine: false,
    }
}

impl Cell {
    fn new(nodes: usize) -> Self {
        let down = Node {
            machine: None,
            leadership: Leadership::default(),
            filter: RoundFilter::new(0, Timestamp(1_000_000_000)),
            clock: Timestamp(1_000_000_000),
            persisted: 0,
            publishing: None,
            accepted: 0,
            last: None,
        };
        let mut cell = Self {
            nodes: vec![down; nodes],
            packets: Vec::new(),
            led: BTreeMap::new(),
            crashes_left: 2,
            went_back: false,
            accepted_twice: false,
            led_unwritten: false,
            steps: 0,
        };
        for index in 0..nodes {
            cell.start(index);
        }
        cell
    }

    fn start(&mut self, index: usize) {
        let node = &mut self.nodes[index];
        node.clock = node.clock + Duration::from_millis(1);
        node.leadership = Leadership::default();
        node.machine = Some(LeadershipNode::new(
            settings(index),
            node.persisted,
            &node.leadership,
            node.clock,
        ));
        node.filter = RoundFilter::new(node.persisted, node.clock);
        node.last = None;
        self.handle(
            index,
            Input::OwnBroker {
                address: Some(broker(index)),
            },
        );
        self.handle(
            index,
            Input::LinkChanged {
                broker: broker(index).into(),
                state: LinkState::Up,
            },
        );
        for peer in (0..self.nodes.len()).filter(|peer| *peer != index) {
            self.handle(
                index,
                Input::MemberAlive {
                    member: member(peer),
                },
            );
        }
    }

    fn handle(&mut self, index: usize, input: Input) {
        let node = &mut self.nodes[index];
        let Some(machine) = &mut node.machine else {
            return;
        };
        let effects = machine.handle(input, node.clock);
        self.carry_out(index, effects);
    }

    /// The next action of a timer, except checks of the own parts, which have no effect because all parts work.
    fn tick(&mut self, index: usize) -> Vec<Effect> {
        loop {
            let node = &mut self.nodes[index];
            let Some(machine) = &mut node.machine else {
                return Vec::new();
            };
            node.clock = node.clock.max(machine.next_deadline());
            let effects = machine.handle(Input::Wake, node.clock);
            if !effects.contains(&Effect::Observe) {
                return effects;
            }
            let (observes, others): (Vec<_>, Vec<_>) = effects
                .into_iter()
                .partition(|effect| matches!(effect, Effect::Observe | Effect::AskParts));
            self.carry_out(index, observes);
            if !others.is_empty() {
                return others;
            }
        }
    }

    fn crash(&mut self, index: usize) {
        self.nodes[index].machine = None;
        self.nodes[index].publishing = None;
    }

    fn carry_out(&mut self, index: usize, effects: Vec<Effect>) {
        let mut effects = VecDeque::from(effects);
        while let Some(effect) = effects.pop_front() {
            let answer = self.carry_out_one(index, effect);
            let node = &mut self.nodes[index];
            if let (Some(input), Some(machine)) = (answer, &mut node.machine) {
                effects.extend(machine.handle(input, node.clock));
            }
        }
    }

    /// Carries out an effect of the machine; returns the resulting input.
    fn carry_out_one(&mut self, index: usize, effect: Effect) -> Option<Input> {
        let nodes = self.nodes.len();
        let node = &mut self.nodes[index];
        match effect {
            Effect::PersistTerm { term } => node.persisted = term,
            Effect::PublishLeadership { leadership } => node.leadership = leadership,
            Effect::Lead {
                epoch, first_round, ..
            } => {
                self.led_unwritten |= epoch.term > node.persisted;
                *self.led.entry(epoch.clone()).or_default() += 1;
                node.publishing = Some((epoch, first_round));
            }
            Effect::StopPublishing { .. } => node.publishing = None,
            Effect::Send { to, message } => {
                let known = (0..nodes).find(|index| name(*index) == to);
                self.packets
                    .extend(known.map(|to| Packet::Election(to, message)));
            }
            Effect::Observe => {
                let members = (0..nodes)
                    .filter(|peer| *peer != index)
                    .map(member)
                    .collect();
                let rounds_due = node.clock.micros() / 100_000;
                return Some(Input::Observed {
                    rounds_due,
                    load_percent: 0,
                    members,
                });
            }
            Effect::AskParts => {
                let links = (0..nodes)
                    .map(|index| (broker(index).into(), LinkState::Up))
                    .collect();
                let sample = HealthSample {
                    broker_serves: true,
                    links: Some(links),
                    fuser_runs: true,
                    rejects_reports: false,
                    contradicts: false,
                    certificate_ends: false,
                };
                return Some(Input::PartsAnswered { sample });
            }
            Effect::HoldRound
            | Effect::SetLinks { .. }
            | Effect::PublishStatus { .. }
            | Effect::SendSnapshot { .. }
            | Effect::CountImplausible { .. }
            | Effect::Log { .. } => {}
        }
        None
    }

    fn publish(&mut self, index: usize) {
        let node = &mut self.nodes[index];
        let Some((epoch, next)) = &mut node.publishing else {
            return;
        };
        let map = Map {
            epoch: epoch.clone(),
            round: *next,
            fused_at: node.clock,
        };
        *next += 1;
        for to in (0..self.nodes.len()).filter(|to| *to != index) {
            self.packets.push(Packet::Map(to, map.clone()));
        }
        self.accept(index, map);
    }

    fn accept(&mut self, index: usize, map: Map) {
        let node = &mut self.nodes[index];
        let Map {
            epoch,
            round,
            fused_at,
        } = map;
        let map = GlobalMap::new(&epoch, round, fused_at);
        let accepted = node
            .filter
            .accept_map(&map, Origin::Claimed, node.clock, &node.leadership);
        if node.machine.is_none() || accepted.is_err() {
            return;
        }
        let is_elected = node.leadership.present_epoch() == Some(&epoch);
        let was_quiet = node.leadership.leader().is_none()
            && node
                .last
                .as_ref()
                .is_none_or(|(_, _, at)| node.clock.since(*at) >= EPOCH_MEMORY);
        self.went_back |= epoch.term < node.accepted && !is_elected && !was_quiet;
        self.accepted_twice |= node
            .last
            .as_ref()
            .is_some_and(|(of, last, _)| *of == epoch && *last >= round);
        node.accepted = node.accepted.max(epoch.term);
        node.last = Some((epoch.clone(), round, node.clock));
        self.handle(index, Input::RoundAccepted { epoch, round });
    }

    fn deliver(&mut self, packet: Packet) {
        match packet {
            Packet::Election(to, message) => {
                let from = message.from.clone();
                self.handle(
                    to,
                    Input::Receive {
                        from,
                        rights: Rights::ALL,
                        message,
                    },
                );
            }
            Packet::Map(to, map) => self.accept(to, map),
        }
    }

    /// A connection to a node's broker breaks, and its port refuses.
    fn refuse(&mut self, to: usize, about: usize) {
        for state in [LinkState::Up, LinkState::Down, LinkState::Refused] {
            self.handle(
                to,
                Input::LinkChanged {
                    broker: broker(about).into(),
                    state,
                },
            );
        }
    }

    /// Time passes evenly, every message arrives, and no node crashes.
    fn run_quietly(&mut self, millis: u64) {
        let mut left = Duration::from_millis(millis);
        while !left.is_zero() {
            while !self.packets.is_empty() {
                let packet = self.packets.remove(0);
                self.deliver(packet);
            }
            let due = |node: &Node| Some(node.machine.as_ref()?.next_deadline().since(node.clock));
            let next = self.nodes.iter().filter_map(due).min().unwrap_or(left);
            let step = next
                .clamp(Duration::from_millis(1), Duration::from_millis(20))
                .min(left);
            left -= step;
            for index in 0..self.nodes.len() {
                let node = &mut self.nodes[index];
                node.clock = node.clock + step;
                self.handle(index, Input::Wake);
            }
        }
    }

    fn converges(&self) -> bool {
        let mut quiet = self.clone();
        // A peer that became silent counts as present for 2.5 idle beats (6.25 s); then come `stable_ms` and a
        // handover.
        quiet.run_quietly(14_000);
        let running = || {
            quiet
                .nodes
                .iter()
                .filter_map(|node| node.machine.as_ref())
                .map(LeadershipNode::election)
        };
        let candidates = quiet
            .nodes
            .iter()
            .take(3)
            .any(|node| node.machine.is_some());
        let leaders = running().filter(|election| election.is_leading()).count();
        let followed: BTreeSet<_> = running().map(Election::leader).collect();
        leaders == usize::from(candidates) && (!candidates || followed.len() == 1)
    }
}

impl CellModel {
    /// True if to let this state settle: it takes thousands of steps, so a fixed sample of the last ones has to do.
    fn settles(&self, cell: &Cell) -> bool {
        let clocks: u64 = cell
            .nodes
            .iter()
            .map(|node| node.clock.micros() / 1000)
            .sum();
        cell.steps.is_multiple_of(self.depth.min(20))
            && (clocks + cell.packets.len() as u64).is_multiple_of(self.sample)
    }
}

impl Model for CellModel {
    type State = Cell;
    type Action = Action;

    fn init_states(&self) -> Vec<Cell> {
        self.initial.clone()
    }

    fn actions(&self, cell: &Cell, actions: &mut Vec<Action>) {
        for packet in 0..cell.packets.len() {
            actions.push(Action::Deliver {
                packet,
                again: false,
            });
            actions.push(Action::Deliver {
                packet,
                again: true,
            });
        }
        for (index, node) in cell.nodes.iter().enumerate() {
            if node.machine.is_none() {
                actions.push(Action::Restart(index));
                let others = (0..cell.nodes.len()).filter(|to| *to != index);
                actions.extend(others.map(|to| Action::Gone { to, about: index }));
                continue;
            }
            actions.push(Action::Tick(index));
            if node.publishing.is_some() {
                actions.push(Action::Publish(index));
            }
            if cell.crashes_left > 0 {
                actions.push(Action::Crash(index));
                actions.push(Action::TornTick(index));
            }
        }
    }

    fn next_state(&self, last: &Cell, action: Action) -> Option<Cell> {
        let mut cell = last.clone();
        cell.steps += 1;
        match action {
            Action::Deliver {
                packet,
                again: false,
            } => {
                let packet = cell.packets.remove(packet);
                cell.deliver(packet);
            }
            Action::Deliver {
                packet,
                again: true,
            } => cell.deliver(last.packets[packet].clone()),
            Action::Tick(index) => {
                let effects = cell.tick(index);
                cell.carry_out(index, effects);
            }
            Action::TornTick(index) => {
                let effects = cell.tick(index);
                cell.carry_out(index, effects.into_iter().take(1).collect());
                cell.crash(index);
                cell.crashes_left -= 1;
            }
            Action::Publish(index) => cell.publish(index),
            Action::Crash(index) => {
                cell.crash(index);
                cell.crashes_left -= 1;
            }
            Action::Restart(index) => cell.start(index),
            Action::Gone { to, about } => cell.refuse(to, about),
        }
        let surplus = cell.packets.len().saturating_sub(MAX_PACKETS);
        cell.packets.drain(..surplus);
        (cell != *last).then_some(cell)
    }

    fn within_boundary(&self, cell: &Cell) -> bool {
        cell.steps <= self.depth
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("no two leaderships have one epoch", |_, cell: &Cell| {
                cell.led.values().all(|count| *count == 1)
            }),
            Property::always(
                "the term is on disk before it is led in",
                |_, cell: &Cell| !cell.led_unwritten,
            ),
            // But to the elected leader's, and to a lone publisher's after a while without any round.
            Property::always(
                "terms accepted by a node do not go back, restarts included",
                |_, cell: &Cell| !cell.went_back,
            ),
            Property::always("no round is accepted twice in a row", |_, cell: &Cell| {
                !cell.accepted_twice
            }),
            Property::always(
                "a quiet component converges",
                |model: &Self, cell: &Cell| !model.settles(cell) || cell.converges(),
            ),
            Property::sometimes("two lead at once", |_, cell: &Cell| {
                cell.nodes
                    .iter()
                    .filter(|node| node.publishing.is_some())
                    .count()
                    > 1
            }),
        ]
    }
}

/// A starting cell, a cell that has just elected its leader, a cell a moment before its edge is offered the lead, a
/// cell a moment before the edge is ready for it, and a cell after a split.
fn settled(nodes: usize) -> Vec<Cell> {
    let cold = Cell::new(nodes);
    let mut quiet = cold.clone();
    quiet.run_quietly(1500);
    let mut late_edge = cold.clone();
    late_edge.crash(0);
    late_edge.run_quietly(1500);
    late_edge.start(0);
    late_edge.run_quietly(195);
    let mut ready_edge = late_edge.clone();
    ready_edge.run_quietly(320);
    let mut split = quiet.clone();
    split.crash(0);
    split.run_quietly(400);
    split.start(0);
    split.packets.clear();
    vec![cold, quiet, late_edge, ready_edge, split]
}

fn everything_holds(checker: &impl Checker<CellModel>) {
    checker.assert_no_discovery("no two leaderships have one epoch");
    checker.assert_no_discovery("the term is on disk before it is led in");
    checker.assert_no_discovery("terms accepted by a node do not go back, restarts included");
    checker.assert_no_discovery("no round is accepted twice in a row");
    checker.assert_no_discovery("a quiet component converges");
}

#[test]
fn three_nodes_in_every_order() {
    let model = CellModel {
        initial: settled(3),
        depth: 4,
        sample: 61,
    };
    let checker = model
        .checker()
        .finish_when(HasDiscoveries::AnyFailures)
        .spawn_bfs()
        .join();
    println!(
        "{} states, {} of them different",
        checker.state_count(),
        checker.unique_state_count()
    );
    everything_holds(&checker);
    assert!(
        checker.unique_state_count() > 10_000,
        "the model hardly moves"
    );
}

#[test]
fn four_nodes_in_random_orders() {
    let model = CellModel {
        initial: settled(4),
        depth: 120,
        sample: 1,
    };
    let checker = model
        .checker()
        .finish_when(HasDiscoveries::AnyFailures)
        .target_state_count(60_000)
        .spawn_simulation(7, UniformChooser)
        .join();
    println!("{} states on random walks", checker.state_count());
    everything_holds(&checker);
    assert!(
        checker.discovery("two lead at once").is_some(),
        "the walks do not split the cell"
    );
}
