//! A candidate that does not outrank the leader says whatever takes the lead.

use ecod::leadership::Rights;
use ecod::leadership::election::{Body, Candidacy, ElectionMessage, MAX_TERM, MAX_TERM_STEP};
use ecod::leadership::node::Input;
use ecod::model::epoch::Epoch;
use ecod::wire::{Role, SCHEMA_VERSION};

use super::{SECOND, cell, check, ensure, for_seeds, one_best_leader, seeds, start_all};
use crate::world::{MS, World};

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
            let rank = |node: usize| (world.nodes[node].config.role, world.nodes[node].config.priority);
            let may_lie = |world: &World, node: usize| {
                node != leader && rank(node).0 != Role::Cav && (world.nodes.len() > 2 || rank(node) != rank(leader))
            };
            let Some(liar) = (0..world.nodes.len()).find(|node| may_lie(world, *node)) else { return Ok(()) };
            one_best_leader(world)?;
            world.loss_percent = seed % 6;
            let before = world.led.len();
            for lie in 0..1000 {
                tell_lies(world, liar, leader, FORGED + lie);
                world.run_for(10 * MS);
                ensure(world.nodes[leader].leads(), "the leader gave way")?;
                for (index, node) in world.alive().filter(|(index, _)| *index != liar) {
                    let follows = node.leader() == Some(&world.nodes[leader].name);
                    ensure(index == leader || follows, &format!("{} left the leader", node.name))?;
                }
            }
            // Pauses of 0.4, 0.4, 0.8, 1.6 and 3.2 s lie between renewals; the next would be the seventh.
            ensure(world.led.len() <= before + 6, "the leader renews its term without end")
        });
    });
}

/// Tells every honest node the same lie, one of all kinds.
fn tell_lies(world: &mut World, liar: usize, leader: usize, seq: u64) {
    let (name, config) = (world.nodes[liar].name.clone(), world.nodes[liar].config.clone());
    let Some(present) = world.nodes[leader].election().and_then(|election| election.epoch().cloned()) else { return };
    let other = world.random.index(world.nodes.len());
    let own = Epoch::new(present.term + 1, name.clone());
    let of_other = Epoch::new(present.term + 1, world.nodes[other].name.clone());
    let beat = |followers, after| Body::Beat { every_ms: 50, round: 1, followers, after, successors: Vec::new() };
    let (epoch, hears_you, body) = match world.random.between(0, 8) {
        0 => (Some(own), true, beat(200, None)),
        1 => (Some(own), true, beat(200, Some(present))),
        // A leader that nobody follows makes way for one that does not hear it.
        2 if world.nodes.len() > 2 => (Some(own), false, beat(200, Some(present))),
        3 => (Some(of_other), true, Body::Status { over: None, no_login: Vec::new() }),
        4 => (Some(of_other.clone()), true, Body::LeaderEvidence { ask: seq % 32, age_ms: 0 }),
        5 => (
            None,
            true,
            Body::Resign { epoch: Epoch::new(present.term + MAX_TERM_STEP / 2, name.clone()), last_round: 0 },
        ),
        6 => {
            let at = world.random.index(world.nodes.len());
            let no_login = vec![present.leader.clone(), world.nodes[at].name.clone()];
            (Some(present), true, Body::Status { over: None, no_login })
        }
        _ => (None, true, Body::Status { over: Some(present), no_login: Vec::new() }),
    };
    let run = 1_900_000_000_000_000;
    let candidacy = Candidacy { role: config.role, priority: config.priority, load: 0, fit: true };
    let stated = epoch.as_ref().map_or(own_term(world, leader), |epoch| epoch.term);
    let term = if world.random.chance(20) { MAX_TERM } else { stated };
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
        world.handle(to, Input::Receive { from: name.clone(), rights: Rights::ALL, message: message.clone() });
    }
}

fn own_term(world: &World, node: usize) -> u64 {
    world.nodes[node].election().map_or(0, |election| election.term())
}
