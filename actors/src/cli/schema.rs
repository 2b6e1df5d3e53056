//! `ecod-node schema`: JSON Schemas of every payload.

use anyhow::Context;
use ecod::wire;

use super::{Failure, print};

pub(super) fn run() -> Result<(), Failure> {
    let schemas = wire::schemas();
    let text = serde_json::to_string_pretty(&schemas).context("cannot encode schemas")?;
    Ok(print(&format!("{text}\n"))?)
}
