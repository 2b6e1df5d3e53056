//! All faults together, for any time: each minute causes a fault from the seed, the cell must work again before the
//! minute ends, the nodes show no trouble that does not follow from it, and memory and files must not grow.
//!
//! `make soak` runs it: `MINUTES=n` (default 30), `NODES=n` (default 32) and `SEED=n` (default 1). The summary is printed
//! and written to `target/soak.json`; the files of a soak that went wrong are kept.

mod alarms;
mod disturbance;
mod growth;
mod intruder;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use anyhow::{Context, bail};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod_actors::platform::clock;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use tokio::time::{Instant, sleep_until};

use crate::failover::analysis::{Accepted, NodeRun, longest_wait, stale};
use crate::failover::cell::{Cell, Plan};
use crate::failover::{end_with_the_harness, target_file};
use crate::network;
use alarms::Alarm;
use disturbance::Disturbance;
use growth::{Resources, Series};
use intruder::Intruder;

const MINUTE: Duration = Duration::from_secs(60);

/// A map that is older than this when it is taken is of no use to a driver.
const MAX_AGE: Duration = Duration::from_secs(1);

#[test]
#[ignore = "takes the given number of minutes: make soak"]
fn soak() {
    end_with_the_harness(run());
}

/// Outcome of a soak.
#[derive(Debug, Serialize)]
struct Summary {
    nodes: usize,
    seed: u64,
    minutes: Vec<Minute>,
    maps_accepted: usize,
    stale_accepted: u64,
    forged_accepted: usize,
    accepted_older_than_1_s: usize,
    oldest_accepted_ms: u64,
    unrecovered_minutes: usize,
    /// Processes that lived for long enough to show whether they grow.
    watched_for_growth: usize,
    growing: Vec<String>,
    largest: Resources,
    alarms: Vec<Alarm>,
}

/// One minute of it.
#[derive(Debug, Clone, Serialize)]
struct Minute {
    disturbance: Disturbance,
    #[serde(skip)]
    struck: BTreeSet<NodeName>,
    /// Longest time that a vehicle that ran throughout waited for a map.
    longest_gap_ms: u64,
    /// Time from the end of the disturbance until all followed one leader again; `None` if they did not.
    recovered_after_ms: Option<u64>,
    leader: String,
    /// The largest of all processes at the minute's end.
    largest: Resources,
    #[serde(skip)]
    span: (Timestamp, Timestamp),
}

async fn run() -> anyhow::Result<()> {
    let minutes = setting("MINUTES", 30)?;
    let nodes = setting("NODES", 32)? as usize;
    let seed = setting("SEED", 1)?;
    if nodes < disturbance::LEAST_NODES {
        bail!(
            "NODES={nodes}: a soak takes {} or more",
            disturbance::LEAST_NODES
        );
    }
    let bridged = network::has_namespaces() && network::has_packet_filter();
    if !bridged {
        println!("no splits and no losses: network namespaces or nftables are missing here");
    }
    let plan = Plan {
        nodes,
        edge: true,
        external_broker: false,
        fallback: false,
        bridged,
        votes: true,
    };
    let mut cell = Cell::start(&plan)?;
    let outcome = pass(&mut cell, minutes, seed, bridged).await;
    match outcome {
        Ok(summary) => {
            let failures = report(&summary)?;
            if failures.is_empty() {
                return Ok(());
            }
            bail!(
                "{}; files in {}",
                failures.join("; "),
                cell.keep_files().display()
            )
        }
        Err(error) => {
            Err(error).with_context(|| format!("files in {}", cell.keep_files().display()))
        }
    }
}

async fn pass(cell: &mut Cell, minutes: u64, seed: u64, bridged: bool) -> anyhow::Result<Summary> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut intruder = Intruder::new(cell.brokers(), cell.gossips(), seed);
    let mut past: Vec<Minute> = Vec::new();
    let mut series: BTreeMap<String, Series> = BTreeMap::new();
    cell.settle().await?;
    for number in 1..=minutes {
        let began = Instant::now();
        let from = clock::now();
        let disturbance = Disturbance::draw(&mut rng, bridged);
        let struck = disturbance.carry_out(cell, &mut intruder, &mut rng).await?;
        let over = Instant::now();
        let limit = MINUTE.saturating_sub(began.elapsed());
        let recovered = cell.settle_within(limit).await;
        if let Err(why) = &recovered {
            println!("minute {number}: {why:#}");
        }
        let recovered_after_ms = recovered.is_ok().then(|| over.elapsed().as_millis() as u64);
        sleep_until(began + MINUTE).await;
        let mut largest = Resources::default();
        for (process, id) in cell.processes() {
            let resources = Resources::of(id).with_context(|| format!("resources of {process}"))?;
            largest = largest.max(resources);
            series.entry(process).or_default().push(resources);
        }
        let minute = Minute {
            disturbance,
            struck,
            longest_gap_ms: 0,
            recovered_after_ms,
            leader: cell.leader_name()?,
            largest,
            span: (from, clock::now()),
        };
        println!(
            "minute {number} of {minutes}: {disturbance}; {}",
            summary_of(&minute)
        );
        past.push(minute);
    }
    drop(intruder);
    let mut runs = cell.runs()?;
    let forged_accepted = take_out_forged(&mut runs);
    for minute in &mut past {
        let (from, until) = minute.span;
        minute.longest_gap_ms = longest_gap(&runs, from, until).as_millis() as u64;
    }
    let growing = series
        .iter()
        .filter_map(|(process, series)| Some(format!("{process}: {}", series.growth()?)));
    let alarms = alarms::judge(&cell.troubles()?, &past);
    let accepted = || runs.iter().flat_map(|run| &run.accepted);
    Ok(Summary {
        nodes: cell.nodes(),
        seed,
        maps_accepted: accepted().count(),
        stale_accepted: runs.iter().map(stale).sum(),
        forged_accepted,
        accepted_older_than_1_s: accepted().filter(|map| map.age() > MAX_AGE).count(),
        oldest_accepted_ms: accepted()
            .map(Accepted::age)
            .max()
            .unwrap_or_default()
            .as_millis() as u64,
        unrecovered_minutes: past
            .iter()
            .filter(|minute| minute.recovered_after_ms.is_none())
            .count(),
        watched_for_growth: series.values().filter(|series| series.is_telling()).count(),
        growing: growing.collect(),
        largest: past
            .iter()
            .map(|minute| minute.largest)
            .fold(Resources::default(), Resources::max),
        minutes: past,
        alarms,
    })
}

/// Removes the maps of aggregators that are not nodes of the cell, whose epochs would make correct maps appear
/// superseded.
fn take_out_forged(runs: &mut [NodeRun]) -> usize {
    let nodes: BTreeSet<_> = runs.iter().map(|run| run.node.clone()).collect();
    let all = |runs: &[NodeRun]| runs.iter().map(|run| run.accepted.len()).sum::<usize>();
    let before = all(runs);
    runs.iter_mut()
        .for_each(|run| run.accepted.retain(|map| nodes.contains(&map.epoch.leader)));
    before - all(runs)
}

/// The longest wait of any process that took maps before and after the span.
fn longest_gap(runs: &[NodeRun], from: Timestamp, until: Timestamp) -> Duration {
    let throughout = |run: &&NodeRun| {
        let first_and_last = run.accepted.first().zip(run.accepted.last());
        first_and_last
            .is_some_and(|(first, last)| first.at <= from && until.since(last.at) < MINUTE / 60)
    };
    let waits = runs
        .iter()
        .filter(throughout)
        .filter_map(|run| longest_wait(run, from, until));
    waits.max().unwrap_or_default()
}

fn summary_of(minute: &Minute) -> String {
    let recovered = match minute.recovered_after_ms {
        Some(ms) => format!("all well {:.1} s later", ms as f64 / 1000.0),
        None => "NOT RECOVERED".to_owned(),
    };
    format!(
        "{recovered}, {} leads; at most {}",
        minute.leader, minute.largest
    )
}

/// Prints and writes the summary; what went wrong, in words.
fn report(summary: &Summary) -> anyhow::Result<Vec<String>> {
    println!(
        "\nminute  {:<44}{:>10}{:>12}  {:<8}largest",
        "disturbance", "gap ms", "well after", "leader"
    );
    for (number, minute) in summary.minutes.iter().enumerate() {
        let well = minute
            .recovered_after_ms
            .map_or_else(|| "never".to_owned(), |ms| format!("{ms} ms"));
        let what = minute.disturbance.to_string();
        let gap = minute.longest_gap_ms;
        println!(
            "{:>6}  {what:<44}{gap:>10}{well:>12}  {:<8}{}",
            number + 1,
            minute.leader,
            minute.largest
        );
    }
    println!("\n{:<44}{:<18}{:>5}  verdict", "fault", "trouble", "times");
    for alarm in &summary.alarms {
        println!("{alarm}");
    }
    for fault in alarms::silent(&summary.minutes, &summary.alarms) {
        println!("{fault:<44}none");
    }
    println!(
        "\n{} nodes, {} minutes, seed {}: {} maps taken, {} of them superseded, {} forged, {} older than 1 s (the oldest {} ms); \
         {} minutes unrecovered; at most {}; {} processes grow, of {} that lived long enough to tell",
        summary.nodes,
        summary.minutes.len(),
        summary.seed,
        summary.maps_accepted,
        summary.stale_accepted,
        summary.forged_accepted,
        summary.accepted_older_than_1_s,
        summary.oldest_accepted_ms,
        summary.unrecovered_minutes,
        summary.largest,
        summary.growing.len(),
        summary.watched_for_growth,
    );
    let file = target_file("soak.json");
    std::fs::write(&file, serde_json::to_string_pretty(summary)? + "\n")
        .with_context(|| format!("cannot write {}", file.display()))?;
    let count = |what: &str, count: usize| (count > 0).then(|| format!("{what}: {count}"));
    let counted = [
        count("superseded maps taken", summary.stale_accepted as usize),
        count("forged maps taken", summary.forged_accepted),
        count("maps older than 1 s taken", summary.accepted_older_than_1_s),
        count("minutes unrecovered", summary.unrecovered_minutes),
        count(
            "kinds of false alarms",
            summary
                .alarms
                .iter()
                .filter(|alarm| !alarm.is_right)
                .count(),
        ),
    ];
    Ok(counted
        .into_iter()
        .flatten()
        .chain(summary.growing.iter().cloned())
        .collect())
}

fn setting(key: &str, default: u64) -> anyhow::Result<u64> {
    match std::env::var(key).ok().filter(|text| !text.is_empty()) {
        Some(text) => text
            .parse()
            .with_context(|| format!("{key}={text}: must be a whole number")),
        None => Ok(default),
    }
}
