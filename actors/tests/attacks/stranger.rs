//! A stranger on the network, who reaches the cell's ports and holds no secret.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::interval;

use crate::cell::Target;
use crate::client::knock;
use crate::row::{Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[Row {
    attack: "connections by the hundred",
    means: Means::Stranger,
    on_brokers: true,
    deeds: (300, "connections"),
    bar: UNHARMED,
    quick: true,
    run: |target| Box::pin(connections(target)),
}];

/// Opens 500 connections a second and holds the latest thousand.
async fn connections(target: Target) -> anyhow::Result<()> {
    let mut held = VecDeque::new();
    let mut ticks = interval(Duration::from_millis(2));
    loop {
        ticks.tick().await;
        held.extend(knock(&target).await.inspect(|_| target.did(1)));
        if held.len() > 1000 {
            held.pop_front();
        }
    }
}
