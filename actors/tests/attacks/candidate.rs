//! The owner of a candidate's certificate, which may lead and does not.

use futures_util::future::join_all;

use crate::cell::{CANDIDATE, CELL, Target};
use crate::client::{publish, send_for_ever};
use crate::row::{Means, Row, UNHARMED};

pub(crate) const ROWS: &[Row] = &[Row {
    attack: "30 connections flood with maps of 8 MB",
    means: Means::Candidate,
    bar: UNHARMED,
    quick: false,
    run: |target| Box::pin(flood(target)),
}];

async fn flood(target: Target) -> anyhow::Result<()> {
    let map = publish(&format!("ecod/v1/{CELL}/global_detections"), &vec![b'x'; 8_000_000]);
    join_all((0..30).map(|_| send_for_ever(target.broker, (&target.candidate, CANDIDATE), &[], &map))).await;
    Ok(())
}
