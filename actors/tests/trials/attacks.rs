//! Attacks on a cell of real processes, from outside and from within: `make attack`.
//!
//! ```text
//! harness ── starts ──> edge, v01, v02   real nodes with certificates, which report and fuse throughout
//!    └────── runs ───>  a row            one attack, by the means of one kind of attacker, who must have done enough
//!    └────── reads ──>  map logs, memory of the edge ──> the row's line in the table
//! ```
//!
//! Each node has a network namespace, joined by a bridge, and attackers have a separate address there. Without the
//! right to create namespaces, all are on loopback, and the harness prints this.
//!
//! Each kind of attacker has a file with its rows. Attacks on brokers run against the leader's broker, then against the
//! standby's. `ROWS=a,b` runs the rows whose names contain `a` or `b`; `ATTACK=quick` runs only the rows for every
//! change, `PROGRAM=file` attacks another build. A row that missed its bar while the machine stalled is repeated.

mod candidate;
mod cell;
mod client;
mod description;
mod insider;
mod key_holder;
mod leader;
mod reports;
mod row;
mod stranger;
mod vehicle;

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use anyhow::{Context, bail};
use tokio::runtime::{Builder, Runtime};

use crate::attacks::cell::{Cell, Target, Victim};
use crate::attacks::row::{Outcome, Row, table};
use crate::machine::Machine;
use crate::network;

const ATTACKERS: [&[Row]; 6] = [
    stranger::ROWS,
    key_holder::ROWS,
    vehicle::ROWS,
    reports::ROWS,
    candidate::ROWS,
    leader::ROWS,
];

/// Duration of an attack, and of a quick one.
const ATTACK_TIME: Duration = Duration::from_secs(20);
const QUICK_TIME: Duration = Duration::from_secs(5);

/// Time after the attack in which maps still count.
const AFTERMATH: Duration = Duration::from_secs(1);

/// Attempts at a row on a machine that stands still.
const MAX_ATTEMPTS: usize = 3;

#[test]
#[ignore = "takes minutes: make attack"]
fn attacks() {
    // Processes end with the thread that started them: all are started by this one.
    let runtime = Builder::new_current_thread().enable_all().build().unwrap();
    if let Err(error) = runtime.block_on(run_all()) {
        panic!("{error:#}");
    }
}

async fn run_all() -> anyhow::Result<()> {
    let is_quick = std::env::var("ATTACK").is_ok_and(|mode| mode == "quick");
    let wanted = std::env::var("ROWS").unwrap_or_default();
    let is_wanted = |row: &&Row| {
        let is_named = wanted
            .split(',')
            .any(|part| row.attack.contains(part.trim()));
        is_named && (row.quick || !is_quick)
    };
    let time = if is_quick { QUICK_TIME } else { ATTACK_TIME };
    if !network::has_namespaces() {
        println!("on loopback: network namespaces cannot be made here");
    }
    let mut lines = Vec::new();
    for row in ATTACKERS.into_iter().flatten().filter(is_wanted) {
        for victim in [Victim::Leader, Victim::Standby] {
            if victim == Victim::Leader || (row.on_brokers && !is_quick) {
                lines.push((
                    row,
                    victim,
                    attempt(row, victim, time)
                        .await
                        .with_context(|| row.attack)?,
                ));
            }
        }
    }
    println!("\n{}", table(&lines));
    let misses: Vec<_> = lines
        .iter()
        .filter(|(row, _, outcome)| !row.is_met(outcome))
        .collect();
    if lines.is_empty() {
        bail!("no row's name contains any of ROWS={wanted}");
    }
    if !misses.is_empty() {
        bail!(
            "bars missed: {}",
            misses
                .iter()
                .map(|(row, ..)| row.attack)
                .collect::<Vec<_>>()
                .join(", ")
        );
    }
    Ok(())
}

/// Runs a row until it meets its bar, or misses it without a stall of the machine.
async fn attempt(row: &Row, victim: Victim, time: Duration) -> anyhow::Result<Outcome> {
    for left in (0..MAX_ATTEMPTS).rev() {
        let mut machine = Machine::default();
        let outcome = run(row, victim, time, &mut machine).await?;
        println!("{}, {}: {outcome}", row.attack, victim.name());
        if row.is_met(&outcome) || left == 0 || !machine.is_starved() {
            return Ok(outcome);
        }
        println!(
            "    repeated, the machine stood still: {}",
            machine.account()
        );
    }
    bail!("no attempt")
}

async fn run(
    row: &Row,
    victim: Victim,
    time: Duration,
    machine: &mut Machine,
) -> anyhow::Result<Outcome> {
    let mut cell = Cell::start()?;
    cell.settle().await?;
    let target = cell.target(victim)?;
    let deeds = Arc::clone(&target.deeds);
    let attacker = Attacker::start(row, target)?;
    let from = cell.mark()?;
    machine.sleep(time).await?;
    let fault = attacker.stop().map(|error| format!("{error:#}"));
    machine.sleep(AFTERMATH).await?;
    Ok(Outcome {
        deeds: deeds.load(Ordering::Relaxed),
        fault,
        ..cell.outcome(from, row.means)?
    })
}

/// An attack under way, on separate threads.
struct Attacker {
    runtime: Runtime,
    task: tokio::task::JoinHandle<anyhow::Result<()>>,
}

impl Attacker {
    fn start(row: &Row, target: Target) -> anyhow::Result<Self> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()?;
        let task = runtime.spawn((row.run)(target));
        Ok(Self { runtime, task })
    }

    /// Ends the attack; the result is the reason for which it ended before, if it failed.
    fn stop(self) -> Option<anyhow::Error> {
        let fault = if self.task.is_finished() {
            futures_util::FutureExt::now_or_never(self.task)
                .and_then(|ended| ended.unwrap_or_else(|panic| Err(panic.into())).err())
        } else {
            None
        };
        self.runtime.shutdown_background();
        fault
    }
}
