//! False election messages of a candidate that does not outrank the leader.

use ecod::leadership::Rights;
use ecod::leadership::election::{
    Body, Candidacy, ElectionConfig, ElectionMessage, LifeSign, MAX_ROUND, MAX_TERM, MAX_TERM_STEP,
};
use ecod::leadership::node::Input;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::wire::{Role, SCHEMA_VERSION};

use super::{SECOND, cell, check, ensure, for_seeds, one_best_leader, seeds, start_all};
use crate::sim::node::Fault;
use crate::sim::world::{MS, World};

/// First sequence number of the false messages. The number is so large that all nodes drop the later genuine messages
/// of the sender.
const FORGED: u64 = 1 << 40;

/// The leader stays, and every honest node receives its rounds, while one in twenty packets is lost.
#[test]
fn false_claim_takes_no_lead() {
    for_seeds(seeds() / 10, |seed| {
        let mut world = cell(seed);
        start_all(&mut world);
        check(&mut world, seed, |world| {
            world.run_for(9 * SECOND);
            let leader = world.leaders()[0];
            // In a cell of two, a leader without followers yields to another node of its rank.
            let rank = |node: usize| {
                (
                    world.nodes[node].config.role,
                    world.nodes[node].config.priority,
                )
            };
            let may_be_faulty = |world: &World, node: usize| {
                node != leader
                    && rank(node).0 != Role::Cav
                    && (world.nodes.len() > 2 || rank(node) != rank(leader))
            };
            let Some(faulty) = (0..world.nodes.len()).find(|node| may_be_faulty(world, *node))
            else {
                return Ok(());
            };
            one_best_leader(world)?;
            world.loss_percent = seed % 6;
            let before = world.led.len();
            for report in 0..1000 {
                send_false_reports(world, faulty, leader, FORGED + report);
                world.run_for(10 * MS);
                ensure(world.nodes[leader].leads(), "the leader stepped down")?;
                for (index, node) in world.alive().filter(|(index, _)| *index != faulty) {
                    let follows = node.leader() == Some(&world.nodes[leader].name);
                    ensure(
                        index == leader || follows,
                        &format!("{} left the leader", node.name),
                    )?;
                }
            }
            // Pauses of 0.4, 0.4, 0.8, 1.6 and 3.2 s lie between renewals; the next would be the seventh.
            ensure(
                world.led.len() <= before + 6,
                "the leader renews its term without end",
            )
        });
    });
}

/// The leader hangs, and a member answers each query about it with "it is alive". Another node leads after the same
/// time as without the member, because the member has the leader's last sign of life and cannot create a new one.
#[test]
fn vouched_hung_leader_is_replaced() {
    for_seeds(seeds() / 5, |seed| {
        let mut world = cell(seed);
        start_all(&mut world);
        check(&mut world, seed, |world| {
            world.run_for(9 * SECOND);
            one_best_leader(world)?;
            let leader = world.leaders()[0];
            let is_candidate =
                |node: usize| node != leader && world.nodes[node].config.role != Role::Cav;
            let candidates: Vec<usize> = (0..world.nodes.len())
                .filter(|node| is_candidate(*node))
                .collect();
            // Needs a second, honest candidate; large cells take too long.
            let [faulty, _, ..] = candidates[..] else {
                return Ok(());
            };
            if world.nodes.len() > 8 {
                return Ok(());
            }
            let life = life_of(world, leader);
            world.plan(
                0,
                Fault::Pause {
                    node: leader,
                    micros: 20 * SECOND,
                },
            );
            let hung_at = world.now;
            let has_taken_over = |world: &World| {
                world
                    .alive()
                    .any(|(node, state)| node != leader && node != faulty && state.leads())
                    || world.nodes[faulty].leads()
            };
            let report = FALSE_REPORTS
                .iter()
                .find(|report| report.message == "vouch")
                .unwrap();
            let mut seq = FORGED;
            while !has_taken_over(world) {
                // Query numbers are small.
                for _ in 0..100 {
                    seq += 1;
                    send(world, report, faulty, leader, seq, &life);
                }
                world.run_for(20 * MS);
                ensure(
                    world.now - hung_at <= SECOND,
                    "no node has taken over after a second",
                )?;
            }
            Ok(())
        });
    });
}

/// Names and state of the cell from which a false message is made.
struct Scene {
    faulty: NodeName,
    /// The present leadership, and its last sign of life.
    present: Epoch,
    life: LifeSign,
    other: NodeName,
    seq: u64,
}

struct Statement {
    term: u64,
    epoch: Option<Epoch>,
    hears_you: bool,
    body: Body,
}

/// One kind of false message that a member sends.
struct FalseReport {
    message: &'static str,
    description: &'static str,
    /// True if the message claims the lead for its sender.
    claims: bool,
    state: fn(&Scene) -> Statement,
}

impl Scene {
    /// A message about the present leadership, with this body.
    fn of_present(&self, body: Body) -> Statement {
        let epoch = self.present.clone();
        Statement {
            term: epoch.term,
            epoch: Some(epoch),
            hears_you: true,
            body,
        }
    }

    /// A message about the next leadership, of this node.
    fn of_next(&self, leader: &NodeName, body: Body) -> Statement {
        let epoch = Epoch::new(self.present.term + 1, leader.clone());
        Statement {
            term: epoch.term,
            epoch: Some(epoch),
            hears_you: true,
            body,
        }
    }

    /// A message of a node without a leader.
    fn without_leader(&self, body: Body) -> Statement {
        Statement {
            term: self.present.term,
            epoch: None,
            hears_you: true,
            body,
        }
    }
}

fn status(over: Option<&Epoch>, no_login: &[&NodeName]) -> Body {
    Body::Status {
        over: over.cloned(),
        no_login: no_login.iter().copied().cloned().collect(),
    }
}

fn claim(round: u64, after: Option<&Epoch>) -> Body {
    Body::Beat {
        every_ms: 50,
        round,
        followers: 200,
        after: after.cloned(),
        successors: Vec::new(),
        life: LifeSign::default(),
    }
}

/// Every message of the election, with what can be false in it.
const FALSE_REPORTS: [FalseReport; 16] = [
    FalseReport {
        message: "status",
        description: "follows a later leadership of another node",
        claims: false,
        state: |scene| scene.of_next(&scene.other, status(None, &[])),
    },
    FalseReport {
        message: "status",
        description: "the present leadership is over",
        claims: false,
        state: |scene| scene.without_leader(status(Some(&scene.present), &[])),
    },
    FalseReport {
        message: "status",
        description: "no login at the leader's broker and another",
        claims: false,
        state: |scene| scene.of_present(status(None, &[&scene.present.leader, &scene.other])),
    },
    FalseReport {
        message: "status",
        description: "receives no node",
        claims: false,
        state: |scene| Statement {
            hears_you: false,
            ..scene.of_present(status(None, &[]))
        },
    },
    FalseReport {
        message: "status",
        description: "the largest term",
        claims: false,
        state: |scene| Statement {
            term: MAX_TERM,
            ..scene.of_present(status(None, &[]))
        },
    },
    FalseReport {
        message: "ask",
        description: "has no leader, all the time",
        claims: false,
        state: |scene| scene.without_leader(Body::Ask { ask: scene.seq }),
    },
    FalseReport {
        message: "vouch",
        description: "received the leader just now",
        claims: false,
        state: |scene| {
            scene.of_present(Body::LeaderEvidence {
                ask: scene.seq % 100,
                age_ms: 0,
                life: scene.life.clone(),
            })
        },
    },
    FalseReport {
        message: "vouch",
        description: "received another node, which leads",
        claims: false,
        state: |scene| {
            let body = Body::LeaderEvidence {
                ask: scene.seq % 100,
                age_ms: 0,
                life: LifeSign::default(),
            };
            scene.of_next(&scene.other, body)
        },
    },
    FalseReport {
        message: "beat",
        description: "leads, with 200 followers",
        claims: true,
        state: |scene| scene.of_next(&scene.faulty, claim(1, None)),
    },
    FalseReport {
        message: "beat",
        description: "leads after the present leader",
        claims: true,
        state: |scene| scene.of_next(&scene.faulty, claim(1, Some(&scene.present))),
    },
    FalseReport {
        message: "beat",
        description: "leads, and does not receive the leader",
        claims: true,
        state: |scene| Statement {
            hears_you: false,
            ..scene.of_next(&scene.faulty, claim(1, Some(&scene.present)))
        },
    },
    FalseReport {
        message: "beat",
        description: "leads, in the largest round",
        claims: true,
        state: |scene| scene.of_next(&scene.faulty, claim(MAX_ROUND, Some(&scene.present))),
    },
    FalseReport {
        message: "offer",
        description: "wants to hand over a lead that it does not have",
        claims: false,
        state: |scene| scene.of_present(Body::Offer),
    },
    FalseReport {
        message: "ready",
        description: "is about to lead",
        claims: false,
        state: |scene| scene.of_present(Body::Ready),
    },
    FalseReport {
        message: "yield",
        description: "hands over a lead that it does not have, in the largest round",
        claims: false,
        state: |scene| {
            scene.of_present(Body::Yield {
                last_round: MAX_ROUND,
            })
        },
    },
    FalseReport {
        message: "resign",
        description: "ends a leadership of its own, far ahead",
        claims: false,
        state: |scene| {
            let term = scene.present.term + MAX_TERM_STEP / 2;
            let epoch = Epoch::new(term, scene.faulty.clone());
            let body = Body::Resign {
                epoch,
                last_round: 0,
            };
            Statement {
                term,
                ..scene.without_leader(body)
            }
        },
    },
];

/// The worst outcomes of one lie.
#[derive(Clone, Copy, Default)]
struct Outcome {
    cells: u64,
    /// Longest time without a map at an honest vehicle in µs, while the leader works and after it hangs.
    longest_gap: [u64; 2],
    /// Most changes of leadership while the leader works.
    changes: usize,
}

/// Longest time without a map at an honest vehicle.
const MAX_GAP: u64 = SECOND;

/// A member sends one kind of false message for seconds, first while the leader works, then while it hangs: every
/// honest vehicle receives maps without a gap of a second, and every accepted map is judged. Prints the table of
/// messages and attacks.
#[test]
fn false_claims_cost_no_maps() {
    let mut outcomes = [Outcome::default(); FALSE_REPORTS.len()];
    for_seeds(seeds(), |seed| {
        let number = seed as usize % FALSE_REPORTS.len();
        if let Some(outcome) = outcome_of(&FALSE_REPORTS[number], seed / FALSE_REPORTS.len() as u64)
        {
            let worst = &mut outcomes[number];
            worst.cells += 1;
            worst.changes = worst.changes.max(outcome.changes);
            for (worst, gap) in worst.longest_gap.iter_mut().zip(outcome.longest_gap) {
                *worst = gap.max(*worst);
            }
        }
    });
    println!(
        "| message | false statement | cells | changes of leadership | longest gap in ms | with a hung leader |"
    );
    println!("|---|---|---|---|---|---|");
    for (report, outcome) in FALSE_REPORTS.iter().zip(outcomes) {
        let FalseReport {
            message,
            description,
            claims,
            ..
        } = report;
        let Outcome {
            cells,
            longest_gap,
            changes,
        } = outcome;
        let [gap, hung_gap] = longest_gap.map(|gap| (gap / MS).to_string());
        let hung_gap = if *claims {
            "leads".to_owned()
        } else {
            hung_gap
        };
        println!("| `{message}` | {description} | {cells} | {changes} | {gap} | {hung_gap} |");
    }
}

/// Outcome of a lie in one cell; `None` in a cell too small or too large for it.
fn outcome_of(report: &FalseReport, seed: u64) -> Option<Outcome> {
    let mut world = cell(seed);
    if !(3..=8).contains(&world.nodes.len()) {
        return None;
    }
    start_all(&mut world);
    let mut outcome = None;
    check(&mut world, seed, |world| {
        world.run_for(9 * SECOND);
        one_best_leader(world)?;
        let leader = world.leaders()[0];
        let standby = world.nodes[leader].standby().cloned();
        let others: Vec<usize> = (0..world.nodes.len())
            .filter(|node| *node != leader)
            .collect();
        // Some honest node takes over. A standby that stays silent is another fault.
        let may_be_faulty =
            |world: &World, faulty: usize| Some(&world.nodes[faulty].name) != standby.as_ref();
        let faulty_nodes: Vec<usize> = others
            .into_iter()
            .filter(|node| may_be_faulty(world, *node))
            .collect();
        if standby.is_none() || faulty_nodes.is_empty() {
            return Ok(());
        }
        let faulty = faulty_nodes[world.random.index(faulty_nodes.len())];
        let life = life_of(world, leader);
        let mut longest_gap = [0; 2];
        let before = world.led.len();
        let mut seq = FORGED;
        let mut report_for = |world: &mut World, micros: u64| {
            let end = world.now + micros;
            while world.now < end {
                seq += 1;
                send(world, report, faulty, leader, seq, &life);
                world.run_for(10 * MS);
            }
        };
        let from = world.now;
        report_for(world, 3 * SECOND);
        ensure(world.nodes[leader].leads(), "the leader stepped down")?;
        let changes = world.led.len() - before;
        longest_gap[0] = longest_gap_of(world, &[faulty, leader], from)?;
        // A candidate that claims the lead of a hung leader gets it.
        if !report.claims {
            world.plan(
                0,
                Fault::Pause {
                    node: leader,
                    micros: 20 * SECOND,
                },
            );
            let from = world.now;
            report_for(world, 3 * SECOND);
            longest_gap[1] = longest_gap_of(world, &[faulty, leader], from)?;
        }
        let longest = longest_gap[0].max(longest_gap[1]);
        ensure(
            longest <= MAX_GAP,
            &format!(
                "{}: {}: {longest} µs without a map",
                report.message, report.description
            ),
        )?;
        outcome = Some(Outcome {
            cells: 1,
            longest_gap,
            changes,
        });
        Ok(())
    });
    outcome
}

/// The longest time in µs without a map since `from`, at all nodes except these.
fn longest_gap_of(world: &World, but: &[usize], from: u64) -> Result<u64, String> {
    let mut longest = 0;
    for (_, node) in world.alive().filter(|(index, _)| !but.contains(index)) {
        let accepted = node.accepted.iter().map(|map| map.at);
        let before = accepted.clone().filter(|at| *at <= from).max();
        let times = before.into_iter().chain(accepted.filter(|at| *at > from));
        let times: Vec<u64> = times.chain([world.now]).collect();
        ensure(times.len() > 2, &format!("{} gets no maps", node.name))?;
        let gaps = times.windows(2).map(|pair| pair[1] - pair[0]);
        longest = longest.max(gaps.max().unwrap_or(0));
    }
    Ok(longest)
}

/// The last sign of life of a leader.
fn life_of(world: &World, leader: usize) -> LifeSign {
    let epoch = world.nodes[leader]
        .election()
        .and_then(|election| election.epoch().cloned());
    let began = world
        .led
        .iter()
        .rev()
        .find(|(_, led)| Some(led) == epoch.as_ref())
        .map_or(world.now, |(began, _)| *began);
    LifeSign {
        led_ms: (world.now - began) / MS,
        signature: None,
    }
}

/// Sends a false message of a random kind to every honest node.
fn send_false_reports(world: &mut World, faulty: usize, leader: usize, seq: u64) {
    let report = loop {
        let report = &FALSE_REPORTS[world.random.index(FALSE_REPORTS.len())];
        // In a cell of two, a leader without followers yields to a claimant that does not receive it.
        if world.nodes.len() > 2 || report.description != "leads, and does not receive the leader" {
            break report;
        }
    };
    send(world, report, faulty, leader, seq, &LifeSign::default());
}

/// Sends a false message of node `faulty` about the leader to every honest node. `life` is the leader's sign of life in it.
fn send(
    world: &mut World,
    report: &FalseReport,
    faulty: usize,
    leader: usize,
    seq: u64,
    life: &LifeSign,
) {
    let Some(present) = world.nodes[leader]
        .election()
        .and_then(|election| election.epoch().cloned())
    else {
        return;
    };
    let other = world.random.index(world.nodes.len());
    let name = world.nodes[faulty].name.clone();
    let scene = Scene {
        faulty: name.clone(),
        present,
        life: life.clone(),
        other: world.nodes[other].name.clone(),
        seq,
    };
    let Statement {
        term,
        epoch,
        hears_you,
        body,
    } = (report.state)(&scene);
    let ElectionConfig { role, priority, .. } = world.nodes[faulty].config;
    let message = ElectionMessage {
        schema: SCHEMA_VERSION,
        from: name.clone(),
        run: 1_900_000_000_000_000,
        seq,
        candidacy: Candidacy {
            role,
            priority,
            load: 0,
            fit: true,
        },
        term,
        epoch,
        hears_you,
        body,
        clock: None,
        description: None,
    };
    for to in (0..world.nodes.len()).filter(|to| *to != faulty) {
        if world.nodes[to].paused_until > world.now {
            continue;
        }
        let from = name.clone();
        let message = message.clone();
        // As in its certificate.
        let rights = Rights {
            role,
            priority,
            may_describe: false,
        };
        world.handle(
            to,
            Input::Receive {
                from,
                rights,
                message,
            },
        );
    }
}
