//! A candidate that does not outrank the leader says whatever takes the lead.

use ecod::leadership::Rights;
use ecod::leadership::election::{
    Body, Candidacy, ElectionMessage, LifeSign, MAX_TERM, MAX_TERM_STEP,
};
use ecod::leadership::node::Input;
use ecod::model::epoch::Epoch;
use ecod::wire::{Role, SCHEMA_VERSION};

use super::{SECOND, cell, check, ensure, for_seeds, one_best_leader, seeds, start_all};
use crate::sim::node::Fault;
use crate::sim::world::{MS, World};

/// Sequence numbers beyond those of the liar's own election, which nobody hears any more.
const FORGED: u64 = 1 << 40;

/// The lead stays where it is, and every honest node gets its rounds, while one in twenty packets is lost.
#[test]
fn a_liar_takes_the_lead_from_nobody() {
    for_seeds(seeds() / 10, |seed| {
        let mut world = cell(seed);
        start_all(&mut world);
        check(&mut world, seed, |world| {
            world.run_for(9 * SECOND);
            let leader = world.leaders()[0];
            // A leader that nobody else follows makes way for its like.
            let rank = |node: usize| {
                (
                    world.nodes[node].config.role,
                    world.nodes[node].config.priority,
                )
            };
            let may_lie = |world: &World, node: usize| {
                node != leader
                    && rank(node).0 != Role::Cav
                    && (world.nodes.len() > 2 || rank(node) != rank(leader))
            };
            let Some(liar) = (0..world.nodes.len()).find(|node| may_lie(world, *node)) else {
                return Ok(());
            };
            one_best_leader(world)?;
            world.loss_percent = seed % 6;
            let before = world.led.len();
            for lie in 0..1000 {
                tell_lies(world, liar, leader, FORGED + lie);
                world.run_for(10 * MS);
                ensure(world.nodes[leader].leads(), "the leader gave way")?;
                for (index, node) in world.alive().filter(|(index, _)| *index != liar) {
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

/// The leader hangs, and a member answers each question about it with "it is alive": it takes as long as without the member
/// until another node leads. The member has the leader's last sign of life, and can make none.
#[test]
fn a_member_that_vouches_for_a_hung_leader_delays_no_takeover() {
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
            // Of two candidates, one is honest. Large cells take long to lie to.
            let [liar, _, ..] = candidates[..] else {
                return Ok(());
            };
            if world.nodes.len() > 8 {
                return Ok(());
            }
            let Some(epoch) = world.nodes[leader]
                .election()
                .and_then(|election| election.epoch().cloned())
            else {
                return Ok(());
            };
            let (began, _) = world
                .led
                .iter()
                .rev()
                .find(|(_, led)| *led == epoch)
                .cloned()
                .unwrap_or((world.now, epoch));
            let life = LifeSign {
                led_ms: (world.now - began) / MS,
                signature: None,
            };
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
                    .any(|(node, state)| node != leader && node != liar && state.leads())
                    || world.nodes[liar].leads()
            };
            let mut seq = FORGED;
            while !has_taken_over(world) {
                for ask in 0..100 {
                    seq += 1;
                    vouch(world, liar, leader, seq, ask, life.clone());
                }
                world.run_for(20 * MS);
                ensure(
                    world.now - hung_at <= SECOND,
                    "nobody has taken over after a second",
                )?;
            }
            Ok(())
        });
    });
}

/// Tells every honest node that the leader was alive just now, with its last sign of life.
fn vouch(world: &mut World, liar: usize, leader: usize, seq: u64, ask: u64, life: LifeSign) {
    let Some(present) = world.nodes[leader]
        .election()
        .and_then(|election| election.epoch().cloned())
    else {
        return;
    };
    let (name, config) = (
        world.nodes[liar].name.clone(),
        world.nodes[liar].config.clone(),
    );
    let message = ElectionMessage {
        schema: SCHEMA_VERSION,
        from: name.clone(),
        run: 1_900_000_000_000_000,
        seq,
        candidacy: Candidacy {
            role: config.role,
            priority: config.priority,
            load: 0,
            fit: true,
        },
        term: present.term,
        epoch: Some(present),
        hears_you: true,
        body: Body::LeaderEvidence {
            ask,
            age_ms: 0,
            life,
        },
        clock: None,
        description: None,
    };
    for to in (0..world.nodes.len()).filter(|to| *to != liar && *to != leader) {
        world.handle(
            to,
            Input::Receive {
                from: name.clone(),
                rights: Rights::ALL,
                message: message.clone(),
            },
        );
    }
}

/// Tells every honest node the same lie, one of all kinds.
fn tell_lies(world: &mut World, liar: usize, leader: usize, seq: u64) {
    let (name, config) = (
        world.nodes[liar].name.clone(),
        world.nodes[liar].config.clone(),
    );
    let Some(present) = world.nodes[leader]
        .election()
        .and_then(|election| election.epoch().cloned())
    else {
        return;
    };
    let other = world.random.index(world.nodes.len());
    let own = Epoch::new(present.term + 1, name.clone());
    let of_other = Epoch::new(present.term + 1, world.nodes[other].name.clone());
    let beat = |followers, after| Body::Beat {
        every_ms: 50,
        round: 1,
        followers,
        after,
        successors: Vec::new(),
        life: LifeSign::default(),
    };
    let (epoch, hears_you, body) = match world.random.between(0, 8) {
        0 => (Some(own), true, beat(200, None)),
        1 => (Some(own), true, beat(200, Some(present))),
        // A leader that nobody follows makes way for one that does not hear it.
        2 if world.nodes.len() > 2 => (Some(own), false, beat(200, Some(present))),
        3 => (
            Some(of_other),
            true,
            Body::Status {
                over: None,
                no_login: Vec::new(),
            },
        ),
        4 => (
            Some(of_other.clone()),
            true,
            Body::LeaderEvidence {
                ask: seq % 32,
                age_ms: 0,
                life: LifeSign::default(),
            },
        ),
        5 => (
            None,
            true,
            Body::Resign {
                epoch: Epoch::new(present.term + MAX_TERM_STEP / 2, name.clone()),
                last_round: 0,
            },
        ),
        6 => {
            let at = world.random.index(world.nodes.len());
            let no_login = vec![present.leader.clone(), world.nodes[at].name.clone()];
            (
                Some(present),
                true,
                Body::Status {
                    over: None,
                    no_login,
                },
            )
        }
        _ => (
            None,
            true,
            Body::Status {
                over: Some(present),
                no_login: Vec::new(),
            },
        ),
    };
    let run = 1_900_000_000_000_000;
    let candidacy = Candidacy {
        role: config.role,
        priority: config.priority,
        load: 0,
        fit: true,
    };
    let stated = epoch
        .as_ref()
        .map_or(own_term(world, leader), |epoch| epoch.term);
    let term = if world.random.chance(20) {
        MAX_TERM
    } else {
        stated
    };
    let message = ElectionMessage {
        schema: SCHEMA_VERSION,
        from: name.clone(),
        run,
        seq,
        candidacy,
        term,
        epoch,
        hears_you,
        body,
        clock: None,
        description: None,
    };
    for to in (0..world.nodes.len()).filter(|to| *to != liar) {
        world.handle(
            to,
            Input::Receive {
                from: name.clone(),
                rights: Rights::ALL,
                message: message.clone(),
            },
        );
    }
}

fn own_term(world: &World, node: usize) -> u64 {
    world.nodes[node]
        .election()
        .map_or(0, |election| election.term())
}
