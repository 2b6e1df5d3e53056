//! Analysis of a trial's logs: gaps, missed rounds, superseded maps, lasting double leaders, needless changes of
//! leader.
//!
//! All results are computed from the accepted maps and their times; this module does not use processes or clocks.

use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::time::Duration;

use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use crate::failover::doors::DoorVerdict;
use crate::failover::flood::FloodCost;

/// A map that a node accepted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Accepted {
    pub(crate) at: Timestamp,
    pub(crate) epoch: Epoch,
    pub(crate) round: u64,
    pub(crate) fused_at: Timestamp,
}

impl Accepted {
    /// Time from the aggregator's fusion to the node's taking it; all of them have one clock.
    pub(crate) fn age(&self) -> Duration {
        self.at.since(self.fused_at)
    }
}

/// Everything that one run of a node's process accepted, in the order of its log.
#[derive(Debug, Clone)]
pub(crate) struct NodeRun {
    pub(crate) node: NodeName,
    pub(crate) accepted: Vec<Accepted>,
}

/// A part of a trial, between two faults.
#[derive(Debug, Clone)]
pub(crate) struct Phase {
    pub(crate) from: Timestamp,
    pub(crate) until: Timestamp,
    /// Allowed number of new leaderships.
    pub(crate) changes: RangeInclusive<usize>,
    /// Groups of living nodes that reach each other; each has one leader at the end of the phase.
    pub(crate) components: Vec<BTreeSet<NodeName>>,
    /// The vehicles whose longest wait for a map counts as the trial's gap; empty if the phase is not measured.
    pub(crate) measured: BTreeSet<NodeName>,
}

/// Outcome of one trial.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Verdict {
    /// Longest time between two accepted maps of any measured vehicle.
    pub(crate) gap: Option<Duration>,
    /// Maps accepted although the node had accepted a later one.
    pub(crate) stale_accepted: u64,
    /// Rounds that a measured vehicle did not get, and rounds that it got from two leaders.
    pub(crate) missed_rounds: u64,
    /// True if a living node was without maps at the end of a phase.
    pub(crate) unrecovered: bool,
    /// True if a component had two leaders at the end of a phase.
    pub(crate) double_leader: bool,
    /// True if the reputations after the trial differ from those before; judged by the caller.
    pub(crate) reputations_changed: bool,
    /// New leaderships that the faults do not explain, and expected leaderships that did not occur.
    pub(crate) false_failovers: u64,
    /// True if so much processor time was withheld from the machine that a missed time bar is not meaningful; judged by
    /// the caller.
    pub(crate) is_void: bool,
    /// Outcome for programs next to the measured vehicles; judged by the caller.
    pub(crate) doors: DoorVerdict,
    /// Cost of a flood, if there was one; judged by the caller.
    pub(crate) flood: Option<FloodCost>,
}

/// A node that has taken no map for so long at the end of a phase is without service.
const SERVED_WITHIN: Duration = Duration::from_millis(500);

/// The end of a phase, in which a component is to have one leader.
pub(crate) const QUIET: Duration = Duration::from_secs(1);

/// Judges a trial by the logs of all its processes.
pub(crate) fn judge(runs: &[NodeRun], phases: &[Phase]) -> Verdict {
    let mut verdict = Verdict {
        stale_accepted: runs.iter().map(stale).sum(),
        ..Verdict::default()
    };
    let mut known: BTreeSet<&Epoch> = phases
        .first()
        .map(|first| epochs(runs, Timestamp::default(), first.from))
        .unwrap_or_default();
    for phase in phases {
        for run in runs.iter().filter(|run| phase.measured.contains(&run.node)) {
            verdict.gap = verdict.gap.max(longest_wait(run, phase.from, phase.until));
            verdict.missed_rounds += missed(run, phase);
        }
        verdict.unrecovered |= phase
            .components
            .iter()
            .flatten()
            .any(|node| !served(runs, node, phase.until));
        verdict.double_leader |= phase
            .components
            .iter()
            .any(|component| leaders(runs, component, phase.until) > 1);
        let new: BTreeSet<&Epoch> = epochs(runs, phase.from, phase.until)
            .difference(&known)
            .copied()
            .collect();
        let beyond = new.len().saturating_sub(*phase.changes.end());
        let lacking = phase.changes.start().saturating_sub(new.len());
        verdict.false_failovers += (beyond + lacking) as u64;
        known.extend(new);
    }
    verdict
}

/// Value of `sorted` at a share of its length, by the nearest rank.
pub(crate) fn percentile(sorted: &[Duration], percent: usize) -> Option<Duration> {
    let rank = (sorted.len() * percent).div_ceil(100).max(1);
    sorted.get(rank - 1).copied()
}

/// Number of maps that a process took although it had taken a later one.
pub(crate) fn stale(run: &NodeRun) -> u64 {
    let mut latest: Option<(&Epoch, u64)> = None;
    let mut stale = 0;
    for map in &run.accepted {
        let this = (&map.epoch, map.round);
        stale += u64::from(latest.is_some_and(|latest| this <= latest));
        latest = latest.max(Some(this));
    }
    stale
}

/// Pairs of maps taken one after the other, the second within the time.
fn pairs(
    run: &NodeRun,
    from: Timestamp,
    until: Timestamp,
) -> impl Iterator<Item = (&Accepted, &Accepted)> {
    let within = move |map: &Accepted| from <= map.at && map.at <= until;
    run.accepted
        .windows(2)
        .map(|pair| (&pair[0], &pair[1]))
        .filter(move |(_, second)| within(second))
}

/// The longest time between two maps that a process took, the second between these times.
pub(crate) fn longest_wait(run: &NodeRun, from: Timestamp, until: Timestamp) -> Option<Duration> {
    pairs(run, from, until)
        .map(|(first, second)| second.at.since(first.at))
        .max()
}

fn missed(run: &NodeRun, phase: &Phase) -> u64 {
    let between =
        |(first, second): (&Accepted, &Accepted)| match second.round.checked_sub(first.round) {
            Some(step) if step > 0 => step - 1,
            _ => u64::from(second.epoch != first.epoch),
        };
    pairs(run, phase.from, phase.until).map(between).sum()
}

/// True if the node, or the program at its door, still took maps at this time.
pub(crate) fn served(runs: &[NodeRun], node: &NodeName, until: Timestamp) -> bool {
    let maps = runs
        .iter()
        .filter(|run| run.node == *node)
        .flat_map(|run| &run.accepted);
    maps.into_iter()
        .any(|map| map.at <= until && until.since(map.at) <= SERVED_WITHIN)
}

fn leaders(runs: &[NodeRun], component: &BTreeSet<NodeName>, until: Timestamp) -> usize {
    let maps = runs
        .iter()
        .filter(|run| component.contains(&run.node))
        .flat_map(|run| &run.accepted);
    let quiet = maps.filter(|map| map.at <= until && until.since(map.at) <= QUIET);
    quiet.map(|map| &map.epoch).collect::<BTreeSet<_>>().len()
}

fn epochs(runs: &[NodeRun], from: Timestamp, until: Timestamp) -> BTreeSet<&Epoch> {
    let maps = runs
        .iter()
        .flat_map(|run| &run.accepted)
        .filter(|map| from <= map.at && map.at <= until);
    maps.map(|map| &map.epoch).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const EDGE: &str = "edge";

    fn name(text: &str) -> NodeName {
        NodeName::new(text).unwrap()
    }

    fn names(nodes: &[&str]) -> BTreeSet<NodeName> {
        nodes.iter().map(|node| name(node)).collect()
    }

    /// Rounds of one leader every 100 ms from `at_ms` on.
    fn maps(leader: &str, term: u64, first_round: u64, at_ms: u64, count: u64) -> Vec<Accepted> {
        let epoch = Epoch::new(term, name(leader));
        let map = |n| {
            let at = ms(at_ms + 100 * n);
            Accepted {
                at,
                epoch: epoch.clone(),
                round: first_round + n,
                fused_at: at,
            }
        };
        (0..count).map(map).collect()
    }

    fn ms(time: u64) -> Timestamp {
        Timestamp(1_000_000_000 + time * 1000)
    }

    fn run(node: &str, parts: &[Vec<Accepted>]) -> NodeRun {
        NodeRun {
            node: name(node),
            accepted: parts.concat(),
        }
    }

    fn phase(from: u64, until: u64, changes: RangeInclusive<usize>, nodes: &[&str]) -> Phase {
        Phase {
            from: ms(from),
            until: ms(until),
            changes,
            components: vec![names(nodes)],
            measured: names(nodes),
        }
    }

    #[test]
    fn clean_failover_costs_only_gap() {
        // The edge's last round comes at 900 ms; a takes over at 1050, b receives it at 1060.
        let a = run("a", &[maps(EDGE, 1, 1, 0, 10), maps("a", 2, 11, 1050, 20)]);
        let b = run("b", &[maps(EDGE, 1, 1, 0, 10), maps("a", 2, 11, 1060, 20)]);
        let verdict = judge(&[a, b], &[phase(910, 2950, 1..=1, &["a", "b"])]);
        assert_eq!(
            verdict,
            Verdict {
                gap: Some(Duration::from_millis(160)),
                ..Verdict::default()
            }
        );
    }

    #[test]
    fn gap_is_worst_vehicles() {
        let a = run("a", &[maps(EDGE, 1, 1, 0, 10), maps("a", 2, 11, 1050, 20)]);
        let late = run("b", &[maps(EDGE, 1, 1, 0, 10), maps("a", 2, 13, 1300, 18)]);
        let runs = [a, late];
        let verdict = judge(&runs, &[phase(910, 2950, 1..=1, &["a", "b"])]);
        assert_eq!(
            (verdict.gap, verdict.missed_rounds),
            (Some(Duration::from_millis(400)), 2)
        );
        let mut only_a = phase(910, 2950, 1..=1, &["a", "b"]);
        only_a.measured = names(&["a"]);
        assert_eq!(
            judge(&runs, &[only_a]).gap,
            Some(Duration::from_millis(150))
        );
    }

    #[test]
    fn round_published_during_handover_counts() {
        let twice = run("a", &[maps("a", 2, 1, 0, 10), maps(EDGE, 3, 10, 1000, 20)]);
        let verdict = judge(&[twice], &[phase(500, 2900, 1..=1, &["a"])]);
        assert_eq!((verdict.missed_rounds, verdict.stale_accepted), (1, 0));
        let seamless = run("a", &[maps("a", 2, 1, 0, 10), maps(EDGE, 3, 11, 1000, 20)]);
        assert_eq!(
            judge(&[seamless], &[phase(500, 2900, 1..=1, &["a"])]).missed_rounds,
            0
        );
    }

    #[test]
    fn superseded_leaders_map_is_stale() {
        let fooled = run(
            "a",
            &[
                maps("a", 2, 11, 0, 10),
                maps(EDGE, 1, 30, 1000, 2),
                maps("a", 2, 21, 1200, 20),
            ],
        );
        assert_eq!(
            judge(&[fooled], &[phase(0, 3100, 0..=2, &["a"])]).stale_accepted,
            2
        );
        let before = run("a", &[maps("a", 2, 11, 0, 10)]);
        let restarted = run("a", &[maps(EDGE, 1, 30, 1000, 2)]);
        assert_eq!(
            judge(&[before, restarted], &[phase(0, 1100, 0..=2, &["a"])]).stale_accepted,
            0
        );
    }

    #[test]
    fn mapless_node_is_unrecovered() {
        let a = run("a", &[maps(EDGE, 1, 1, 0, 10), maps("a", 2, 11, 1050, 20)]);
        let lost = run("b", &[maps(EDGE, 1, 1, 0, 10)]);
        assert!(judge(&[a.clone(), lost], &[phase(910, 2950, 1..=1, &["a", "b"])]).unrecovered);
        assert!(
            judge(&[a], &[phase(910, 2950, 1..=1, &["a", "b"])]).unrecovered,
            "no log at all"
        );
    }

    #[test]
    fn two_leaders_need_two_components() {
        let a = run("a", &[maps("a", 2, 11, 0, 30)]);
        let edge = run(EDGE, &[maps(EDGE, 1, 11, 0, 30)]);
        let runs = [a, edge];
        let mut split = phase(1000, 2900, 0..=0, &["a"]);
        split.components = vec![names(&["a"]), names(&[EDGE])];
        assert!(!judge(&runs, &[split.clone()]).double_leader);
        split.components = vec![names(&["a", EDGE])];
        assert!(judge(&runs, &[split]).double_leader);
    }

    #[test]
    fn unexplained_failovers_are_counted() {
        let a = run(
            "a",
            &[
                maps(EDGE, 1, 1, 0, 10),
                maps("a", 2, 11, 1000, 10),
                maps("b", 3, 21, 2000, 10),
            ],
        );
        let runs = [a];
        let false_failovers = |phases: &[Phase]| judge(&runs, phases).false_failovers;
        assert_eq!(false_failovers(&[phase(500, 2900, 0..=0, &["a"])]), 2);
        assert_eq!(false_failovers(&[phase(500, 2900, 1..=1, &["a"])]), 1);
        assert_eq!(
            false_failovers(&[
                phase(500, 1500, 1..=1, &["a"]),
                phase(1500, 2900, 1..=1, &["a"])
            ]),
            0
        );
        assert_eq!(
            false_failovers(&[
                phase(500, 900, 1..=1, &["a"]),
                phase(900, 2900, 2..=2, &["a"])
            ]),
            1
        );
    }

    #[test]
    fn percentiles_are_values_that_occurred() {
        let sorted: Vec<Duration> = (1..=20).map(Duration::from_millis).collect();
        assert_eq!(percentile(&sorted, 50), Some(Duration::from_millis(10)));
        assert_eq!(percentile(&sorted, 99), Some(Duration::from_millis(20)));
        assert_eq!(percentile(&sorted[..3], 50), Some(Duration::from_millis(2)));
        assert_eq!(percentile(&[], 50), None);
    }
}
