//! `ecod-node schema`: JSON Schemas of every payload.

use anyhow::Context;
use ecod::wire;

use super::Failure;

pub(super) fn print() -> Result<(), Failure> {
    let schemas = wire::schemas();
    println!("{}", serde_json::to_string_pretty(&schemas).context("schemas are plain JSON")?);
    Ok(())
}
