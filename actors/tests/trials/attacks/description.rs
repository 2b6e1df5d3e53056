//! A description that a candidate sets without the right to do so.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{bail, ensure};
use ecod::description::MAX_VERSION_STEP;
use ecod::leadership::election::Body;
use ecod::model::names::NodeName;
use ecod::wire::{CellDescription, Encoding, Role, SCHEMA_VERSION, encode};
use ecod_actors::platform::content_hash::content_hash;
use tokio::task::spawn_blocking;
use tokio::time::sleep;

use crate::attacks::candidate::{join, publish_for_ever};
use crate::attacks::cell::{CELL, LANDMARK, LEADER, NODES, OBSERVED, Target, program};
use crate::attacks::client::publish;

/// Maximum time until all nodes have a description.
const PATIENCE: Duration = Duration::from_secs(6);

/// The attacker continues without a pause. All nodes use the right description all the time.
pub(crate) async fn set_without_right(target: Target) -> anyhow::Result<()> {
    let file = target.home.join("right.toml");
    fs::write(&file, LANDMARK)?;
    cell(&target, LEADER, &["set".as_ref(), &file]).await?;
    let right = content_hash(&NodeName::from_static(LEADER), LANDMARK).to_string();
    used_by_all(&target, &right).await?;
    // A setting that costs no map: only descriptions show whose counts.
    let text = format!("{LANDMARK}\n[fusion.pace]\ngate_m = 0.6\n");
    let set_by = NodeName::from_static(LEADER);
    let hash = content_hash(&set_by, &text);
    let forged = CellDescription {
        schema: SCHEMA_VERSION,
        version: 1 + MAX_VERSION_STEP,
        hash,
        set_by,
        text,
    };
    tokio::select! {
        ended = set_for_ever(target.clone(), &forged) => ended,
        changed = watch(&target, &right) => changed,
    }
}

/// States the description as a candidate, and publishes it at the broker.
async fn set_for_ever(target: Target, forged: &CellDescription) -> anyhow::Result<()> {
    let member = join(&target, Role::Auto).await?.stating(forged.stamp());
    let packet = [publish(
        &format!("ecod/v1/{CELL}/cell"),
        &encode(forged, Encoding::Json),
    )];
    let status = Body::Status {
        over: None,
        no_login: Vec::new(),
    };
    tokio::try_join!(
        member.repeat(1, None, status),
        publish_for_ever(&target, &packet)
    )
    .map(drop)
}

/// Fails as soon as a node does not use the right description.
async fn watch(target: &Target, right: &str) -> anyhow::Result<()> {
    loop {
        let shown = cell(target, OBSERVED, &["show".as_ref()]).await?;
        ensure!(
            is_used_by_all(&shown, right),
            "the right description does not count: {shown}"
        );
        sleep(Duration::from_millis(500)).await;
    }
}

async fn used_by_all(target: &Target, hash: &str) -> anyhow::Result<()> {
    let started = Instant::now();
    loop {
        let shown = cell(target, OBSERVED, &["show".as_ref()]).await?;
        if is_used_by_all(&shown, hash) {
            return Ok(());
        }
        if started.elapsed() > PATIENCE {
            bail!("not all nodes use {hash}: {shown}");
        }
    }
}

/// True if the observed vehicle has the description, and reports that all nodes use it.
fn is_used_by_all(shown: &str, hash: &str) -> bool {
    let states = |name: &str| {
        let line = shown
            .lines()
            .find(|line| line.starts_with(&format!("# {name}: ")));
        line.is_some_and(|line| line.contains(hash) && !line.contains("not used"))
    };
    NODES.iter().all(|(name, _)| states(name)) && states(&format!("cell {CELL}"))
}

/// Output of `ecod-node cell` at the door of a node.
async fn cell(target: &Target, node: &str, arguments: &[&Path]) -> anyhow::Result<String> {
    let mut command = Command::new(program());
    command
        .arg("cell")
        .args(arguments)
        .args(["--config", "node.toml"])
        .current_dir(target.home.join(node));
    let output = spawn_blocking(move || command.output()).await??;
    ensure!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(String::from_utf8(output.stdout)?)
}
