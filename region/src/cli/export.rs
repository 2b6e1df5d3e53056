//! `ecod-region export`: maps of a region in other file formats.

use std::cell::RefCell;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use clap::Args;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod_actors::cli::{Failure, print};
use ecod_actors::platform::clock;

use super::run_until_stopped;
use crate::broker::BrokerArguments;
use crate::export::{CellMapLog, geojson};
use crate::reader::{self, Reading, RegionState};
use crate::town::{Accepted, GeographicBounds};

/// Flags of `export`.
#[derive(Debug, Args)]
pub(super) struct ExportArguments {
    #[command(flatten)]
    broker: BrokerArguments,
    /// Tile to be read, by its quadkey. Default: the whole region
    #[arg(long, value_name = "QUADKEY", default_value = "")]
    tile: Quadkey,
    /// Seconds to read, at least 2, because each cell's maps count only after the first one.
    /// GeoJSON then has the latest map of each cell, MCAP has all
    #[arg(long, value_name = "SECONDS", default_value_t = 3, value_parser = clap::value_parser!(u64).range(2..))]
    seconds: u64,
    /// File to be written: NAME.geojson or NAME.mcap
    #[arg(short, long = "output", alias = "out", value_name = "FILE")]
    out: PathBuf,
}

/// Format of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ExportFormat {
    GeoJson,
    Mcap,
}

pub(super) fn run(arguments: &ExportArguments) -> Result<(), Failure> {
    let format = match arguments
        .out
        .extension()
        .and_then(|extension| extension.to_str())
    {
        Some("geojson" | "json") => ExportFormat::GeoJson,
        Some("mcap") => ExportFormat::Mcap,
        _ => {
            return Err(Failure::usage(anyhow!(
                "{}: name a .geojson or .mcap file",
                arguments.out.display()
            )));
        }
    };
    let login = arguments.broker.load().map_err(Failure::usage)?;
    let state = Arc::new(RegionState::default());
    state.ask([arguments.tile].into());
    // A failure leaves the file of an earlier export alone.
    let unfinished = arguments.out.with_added_extension("unfinished");
    let log = RefCell::new(match format {
        ExportFormat::Mcap => Some(CellMapLog::create(&unfinished)?),
        ExportFormat::GeoJson => None,
    });
    let failed = RefCell::new(None);
    let write = |reading: &Reading<'_>| {
        if let (Some(log), Ok(Accepted::Map(..))) = (log.borrow_mut().as_mut(), &reading.outcome)
            && let Err(error) = log.write(reading.topic, reading.payload, reading.at)
        {
            failed.borrow_mut().get_or_insert(error);
        }
    };
    run_until_stopped(async {
        tokio::select! {
            () = reader::read(&login, &state, write) => {}
            () = tokio::time::sleep(Duration::from_secs(arguments.seconds)) => {}
        }
        Ok(())
    })?;
    if let Some(error) = failed.into_inner() {
        return Err(error
            .context(format!("cannot write {}", arguments.out.display()))
            .into());
    }
    let summary = match log.into_inner() {
        Some(log) => {
            let (cells, maps) = log.finish()?;
            format!("{cells} cells, {maps} maps")
        }
        None => write_geojson(arguments.tile, &unfinished, &state, clock::now())?,
    };
    let link = state.link();
    let trouble = link.trouble.or_else(|| {
        (link.logins == 0).then(|| "the broker has not answered; give it more --seconds".into())
    });
    if let (Some(trouble), 0) = (trouble, state.town().counts().maps) {
        // The next export overwrites a file that stays.
        let _ = std::fs::remove_file(&unfinished);
        return Err(anyhow!("{trouble}").into());
    }
    std::fs::rename(&unfinished, &arguments.out)
        .with_context(|| format!("cannot write {}", arguments.out.display()))?;
    print(&format!("{}: {summary}\n", arguments.out.display()))?;
    Ok(())
}

fn write_geojson(
    tile: Quadkey,
    path: &Path,
    state: &RegionState,
    now: Timestamp,
) -> anyhow::Result<String> {
    let town = state.town();
    let collection = geojson(&town, &GeographicBounds::of(tile), now);
    let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
    if let Err(error) = serde_json::to_writer(BufWriter::new(file), &collection) {
        bail!("cannot write {}: {error}", path.display());
    }
    Ok(format!(
        "{} cells, {} features",
        town.count_within(&[tile]),
        collection.features.len()
    ))
}
