//! `ecod-lab testbed`: the scenes of a file, rendered, detected and fused in virtual time; or a
//! recorded intersection.

mod intersection;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, anyhow};
use clap::Args;
use ecod::model::names::NodeName;
use ecod::wire::{ObjectReport, ReportKind};
use ecod_actors::cli::{Failure, lines, print};
use ecod_actors::platform::bounded_file;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use super::write_json;
use crate::testbed::intersection::line;
use crate::testbed::scene_run::SceneRun;
use crate::testbed::score::SceneResult;
use crate::testbed::table::table;
use crate::testbed::{IntersectionRecording, Scene, Testbed};

/// Flags of `testbed`.
#[derive(Debug, Args)]
pub(super) struct TestbedArguments {
    /// Scene file, such as examples/testbed/pace_setup1.json, or recorded detections, such as
    /// examples/testbed/vote_recording.json
    #[arg(long, value_name = "FILE")]
    pub(super) scenes: PathBuf,
    /// Run this scene only; of recorded detections, `recording` or `generated`
    #[arg(long, value_name = "NAME")]
    pub(super) scene: Option<String>,
    /// Fused maps to evaluate in each scene
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    verdicts: u64,
    /// Seed of everything that varies from frame to frame
    #[arg(long, default_value_t = 1)]
    pub(super) seed: u64,
    /// Scenes to generate from recorded detections
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u64).range(..=100_000))]
    pub(super) generated: u64,
    /// Frames in each generated scene
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u16).range(1..))]
    pub(super) frames: u16,
    /// Write the vehicles' reports to this file, as `replay` reads them; parking lots also need
    /// `--scene`
    #[arg(long, value_name = "FILE")]
    pub(super) reports: Option<PathBuf>,
    /// Fail if fewer spots than this percentage are right in any scene, fused; of recorded
    /// detections, fewer verdicts of the recording, or of the generated scenes if only they are
    /// chosen
    #[arg(long, value_name = "PCT", value_parser = percent)]
    pub(super) at_least: Option<f64>,
    /// The same limit for the occupied spots alone; default: the value of `--at-least`
    #[arg(long, value_name = "PCT", value_parser = percent)]
    pub(super) occupied_at_least: Option<f64>,
    /// Write the results to this file (JSON)
    #[arg(short, long = "output", alias = "out", value_name = "FILE")]
    pub(super) out: Option<PathBuf>,
}

/// The file of `--output`.
#[derive(Serialize)]
pub(super) struct Results<'a, T = SceneResult> {
    pub(super) scenes: &'a [T],
}

fn percent(text: &str) -> Result<f64, String> {
    let percent = text
        .parse()
        .ok()
        .filter(|percent| (0.0..=100.0).contains(percent));
    percent.ok_or_else(|| "must be a number from 0 to 100".to_owned())
}

pub(super) fn run(arguments: &TestbedArguments) -> Result<(), Failure> {
    let text = read_text(&arguments.scenes).map_err(Failure::usage)?;
    if let Some(out) = &arguments.out {
        lines::check_apart(out, &[&arguments.scenes]).map_err(Failure::usage)?;
    }
    if serde_json::from_str(&text).is_ok_and(|file| IntersectionRecording::is_recording(&file)) {
        return intersection::run(arguments, &text);
    }
    if arguments.reports.is_some() && arguments.scene.is_none() {
        return Err(Failure::usage(anyhow!(
            "--reports holds the reports of one parking lot: name it by --scene"
        )));
    }
    let testbed = read(&arguments.scenes).map_err(Failure::usage)?;
    let scenes = select(&testbed, arguments.scene.as_deref()).map_err(Failure::usage)?;
    if let Some(out) = &arguments.out {
        check_writable(out)?;
    }
    let total = scenes.len();
    let mut results: Vec<SceneResult> = Vec::with_capacity(total);
    let start = Instant::now();
    for scene in scenes {
        let scene_run = SceneRun {
            testbed: &testbed,
            scene,
            verdicts: arguments.verdicts,
            seed: arguments.seed,
        };
        let frames = scene_run.frames_per_verdict() * arguments.verdicts * scene.cavs.len() as u64;
        let bar = progress(frames, &scene.name);
        let reports = scene_run
            .reports(&|| bar.inc(1))
            .with_context(|| format!("scene {}", scene.name))?;
        if let Some(file) = &arguments.reports {
            write_reports(file, &reports)?;
        }
        results.push(scene_run.run(&reports));
        bar.finish_and_clear();
        if let Some(result) = results.last().filter(|_| total > 1) {
            let left = start.elapsed() / results.len() as u32 * (total - results.len()) as u32;
            eprintln!(
                "{}: {:.2} % right; {} of {total} scenes done, about {} s left",
                result.name,
                result.pace_accuracy_pct,
                results.len(),
                left.as_secs()
            );
        }
        // After each scene: finished results are kept, even if a later scene fails.
        if let Some(out) = &arguments.out {
            write_json(out, &Results { scenes: &results })?;
        }
    }
    print(&table(&results).to_string())?;
    let least = arguments.at_least.unwrap_or(0.0);
    let least_occupied = arguments.occupied_at_least.unwrap_or(least);
    for scene in &results {
        if scene.pace_accuracy_pct < least {
            return Err(anyhow!(
                "scene {}: fewer than {least} % of the spots are right",
                scene.name
            )
            .into());
        }
        if scene.occupied_accuracy_pct.unwrap_or(100.0) < least_occupied {
            let name = &scene.name;
            return Err(anyhow!(
                "scene {name}: fewer than {least_occupied} % of the occupied spots are right"
            )
            .into());
        }
    }
    Ok(())
}

/// Writes the reports of all vehicles in the order of capture.
fn write_reports(
    path: &Path,
    reports: &BTreeMap<NodeName, Vec<ObjectReport>>,
) -> anyhow::Result<()> {
    let mut reports: Vec<_> = reports.values().flatten().collect();
    reports.sort_by_key(|report| report.captured_at_us);
    let mut text = String::new();
    for report in reports {
        text += &line(report, ReportKind::Detections)?;
        text.push('\n');
    }
    fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// Reads a scene file.
pub(super) fn read(path: &Path) -> anyhow::Result<Testbed> {
    Testbed::from_json(&read_text(path)?).with_context(|| format!("scenes {}", path.display()))
}

fn read_text(path: &Path) -> anyhow::Result<String> {
    bounded_file::read_text(path).with_context(|| format!("cannot read scenes {}", path.display()))
}

/// The named scene, or all.
pub(super) fn select<'a>(
    testbed: &'a Testbed,
    name: Option<&str>,
) -> anyhow::Result<Vec<&'a Scene>> {
    let Some(name) = name else {
        return Ok(testbed.scenes.iter().collect());
    };
    let known = || {
        testbed
            .scenes
            .iter()
            .map(|scene| scene.name.as_str())
            .collect::<Vec<_>>()
            .join(", ")
    };
    Ok(vec![testbed.scene(name).with_context(|| {
        format!("no scene {name:?}; there are {}", known())
    })?])
}

/// Checks before a long run that its results can be written; leaves no file behind.
pub(super) fn check_writable(path: &Path) -> anyhow::Result<()> {
    let was_there = path.exists();
    let opened = fs::File::options()
        .create(true)
        .append(true)
        .open(path)
        .map(drop);
    let checked = opened.and_then(|()| {
        if was_there {
            Ok(())
        } else {
            fs::remove_file(path)
        }
    });
    checked.with_context(|| format!("cannot write {}", path.display()))
}

fn progress(frames: u64, scene: &str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg:16} {bar:40} {pos}/{len} frames, {eta} left");
    let bar = ProgressBar::new(frames).with_message(scene.to_owned());
    style.map_or_else(|_| bar.clone(), |style| bar.clone().with_style(style))
}
