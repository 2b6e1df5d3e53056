//! A cell of an edge and three vehicles that loses its leaders, one after the other, and gets them back.
//!
//! `cargo run --example mixed_aggregation`
//!
//! All nodes run in this process, each on a runtime of its own and with its own broker and sockets on loopback.
//! Shutting a runtime down ends a node as SIGKILL ends a process: its connections break, and nobody is told. The
//! vehicles have no cameras; what they would see is published through their gateways ten times a second. Figures are
//! from the maps that the nodes accepted, as their map logs tell. The program fails unless the cell is served by one
//! leader after every step, and nobody accepts a superseded map.

mod cell;

use std::time::Duration;

use anyhow::{Context, ensure};
use ecod::model::epoch::Epoch;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use ecod_actors::platform::clock;
use tokio::runtime::Builder;

use cell::{Cell, Record};

/// The places of the cell and metres east; nobody is at the last.
const PLACES: [(&str, f64); 3] = [("slot-0", 0.0), ("slot-1", 3.0), ("slot-2", 6.0)];

/// Labels that each vehicle reads, by place; all have all places in view, and noether misreads the first: without
/// euclid, the map cannot tell who is right.
const SEEN: [(&str, &[(usize, &str)]); 3] = [
    ("euclid", &[(0, "ABC123"), (1, "XYZ789")]),
    ("gauss", &[(0, "ABC123"), (1, "XYZ789")]),
    ("noether", &[(0, "ABC128"), (1, "XYZ789")]),
];

/// A fault, or its end.
enum Step {
    /// The edge starts; it is to lead in the end.
    StartEdge,
    /// All vehicles start that are not there.
    StartVehicles,
    /// Whoever leads is killed; another is to lead in the end.
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

/// Time in which all nodes must be served by one leader again.
const PATIENCE: Duration = Duration::from_secs(20);

/// Time between recovery and the next step: all have links to the leader and to the standby that it named.
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

/// Carries out the script; every step has a line when it is done and one when all are served again.
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
            let epoch = cell.epoch().context("nobody leads")?;
            cell.kill(epoch.leader.as_str())?;
            format!("{} killed", epoch.leader)
        }
    })
}

/// Waits until all nodes take the maps of one that is there, which is the edge if that is there.
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
