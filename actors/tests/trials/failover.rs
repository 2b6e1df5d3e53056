//! Failover as vehicles see it: cells of real processes, killed, stopped, cut off and starved, again and again.
//!
//! This module has two harnesses. `make soak` runs the harness in `soak`. `make trials` runs the other one; `TRIALS=n`
//! is the number of trials of each scenario and cell size (default 20), `SCENARIOS=a,b` and `NODES=2,5` select
//! scenarios and sizes. Scenarios that cannot run on this machine are skipped and listed. A trial that missed a bar
//! while the machine stalled is void and repeated, at most as many times as the number of trials; superseded maps and
//! lost reputations always count, and a scenario without a valid trial has failed. The results are printed and written
//! to `target/trials.json`; the files of a failed trial are kept.

mod analysis;
mod cell;
mod doors;
mod flood;
mod logs;
mod report;
mod scenario;
mod settings;
mod soak;
mod voters;

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use ecod_actors::platform::clock;
use tokio::signal::unix::{SignalKind, signal};

use crate::failover::analysis::{Phase, Verdict, judge};
use crate::failover::cell::{Cell, EDGE, Plan};
use crate::failover::doors::judge_doors;
use crate::failover::flood::FloodCost;
use crate::failover::report::{Outcome, table};
use crate::failover::scenario::{Cure, Fault, Needs, SCENARIOS, Scenario, Step, Who};
use crate::failover::voters::Voters;
use crate::machine::Machine;
use crate::network;

/// Cell sizes, the edge included.
const NODES: [usize; 4] = [2, 5, 16, 32];

#[test]
#[ignore = "takes minutes to hours: make trials"]
fn trials() {
    end_with_the_harness(run_all());
}

/// Runs to the end, or until the harness is stopped.
#[track_caller]
fn end_with_the_harness(work: impl Future<Output = anyhow::Result<()>>) {
    // Processes end with the thread that started them: all are started by this one.
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let outcome = runtime.block_on(async {
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut terminate = signal(SignalKind::terminate())?;
        tokio::select! {
            outcome = work => outcome,
            _ = interrupt.recv() => bail!("interrupted"),
            _ = terminate.recv() => bail!("terminated"),
        }
    });
    if let Err(error) = outcome {
        panic!("{error:#}");
    }
}

async fn run_all() -> anyhow::Result<()> {
    let trials: usize = std::env::var("TRIALS")
        .ok()
        .map_or(Ok(20), |text| text.parse())
        .context("TRIALS")?;
    let scenarios = filter("SCENARIOS");
    let sizes = filter("NODES");
    let known = |name: &String| SCENARIOS.iter().any(|scenario| scenario.name == name);
    if let Some(unknown) = scenarios.iter().flatten().find(|name| !known(name)) {
        let names: Vec<_> = SCENARIOS.iter().map(|scenario| scenario.name).collect();
        bail!("no scenario {unknown}; there are {}", names.join(", "));
    }
    let chosen = |list: &Option<Vec<String>>, item: &str| {
        list.as_ref()
            .is_none_or(|list| list.iter().any(|i| i == item))
    };
    let mut outcomes = Vec::new();
    for scenario in SCENARIOS
        .iter()
        .filter(|scenario| chosen(&scenarios, scenario.name))
    {
        if let Some(lack) = lacking(scenario.needs) {
            println!("{}: skipped, {lack}", scenario.name);
            continue;
        }
        for nodes in NODES
            .into_iter()
            .filter(|nodes| chosen(&sizes, &nodes.to_string()))
        {
            if nodes < scenario.least_nodes {
                continue;
            }
            let mut verdicts: Vec<Verdict> = Vec::new();
            let void =
                |verdicts: &[Verdict]| verdicts.iter().filter(|verdict| verdict.is_void).count();
            while verdicts.len() < trials + void(&verdicts).min(trials) {
                let trial = verdicts.len() - void(&verdicts) + 1;
                verdicts.push(run(scenario, nodes, trial, trials).await?);
            }
            outcomes.push(Outcome::new(scenario, nodes, &verdicts));
            write(&outcomes)?;
        }
    }
    println!("\n{}", table(&outcomes));
    let misses: Vec<String> = outcomes.iter().flat_map(Outcome::misses).collect();
    if misses.is_empty() {
        Ok(())
    } else {
        bail!("bars missed: {}", misses.join("; "))
    }
}

/// Runs one trial and prints its result in one line.
async fn run(
    scenario: &Scenario,
    nodes: usize,
    trial: usize,
    trials: usize,
) -> anyhow::Result<Verdict> {
    let plan = Plan {
        nodes,
        edge: scenario.edge,
        external_broker: matches!(
            scenario.needs,
            Needs::Mosquitto | Needs::MosquittoAndFallback
        ),
        fallback: scenario.needs == Needs::MosquittoAndFallback,
        bridged: matches!(scenario.needs, Needs::Namespaces | Needs::PacketFilter),
        votes: false,
    };
    let mut cell = Cell::start(&plan)?;
    let outcome = perform(scenario, &mut cell).await;
    let label = format!(
        "{}, {nodes} nodes, trial {trial} of {trials}",
        scenario.name
    );
    match outcome {
        Ok(verdict) => {
            let gap = verdict.gap.map_or_else(
                || "none".to_owned(),
                |gap| format!("{} ms", gap.as_millis()),
            );
            let misses = Outcome::new(
                scenario,
                nodes,
                &[Verdict {
                    is_void: false,
                    ..verdict.clone()
                }],
            )
            .misses();
            // A trial that meets its bars in spite of a stall counts.
            let verdict = Verdict {
                is_void: verdict.is_void && !misses.is_empty(),
                ..verdict
            };
            let void = if verdict.is_void {
                ", void: the machine stood still"
            } else {
                ""
            };
            let flood = verdict.flood.as_ref().map_or_else(
                String::new,
                |FloodCost {
                     messages,
                     grown_kib,
                     ..
                 }| {
                    format!(
                        ", {messages} messages of a flood, which the node met with {} MiB",
                        grown_kib / 1024
                    )
                },
            );
            println!("{label}: gap {gap}{flood}{void}");
            if !misses.is_empty() {
                let mut shown = verdict.clone();
                shown.doors.delays.clear();
                println!(
                    "    {}; {shown:?}, files in {}",
                    misses.join("; "),
                    cell.keep_files().display()
                );
            }
            Ok(verdict)
        }
        Err(error) => {
            Err(error).with_context(|| format!("{label}, files in {}", cell.keep_files().display()))
        }
    }
}

async fn perform(scenario: &Scenario, cell: &mut Cell) -> anyhow::Result<Verdict> {
    cell.settle().await?;
    if scenario.needs_standby() {
        cell.until_standby().await?;
    }
    cell.open_doors().await?;
    let mut voters = if scenario.votes {
        Some(Voters::connect(cell.brokers()).await?)
    } else {
        None
    };
    let before = match &mut voters {
        Some(voters) => Some(voters.vote().await?),
        None => None,
    };
    let mut phases = Vec::new();
    let mut machine = Machine::default();
    for step in scenario.script {
        let from = clock::now();
        machine.sleep(Duration::ZERO).await?;
        apply(step.fault, cell)?;
        machine.sleep(step.watch).await?;
        phases.push(phase(step, from, cell));
    }
    let after = voters.as_ref().and_then(Voters::newest);
    let reputations_changed = match (before, after) {
        (Some(before), Some(after)) => {
            after.epoch <= before.epoch || after.reputations != before.reputations
        }
        (before, after) => before.is_some() || after.is_some(),
    };
    if machine.is_starved() {
        println!("the machine stood still: {}", machine.account());
    }
    let flood = cell.flood_cost()?;
    // Doors first, because a node has written all messages that its door has sent.
    let doors = cell.doors()?;
    let runs = cell.runs()?;
    let doors = judge_doors(&runs, &doors, &phases, cell.flooded());
    Ok(Verdict {
        reputations_changed,
        is_void: machine.is_starved(),
        doors,
        flood,
        ..judge(&runs, &phases)
    })
}

fn apply(fault: Fault, cell: &mut Cell) -> anyhow::Result<()> {
    let find = |who: &Who| match who {
        Who::Edge => Ok(EDGE),
        Who::Leader => cell.leader(),
        Who::Standby => cell.standby(),
    };
    match fault {
        Fault::Kill(victims) => {
            let victims = victims
                .iter()
                .map(find)
                .collect::<anyhow::Result<Vec<_>>>()?;
            victims.into_iter().try_for_each(|victim| cell.kill(victim))
        }
        Fault::RestartEdge => cell.restart(EDGE),
        Fault::PauseEdge => cell.pause(EDGE, true),
        Fault::ResumeEdge => cell.pause(EDGE, false),
        Fault::KillExternalBroker => cell.kill_mosquitto(),
        Fault::Busy(loops) => cell.busy(loops),
        Fault::FloodStandby => cell.flood(cell.standby()?),
        Fault::Split => cell.split(true),
        Fault::CutOneWay => cell.cut_one_way(true),
        Fault::Readdress(who) => cell.readdress(find(&who)?),
        Fault::Lose(percent) => cell.lose(percent),
        Fault::Heal(Cure::Split) => cell.split(false),
        Fault::Heal(Cure::OneWay) => cell.cut_one_way(false),
        Fault::Heal(Cure::Loss) => cell.lose(0),
    }
}

fn phase(step: &Step, from: ecod::model::time::Timestamp, cell: &Cell) -> Phase {
    let measured = if step.measured {
        cell.vehicles()
    } else {
        Default::default()
    };
    let changes = step.changes.0..=step.changes.1;
    Phase {
        from,
        until: clock::now(),
        changes,
        components: cell.components(),
        measured,
    }
}

/// Why a scenario cannot be run here, if it cannot.
fn lacking(needs: Needs) -> Option<&'static str> {
    let namespaces =
        || (!network::has_namespaces()).then_some("network namespaces cannot be made here");
    match needs {
        Needs::Loopback => None,
        Needs::Mosquitto | Needs::MosquittoAndFallback => {
            (!cell::has_mosquitto()).then_some("mosquitto is not installed")
        }
        Needs::Namespaces => namespaces(),
        Needs::PacketFilter => namespaces()
            .or_else(|| (!network::has_packet_filter()).then_some("nftables is not installed")),
    }
}

/// The parts of a list in the environment.
fn filter(key: &str) -> Option<Vec<String>> {
    let list = std::env::var(key)
        .ok()
        .filter(|list| !list.trim().is_empty())?;
    Some(list.split(',').map(|item| item.trim().to_owned()).collect())
}

fn write(outcomes: &[Outcome]) -> anyhow::Result<()> {
    let file = target_file("trials.json");
    let text = serde_json::to_string_pretty(outcomes)? + "\n";
    std::fs::write(&file, text).with_context(|| format!("cannot write {}", file.display()))
}

/// Where a file of results belongs.
fn target_file(name: &str) -> PathBuf {
    let target = std::env::var_os("CARGO_TARGET_DIR").map(PathBuf::from);
    target
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../target"))
        .join(name)
}
