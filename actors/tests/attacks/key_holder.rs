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
        on_brokers: false,
        deeds: (10, "frames"),
        bar: UNHARMED,
        quick: true,
        run: |target| Box::pin(largest_term(target)),
    },
    Row {
        attack: "claims to lead, by another CA's certificate and priority 255",
        means: Means::CellKey,
        on_brokers: false,
        deeds: (10, "frames"),
        bar: UNHARMED,
        quick: false,
        run: |target| Box::pin(claims(target)),
    },
];

/// The name under which the attacker takes part.
pub(crate) const NAME: &str = "mallory";

async fn largest_term(target: Target) -> anyhow::Result<()> {
    let insider = Insider::join(&target, (NAME, Role::Cav), None).await?;
    tokio::try_join!(insider.repeat(MAX_TERM, None, Body::Status { over: None, no_login: Vec::new() }), insider.knock())
        .map(drop)
}

async fn claims(target: Target) -> anyhow::Result<()> {
    let insider = Insider::join(&target, (NAME, Role::Edge), Some(Arc::clone(&target.foreign))).await?;
    let beat = Body::Beat { every_ms: 50, round: 1, followers: 9, after: None, successors: Vec::new() };
    tokio::try_join!(insider.repeat(1 << 20, Some(insider.epoch(1 << 20)), beat), insider.knock()).map(drop)
}
