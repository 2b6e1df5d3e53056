//! Files of benchmarks, as commands take them.

use std::path::Path;

use anyhow::Context;
use ecod_actors::cli::Failure;

use crate::eval::formats::{FileContext, FileFormat, Sequence, StandingCamera};

/// Parses frames a second.
pub(super) fn frame_rate(text: &str) -> Result<f64, String> {
    let rate = text
        .parse()
        .ok()
        .filter(|rate| (0.01..=1000.0).contains(rate));
    rate.ok_or_else(|| "must be a number from 0.01 to 1000".to_owned())
}

/// The camera in a vehicle's configuration.
pub(super) fn camera(config: Option<&Path>) -> Result<Option<StandingCamera>, Failure> {
    let load = |path: &Path| {
        StandingCamera::load(path).with_context(|| format!("camera of {}", path.display()))
    };
    config.map(load).transpose().map_err(Failure::usage)
}

/// Reads a file, or all of a directory, and prints which entries are not used.
pub(super) fn read(
    format: FileFormat,
    path: &Path,
    context: FileContext<'_>,
) -> Result<Vec<Sequence>, Failure> {
    let sequences = format.read(path, context).map_err(Failure::usage)?;
    for Sequence {
        name,
        discarded,
        skipped,
        ..
    } in &sequences
    {
        if skipped.count > 0 {
            eprintln!(
                "{name}: {} entries cannot be used, the first is {}",
                skipped.count, skipped.first
            );
        }
        for (reason, boxes) in discarded {
            eprintln!("{name}: {boxes} boxes have no place on the ground: {reason}");
        }
    }
    Ok(sequences)
}
