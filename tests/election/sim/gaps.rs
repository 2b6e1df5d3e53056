//! Gaps between accepted rounds, around the end of a leader and around a split.

use super::{SECOND, cell, check, ensure, one_best_leader, start_all};
use crate::sim::node::{Fault, Node};
use crate::sim::world::{MS, World};
use ecod::wire::Role;

/// The largest gap between two accepted rounds of any vehicle around the end of the leader, and of its standby if
/// `victims` is 2, in µs; `None` in a cell too small for it.
pub(super) fn failover_gap(seed: u64, seen: bool, victims: usize) -> Option<u64> {
    let mut world = cell(seed);
    if world.nodes.len() < victims + 1 {
        return None;
    }
    for node in &mut world.nodes[1..=victims] {
        node.config.role = Role::Auto;
    }
    start_all(&mut world);
    let mut gap = 0;
    check(&mut world, seed, |world| {
        let settle = world.random.between(0, 200 * MS);
        world.run_for(9 * SECOND + settle);
        one_best_leader(world)?;
        let leader = world.leaders()[0];
        let changes = world.led.len();
        let from = world.now;
        world.plan(0, Fault::Kill { node: leader, seen });
        if victims > 1 {
            let standby = world.nodes[leader].standby().cloned();
            let standby = world
                .nodes
                .iter()
                .position(|node| Some(&node.name) == standby.as_ref());
            world.plan(
                0,
                Fault::Kill {
                    node: standby.ok_or("no standby")?,
                    seen,
                },
            );
        }
        world.run_for(2 * SECOND);
        ensure(world.led.len() == changes + 1, "not exactly one new leader")?;
        for (_, node) in world.alive() {
            gap = gap.max(longest_gap(node, from, world.now)?.unwrap_or(0));
        }
        Ok(())
    });
    Some(gap)
}

/// The largest gap between two rounds that a node has accepted since a second before `from`, in µs. The node must be served
/// until `now`.
fn longest_gap(node: &Node, from: u64, now: u64) -> Result<Option<u64>, String> {
    let times: Vec<u64> = node
        .accepted
        .iter()
        .map(|map| map.at)
        .filter(|at| at + SECOND > from)
        .collect();
    ensure(
        times.last().is_some_and(|at| at + SECOND > now),
        "a vehicle is not served",
    )?;
    Ok(times.windows(2).map(|pair| pair[1] - pair[0]).max())
}

/// The largest gap between two accepted rounds of any vehicle that a split cuts off from the leader, in µs; `None`
/// if no vehicle is cut off, or if the cut-off nodes include no candidate.
pub(super) fn split_gap(seed: u64) -> Option<u64> {
    let mut world = cell(seed);
    start_all(&mut world);
    let mut gap = None;
    check(&mut world, seed, |world| {
        let settle = world.random.between(0, 200 * MS);
        world.run_for(9 * SECOND + settle);
        let Some(leader) = world.leaders().first().copied() else {
            return Ok(());
        };
        let away: Vec<bool> = (0..world.nodes.len())
            .map(|node| node != leader && world.random.chance(50))
            .collect();
        if !(0..away.len()).any(|node| away[node] && world.nodes[node].config.role != Role::Cav) {
            return Ok(());
        }
        split(world, 0, &away);
        let from = world.now;
        world.run_for(2 * SECOND);
        for (_, node) in world.alive().filter(|(index, _)| away[*index]) {
            gap = gap.max(longest_gap(node, from, world.now)?);
        }
        let changes = world.led.len();
        world.plan(0, Fault::Heal);
        world.run_for(13 * SECOND);
        one_best_leader(world)?;
        // The sides become one, and the best of both may have to be handed the lead.
        ensure(
            world.led.len() <= changes + 2,
            "the lead moved more than twice when the split healed",
        )
    });
    gap
}

/// Cuts every link between nodes on different sides.
pub(super) fn split(world: &mut World, at: u64, sides: &[bool]) {
    for from in 0..sides.len() {
        for to in (0..sides.len()).filter(|to| sides[from] != sides[*to]) {
            world.plan(at, Fault::Cut { from, to });
        }
    }
}

/// Prints how long the gaps are, each with the seed of its cell.
pub(super) fn report(what: &str, gaps: &mut [(u64, u64)], bound: u64) {
    gaps.sort_unstable();
    let (longest, seed) = gaps.last().copied().expect("a cell that is large enough");
    let at = |percent: usize| gaps[(gaps.len() - 1) * percent / 100].0 as f64 / MS as f64;
    println!(
        "{what}: verdict gap p50 {} p99 {} max {} ms over {} cells",
        at(50),
        at(99),
        at(100),
        gaps.len()
    );
    assert!(
        longest <= bound,
        "{what}: a gap of {} ms, replay with SEED={seed}",
        at(100)
    );
}
