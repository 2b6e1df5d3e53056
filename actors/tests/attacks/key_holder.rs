//! A holder of the cell's key without a certificate of the cell.

use std::sync::Arc;

use ecod::leadership::election::{Body, MAX_TERM};
use ecod::wire::Role;

use crate::cell::Target;
use crate::insider::Insider;
use crate::row::{Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[
    Row {
        attack: "a status with the largest term",
        means: Means::CellKey,
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(largest_term(target)),
    },
    Row {
        attack: "claims to lead, by another CA's certificate and priority 255",
        means: Means::CellKey,
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(claims(target)),
    },
];

/// The name under which the attacker takes part.
pub(crate) const NAME: &str = "mallory";

async fn largest_term(target: Target) -> anyhow::Result<()> {
    let insider = Insider::join(&target, (NAME, Role::Cav), None).await?;
    insider.repeat(MAX_TERM, None, Body::Status { over: None }).await
}

async fn claims(target: Target) -> anyhow::Result<()> {
    let insider = Insider::join(&target, (NAME, Role::Edge), Some(Arc::clone(&target.foreign))).await?;
    let beat = Body::Beat { every_ms: 50, round: 1, followers: 9, after: None, successors: Vec::new() };
    insider.repeat(1 << 20, Some(insider.epoch(1 << 20)), beat).await
}
