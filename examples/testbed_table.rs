//! The table of the recorded testbeds in the manual, from the results of `ecod-lab testbed`.
//!
//! `make testbed`, or `cargo run --example testbed_table -- [--write-table FILE] NAME=RESULTS.json…`

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use ecod_lab::document::write_table;
use serde_json::Value;

const HEADER: &str = "| | scenes | maps, verdicts | VOTE % | PACE % | one answer % | `paper` % | majority % | best alone % |\n\
                      |---|---|---|---|---|---|---|---|---|\n";

/// Fields of a scene that become columns: VOTE, PACE, both together, `paper` mode, majority. Parking
/// lots and intersections name their share in `paper` mode differently.
const SHARES: [&[&str]; 5] = [
    &["vote_accuracy_pct"],
    &["pace_accuracy_pct"],
    &["answer_accuracy_pct"],
    &["paper_accuracy_pct", "vote_paper_accuracy_pct"],
    &["majority_accuracy_pct"],
];

fn main() -> anyhow::Result<()> {
    let mut document = None;
    let mut table = HEADER.to_owned();
    let mut args = std::env::args().skip(1);
    while let Some(argument) = args.next() {
        if argument == "--write-table" {
            let file = args.next().context("--write-table needs a file")?;
            document = Some(PathBuf::from(file));
            continue;
        }
        let Some((name, file)) = argument.split_once('=') else {
            bail!("{argument}: is no NAME=RESULTS.json");
        };
        table += &rows(name, Path::new(file)).with_context(|| file.to_owned())?;
    }
    print!("{table}");
    match document {
        Some(document) => write_table(&document, "testbed", &table),
        None => Ok(()),
    }
}

/// One row for all scenes of a parking lot, or a row for each result of an intersection.
fn rows(name: &str, file: &Path) -> anyhow::Result<String> {
    let results: Value = serde_json::from_slice(&fs::read(file)?)?;
    let scenes = results["scenes"].as_array().context("has no scenes")?;
    let is_intersection = scenes.iter().any(|scene| !scene["scenes"].is_null());
    Ok(if is_intersection {
        let rows = scenes.iter().map(|scene| {
            let kind = scene["name"].as_str().context("a scene has no name")?;
            Ok(row(&format!("{name}, {kind}"), std::slice::from_ref(scene)))
        });
        rows.collect::<anyhow::Result<String>>()?
    } else {
        row(name, scenes)
    })
}

/// Sums of scenes and of their maps or verdicts, and means of the shares over the scenes.
fn row(name: &str, scenes: &[Value]) -> String {
    let counted = |scene: &Value| scene["scenes"].as_u64().unwrap_or(1);
    let count: u64 = scenes.iter().map(counted).sum();
    let maps: u64 = scenes
        .iter()
        .filter_map(|scene| scene["verdicts"].as_u64())
        .sum();
    let shares = SHARES.map(|fields| {
        let share = |scene: &Value| fields.iter().find_map(|field| scene[field].as_f64());
        mean(scenes.iter().map(share))
    });
    let best = mean(scenes.iter().map(best_alone));
    let cells: Vec<String> = shares
        .into_iter()
        .chain([best])
        .map(|share| share.map_or_else(|| "–".to_owned(), |share| format!("{share:.2}")))
        .collect();
    format!("| {name} | {count} | {maps} | {} |\n", cells.join(" | "))
}

/// The share of the vehicle that is right most often without the others.
fn best_alone(scene: &Value) -> Option<f64> {
    let vehicles = scene["single_cav_accuracy_pct"].as_object()?;
    vehicles
        .values()
        .filter_map(Value::as_f64)
        .max_by(f64::total_cmp)
}

/// `None` if a scene has no figure, or there are no scenes.
fn mean(figures: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let count = figures.len();
    let sum: f64 = figures.sum::<Option<f64>>()?;
    (count > 0).then(|| sum / count as f64)
}
