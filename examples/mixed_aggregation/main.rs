//! A cell of an edge and three vehicles that loses and regains its leaders one after the other.
//!
//! `cargo run --example mixed_aggregation`
//!
//! All nodes run in this process, each on a separate runtime with a separate broker and sockets on loopback. Shutting a
//! runtime down ends a node like SIGKILL ends a process: its connections break without a farewell. The vehicles have no
//! cameras; their detections are published through their gateways ten times a second. Figures are from the maps that
//! the nodes accepted, by their map logs. The program fails if a step ends without one leader that serves the cell, or
//! if a node accepts a superseded map.

mod cell;

use std::time::Duration;

use anyhow::{Context, ensure};
use ecod::model::epoch::Epoch;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use ecod_actors::platform::clock;
use tokio::runtime::Builder;

use cell::{Cell, Record};

/// The landmarks of the cell and metres east; the last landmark is empty.
const PLACES: [(&str, f64); 3] = [("slot-0", 0.0), ("slot-1", 3.0), ("slot-2", 6.0)];

/// Labels that each vehicle reads, by landmark. All vehicles have all landmarks in view, and noether misreads the first
/// landmark: without euclid, the map cannot decide between the two labels.
const SEEN: [(&str, &[(usize, &str)]); 3] = [
    ("euclid", &[(0, "ABC123"), (1, "XYZ789")]),
    ("gauss", &[(0, "ABC123"), (1, "XYZ789")]),
    ("noether", &[(0, "ABC128"), (1, "XYZ789")]),
];

/// A fault, or its end.
enum Step {
    /// The edge starts, and leads at the end of the step.
    StartEdge,
    /// All absent vehicles start.
    StartVehicles,
    /// The leader is killed, and another node leads at the end of the step.
    KillLeader,
}

const SCRIPT: [Step; 7] = [
    Step::StartVehicles,
    Step::StartEdge,
    Step::KillLeader,
    Step::KillLeader,
    Step::StartEdge,
    Step::StartVehicles,
    Step::KillLeader,
];

/// Maximum time until one leader serves all nodes again.
const PATIENCE: Duration = Duration::from_secs(20);

/// Time between recovery and the next step: all nodes have links to the leader and to its standby.
const CALM: Duration = Duration::from_secs(2);

fn main() -> anyhow::Result<()> {
    let runtime = Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()?;
    runtime.block_on(async {
        let mut cell = Cell::new()?;
        let outcome = play(&mut cell).await;
        let total = cell.record(Timestamp(0))?;
        cell.stop().await;
        println!(
            "\nlongest gap {} ms, {} rounds missed, {} stale accepted",
            total.gap_ms, total.missed, total.stale
        );
        outcome?;
        ensure!(total.stale == 0, "superseded maps were accepted");
        Ok(())
    })
}

/// Carries out the script and prints a line when a step is done and when all nodes are served again.
async fn play(cell: &mut Cell) -> anyhow::Result<()> {
    let started = clock::now();
    let age = || clock::now().since(started).as_secs_f64();
    println!(
        "{:>7}  {:<34}{:>8}  {:<20}votes",
        "time", "event", "gap", "map"
    );
    for step in SCRIPT {
        let from = clock::now();
        println!("{:>5.1} s  {}", age(), carry_out(&step, cell).await?);
        let epoch = tokio::time::timeout(PATIENCE, recovered(cell))
            .await
            .with_context(|| format!("no leader serves all within {PATIENCE:?}"))?;
        let recovered_at = age();
        tokio::time::sleep(CALM).await;
        let Record { gap_ms, .. } = cell.record(from)?;
        let (map, votes) = cell.agreed();
        println!(
            "{recovered_at:>5.1} s  {:<34}{gap_ms:>5} ms  {map:<20}{votes}",
            format!("{epoch} leads")
        );
    }
    Ok(())
}

async fn carry_out(step: &Step, cell: &mut Cell) -> anyhow::Result<String> {
    Ok(match step {
        Step::StartEdge => {
            cell.start("edge", Role::Edge).await?;
            "edge started".into()
        }
        Step::StartVehicles => {
            let missing: Vec<_> = SEEN
                .iter()
                .map(|(name, _)| *name)
                .filter(|name| !cell.nodes.contains_key(name))
                .collect();
            for name in &missing {
                cell.start(name, Role::Auto).await?;
            }
            format!("{} started", missing.join(", "))
        }
        Step::KillLeader => {
            let epoch = cell.epoch().context("no leader")?;
            cell.kill(epoch.leader.as_str())?;
            format!("{} killed", epoch.leader)
        }
    })
}

/// Waits until all nodes accept maps of one running node, which is the edge if it runs.
async fn recovered(cell: &Cell) -> Epoch {
    loop {
        if let Some(epoch) = cell.epoch()
            && cell.nodes.contains_key(epoch.leader.as_str())
            && (epoch.leader.as_str() == "edge" || !cell.nodes.contains_key("edge"))
        {
            return epoch;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
