//! Effects of a node's leadership, and their order.

use super::*;
use crate::leadership::election::{Body, Candidacy, ElectionConfig, ElectionMessage, LifeSign};
use crate::leadership::health::HealthSample;
use crate::leadership::links::DataPlane;
use crate::leadership::timers::HEALTH_PERIOD;
use crate::leadership::view::Position;
use crate::wire::{Role, SCHEMA_VERSION};

const START: Timestamp = Timestamp(1_732_154_400_000_000);

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn broker(host: u8) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, host], 1883))
}

fn status(role: Role) -> NodeStatus {
    NodeStatus::starting(name("euclid"), Uuid::nil(), role, "1.0")
}

/// The node `euclid` and the effects that it has returned.
struct Scene {
    machine: LeadershipNode,
    now: Timestamp,
    rounds_due: u64,
    members: Vec<SeenMember>,
    effects: Vec<Effect>,
    seq: u64,
}

impl Scene {
    fn new(role: Role, external: Option<&str>) -> Self {
        let plane = DataPlane {
            external: external.map(|at| at.parse().unwrap()),
            embedded: external.is_none(),
        };
        let settings = NodeSettings {
            election: ElectionConfig {
                role,
                ..ElectionConfig::default()
            },
            plane,
            round_period: Duration::from_millis(100),
            keeps_reputations: true,
            status: status(role),
        };
        let machine = LeadershipNode::new(settings, 0, &Leadership::default(), START);
        let members = Vec::new();
        let effects = Vec::new();
        let mut scene = Self {
            machine,
            now: START,
            rounds_due: 0,
            members,
            effects,
            seq: 0,
        };
        if role != Role::Cav {
            scene.handle_input(Input::OwnBroker {
                address: Some(broker(1)),
            });
            scene.handle_input(Input::LinkChanged {
                broker: broker(1).into(),
                state: LinkState::Up,
            });
        }
        scene
    }

    /// A fit candidate that follows `edge` in term 7, whose standby it is.
    fn standing_by() -> Self {
        let mut scene = Self::new(Role::Auto, None);
        scene.handle_input(Input::MemberAlive {
            member: member("edge", 2),
        });
        scene.members.push(member("edge", 2));
        scene.run_for(1000);
        scene.beat();
        scene.handle_input(Input::LinkChanged {
            broker: broker(2).into(),
            state: LinkState::Up,
        });
        assert_eq!(scene.machine.leadership.position, Position::StandingBy);
        assert!(scene.machine.health.is_fit());
        scene.effects.clear();
        scene
    }

    /// Passes an input; checks of the parts, which all work, are answered at once.
    fn handle_input(&mut self, input: Input) {
        for effect in self.machine.handle(input, self.now) {
            let answer = match effect {
                Effect::Observe => Input::Observed {
                    rounds_due: self.rounds_due,
                    load_percent: 0,
                    members: self.members.clone(),
                },
                Effect::AskParts => Input::PartsAnswered {
                    sample: HealthSample {
                        broker_serves: true,
                        links: Some(BTreeMap::new()),
                        fuser_runs: true,
                        rejects_reports: false,
                        contradicts: false,
                        certificate_ends: false,
                    },
                },
                effect => {
                    self.effects.push(effect);
                    continue;
                }
            };
            self.handle_input(answer);
        }
    }

    fn run_for(&mut self, ms: u64) {
        let end = self.now + Duration::from_millis(ms);
        while self.machine.next_deadline() <= end {
            self.now = self.now.max(self.machine.next_deadline());
            self.rounds_due = self.now.since(START).as_millis() as u64 / 100;
            self.handle_input(Input::Wake);
        }
        self.now = end;
    }

    /// A message of `edge`, which leads or follows `epoch`.
    fn message(&mut self, epoch: Epoch, body: Body) -> ElectionMessage {
        self.seq += 1;
        ElectionMessage {
            schema: SCHEMA_VERSION,
            from: name("edge"),
            run: 1,
            seq: self.seq,
            candidacy: Candidacy {
                role: Role::Edge,
                priority: 100,
                load: 0,
                fit: true,
            },
            term: epoch.term,
            epoch: Some(epoch),
            hears_you: true,
            body,
            clock: None,
            description: None,
        }
    }

    /// Receives a message from `edge`, which leads in term 7.
    fn receive(&mut self, body: Body) {
        self.receive_in(Epoch::new(7, name("edge")), body);
    }

    fn receive_in(&mut self, epoch: Epoch, body: Body) {
        let message = self.message(epoch, body);
        self.handle_input(Input::Receive {
            from: name("edge"),
            rights: Rights::ALL,
            message,
        });
    }

    fn beat(&mut self) {
        let successors = vec![name("euclid")];
        self.receive(Body::Beat {
            every_ms: 50,
            round: 40,
            followers: 1,
            after: None,
            successors,
            life: LifeSign::default(),
        });
    }

    fn notices(&self) -> Vec<&Notice> {
        let notice = self.effects.iter().filter_map(|effect| match effect {
            Effect::Log { notice } => Some(notice),
            _ => None,
        });
        notice.collect()
    }

    /// Millisecond `ms` beside a candidate that is ready; rounds end every `round_ms`.
    fn receive_ready_challenger(&mut self, epoch: &Epoch, ms: u64, round_ms: u64) {
        if ms.is_multiple_of(50) {
            self.receive_in(
                epoch.clone(),
                Body::Status {
                    over: None,
                    no_login: Vec::new(),
                },
            );
            self.receive_in(epoch.clone(), Body::Ready);
        }
        if ms.is_multiple_of(round_ms) {
            self.handle_input(Input::RoundAccepted {
                epoch: epoch.clone(),
                round: ms / round_ms,
            });
        }
        self.run_for(1);
    }

    fn position_of(&self, wanted: impl Fn(&Effect) -> bool) -> Option<usize> {
        self.effects.iter().position(wanted)
    }
}

fn member(node: &str, host: u8) -> SeenMember {
    SeenMember {
        name: name(node),
        run: 1,
        broker: Some(broker(host).into()),
        is_on_this_machine: false,
    }
}

#[test]
fn term_is_persisted_before_leading() {
    let mut scene = Scene::new(Role::Auto, None);
    scene.run_for(1300);
    let leads = |effect: &Effect| matches!(effect, Effect::PublishLeadership { leadership } if leadership.is_leading());
    let persists = scene
        .position_of(|effect| matches!(effect, Effect::PersistTerm { term: 1 }))
        .unwrap();
    let announces = scene.position_of(leads).unwrap();
    let lead = scene
        .position_of(|effect| matches!(effect, Effect::Lead { .. }))
        .unwrap();
    assert!(persists < announces && announces < lead);
}

#[test]
fn refused_link_ends_its_leader() {
    let mut scene = Scene::standing_by();
    scene.handle_input(Input::LinkChanged {
        broker: broker(2).into(),
        state: LinkState::Down,
    });
    assert_eq!(scene.machine.leadership.position, Position::StandingBy);
    scene.handle_input(Input::LinkChanged {
        broker: broker(2).into(),
        state: LinkState::Refused,
    });
    assert!(scene.machine.leadership.is_leading());
    assert!(scene.notices().contains(&&Notice::ProcessGone {
        peer: name("edge"),
        broker: broker(2).into()
    }));
}

#[test]
fn last_will_ends_leader() {
    let mut scene = Scene::new(Role::Auto, Some("10.0.0.9:1883"));
    scene.handle_input(Input::LinkChanged {
        broker: "10.0.0.9:1883".parse().unwrap(),
        state: LinkState::Up,
    });
    scene.handle_input(Input::MemberAlive {
        member: member("edge", 2),
    });
    scene.members.push(member("edge", 2));
    scene.run_for(1000);
    scene.beat();
    let living = Uuid::from_u128(2);
    let earlier = Uuid::from_u128(1);
    let status = |id, state| NodeStatus {
        node: name("edge"),
        id,
        state,
        ..status(Role::Edge)
    };
    scene.handle_input(Input::StatusReceived {
        status: status(living, NodeState::Aggregating),
    });
    scene.handle_input(Input::StatusReceived {
        status: status(earlier, NodeState::Offline),
    });
    assert_eq!(
        scene.machine.leadership.leader(),
        Some(&name("edge")),
        "the will of a run before this one"
    );
    scene.handle_input(Input::StatusReceived {
        status: status(living, NodeState::Aggregating),
    });
    scene.handle_input(Input::StatusReceived {
        status: status(living, NodeState::Offline),
    });
    assert!(
        scene
            .notices()
            .contains(&&Notice::LeaderDisconnected { peer: name("edge") })
    );
    assert_ne!(scene.machine.leadership.leader(), Some(&name("edge")));
}

/// Any member can forge the broker's report that the leader's connection broke.
#[test]
fn false_will_ends_run_once() {
    let mut scene = Scene::new(Role::Auto, Some("10.0.0.9:1883"));
    scene.handle_input(Input::LinkChanged {
        broker: "10.0.0.9:1883".parse().unwrap(),
        state: LinkState::Up,
    });
    for (attempt, run, is_ended) in [(0, 1, true), (1, 1, false), (2, 1, false), (3, 2, true)] {
        let edge = SeenMember {
            run,
            ..member("edge", 2)
        };
        scene.members = vec![edge.clone()];
        scene.handle_input(Input::MemberAlive { member: edge });
        scene.run_for(1000);
        let successors = vec![name("euclid")];
        let beat = Body::Beat {
            every_ms: 50,
            round: 40,
            followers: 2,
            after: None,
            successors,
            life: LifeSign::default(),
        };
        scene.receive_in(Epoch::new(7 + 2 * attempt, name("edge")), beat);
        assert_eq!(
            scene.machine.leadership.leader(),
            Some(&name("edge")),
            "attempt {attempt}"
        );
        for state in [NodeState::Aggregating, NodeState::Offline] {
            let node = name("edge");
            let id = Uuid::from_u128(attempt.into());
            scene.handle_input(Input::StatusReceived {
                status: NodeStatus {
                    node,
                    id,
                    state,
                    ..status(Role::Edge)
                },
            });
        }
        let is_gone = scene.machine.leadership.leader() != Some(&name("edge"));
        assert_eq!(is_gone, is_ended, "attempt {attempt}");
    }
}

#[test]
fn handover_waits_bounded_for_evidence() {
    for (evidence_at, ready_at) in [(Some(0), 300), (Some(420), 450), (None, 1000)] {
        let mut scene = Scene::standing_by();
        scene.receive(Body::Offer);
        let offered_at = scene.now;
        let mut ready = None;
        for ms in 0..1200 {
            if evidence_at == Some(ms) {
                scene.handle_input(Input::EvidenceReceived {
                    from: name("gauss"),
                });
                scene.handle_input(Input::EvidenceReceived { from: name("edge") });
            }
            if ms % 50 == 0 {
                scene.beat();
                scene.receive(Body::Offer);
            }
            scene.run_for(1);
            let is_ready = |effect: &Effect| matches!(effect, Effect::Send { message, .. } if message.body == Body::Ready);
            if ready.is_none() && scene.position_of(is_ready).is_some() {
                ready = Some(scene.now.since(offered_at).as_millis());
            }
        }
        assert_eq!(ready, Some(ready_at), "evidence after {evidence_at:?} ms");
    }
}

/// A leader that receives `Ready` from a better candidate. The leader can log in at `broker`, if
/// one is given.
fn leading_beside_a_ready_challenger(
    external: Option<SocketAddr>,
    broker: Option<SocketAddr>,
) -> Scene {
    leading_beside(external, broker, "edge")
}

/// The same, where the broker has the certificate of `shown`.
fn leading_beside(external: Option<SocketAddr>, broker: Option<SocketAddr>, shown: &str) -> Scene {
    let mut scene = leading_with_external_broker(external);
    let epoch = scene.machine.leadership.epoch.clone().unwrap();
    for ms in 0..4500 {
        if let Some(broker) = broker.filter(|_| ms == 1000) {
            if external.is_none() {
                scene.handle_input(Input::BrokerProven {
                    broker: broker.into(),
                    node: name(shown),
                });
            }
            scene.handle_input(Input::LinkChanged {
                broker: broker.into(),
                state: LinkState::Up,
            });
        }
        scene.receive_ready_challenger(&epoch, ms, 100);
    }
    scene
}

/// A leader that has just found a better candidate.
fn leading_with_external_broker(external: Option<SocketAddr>) -> Scene {
    let mut scene = Scene::new(Role::Auto, None);
    scene.machine.links = Links::new(DataPlane {
        external: external.map(Into::into),
        embedded: true,
    });
    scene.handle_input(Input::MemberAlive {
        member: member("edge", 2),
    });
    scene.members.push(member("edge", 2));
    scene.run_for(1300);
    assert!(scene.machine.leadership.is_leading());
    scene
}

fn is_yield(effect: &Effect) -> bool {
    matches!(effect, Effect::Send { message, .. } if matches!(message.body, Body::Yield { .. }))
}

#[test]
fn round_is_held_before_yielding() {
    let scene = leading_beside_a_ready_challenger(None, Some(broker(2)));
    let yielded = scene
        .position_of(is_yield)
        .expect("a better candidate is handed the lead");
    assert_eq!(scene.effects[yielded - 1], Effect::HoldRound);
    let snapshot = scene.position_of(|effect| *effect == Effect::SendSnapshot { to: name("edge") });
    assert!(snapshot.is_some_and(|snapshot| snapshot < yielded));
}

#[test]
fn rounds_are_held_whole_before_yielding() {
    // A round that ends early right after the yielded one would be published by both leaders.
    let scene = leading_beside_a_ready_challenger(None, Some(broker(2)));
    let yielded = scene.position_of(is_yield).unwrap();
    let holds = scene.effects[..yielded]
        .iter()
        .filter(|effect| **effect == Effect::HoldRound);
    assert_eq!(
        holds.count(),
        3,
        "as the challenger is ready, after the round then in progress, and after the next one"
    );
}

#[test]
fn lead_is_yielded_after_round() {
    const ROUND_MS: u64 = 700;
    let mut scene = leading_with_external_broker(None);
    let epoch = scene.machine.leadership.epoch.clone().unwrap();
    scene.handle_input(Input::BrokerProven {
        broker: broker(2).into(),
        node: name("edge"),
    });
    scene.handle_input(Input::LinkChanged {
        broker: broker(2).into(),
        state: LinkState::Up,
    });
    let yielded_ms = (0..6000).find(|ms| {
        scene.receive_ready_challenger(&epoch, *ms, ROUND_MS);
        scene.position_of(is_yield).is_some()
    });
    assert_eq!(
        yielded_ms.map(|ms| ms % ROUND_MS),
        Some(0),
        "yielded at {yielded_ms:?} ms, which is within a round"
    );
}

#[test]
fn no_handover_to_refusing_broker() {
    // An external broker that is down does not serve the challenger either.
    for external in [None, Some(broker(9))] {
        let scene = leading_beside_a_ready_challenger(external, None);
        assert_eq!(scene.position_of(is_yield), None, "{external:?}");
        assert!(scene.machine.leadership.is_leading());
        assert!(scene.notices().contains(&&Notice::NotServed {
            challenger: name("edge")
        }));
    }
    let both = leading_beside_a_ready_challenger(Some(broker(9)), Some(broker(9)));
    assert!(
        both.position_of(is_yield).is_some(),
        "all use the external broker"
    );
}

#[test]
fn no_handover_to_replaced_broker() {
    let scene = leading_beside(None, Some(broker(2)), "gauss");
    assert_eq!(scene.position_of(is_yield), None);
    assert!(scene.notices().contains(&&Notice::NotServed {
        challenger: name("edge")
    }));
    assert!(scene.notices().contains(&&Notice::NoLogin {
        at: vec![name("edge")]
    }));
}

#[test]
fn late_wake_up_processes_messages_first() {
    let mut scene = Scene::standing_by();
    let due = scene.machine.next_deadline();
    scene.now = due + Duration::from_millis(300);
    scene.handle_input(Input::Wake);
    assert_eq!(scene.effects, [], "timers wait");
    assert_eq!(scene.machine.next_deadline(), scene.now + DRAIN_TIME);
    scene.beat();
    scene.now = scene.machine.next_deadline();
    scene.handle_input(Input::Wake);
    assert_eq!(scene.machine.leadership.position, Position::StandingBy);
    assert!(!scene.machine.is_draining);
}

#[test]
fn restarted_gateway_receives_links_and_status() {
    let mut scene = Scene::standing_by();
    scene.handle_input(Input::GatewayRestarted);
    let [links] = &scene
        .effects
        .iter()
        .filter(|effect| matches!(effect, Effect::SetLinks { .. }))
        .collect::<Vec<_>>()[..]
    else {
        panic!("links are reported once: {:?}", scene.effects)
    };
    let Effect::SetLinks { links } = links else {
        return;
    };
    assert_eq!(links.brokers, [broker(1).into(), broker(2).into()]);
    assert!(
        scene
            .position_of(|effect| matches!(effect, Effect::PublishStatus { .. }))
            .is_some()
    );
    assert!(
        scene
            .notices()
            .iter()
            .any(|notice| matches!(notice, Notice::Unfit { .. })),
        "it has no links yet"
    );
}

#[test]
fn vehicle_declares_no_fitness() {
    let mut scene = Scene::new(Role::Cav, None);
    for _ in 0..8 {
        scene.now = scene.now + HEALTH_PERIOD;
        let effects = scene.machine.handle(Input::Wake, scene.now);
        assert!(!effects.contains(&Effect::AskParts));
        scene.effects.extend(effects);
    }
    let statuses: Vec<_> = scene
        .effects
        .iter()
        .filter(|e| matches!(e, Effect::PublishStatus { .. }))
        .collect();
    let [Effect::PublishStatus { status }] = statuses[..] else {
        panic!("one status: {statuses:?}")
    };
    assert_eq!(
        (status.fit, status.state, status.epoch),
        (None, NodeState::Following, 0)
    );
}

#[test]
fn unreachable_node_is_unfit_once() {
    let mut scene = Scene::new(Role::Auto, None);
    scene.handle_input(Input::OwnBroker {
        address: Some(SocketAddr::from(([127, 0, 0, 1], 1883))),
    });
    scene.handle_input(Input::LinkChanged {
        broker: "127.0.0.1:1883".parse().unwrap(),
        state: LinkState::Up,
    });
    scene.members.push(member("gauss", 3));
    scene.run_for(3000);
    assert!(!scene.machine.health.is_fit());
    let count = scene
        .notices()
        .into_iter()
        .filter(|notice| matches!(notice, Notice::OutOfReach { .. }))
        .count();
    assert_eq!(count, 1);
}

#[test]
fn rebooted_machine_avoids_earlier_term() {
    let epoch = Some(Epoch::new(9, name("euclid")));
    let before = Leadership {
        position: Position::Leading,
        epoch,
        standby: None,
        term: 9,
        is_deserted: false,
        is_yielding: false,
    };
    let settings = NodeSettings {
        election: ElectionConfig::default(),
        plane: DataPlane {
            external: None,
            embedded: true,
        },
        round_period: Duration::from_millis(100),
        keeps_reputations: false,
        status: status(Role::Auto),
    };
    let mut scene = Scene::new(Role::Auto, None);
    scene.machine = LeadershipNode::new(settings, 4, &before, START);
    scene.handle_input(Input::OwnBroker {
        address: Some(broker(1)),
    });
    scene.handle_input(Input::LinkChanged {
        broker: broker(1).into(),
        state: LinkState::Up,
    });
    scene.run_for(2000);
    let led = scene.effects.iter().find_map(|effect| match effect {
        Effect::Lead { epoch, .. } => Some(epoch.term),
        _ => None,
    });
    assert_eq!(led, Some(11));
}

#[test]
fn foreign_sender_is_dropped() {
    let mut scene = Scene::standing_by();
    let mut before = scene.machine.clone();
    let ended = Epoch::new(7, name("edge"));
    let message = scene.message(
        ended.clone(),
        Body::Resign {
            epoch: ended,
            last_round: 40,
        },
    );
    scene.handle_input(Input::Receive {
        from: name("gauss"),
        rights: Rights::ALL,
        message,
    });
    assert_eq!(
        scene.notices(),
        [&Notice::Misattributed {
            from: name("gauss"),
            claimed: name("edge")
        }]
    );
    before.deadline = scene.machine.deadline;
    assert_eq!(scene.machine, before);
}

/// Times after the start at which a node is followed, as far as its certificate allows it to lead.
fn is_followed(rights: Rights) -> bool {
    let mut scene = Scene::new(Role::Auto, None);
    scene.handle_input(Input::MemberAlive {
        member: member("edge", 2),
    });
    for _ in 0..10 {
        let successors = vec![name("euclid")];
        let body = Body::Beat {
            every_ms: 50,
            round: 40,
            followers: 1,
            after: None,
            successors,
            life: LifeSign::default(),
        };
        let message = scene.message(Epoch::new(7, name("edge")), body);
        scene.handle_input(Input::Receive {
            from: name("edge"),
            rights,
            message,
        });
        scene.run_for(50);
    }
    let overreached = scene
        .notices()
        .iter()
        .any(|notice| matches!(notice, Notice::Overreached { .. }));
    assert_eq!(overreached, !rights.allow(Role::Edge, 100));
    scene.machine.election().leader() == Some(&name("edge"))
}

#[test]
fn unauthorised_beat_is_not_followed() {
    assert!(is_followed(Rights::ALL));
    assert!(is_followed(Rights {
        priority: 100,
        ..Rights::from(Role::Edge)
    }));
    assert!(
        is_followed(Rights {
            priority: 50,
            ..Rights::from(Role::Auto)
        }),
        "as an auto node"
    );
    assert!(!is_followed(Rights::NONE));
}

/// An observer has no rights, and the priority that nodes have by default.
#[test]
fn follower_priority_declares_no_role() {
    let mut scene = Scene::new(Role::Auto, None);
    let mut message = scene.message(
        Epoch::new(7, name("edge")),
        Body::Status {
            over: None,
            no_login: Vec::new(),
        },
    );
    message.epoch = None;
    message.candidacy.role = Role::Cav;
    message.candidacy.priority = 100;
    scene.handle_input(Input::Receive {
        from: name("edge"),
        rights: Rights::NONE,
        message,
    });
    assert!(
        !scene
            .notices()
            .iter()
            .any(|notice| matches!(notice, Notice::Overreached { .. }))
    );
}

/// Vehicles and observers are asked for the leader's last sign of life, as all nodes are.
#[test]
fn vouching_follower_declares_no_role() {
    let mut scene = Scene::new(Role::Auto, None);
    let body = Body::LeaderEvidence {
        ask: 1,
        age_ms: 0,
        life: LifeSign::default(),
    };
    let mut message = scene.message(Epoch::new(7, name("edge")), body);
    message.candidacy.role = Role::Cav;
    message.candidacy.priority = 100;
    scene.handle_input(Input::Receive {
        from: name("edge"),
        rights: Rights::NONE,
        message,
    });
    let notices = scene.notices();
    let is_overreach = |notice: &Notice| matches!(notice, Notice::Overreached { .. });
    assert!(!notices.iter().any(|notice| is_overreach(notice)));
}

/// A leader hands leadership over to an `edge`, but not to a node that merely claims that role.
#[test]
fn excess_role_takes_no_lead() {
    for (role, is_offered) in [(Role::Edge, true), (Role::Auto, false)] {
        let mut scene = Scene::new(Role::Auto, None);
        scene.handle_input(Input::OwnBroker {
            address: Some(broker(1)),
        });
        scene.handle_input(Input::LinkChanged {
            broker: broker(1).into(),
            state: LinkState::Up,
        });
        scene.run_for(2000);
        assert!(scene.machine.election().is_leading());
        scene.handle_input(Input::MemberAlive {
            member: member("zeno", 2),
        });
        for _ in 0..100 {
            let epoch = scene.machine.election().epoch().unwrap().clone();
            let message = ElectionMessage {
                from: name("zeno"),
                ..scene.message(
                    epoch,
                    Body::Status {
                        over: None,
                        no_login: Vec::new(),
                    },
                )
            };
            let rights = Rights {
                priority: 100,
                ..Rights::from(role)
            };
            scene.handle_input(Input::Receive {
                from: name("zeno"),
                rights,
                message,
            });
            scene.run_for(50);
        }
        let offered = scene.position_of(|effect| {
            matches!(
                effect,
                Effect::Send {
                    message: ElectionMessage {
                        body: Body::Offer,
                        ..
                    },
                    ..
                }
            )
        });
        assert_eq!(offered.is_some(), is_offered, "{role:?}");
    }
}
