//! The results of all trials: for programs as JSON, for people as a table, and against the bars.

use std::thread::available_parallelism;
use std::time::Duration;

use serde::Serialize;

use crate::failover::analysis::{Verdict, percentile};
use crate::failover::flood::FloodCost;
use crate::failover::scenario::Scenario;

/// Parts of a second.
const MILLIS: u128 = 1000;
const MICROS: u128 = 1_000_000;

/// All trials of one scenario with one number of nodes.
#[derive(Debug, Serialize)]
pub(crate) struct Outcome {
    scenario: &'static str,
    nodes: usize,
    /// The valid trials.
    trials: usize,
    void: usize,
    gap_ms: Gaps,
    stale_accepted: u64,
    missed_rounds: u64,
    unrecovered: usize,
    double_leader_after_quiet: usize,
    false_failovers: u64,
    reputations_changed: usize,
    doors: Doors,
    #[serde(skip_serializing_if = "Option::is_none")]
    flood: Option<Flood>,
    #[serde(skip)]
    gap_bar_ms: Option<u64>,
    #[serde(skip)]
    seamless: bool,
}

#[derive(Debug, Serialize)]
struct Gaps {
    p50: Option<u64>,
    p99: Option<u64>,
    max: Option<u64>,
}

/// Outcome for programs next to the vehicles.
#[derive(Debug, Serialize)]
struct Doors {
    /// Difference between the gap of a program and the gap of its node, over the trials.
    longer_gap_us: Gaps,
    /// By how much a program has a map later than its node.
    delay_us: Gaps,
    /// Maps whose delays these are.
    maps: u64,
    /// Number of maps that a program seems to receive before its node, whose clock is ahead.
    early_maps: u64,
    wrong_maps: u64,
    /// Programs that were without maps at the end of a phase.
    unserved: u64,
    /// True if so many nodes share a processor that they wait for each other.
    #[serde(skip)]
    is_crowded: bool,
}

/// Outcome of floods of a door.
#[derive(Debug, Serialize)]
struct Flood {
    least_messages: u64,
    most_grown_kib: u64,
    unheard: u64,
}

impl Flood {
    /// Fewer messages are no flood.
    const LEAST_MESSAGES: u64 = 2000;
    /// Most memory that a flood may cost the node.
    const GROWN_BAR_KIB: u64 = 32 * 1024;

    fn new(costs: &[&FloodCost]) -> Option<Self> {
        Some(Self {
            least_messages: costs.iter().map(|cost| cost.messages).min()?,
            most_grown_kib: costs.iter().map(|cost| cost.grown_kib).max()?,
            unheard: costs.iter().map(|cost| cost.unheard).sum(),
        })
    }

    fn misses(&self) -> impl Iterator<Item = String> {
        let Self {
            least_messages,
            most_grown_kib,
            unheard,
        } = *self;
        let least = Self::LEAST_MESSAGES;
        let most = Self::GROWN_BAR_KIB;
        let few = (least_messages < least)
            .then(|| format!("flood of {least_messages} messages, at least {least}"));
        let grown = (most_grown_kib > most)
            .then(|| format!("flooded node grew by {most_grown_kib} KiB, at most {most}"));
        let unheard =
            (unheard > 0).then(|| format!("maps without the flooded node {unheard}, must be 0"));
        [few, grown, unheard].into_iter().flatten()
    }
}

impl Gaps {
    /// The percentiles of these times, in so many parts of a second.
    fn new(times: impl Iterator<Item = Duration>, parts: u128) -> Self {
        let mut times: Vec<Duration> = times.collect();
        times.sort_unstable();
        let at = |percent| {
            percentile(&times, percent).map(|time| (time.as_nanos() * parts / 1_000_000_000) as u64)
        };
        Self {
            p50: at(50),
            p99: at(99),
            max: at(100),
        }
    }
}

impl Doors {
    const LONGER_GAP_BAR: Duration = Duration::from_millis(5);
    /// A node that is not optimised takes two to three times as long for its part.
    const DELAY_BAR: Duration = Duration::from_millis(if cfg!(debug_assertions) { 3 } else { 1 });
    /// Nodes that can share a processor. A map wakes all nodes and all programs at once: each waits for half of the others.
    const MAX_NODES_PER_PROCESSOR: usize = 4;

    fn new(nodes: usize, verdicts: &[&Verdict], all: &[Verdict]) -> Self {
        let doors = || verdicts.iter().map(|verdict| &verdict.doors);
        let delays = || doors().flat_map(|door| door.delays.iter().copied());
        let micros = |delay: i64| Duration::from_micros(delay.try_into().unwrap_or_default());
        Self {
            longer_gap_us: Gaps::new(doors().filter_map(|door| door.longer_gap), MICROS),
            delay_us: Gaps::new(delays().map(micros), MICROS),
            maps: delays().count() as u64,
            early_maps: delays().filter(|delay| *delay < 0).count() as u64,
            wrong_maps: all.iter().map(|verdict| verdict.doors.wrong).sum(),
            unserved: doors().map(|door| door.unserved).sum(),
            is_crowded: nodes
                > Self::MAX_NODES_PER_PROCESSOR * available_parallelism().map_or(1, Into::into),
        }
    }

    /// The missed bars. Time bars apply to the median, and not on a crowded machine; with few trials the median does
    /// not show their longest waits.
    fn misses(&self, trials: usize) -> impl Iterator<Item = String> {
        let over = |what: &str, gaps: &Gaps, bar: Duration| {
            let bar = bar.as_micros() as u64;
            gaps.p50
                .filter(|p50| *p50 > bar)
                .map(|p50| format!("{what} p50 {p50} us, at most {bar}"))
        };
        let none = |what: &str, count: u64| {
            (count > 0).then(|| format!("{what} at doors {count}, must be 0"))
        };
        let counts = [
            none("wrong maps", self.wrong_maps),
            none("programs without maps", self.unserved),
        ];
        let longer = over(
            "longer gap at doors",
            &self.longer_gap_us,
            Self::LONGER_GAP_BAR,
        )
        .filter(|_| trials >= 10);
        let later = over("delay at doors", &self.delay_us, Self::DELAY_BAR);
        let Self {
            maps, early_maps, ..
        } = self;
        let early = (early_maps * 4 > *maps).then(|| {
            format!(
                "clocks differ: {early_maps} of {maps} maps at doors before their nodes had them, at most a quarter"
            )
        });
        counts
            .into_iter()
            .chain([early])
            .chain([longer, later].map(|miss| miss.filter(|_| !self.is_crowded)))
            .flatten()
    }
}

impl Outcome {
    /// Summary of the verdicts. From void trials it contains only faults that a lack of processor time does not excuse.
    pub(crate) fn new(scenario: &Scenario, nodes: usize, all: &[Verdict]) -> Self {
        let verdicts: Vec<&Verdict> = all.iter().filter(|verdict| !verdict.is_void).collect();
        Self {
            scenario: scenario.name,
            nodes,
            trials: verdicts.len(),
            void: all.len() - verdicts.len(),
            gap_ms: Gaps::new(verdicts.iter().filter_map(|verdict| verdict.gap), MILLIS),
            stale_accepted: all.iter().map(|verdict| verdict.stale_accepted).sum(),
            missed_rounds: verdicts.iter().map(|verdict| verdict.missed_rounds).sum(),
            unrecovered: verdicts
                .iter()
                .filter(|verdict| verdict.unrecovered)
                .count(),
            double_leader_after_quiet: verdicts
                .iter()
                .filter(|verdict| verdict.double_leader)
                .count(),
            false_failovers: verdicts.iter().map(|verdict| verdict.false_failovers).sum(),
            reputations_changed: all
                .iter()
                .filter(|verdict| verdict.reputations_changed)
                .count(),
            doors: Doors::new(nodes, &verdicts, all),
            flood: Flood::new(
                &verdicts
                    .iter()
                    .filter_map(|verdict| verdict.flood.as_ref())
                    .collect::<Vec<_>>(),
            ),
            gap_bar_ms: scenario
                .gap
                .limit(nodes)
                .map(|limit| limit.as_millis() as u64),
            seamless: scenario.seamless,
        }
    }

    /// The bars that were missed, in words.
    pub(crate) fn misses(&self) -> Vec<String> {
        let gap = self
            .gap_bar_ms
            .filter(|bar| self.gap_ms.p99.is_none_or(|p99| p99 > *bar));
        let gap = gap.map(|bar| format!("gap p99 {} ms, at most {bar}", number(self.gap_ms.p99)));
        let none =
            |what: &str, count: u64| (count > 0).then(|| format!("{what} {count}, must be 0"));
        let unmeasured =
            (self.trials == 0).then(|| format!("no trial of {} counts", self.scenario));
        let counts = [
            unmeasured,
            none("stale_accepted", self.stale_accepted),
            self.seamless
                .then_some(())
                .and_then(|()| none("missed_rounds", self.missed_rounds)),
            none("unrecovered", self.unrecovered as u64),
            none(
                "double_leader_after_quiet",
                self.double_leader_after_quiet as u64,
            ),
            none("false_failovers", self.false_failovers),
            none("reputations_changed", self.reputations_changed as u64),
        ];
        let flood = self.flood.iter().flat_map(Flood::misses);
        gap.into_iter()
            .chain(counts.into_iter().flatten())
            .chain(self.doors.misses(self.trials))
            .chain(flood)
            .collect()
    }
}

/// A line for each outcome, with its bars.
pub(crate) fn table(outcomes: &[Outcome]) -> String {
    let mut text = format!(
        "{:<29}{:>6}{:>7}{:>6}{:>7}{:>7}{:>7}{:>6}{:>7}{:>7}{:>12}{:>8}{:>7}\n",
        "scenario",
        "nodes",
        "trials",
        "void",
        "p50",
        "p99",
        "max",
        "bar",
        "stale",
        "missed",
        "unrecovered",
        "double",
        "false"
    );
    for outcome in outcomes {
        let Outcome {
            scenario,
            nodes,
            trials,
            void,
            gap_ms,
            stale_accepted,
            missed_rounds,
            unrecovered,
            ..
        } = outcome;
        let mark = if outcome.misses().is_empty() {
            ""
        } else {
            "  MISSED"
        };
        text += &format!(
            "{scenario:<29}{nodes:>6}{trials:>7}{void:>6}{:>7}{:>7}{:>7}{:>6}{stale_accepted:>7}{missed_rounds:>7}{unrecovered:>12}{:>8}{:>7}{mark}\n",
            number(gap_ms.p50),
            number(gap_ms.p99),
            number(gap_ms.max),
            number(outcome.gap_bar_ms),
            outcome.double_leader_after_quiet,
            outcome.false_failovers,
        );
    }
    text += &doors_table(outcomes);
    text + "gaps in ms, of the worst vehicle, the period of 100 ms included; bar: the most that p99 may be\n\
            void: missed a bar while more than a tenth of the processors' time was withheld for half a second,\n\
            or the harness woke more than 100 ms too late\n"
}

/// The same trials for the programs next to the vehicles.
fn doors_table(outcomes: &[Outcome]) -> String {
    let mut text = format!(
        "\n{:<29}{:>6}{:>12}{:>9}{:>12}{:>9}{:>9}{:>7}{:>7}{:>9}\n",
        "at doors",
        "nodes",
        "longer gap",
        "max",
        "later, p50",
        "p99",
        "max",
        "early",
        "wrong",
        "without"
    );
    for Outcome {
        scenario,
        nodes,
        doors,
        ..
    } in outcomes
    {
        let Doors {
            longer_gap_us: longer,
            delay_us: delay,
            early_maps: early,
            wrong_maps: wrong,
            unserved,
            ..
        } = doors;
        let [longer, longest] = [longer.p50, longer.max].map(millis);
        let [p50, p99, max] = [delay.p50, delay.p99, delay.max].map(millis);
        text += &format!(
            "{scenario:<29}{nodes:>6}{longer:>12}{longest:>9}{p50:>12}{p99:>9}{max:>9}{early:>7}{wrong:>7}{unserved:>9}\n"
        );
    }
    text + "in ms: how much longer a program waited than its node, p50 and most of the trials, and how much later it had each map\n\n"
}

fn millis(micros: Option<u64>) -> String {
    micros.map_or_else(
        || "-".to_owned(),
        |micros| format!("{}.{:03}", micros / 1000, micros % 1000),
    )
}

fn number(value: Option<u64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::failover::doors::DoorVerdict;
    use crate::failover::scenario::SCENARIOS;

    fn outcome(name: &str, mut verdict: Verdict) -> Outcome {
        let scenario = SCENARIOS
            .iter()
            .find(|scenario| scenario.name == name)
            .unwrap();
        verdict.gap = Some(Duration::from_millis(150));
        Outcome::new(scenario, 5, &[verdict])
    }

    #[test]
    fn a_missed_bar_is_named() {
        assert!(
            outcome("edge_sigkill", Verdict::default())
                .misses()
                .is_empty()
        );
        let slow = Outcome::new(
            &SCENARIOS[0],
            5,
            &[Verdict {
                gap: Some(Duration::from_millis(201)),
                ..Verdict::default()
            }],
        );
        assert_eq!(slow.misses(), ["gap p99 201 ms, at most 200"]);
        assert_eq!(
            Outcome::new(&SCENARIOS[0], 5, &[Verdict::default()]).misses(),
            ["gap p99 - ms, at most 200"]
        );
        let wrong = Verdict {
            unrecovered: true,
            false_failovers: 2,
            ..Verdict::default()
        };
        assert_eq!(
            outcome("six_busy_loops", wrong).misses(),
            ["unrecovered 1, must be 0", "false_failovers 2, must be 0"]
        );
    }

    #[test]
    fn program_delays_are_limited() {
        let doors_of = |nodes, longer, later, wrong, unserved| {
            let longer_gap = Some(Duration::from_millis(longer));
            let doors = DoorVerdict {
                longer_gap,
                delays: vec![later],
                wrong,
                unserved,
            };
            let verdict = Verdict {
                gap: Some(Duration::from_millis(150)),
                doors,
                ..Verdict::default()
            };
            Outcome::new(&SCENARIOS[0], nodes, &vec![verdict; 10]).misses()
        };
        let doors = |longer, later, wrong, unserved| doors_of(2, longer, later, wrong, unserved);
        let bar = Doors::DELAY_BAR.as_micros() as i64;
        assert!(doors(5, bar, 0, 0).is_empty());
        let late = format!("delay at doors p50 {} us, at most {bar}", bar + 1);
        let misses = [
            "longer gap at doors p50 6000 us, at most 5000".to_owned(),
            late,
        ];
        assert_eq!(doors(6, bar + 1, 0, 0), misses);
        assert!(
            doors_of(1_000_000, 6, bar + 1, 0, 0).is_empty(),
            "for want of processors"
        );
        assert_eq!(
            doors_of(1_000_000, 0, 0, 1, 0),
            ["wrong maps at doors 10, must be 0"]
        );
        assert_eq!(doors(0, 0, 1, 0), ["wrong maps at doors 10, must be 0"]);
        assert_eq!(
            doors(0, 0, 0, 1),
            ["programs without maps at doors 10, must be 0"]
        );
        let misses = [
            "clocks differ: 10 of 10 maps at doors before their nodes had them, at most a quarter",
        ];
        assert_eq!(doors(0, -1, 0, 0), misses);
    }

    #[test]
    fn flood_costs_node_little() {
        let misses = |messages, grown_kib, unheard| {
            let flood = Some(FloodCost {
                messages,
                grown_kib,
                unheard,
            });
            outcome(
                "edge_sigkill_door_flood",
                Verdict {
                    flood,
                    ..Verdict::default()
                },
            )
            .misses()
        };
        assert!(misses(Flood::LEAST_MESSAGES, Flood::GROWN_BAR_KIB, 0).is_empty());
        assert_eq!(
            misses(Flood::LEAST_MESSAGES - 1, Flood::GROWN_BAR_KIB + 1, 1).len(),
            3
        );
    }

    #[test]
    fn void_excuses_only_lost_time() {
        let slow = Verdict {
            gap: Some(Duration::from_secs(2)),
            unrecovered: true,
            ..Verdict::default()
        };
        let void = Verdict {
            is_void: true,
            ..slow.clone()
        };
        let right = Verdict {
            gap: Some(Duration::from_millis(110)),
            ..Verdict::default()
        };
        let misses = |verdicts: &[Verdict]| Outcome::new(&SCENARIOS[0], 5, verdicts).misses();
        assert!(misses(&[void.clone(), right.clone()]).is_empty());
        assert!(!misses(&[void.clone(), right.clone(), slow]).is_empty());
        assert!(
            !misses(std::slice::from_ref(&void)).is_empty(),
            "no measurement"
        );
        let superseded = Verdict {
            stale_accepted: 1,
            ..void.clone()
        };
        assert_eq!(
            misses(&[superseded, right.clone()]),
            ["stale_accepted 1, must be 0"]
        );
        let forgotten = Verdict {
            reputations_changed: true,
            ..void
        };
        assert_eq!(
            misses(&[forgotten, right]),
            ["reputations_changed 1, must be 0"]
        );
    }

    #[test]
    fn only_kill_may_miss_rounds() {
        let missed = Verdict {
            missed_rounds: 1,
            ..Verdict::default()
        };
        assert!(outcome("edge_sigkill", missed.clone()).misses().is_empty());
        assert_eq!(
            outcome("edge_restart", missed).misses(),
            ["missed_rounds 1, must be 0"]
        );
    }

    #[test]
    fn file_has_documented_keys() {
        let json = serde_json::to_value([outcome("edge_sigkill", Verdict::default())]).unwrap();
        let expected = serde_json::json!([{
            "scenario": "edge_sigkill", "nodes": 5, "trials": 1, "void": 0, "gap_ms": {"p50": 150, "p99": 150, "max": 150},
            "stale_accepted": 0, "missed_rounds": 0, "unrecovered": 0, "double_leader_after_quiet": 0,
            "false_failovers": 0, "reputations_changed": 0,
            "doors": {"longer_gap_us": {"p50": null, "p99": null, "max": null}, "delay_us": {"p50": null, "p99": null, "max": null}, "maps": 0, "early_maps": 0, "wrong_maps": 0, "unserved": 0},
        }]);
        assert_eq!(json, expected);
    }
}
