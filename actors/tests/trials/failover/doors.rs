//! A plain MQTT client at each node's broker, and a comparison of its maps with the maps that the node accepted.

use std::collections::{BTreeSet, HashMap};
use std::fs::File;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;

use crate::failover::analysis::{Accepted, NodeRun, Phase, longest_wait, served, stale};
use crate::failover::settings::CELL;
use crate::process::{Process, command};

/// A client without ECOD's code: it prints every message with its time.
const CLIENT: &str = "/usr/bin/mosquitto_sub";

/// Service of the programs next to measured vehicles.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct DoorVerdict {
    /// Maximum difference between the longest wait for a map at a door and at its node.
    pub(crate) longer_gap: Option<Duration>,
    /// For each map, how much later the program had it than the node, in microseconds. Negative where the cell's time,
    /// by which the node dates, is ahead of the machine's clock.
    pub(crate) delays: Vec<i64>,
    /// Maps that a program missed or received twice or out of order, and maps that its node did not accept.
    pub(crate) wrong: u64,
    /// Ends of phases at which a program was without maps.
    pub(crate) unserved: u64,
}

/// Starts a client that writes to `log` every map at this address.
pub(crate) fn open(
    address: SocketAddr,
    namespace: Option<&str>,
    log: &Path,
) -> anyhow::Result<Process> {
    let file = File::create(log).with_context(|| format!("cannot write {}", log.display()))?;
    let host = address.ip().to_string();
    let port = address.port().to_string();
    let topic = format!("ecod/v1/{CELL}/global_detections");
    let mut client = command(Path::new(CLIENT), namespace);
    Process::start(
        client
            .args(["-h", &host, "-p", &port, "-t", &topic, "-F", "%U %p"])
            .stdout(file),
    )
}

/// Compares the doors, by node, with the logs of all processes. At a flooded door programs may wait, and get the same maps.
pub(crate) fn judge_doors(
    runs: &[NodeRun],
    doors: &[NodeRun],
    phases: &[Phase],
    flooded: Option<&NodeName>,
) -> DoorVerdict {
    let mut verdict = DoorVerdict::default();
    let measured: BTreeSet<&NodeName> = phases.iter().flat_map(|phase| &phase.measured).collect();
    for door in doors.iter().filter(|door| measured.contains(&door.node)) {
        let measuring = || {
            phases
                .iter()
                .filter(|phase| phase.measured.contains(&door.node))
        };
        let own: Vec<&NodeRun> = runs.iter().filter(|run| run.node == door.node).collect();
        verdict.wrong += stale(door) + differences(&own, door);
        let is_unserved =
            |phase: &&Phase| !served(std::slice::from_ref(door), &door.node, phase.until);
        verdict.unserved += measuring().filter(is_unserved).count() as u64;
        if flooded == Some(&door.node) {
            continue;
        }
        for phase in measuring() {
            let at_node = own
                .iter()
                .filter_map(|run| longest_wait(run, phase.from, phase.until))
                .max();
            let at_door = longest_wait(door, phase.from, phase.until);
            let longer = at_door
                .unwrap_or_default()
                .saturating_sub(at_node.unwrap_or_default());
            verdict.longer_gap = verdict.longer_gap.max(Some(longer));
        }
        let accepted_at: HashMap<_, _> = own
            .iter()
            .flat_map(|run| &run.accepted)
            .map(|map| (key(map), map.at))
            .collect();
        let delay = |map: &Accepted| Some(map.at.micros_from(*accepted_at.get(&key(map))?));
        verdict
            .delays
            .extend(door.accepted.iter().filter_map(delay));
    }
    verdict
}

/// Maps of one side only, between the first and the last of the door.
fn differences(own: &[&NodeRun], door: &NodeRun) -> u64 {
    let (Some(first), Some(last)) = (door.accepted.first(), door.accepted.last()) else {
        return 1;
    };
    let between = |map: &&Accepted| key(first) <= key(map) && key(map) <= key(last);
    let accepted: BTreeSet<_> = own
        .iter()
        .flat_map(|run| &run.accepted)
        .filter(between)
        .map(key)
        .collect();
    let got: BTreeSet<_> = door.accepted.iter().map(key).collect();
    accepted.symmetric_difference(&got).count() as u64
}

fn key(map: &Accepted) -> (&Epoch, u64) {
    (&map.epoch, map.round)
}

/// Reads the client's time of a line: whole seconds and nanoseconds.
pub(crate) fn time(text: &str) -> Option<Timestamp> {
    let (seconds, nanos) = text.split_once('.')?;
    let seconds: u64 = seconds.parse().ok()?;
    let nanos: u64 = nanos.parse().ok()?;
    Some(Timestamp(seconds * 1_000_000 + nanos / 1000))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(rounds: impl IntoIterator<Item = (u64, u64)>) -> NodeRun {
        let epoch = Epoch::new(1, NodeName::from_static("edge"));
        let map = |(round, at_ms)| {
            let at = Timestamp(at_ms * 1000);
            Accepted {
                at,
                epoch: epoch.clone(),
                round,
                fused_at: at,
            }
        };
        NodeRun {
            node: NodeName::from_static("a"),
            accepted: rounds.into_iter().map(map).collect(),
        }
    }

    fn judge(node: &NodeRun, door: NodeRun) -> DoorVerdict {
        judge_until(500, node, door, None)
    }

    fn judge_until(
        end_ms: u64,
        node: &NodeRun,
        door: NodeRun,
        flooded: Option<&NodeName>,
    ) -> DoorVerdict {
        let measured = BTreeSet::from([NodeName::from_static("a")]);
        let from = Timestamp(0);
        let until = Timestamp(end_ms * 1000);
        let phase = Phase {
            from,
            until,
            changes: 0..=0,
            components: Vec::new(),
            measured,
        };
        judge_doors(std::slice::from_ref(node), &[door], &[phase], flooded)
    }

    #[test]
    fn program_may_lag_behind_node() {
        let node = run([(1, 100), (2, 200), (3, 350), (4, 450)]);
        let verdict = judge(&node, run([(2, 201), (3, 354), (4, 451)]));
        let delays = vec![1000, 4000, 1000];
        assert_eq!(
            verdict,
            DoorVerdict {
                longer_gap: Some(Duration::from_millis(3)),
                delays,
                wrong: 0,
                unserved: 0
            }
        );
    }

    #[test]
    fn fast_clock_hides_no_delay() {
        let verdict = judge(&run([(1, 100), (2, 200)]), run([(1, 99), (2, 201)]));
        assert_eq!(
            verdict.delays,
            [-1000, 1000],
            "negative for a node whose date is later than the program's"
        );
    }

    #[test]
    fn program_without_maps_is_unserved() {
        let node = run((1..=20).map(|round| (round, 100 * round)));
        let cut_short = run((1..=10).map(|round| (round, 100 * round + 1)));
        for flooded in [None, Some(&NodeName::from_static("a"))] {
            let unserved =
                |end_ms, door: &NodeRun| judge_until(end_ms, &node, door.clone(), flooded).unserved;
            assert_eq!(unserved(2050, &cut_short), 1);
            assert_eq!(unserved(2050, &run([])), 1);
            assert_eq!((unserved(1050, &cut_short), unserved(2050, &node)), (0, 0));
        }
    }

    #[test]
    fn missing_or_repeated_maps_wrong() {
        let node = run([(1, 100), (2, 200), (3, 300)]);
        assert_eq!(judge(&node, run([(1, 100), (3, 300)])).wrong, 1, "lost");
        assert_eq!(
            judge(&node, run([(1, 100), (2, 200), (2, 201), (3, 300)])).wrong,
            1,
            "twice"
        );
        assert_eq!(
            judge(&run([(1, 100), (3, 300)]), node.clone()).wrong,
            1,
            "refused by the node"
        );
        assert_eq!(judge(&node, run([])).wrong, 1, "no maps");
    }

    #[test]
    fn line_time_has_microseconds() {
        assert_eq!(
            time("1795440585.322362340"),
            Some(Timestamp(1_795_440_585_322_362))
        );
        assert_eq!(time("soon"), None);
    }
}
