//! Brokers at which nodes cannot log in, while their messages still pass.

use ecod::leadership::links::LinkState;
use ecod::wire::Role;

use super::{SECOND, cell, check, ensure, for_seeds, one_best_leader, seeds, start_all};
use crate::sim::node::Fault;
use crate::sim::world::{MS, World};

/// More than half of the followers, two at least, cannot log in at their leader's broker. Another candidate leads soon,
/// without a gap for the others, and goes on. The leader comes back only when its broker does.
#[test]
fn leader_refusing_most_logins_yields() {
    for_seeds(seeds() / 10, |seed| {
        let Some((mut world, leader)) = settled(seed) else {
            return;
        };
        check(&mut world, seed, |world| {
            let changes = world.led.len();
            bar(world, leader);
            world.run_for(8 * SECOND);
            ensure(
                !world.nodes[leader].leads(),
                "the leader that most cannot reach still leads",
            )?;
            most_are_logged_in(world)?;
            ensure(
                world.led.len() <= changes + 2,
                "the lead moved more than twice",
            )?;
            // Leaders publish at their standby's broker, too, and hand the lead over while they publish.
            for (_, node) in world.alive() {
                let times: Vec<u64> = node
                    .accepted
                    .iter()
                    .map(|map| map.at)
                    .filter(|at| at + 8 * SECOND > world.now)
                    .collect();
                let gap = times
                    .windows(2)
                    .map(|pair| pair[1] - pair[0])
                    .max()
                    .unwrap_or(u64::MAX);
                ensure(
                    gap <= 250 * MS,
                    &format!("{} got no round for {gap} µs", node.name),
                )?;
            }
            let changes = world.led.len();
            world.run_for(20 * SECOND);
            ensure(world.led.len() == changes, "the lead still moves")?;
            world.plan(0, Fault::Heal);
            world.run_for(13 * SECOND);
            one_best_leader(world)
        });
    });
}

/// The leader dies while the standby's broker refuses most logins. The standby leads, then hands over.
#[test]
fn followers_skip_unreachable_successor() {
    for_seeds(seeds() / 10, |seed| {
        let Some((mut world, leader)) = settled(seed) else {
            return;
        };
        let Some(standby) = standby_of(&world, leader).filter(|_| world.nodes.len() > 3) else {
            return;
        };
        check(&mut world, seed, |world| {
            world.plan(
                0,
                Fault::Kill {
                    node: leader,
                    seen: true,
                },
            );
            bar(world, standby);
            world.run_for(10 * SECOND);
            ensure(world.leaders().len() == 1, "not one leader")?;
            most_are_logged_in(world)
        });
    });
}

/// A standby that most cannot reach is found out while its leader lives: it does not take over.
#[test]
fn unreachable_standby_delays_no_takeover() {
    for_seeds(seeds() / 10, |seed| {
        let Some((mut world, leader)) = settled(seed) else {
            return;
        };
        let Some(standby) = standby_of(&world, leader).filter(|_| world.nodes.len() > 3) else {
            return;
        };
        check(&mut world, seed, |world| {
            bar(world, standby);
            world.run_for(6 * SECOND);
            ensure(
                standby_of(world, leader) != Some(standby),
                "it is still the standby",
            )?;
            world.plan(
                0,
                Fault::Kill {
                    node: leader,
                    seen: true,
                },
            );
            world.run_for(500 * MS);
            ensure(
                world.leaders().len() == 1 && !world.nodes[standby].leads(),
                "it leads",
            )?;
            most_are_logged_in(world)
        });
    });
}

/// A single node that cannot log in, or claims so, does not end a leadership if other nodes follow it or if the leader
/// outranks that node.
#[test]
fn one_failed_login_moves_no_lead() {
    for_seeds(seeds() / 10, |seed| {
        let mut world = cell(seed);
        start_all(&mut world);
        check(&mut world, seed, |world| {
            world.run_for(9 * SECOND);
            let leader = world.leaders()[0];
            let nodes = world.nodes.len();
            let node = (leader + 1) % nodes;
            let rank = |node: usize| {
                (
                    world.nodes[node].config.role,
                    world.nodes[node].config.priority,
                )
            };
            if nodes == 2 && rank(node) == rank(leader) {
                return Ok(());
            }
            let changes = world.led.len();
            for broker in (0..nodes).filter(|broker| *broker != node) {
                world.plan(0, Fault::NoLogin { node, broker });
            }
            world.run_for(20 * SECOND);
            ensure(world.led.len() == changes, "the lead moved")
        });
    });
}

/// A cell in peace with a second candidate and three nodes at least, and its leader.
fn settled(seed: u64) -> Option<(World, usize)> {
    let mut world = cell(seed);
    for node in world
        .nodes
        .iter_mut()
        .filter(|node| node.config.role == Role::Cav)
        .take(2)
    {
        node.config.role = Role::Auto;
    }
    if world.nodes.len() < 3 {
        return None;
    }
    start_all(&mut world);
    world.run_for(9 * SECOND);
    let leader = world.leaders().first().copied()?;
    Some((world, leader))
}

/// Bars more than half of the other nodes, two at least, from a broker.
fn bar(world: &mut World, broker: usize) {
    let mut others: Vec<_> = (0..world.nodes.len())
        .filter(|node| *node != broker)
        .collect();
    let least = (others.len() / 2 + 1).max(2);
    let barred = world.random.between(least as u64, others.len() as u64) as usize;
    for _ in 0..barred.min(others.len()) {
        let node = others.swap_remove(world.random.index(others.len()));
        world.plan(0, Fault::NoLogin { node, broker });
    }
}

fn standby_of(world: &World, leader: usize) -> Option<usize> {
    let standby = world.nodes[leader].standby()?;
    world.nodes.iter().position(|node| node.name == *standby)
}

/// At least half of the followers are logged in at the leader's broker, so that it gets their reports.
fn most_are_logged_in(world: &World) -> Result<(), String> {
    let [leader] = world.leaders()[..] else {
        return Err("not one leader".to_owned());
    };
    let followers = || world.alive().filter(|(index, _)| *index != leader);
    let served = followers()
        .filter(|(_, node)| node.links.get(&leader) == Some(&LinkState::Up))
        .count();
    let all = followers().count();
    ensure(
        2 * served >= all,
        &format!("only {served} of {all} are logged in at the leader's broker"),
    )
}
