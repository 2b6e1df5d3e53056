//! Cells of machines on a network in simulated time.

use std::collections::{BTreeMap, BTreeSet};
use std::net::Ipv4Addr;

use ecod::diagnostics::TroubleKind;
use ecod::leadership::election::ElectionConfig;
use ecod::wire::Role;
use proptest::prelude::*;

use super::*;

mod attacks;
mod certificates;

const KEY: &str = "0101010101010101010101010101010101010101010101010101010101010101";

/// Machines, the datagrams between them, and the events of each machine.
struct Cell {
    now: Timestamp,
    /// Name of the cell in which nodes start.
    name: NodeName,
    nodes: BTreeMap<usize, Node>,
    under_way: Vec<(Timestamp, SocketAddr, SocketAddr, Vec<u8>)>,
    recorded: Vec<(SocketAddr, SocketAddr, Vec<u8>)>,
    multicast: bool,
    /// Nodes whose datagrams reach only each other.
    island: BTreeSet<usize>,
    loss_percent: u32,
    sent: usize,
    rng: ChaCha8Rng,
}

struct Node {
    machine: GossipMachine,
    events: Vec<MembershipEvent>,
    /// Kinds of reported troubles, with the names or addresses that they are about.
    troubles: BTreeSet<(String, TroubleKind)>,
    stopped: bool,
}

impl Cell {
    fn new(multicast: bool) -> Self {
        Self::seeded(multicast, 3)
    }

    /// A cell whose sessions differ from the sessions of cells with another seed.
    fn seeded(multicast: bool, seed: u64) -> Self {
        Self {
            now: Timestamp(1_700_000_000_000_000),
            name: NodeName::from_static("lot-1"),
            nodes: BTreeMap::new(),
            under_way: Vec::new(),
            recorded: Vec::new(),
            multicast,
            island: BTreeSet::new(),
            loss_percent: 0,
            sent: 0,
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    fn of(nodes: usize) -> Self {
        let mut cell = Self::new(true);
        (1..=nodes).for_each(|node| cell.start(node, &name(node)));
        cell.run(3000);
        cell
    }

    fn start(&mut self, node: usize, name: &str) {
        self.start_at(node, name, KEY, self.now.micros());
    }

    fn start_at(&mut self, node: usize, name: &str, key: &str, run: u64) {
        self.start_as(node, name, key, None, run);
    }

    fn start_as(
        &mut self,
        node: usize,
        name: &str,
        key: &str,
        identity: Option<Identity>,
        run: u64,
    ) {
        let own = NodeId {
            name: NodeName::new(name).unwrap(),
            run,
            life: run,
            role: Role::Auto,
            gossip: SocketAddr::from(([0, 0, 0, 0], 17_884)),
            broker: Some(SocketAddr::from(([0, 0, 0, 0], 1883))),
        };
        let mut session = SessionNonce::default();
        self.rng.fill(&mut session);
        let cell = self.name.clone();
        let key = CellKey::new(key, &cell);
        let seed = self.rng.random();
        let setup = GossipSetup {
            own,
            cell,
            key,
            session,
            identity,
            secret: [7; 32],
            seed,
            counters: Arc::default(),
        };
        let machine = GossipMachine::new(setup, &MembershipConfig::default(), self.now);
        self.nodes.insert(
            node,
            Node {
                machine,
                events: Vec::new(),
                troubles: BTreeSet::new(),
                stopped: false,
            },
        );
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms {
            self.now = self.now + Duration::from_millis(1);
            let now = self.now;
            let arrived: Vec<_> = self.take_arrived();
            for (_, from, to, frame) in arrived {
                let Some(node) = self.nodes.get_mut(&index(to)) else {
                    continue;
                };
                node.machine.receive(&frame, from, now);
            }
            for node in self.nodes.values_mut().filter(|node| !node.stopped) {
                if node
                    .machine
                    .next_deadline()
                    .is_some_and(|deadline| deadline <= now)
                {
                    node.machine.tick(now);
                }
            }
            self.deliver();
        }
    }

    /// Runs while a node sends datagrams to all others ten times a second.
    fn send_beats(&mut self, node: usize, ms: u64) {
        for passed in 0..ms {
            let now = self.now;
            let machine = &mut self.nodes.get_mut(&node).unwrap().machine;
            for member in machine.members().iter().filter(|_| passed % 100 == 0) {
                machine.send(&member.name, b"beat", now);
            }
            self.run(1);
        }
    }

    fn take_arrived(&mut self) -> Vec<(Timestamp, SocketAddr, SocketAddr, Vec<u8>)> {
        let stopped =
            |to: &SocketAddr| self.nodes.get(&index(*to)).is_some_and(|node| node.stopped);
        let (arrived, later) = std::mem::take(&mut self.under_way)
            .into_iter()
            .partition(|(at, _, to, _)| *at <= self.now && !stopped(to));
        self.under_way = later;
        arrived
    }

    fn deliver(&mut self) {
        let all: Vec<usize> = self.nodes.keys().copied().collect();
        let mut sent = Vec::new();
        for (index, node) in &mut self.nodes {
            while let Some(output) = node.machine.poll() {
                match output {
                    GossipOutput::Send { to, frame } => sent.push((*index, to, frame)),
                    GossipOutput::Multicast { frame } if self.multicast => {
                        sent.extend(all.iter().map(|to| (*index, address(*to), frame.clone())));
                    }
                    GossipOutput::Multicast { .. } | GossipOutput::Renewal { .. } => (),
                    GossipOutput::Event(MembershipEvent::Troubled { about, kind, .. }) => {
                        node.troubles.insert((about, kind));
                    }
                    GossipOutput::Event(event) => node.events.push(event),
                }
            }
        }
        for (from, to, frame) in sent {
            self.sent += 1;
            self.recorded.push((address(from), to, frame.clone()));
            let cut = self.island.contains(&from) != self.island.contains(&index(to));
            if !cut && !self.rng.random_ratio(self.loss_percent, 100) {
                let delay = Duration::from_micros(self.rng.random_range(100..3000));
                self.under_way
                    .push((self.now + delay, address(from), to, frame));
            }
        }
    }

    fn sees(&self, node: usize) -> BTreeSet<String> {
        self.nodes[&node]
            .machine
            .members()
            .iter()
            .map(|member| member.name.to_string())
            .collect()
    }

    fn assert_complete(&self) {
        for node in self.nodes.keys() {
            let others: BTreeSet<_> = self
                .nodes
                .keys()
                .filter(|other| *other != node)
                .map(|other| name(*other))
                .collect();
            assert_eq!(self.sees(*node), others, "as seen by {node}");
        }
    }

    fn clear_events(&mut self) {
        self.nodes.values_mut().for_each(|node| node.events.clear());
    }

    fn events(&self) -> usize {
        self.nodes.values().map(|node| node.events.len()).sum()
    }
}

fn name(node: usize) -> String {
    format!("node-{node}")
}

fn node_name(node: usize) -> NodeName {
    NodeName::new(name(node)).unwrap()
}

fn address(node: usize) -> SocketAddr {
    SocketAddr::from((Ipv4Addr::new(10, 0, 0, node as u8), 17_884))
}

fn index(address: SocketAddr) -> usize {
    match address.ip() {
        std::net::IpAddr::V4(ip) => usize::from(ip.octets()[3]),
        std::net::IpAddr::V6(_) => usize::MAX,
    }
}

#[test]
fn nodes_join_by_multicast() {
    let cell = Cell::of(8);
    cell.assert_complete();
    let member = &cell.nodes[&1].machine.members()[0];
    assert_eq!(
        (member.gossip, member.broker),
        (address(2), Some(SocketAddr::from(([10, 0, 0, 2], 1883))))
    );
}

/// A node gets another address while it goes on sending. Others reach it there at once and keep it as a member.
fn a_node_moves(mut cell: Cell) {
    cell.clear_events();
    let moving = cell.nodes.remove(&2).unwrap();
    cell.nodes.insert(12, moving);
    // Its next datagrams come from there already, before it has noticed.
    cell.send_beats(12, 50);
    let now = cell.now;
    let moved = address(12);
    let node = cell.nodes.get_mut(&12).unwrap();
    node.machine.move_to(moved.ip(), now);
    cell.deliver();
    cell.send_beats(12, 30);
    for other in [1, 3] {
        let Node {
            machine, events, ..
        } = &cell.nodes[&other];
        let members = machine.members();
        let member = members
            .iter()
            .find(|member| member.name == node_name(2))
            .unwrap();
        assert_eq!(
            (member.gossip, member.broker.unwrap().ip()),
            (moved, moved.ip())
        );
        assert!(events.iter().any(|event| *event
            == MembershipEvent::Changed {
                member: member.clone()
            }));
    }
    cell.send_beats(12, 3000);
    let is_end = |event: &MembershipEvent| matches!(event, MembershipEvent::Down { .. });
    let mut events = cell.nodes.values().flat_map(|node| &node.events);
    assert!(!events.any(is_end));
}

#[test]
fn moved_node_is_reached_at_once() {
    a_node_moves(Cell::of(3));
}

#[test]
fn nodes_join_by_one_seed() {
    let mut cell = Cell::new(false);
    for node in 2..=5 {
        cell.start(node, &name(node));
        cell.nodes
            .get_mut(&node)
            .unwrap()
            .machine
            .set_seeds(vec![address(1)]);
    }
    cell.run(1000);
    assert!(cell.sees(2).is_empty());
    cell.start(1, "node-1");
    cell.run(6000);
    cell.assert_complete();
}

#[test]
fn returning_seed_finds_its_cell() {
    for seed in 0..20 {
        let mut cell = Cell::seeded(false, seed);
        (1..=4).for_each(|node| cell.start(node, &name(node)));
        for node in 2..=4 {
            cell.nodes
                .get_mut(&node)
                .unwrap()
                .machine
                .set_seeds(vec![address(1)]);
        }
        cell.run(3000);
        cell.assert_complete();
        cell.nodes.remove(&1);
        cell.run(2000 + 97 * seed);
        cell.start(1, "node-1");
        cell.run(ElectionConfig::default().join_ms * 3 / 4);
        cell.assert_complete();
    }
}

#[test]
fn cell_forms_despite_loss() {
    let mut cell = Cell::new(true);
    cell.loss_percent = 20;
    (1..=6).for_each(|node| cell.start(node, &name(node)));
    cell.run(6000);
    cell.loss_percent = 0;
    cell.run(3000);
    cell.assert_complete();
}

#[test]
fn only_dead_node_goes_down() {
    let mut cell = Cell::of(8);
    cell.clear_events();
    cell.nodes.remove(&3);
    cell.run(1500);
    cell.assert_complete();
    for node in cell.nodes.values() {
        let downs: Vec<_> = node
            .events
            .iter()
            .filter(|event| matches!(event, MembershipEvent::Down { .. }))
            .collect();
        assert_eq!(downs, [&MembershipEvent::Down { name: node_name(3) }]);
        assert!(
            !node
                .events
                .iter()
                .any(|event| matches!(event, MembershipEvent::Alive { .. }))
        );
    }
}

#[test]
fn leaving_node_goes_at_once() {
    let mut cell = Cell::of(4);
    let now = cell.now;
    cell.nodes.get_mut(&2).unwrap().machine.leave(now);
    cell.deliver();
    cell.nodes.get_mut(&2).unwrap().stopped = true;
    cell.run(150);
    assert!(
        [1, 3, 4]
            .iter()
            .all(|node| !cell.sees(*node).contains("node-2"))
    );
    assert_eq!(cell.nodes[&2].machine.next_deadline(), None);
}

#[test]
fn stopped_node_rejoins() {
    let mut cell = Cell::of(6);
    cell.nodes.get_mut(&4).unwrap().stopped = true;
    cell.run(5000);
    assert!(!cell.sees(1).contains("node-4"));
    cell.clear_events();
    cell.nodes.get_mut(&4).unwrap().stopped = false;
    cell.run(2000);
    cell.assert_complete();
    let blamed = cell
        .nodes
        .values()
        .flat_map(|node| &node.events)
        .any(|event| matches!(event, MembershipEvent::Down { .. }));
    assert!(!blamed);
}

#[test]
fn restart_survives_backward_clock() {
    let mut cell = Cell::of(4);
    for run in [cell.now.micros(), 1000] {
        cell.nodes.remove(&2);
        cell.start_at(2, "node-2", KEY, run);
        cell.run(3000);
        cell.assert_complete();
        for node in [1, 3, 4] {
            let member = cell.nodes[&node]
                .machine
                .members()
                .into_iter()
                .find(|member| member.name == node_name(2));
            assert_eq!(member.unwrap().run, run, "as seen by {node}");
        }
    }
}

#[test]
fn quick_restart_is_no_death() {
    let mut cell = Cell::new(false);
    for node in 1..=8 {
        cell.start(node, &name(node));
        cell.nodes
            .get_mut(&node)
            .unwrap()
            .machine
            .set_seeds(vec![address(1)]);
    }
    cell.run(5000);
    cell.assert_complete();
    cell.clear_events();
    cell.start(5, "node-5");
    cell.nodes
        .get_mut(&5)
        .unwrap()
        .machine
        .set_seeds(vec![address(1)]);
    cell.run(3000);
    cell.assert_complete();
    for (node, Node { events, .. }) in cell.nodes.iter().filter(|(node, _)| **node != 5) {
        let alive = |event: &&MembershipEvent| matches!(event, MembershipEvent::Alive { .. });
        let down = |event: &MembershipEvent| matches!(event, MembershipEvent::Down { .. });
        assert_eq!(events.iter().filter(alive).count(), 1, "{node}: {events:?}");
        assert!(!events.iter().any(down), "{node}: {events:?}");
    }
}

#[test]
fn second_namesake_gives_up() {
    let mut cell = Cell::of(4);
    cell.clear_events();
    cell.start(9, "node-2");
    let sent = cell.sent;
    cell.run(8000);
    assert!(
        (cell.sent - sent) / 5 / 8 < 100,
        "{} frames",
        cell.sent - sent
    );
    let second = &cell.nodes[&9];
    assert!(
        second.events.contains(&MembershipEvent::Excluded) && second.machine.members().is_empty()
    );
    let now = cell.now;
    cell.nodes.get_mut(&9).unwrap().machine.leave(now);
    cell.run(3000);
    for node in [1, 3, 4] {
        let member = cell.nodes[&node]
            .machine
            .members()
            .into_iter()
            .find(|member| member.name == node_name(2));
        assert_eq!(member.unwrap().gossip, address(2), "as seen by {node}");
        let Node {
            events, troubles, ..
        } = &cell.nodes[&node];
        assert!(events.is_empty(), "{events:?}");
        assert!(
            troubles.contains(&("node-2".into(), TroubleKind::NameTaken)),
            "{node} reports it"
        );
    }
    assert_eq!(
        cell.nodes[&2].machine.members().len(),
        3,
        "the first node reports no other change"
    );
}

#[test]
fn two_taken_names_are_reported() {
    let mut cell = Cell::of(4);
    cell.start(9, "node-2");
    cell.start(10, "node-3");
    cell.run(8000);
    for node in [1, 4] {
        let troubles = &cell.nodes[&node].troubles;
        for name in ["node-2", "node-3"] {
            assert!(
                troubles.contains(&(name.into(), TroubleKind::NameTaken)),
                "{node} reports {name}: {troubles:?}"
            );
        }
    }
}

/// Asserts that node 9 has given up the name of node 1, that only node 9 was informed, and that
/// node 1 has reported it.
fn assert_second_gave_up(cell: &Cell) {
    let first = &cell.nodes[&1];
    let second = &cell.nodes[&9];
    assert!(
        second.events.contains(&MembershipEvent::Excluded),
        "{:?}",
        second.events
    );
    assert!(
        !first.events.contains(&MembershipEvent::Excluded),
        "{:?}",
        first.events
    );
    assert!(
        first.troubles.contains(&(name(1), TroubleKind::NameTaken)),
        "{:?}",
        first.troubles
    );
}

#[test]
fn second_namesake_of_seed_gives_up() {
    for others in [0, 2] {
        let mut cell = Cell::new(false);
        (1..=1 + others).for_each(|node| cell.start(node, &name(node)));
        for node in cell.nodes.values_mut() {
            node.machine.set_seeds(vec![address(1)]);
        }
        cell.run(8000);
        cell.start(9, &name(1));
        cell.nodes
            .get_mut(&9)
            .unwrap()
            .machine
            .set_seeds(vec![address(1)]);
        cell.run(8000);
        assert_second_gave_up(&cell);
        assert_eq!(cell.nodes[&1].machine.members().len(), others);
    }
}

/// Two nodes that discover each other late compare their start times.
#[test]
fn late_meeting_namesake_gives_up() {
    let mut cell = Cell::new(false);
    cell.start(1, &name(1));
    cell.run(1000);
    cell.start(9, &name(1));
    cell.run(8000);
    for (node, seed) in [(1, 9), (9, 1)] {
        cell.nodes
            .get_mut(&node)
            .unwrap()
            .machine
            .set_seeds(vec![address(seed)]);
    }
    cell.run(10_000);
    assert_second_gave_up(&cell);
}

#[test]
fn moved_node_regains_its_name() {
    let mut cell = Cell::of(4);
    cell.nodes.remove(&2);
    cell.start(9, "node-2");
    cell.run(3000);
    for node in [1, 3, 4] {
        let member = cell.nodes[&node]
            .machine
            .members()
            .into_iter()
            .find(|member| member.name == node_name(2));
        assert_eq!(member.unwrap().gossip, address(9), "as seen by {node}");
    }
    assert_eq!(cell.nodes[&9].machine.members().len(), 3);
}

#[test]
fn datagrams_arrive_with_their_sender() {
    let mut cell = Cell::of(3);
    cell.clear_events();
    let now = cell.now;
    let sender = &mut cell.nodes.get_mut(&1).unwrap().machine;
    sender.send(&node_name(3), &[42; 1200], now);
    sender.send(&NodeName::from_static("nobody"), b"lost", now);
    cell.run(10);
    assert!(cell.nodes[&2].events.is_empty());
    let [MembershipEvent::Received { from, payload, .. }] = &cell.nodes[&3].events[..] else {
        panic!("no message arrived")
    };
    assert_eq!((from, &payload[..]), (&node_name(1), &[42; 1200][..]));
    assert_eq!(
        cell.nodes[&1].machine.counters.get(FrameEvent::NoSession),
        1
    );
}

#[test]
fn lossy_link_keeps_nodes_connected() {
    let mut cell = Cell::of(2);
    cell.loss_percent = 20;
    cell.clear_events();
    for _ in 0..1200 {
        for (from, to) in [(1, 2), (2, 1)] {
            let now = cell.now;
            cell.nodes
                .get_mut(&from)
                .unwrap()
                .machine
                .send(&node_name(to), b"beat", now);
        }
        cell.run(50);
    }
    let count = |node: &Node, is: fn(&MembershipEvent) -> bool| {
        node.events.iter().filter(|event| is(event)).count()
    };
    let mut given_up = 0;
    for node in cell.nodes.values() {
        given_up += count(node, |event| matches!(event, MembershipEvent::Down { .. }));
        let received = count(node, |event| {
            matches!(event, MembershipEvent::Received { .. })
        });
        assert!(received > 900, "{received} of 1200");
    }
    assert!(given_up > 2, "{given_up} times: too few to show anything");
}

#[test]
fn long_lost_peer_gets_no_frames() {
    let mut cell = Cell::of(2);
    cell.nodes.remove(&2);
    for (wait_ms, left_out) in [(2000, 0), (10_000, 1)] {
        cell.run(wait_ms);
        let now = cell.now;
        let machine = &mut cell.nodes.get_mut(&1).unwrap().machine;
        machine.send(&node_name(2), b"beat", now);
        assert_eq!(
            machine.counters.get(FrameEvent::NoSession),
            left_out,
            "after {wait_ms} ms more"
        );
    }
}

#[test]
fn split_cell_merges_again() {
    let mut cell = Cell::of(6);
    cell.island = [1, 2, 3].into();
    cell.run(4000);
    assert_eq!((cell.sees(1).len(), cell.sees(6).len()), (2, 2));
    cell.island.clear();
    cell.run(5000);
    cell.assert_complete();
}

#[test]
fn other_key_stays_unseen() {
    let mut cell = Cell::new(true);
    cell.start(1, "node-1");
    cell.start(2, "node-2");
    cell.start_at(3, "node-3", "another passphrase", 5);
    cell.run(2000);
    assert_eq!(cell.sees(1), ["node-2".to_owned()].into());
    assert!(cell.sees(3).is_empty());
    assert!(cell.nodes[&1].machine.counters.get(FrameEvent::BadSeal) > 0);
    assert!(cell.nodes[&3].machine.counters.get(FrameEvent::BadSeal) > 0);
}

/// Only a node that has found no other node for ten seconds may be meant for the other cell.
#[test]
fn other_cell_is_named_when_alone() {
    let is_warned = |cell: &Cell| {
        let troubles = &cell.nodes[&1].troubles;
        troubles
            .iter()
            .any(|(_, kind)| *kind == TroubleKind::OtherCell)
    };
    let mut lone = Cell::new(true);
    lone.start(1, "node-1");
    lone.name = NodeName::from_static("lot-2");
    lone.start(2, "node-2");
    lone.run(5000);
    assert!(!is_warned(&lone), "others may still be starting");
    lone.run(10_000);
    assert!(is_warned(&lone));

    let mut whole = Cell::of(2);
    whole.name = NodeName::from_static("lot-2");
    whole.start(3, "node-3");
    whole.run(20_000);
    assert!(!is_warned(&whole), "a neighbouring cell");
}

/// Only the other side can detect a wrong key; this side at least sees a silent seed.
#[test]
fn silent_seeds_are_named() {
    let mut cell = Cell::new(false);
    cell.start(1, "node-1");
    cell.start_at(2, "node-2", "another passphrase", 5);
    let seeds = vec![address(1), address(2)];
    for node in [1, 2] {
        cell.nodes
            .get_mut(&node)
            .unwrap()
            .machine
            .set_seeds(seeds.clone());
    }
    let silent = |cell: &Cell, node: usize| -> Vec<String> {
        let reported = cell.nodes[&node].troubles.iter();
        reported
            .filter(|(_, kind)| *kind == TroubleKind::SeedSilent)
            .map(|(about, _)| about.clone())
            .collect()
    };
    cell.run(5000);
    assert_eq!(silent(&cell, 2), [""; 0], "they may still be starting");
    cell.run(20_000);
    assert_eq!(silent(&cell, 2), [address(1).to_string()]);

    let mut whole = Cell::new(false);
    whole.start(1, "node-1");
    whole.start(2, "node-2");
    whole
        .nodes
        .get_mut(&2)
        .unwrap()
        .machine
        .set_seeds(vec![address(1), address(9)]);
    whole.run(25_000);
    assert_eq!(
        silent(&whole, 2),
        [""; 0],
        "a cell does without one that is not there"
    );
}
