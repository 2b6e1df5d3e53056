use super::*;
use crate::leadership::election::{Body, Candidacy};
use crate::leadership::view::Position;
use crate::model::epoch::Epoch;
use crate::wire::{MAX_INTEGER, SCHEMA_VERSION};

/// A true time, to which the simulated clocks are compared.
const NOON: Timestamp = Timestamp(1_795_000_000_000_000);
const SECOND_US: i64 = 1_000_000;
/// From the true time back to 1970.
const TO_1970_US: i64 = -1_794_000_000_000_000;

/// Nodes that exchange messages with the leader as in a quiet cell: idle beats and their answers.
struct Cell {
    now: Timestamp,
    nodes: Vec<Node>,
    leader: usize,
    /// State of a generator of transit times.
    random: u64,
}

struct Node {
    name: NodeName,
    role: Role,
    time: CellTime,
    /// The node's steady clock minus the true time, and its wall clock minus the true time.
    steady_us: i64,
    wall_us: i64,
    events: Vec<ClockEvent>,
}

impl Cell {
    fn new(nodes: &[(Role, i64, i64)]) -> Self {
        let node = |(index, (role, steady_us, wall_us)): (usize, &(Role, i64, i64))| Node {
            name: NodeName::new(format!("n{index}")).unwrap(),
            role: *role,
            time: CellTime::new(*role),
            steady_us: *steady_us,
            wall_us: *wall_us,
            events: Vec::new(),
        };
        Self {
            now: NOON,
            nodes: nodes.iter().enumerate().map(node).collect(),
            leader: 0,
            random: 1,
        }
    }

    fn leadership(&self, index: usize) -> Leadership {
        let epoch = Some(Epoch::new(7, self.nodes[self.leader].name.clone()));
        let position = match index {
            _ if index == self.leader => Position::Leading,
            _ if index == (self.leader + 1) % self.nodes.len() => Position::StandingBy,
            _ => Position::Following,
        };
        Leadership {
            position,
            epoch,
            standby: None,
            term: 7,
            is_deserted: false,
            is_yielding: false,
        }
    }

    /// A transit time of 1 to 4 ms, and occasionally 300 ms.
    fn transit(&mut self) -> Duration {
        self.random = self
            .random
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        let draw = self.random >> 33;
        if draw.is_multiple_of(7) {
            Duration::from_millis(300)
        } else {
            Duration::from_micros(1000 + draw % 3000)
        }
    }

    fn pass(&mut self, from: usize, to: usize) {
        let transit = self.transit();
        let sender = &self.nodes[from];
        let sender_now = self.now.shifted(sender.steady_us);
        let message = ElectionMessage {
            schema: SCHEMA_VERSION,
            from: sender.name.clone(),
            run: 1,
            seq: 1,
            candidacy: Candidacy {
                role: sender.role,
                priority: 0,
                load: 0,
                fit: true,
            },
            term: 7,
            epoch: None,
            hears_you: true,
            body: Body::Status {
                over: None,
                no_login: Vec::new(),
            },
            clock: Some(Box::new(
                sender.time.stamps(&self.nodes[to].name, sender_now),
            )),
            description: None,
        };
        self.now = self.now + transit;
        let leadership = self.leadership(to);
        let now = self.now;
        let receiver = &mut self.nodes[to];
        receiver
            .time
            .receive(&message, Rights::ALL, now.shifted(receiver.steady_us));
        receiver
            .time
            .follow(&leadership, now.shifted(receiver.steady_us));
    }

    fn read_wall(&mut self) {
        for index in 0..self.nodes.len() {
            let leadership = self.leadership(index);
            let now = self.now;
            let node = &mut self.nodes[index];
            let events = node.time.read_wall(
                node.wall_us - node.steady_us,
                &leadership,
                now.shifted(node.steady_us),
            );
            node.events.extend(events);
        }
    }

    fn run(&mut self, seconds: u32) {
        for _ in 0..seconds {
            let leader = self.leader;
            for index in (0..self.nodes.len()).filter(|index| *index != leader) {
                self.pass(leader, index);
                self.pass(index, leader);
                self.pass(leader, index);
            }
            self.read_wall();
            self.now = self.now + Duration::from_secs(1);
        }
    }

    /// Each node's estimate of the cell's time, minus the true time.
    fn errors(&self) -> Vec<i64> {
        self.nodes
            .iter()
            .map(|node| node.steady_us + node.time.reading().offset_us)
            .collect()
    }

    #[track_caller]
    fn all_know(&self, expected_us: i64, tolerance_us: u64) {
        for (error, node) in self.errors().into_iter().zip(&self.nodes) {
            assert!(
                error.abs_diff(expected_us) <= tolerance_us,
                "{}: {error} µs",
                node.name
            );
            assert!(
                node.time
                    .reading()
                    .error_us
                    .is_some_and(|error| error < 20_000),
                "{}",
                node.name
            );
        }
    }
}

#[test]
fn cell_time_is_candidates_median() {
    let year = 31_536_000 * SECOND_US;
    let mut cell = Cell::new(&[
        (Role::Edge, TO_1970_US, TO_1970_US),
        (Role::Auto, -year, 3_000),
        (Role::Auto, 5 * SECOND_US, 0),
        (Role::Auto, 0, 9 * SECOND_US),
        (Role::Cav, TO_1970_US, TO_1970_US),
        (Role::Cav, 0, -year),
    ]);
    // The cell starts with the leader's own clock, before any other node's messages arrive.
    cell.run(4);
    cell.all_know(3_000, 5_000);
}

#[test]
fn vehicle_step_moves_no_time() {
    let mut cell = Cell::new(&[(Role::Edge, 0, 0), (Role::Auto, 0, 0), (Role::Cav, 0, 0)]);
    cell.run(3);
    for index in 1..3 {
        cell.nodes[index].wall_us = -3 * SECOND_US;
        cell.run(3);
        cell.all_know(0, 5_000);
        assert_eq!(
            cell.nodes[index].events,
            [ClockEvent::WallStepped(-3 * SECOND_US)]
        );
    }
    assert_eq!(cell.nodes[0].events, []);
}

#[test]
fn microsecond_offset_logs_no_jump() {
    let mut cell = Cell::new(&[(Role::Edge, 0, 0), (Role::Auto, 0, 33)]);
    cell.run(5);
    cell.leader = 1;
    cell.run(5);
    let events: Vec<_> = cell.nodes.iter().flat_map(|node| &node.events).collect();
    assert!(events.is_empty(), "{events:?}");
}

#[test]
fn stepping_leader_moves_time_when_alone() {
    for (others, expected) in [(2, 0), (1, 0), (0, 5 * SECOND_US)] {
        let mut nodes = vec![(Role::Edge, 0, 0), (Role::Cav, 0, 0)];
        nodes.extend(vec![(Role::Auto, 0, 0); others]);
        let mut cell = Cell::new(&nodes);
        cell.run(2);
        cell.nodes[0].wall_us = 5 * SECOND_US;
        cell.run(3);
        cell.all_know(expected, 5_000);
        cell.nodes[0].wall_us = TO_1970_US;
        cell.run(3);
        cell.all_know(expected, 5_000);
    }
}

#[test]
fn leader_from_1970_is_followed() {
    let mut cell = Cell::new(&[(Role::Edge, TO_1970_US, TO_1970_US), (Role::Cav, 0, 0)]);
    cell.run(2);
    cell.all_know(TO_1970_US, 5_000);
    cell.nodes[0].wall_us = 0;
    cell.run(2);
    cell.all_know(0, 5_000);
    assert!(
        cell.nodes[0]
            .events
            .contains(&ClockEvent::CellJumped(-TO_1970_US))
    );
}

#[test]
fn new_leader_continues_time_slowly() {
    let ahead = 400_000;
    let mut cell = Cell::new(&[
        (Role::Edge, 0, ahead),
        (Role::Auto, 9 * SECOND_US, 0),
        (Role::Cav, 0, 0),
    ]);
    cell.run(5);
    cell.all_know(ahead, 5_000);
    cell.leader = 1;
    cell.nodes[0].wall_us = 0;
    cell.run(2);
    cell.all_know(ahead, 30_000);
    cell.run(120);
    cell.all_know(0, 5_000);
    assert!(cell.nodes[1].events.is_empty());
}

/// A wrong clock does not affect the cell's time, and both its own node and the leader report it by
/// name. This includes a vehicle's clock.
#[test]
fn wrong_clocks_are_named() {
    let mut cell = Cell::new(&[
        (Role::Edge, 0, 0),
        (Role::Auto, 7 * SECOND_US, 100_000),
        (Role::Cav, -3 * SECOND_US, 5 * SECOND_US),
        (Role::Cav, 0, TO_1970_US),
    ]);
    cell.run(10);
    let errors = |index: usize| {
        let Node {
            time, steady_us, ..
        } = &cell.nodes[index];
        let errors = time.wall_errors(cell.now.shifted(*steady_us));
        errors
            .into_iter()
            .map(|(name, us)| (name.map(NodeName::to_string), us))
            .collect::<Vec<_>>()
    };
    let of_leader = errors(0);
    let off = |of: Option<&str>| {
        of_leader
            .iter()
            .find(|(name, _)| name.as_deref() == of)
            .map(|(_, us)| *us)
    };
    assert!(
        off(Some("n2")).is_some_and(|us| (us - 5 * SECOND_US).abs() < SECOND_US / 2),
        "{of_leader:?}"
    );
    assert!(
        [None, Some("n1")]
            .map(off)
            .iter()
            .all(|us| us.is_some_and(|us| us.abs() < SECOND_US)),
        "{of_leader:?}"
    );
    assert_eq!(
        off(Some("n3")),
        None,
        "a clock that was not set is not sent to others"
    );
    let blamed: Vec<_> = cell.nodes[0]
        .time
        .wrong_clocks(cell.now.shifted(cell.nodes[0].steady_us));
    let [
        WrongClock {
            node: Some(name),
            is_cell_wrong: false,
            is_certain: true,
            ..
        },
    ] = &*blamed
    else {
        panic!("{blamed:?}")
    };
    assert_eq!(name.as_str(), "n2", "two candidates agree");
    assert!(
        (errors(2)[0].1 - 5 * SECOND_US).abs() < SECOND_US / 2,
        "{:?}",
        errors(2)
    );
    assert!(errors(3)[0].1 < -SECOND_US, "and its own node detects it");
}

/// A leader with a wrong clock that is not outvoted imposes its time on the cell; the other clocks
/// agree and are not reported. With two differing clocks, the report is uncertain for both.
#[test]
fn agreeing_clocks_are_not_reported() {
    let wrong = |nodes: &[(Role, i64, i64)]| {
        let mut cell = Cell::new(nodes);
        cell.run(10);
        let Node {
            time, steady_us, ..
        } = &cell.nodes[0];
        let wrong = time.wrong_clocks(cell.now.shifted(*steady_us)).into_iter();
        let whole_s = |us: i64| (us as f64 / SECOND_US as f64).round();
        let shown = |it: WrongClock<'_>| {
            (
                it.node.map(NodeName::to_string),
                whole_s(it.error_us),
                it.is_cell_wrong,
                it.is_certain,
            )
        };
        wrong.map(shown).collect::<Vec<_>>()
    };
    let edge = (Role::Edge, 0, 30 * SECOND_US);
    let cav = (Role::Cav, 9, 0);
    let other = (Role::Cav, 7 * SECOND_US, 0);
    assert_eq!(wrong(&[edge, cav, other]), [(None, 30.0, true, true)]);
    assert_eq!(
        wrong(&[edge, cav]),
        [(Some("n1".into()), -30.0, false, false)]
    );
}

/// The observers of one vehicle agree on a wrong time; the other nodes' clocks stay right.
#[test]
fn parts_state_no_clocks() {
    let ahead = 10 * SECOND_US;
    let mut nodes = vec![(Role::Edge, 0, 0), (Role::Cav, 0, 0), (Role::Cav, 0, ahead)];
    nodes.extend([(Role::Auto, 0, ahead); 8]);
    let mut cell = Cell::new(&nodes);
    for (part, node) in cell.nodes.iter_mut().skip(3).enumerate() {
        node.name = NodeName::new(format!("n2--{part}")).unwrap();
    }
    cell.run(10);
    let wrong = |index: usize| {
        let Node {
            time, steady_us, ..
        } = &cell.nodes[index];
        let wrong = time.wrong_clocks(cell.now.shifted(*steady_us)).into_iter();
        wrong
            .map(|clock| clock.node.map(NodeName::to_string))
            .collect::<Vec<_>>()
    };
    assert_eq!(wrong(0), [Some("n2".to_owned())]);
    assert_eq!(wrong(1), [], "a follower's own clock is right");
    assert!(cell.errors()[0].abs() < 5_000, "{:?}", cell.errors());
}

#[test]
fn false_stamps_move_no_time() {
    let mut cell = Cell::new(&[(Role::Edge, 0, 0), (Role::Auto, 0, 0), (Role::Auto, 0, 0)]);
    cell.run(2);
    let extremes = [Timestamp(0), Timestamp(MAX_INTEGER)];
    for sent_us in extremes {
        for received_us in extremes {
            for other in extremes {
                let answers = Some(AnsweredStamps {
                    sent_us: other,
                    received_us,
                });
                let clock = ClockStamps {
                    sent_us,
                    answers,
                    wall_us: Some(other),
                    cell_us: Some(received_us),
                };
                let message = ElectionMessage {
                    schema: SCHEMA_VERSION,
                    from: cell.nodes[1].name.clone(),
                    run: 1,
                    seq: 1,
                    candidacy: Candidacy {
                        role: Role::Auto,
                        priority: 0,
                        load: 0,
                        fit: true,
                    },
                    term: 7,
                    epoch: None,
                    hears_you: true,
                    body: Body::Status {
                        over: None,
                        no_login: Vec::new(),
                    },
                    clock: Some(Box::new(clock)),
                    description: None,
                };
                let now = cell.now;
                cell.nodes[0].time.receive(&message, Rights::ALL, now);
                cell.read_wall();
            }
        }
    }
    let others = [cell.errors()[0], cell.errors()[2]];
    assert!(others.iter().all(|error| error.abs() < 5_000), "{others:?}");
}

#[test]
fn expelled_leader_sets_no_time() {
    let forged = 5 * SECOND_US;
    let mut cell = Cell::new(&[(Role::Edge, 0, forged), (Role::Auto, 0, 0)]);
    cell.run(3);
    assert!(cell.errors()[1].abs_diff(forged) < 5_000);
    let gone = cell.nodes[0].name.clone();
    let now = cell.now;
    cell.leader = 1;
    let leadership = cell.leadership(1);
    let successor = &mut cell.nodes[1];
    successor.time.remove(&gone);
    let events = successor.time.read_wall(0, &leadership, now);
    assert_eq!(cell.errors()[1], 0, "{events:?}");
}
