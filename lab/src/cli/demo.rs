//! `ecod-lab demo`: a whole cell on this machine, as separate processes.

use std::fs;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use ecod::model::time::Timestamp;
use ecod_actors::cli::{Failure, print};
use nalgebra::Point2;
use tokio::signal::unix::{SignalKind, signal};

use super::testbed::{Results, check_writable, read, select};
use super::write_json;
use crate::demo::{Demo, DemoResult, JudgedTerm, News};
use crate::node_process::{free_address, node_program};
use crate::testbed::birdseye::birdseye;
use crate::testbed::table::table;
use crate::testbed::{Scene, Testbed};

/// The recorded parking lots that are shown if no others are given.
const RECORDED: &str = include_str!("../../../examples/testbed/pace_setup1.json");

/// Flags of `demo`.
#[derive(Debug, Args)]
pub(super) struct DemoArguments {
    /// Scene file [default: the parking lots of the paper's first setup]
    #[arg(long, value_name = "FILE")]
    scenes: Option<PathBuf>,
    /// Run this scene only
    #[arg(long, value_name = "NAME")]
    scene: Option<String>,
    /// Time for which each scene is judged
    #[arg(long, default_value_t = 15, value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,
    /// Directory for results, pictures, configurations and logs
    #[arg(long, value_name = "DIR", default_value = "demo")]
    out: PathBuf,
}

pub(super) fn run(arguments: &DemoArguments) -> Result<(), Failure> {
    let testbed = match &arguments.scenes {
        Some(file) => read(file),
        None => Testbed::from_json(RECORDED).context("the scenes of this program"),
    };
    let testbed = testbed.map_err(Failure::usage)?;
    let scenes = select(&testbed, arguments.scene.as_deref()).map_err(Failure::usage)?;
    let program = node_program()?;
    let runtime = tokio::runtime::Runtime::new().context("no threads for the demo")?;
    let results_file = arguments.out.join("result.json");
    fs::create_dir_all(&arguments.out).with_context(|| format!("cannot make {}", arguments.out.display()))?;
    check_writable(&results_file)?;
    print(&format!("a cell on this machine: 1 edge, killed half-way, {}\n\n", vehicles(&scenes)))?;
    let dashboard = free_address()?;
    print(&format!("watch it at http://{dashboard}/\n\n"))?;
    let mut results = Vec::with_capacity(scenes.len());
    let count = scenes.len();
    for (index, scene) in scenes.into_iter().enumerate() {
        let directory = arguments.out.join(file_name(&scene.name));
        let demo = Demo {
            program: &program,
            testbed: &testbed,
            scene,
            duration: Duration::from_secs(arguments.seconds),
            directory: &directory,
            dashboard,
        };
        print(&format!("[{}/{count}] {}: starting {} processes\n", index + 1, scene.name, scene.cavs.len() + 1))?;
        let outcome = runtime.block_on(until_signalled(demo.run(|progress| {
            let news = match progress.news {
                News::Reports(reports) => format!("{reports} reports"),
                News::EdgeKilled => "the edge is killed".to_owned(),
                News::EdgeStarted => "the edge is started again".to_owned(),
            };
            print(&format!("        {:4.1} s, {news}\n", progress.elapsed.as_secs_f64()))
        })));
        let outcome = outcome.with_context(|| format!("scene {}", scene.name))?;
        print(&format!(
            "        {} maps, of which vehicles missed {} in all, {:.1} ms from the cameras to a vehicle's map (median)\n",
            outcome.maps,
            outcome.missed,
            outcome.median_age.as_secs_f64() * 1e3,
        ))?;
        print(&leaders(&outcome))?;
        let picture = arguments.out.join(format!("{}.svg", file_name(&scene.name)));
        let svg = birdseye(&testbed, scene, &detections(&outcome), outcome.last_map.as_ref()).context("picture")?;
        fs::write(&picture, svg).with_context(|| format!("cannot write {}", picture.display()))?;
        results.push(outcome.result);
    }
    print(&format!("\n{}\n", table(&results)))?;
    write_json(&results_file, &Results { scenes: &results })?;
    Ok(print(&format!("pictures, results, configurations and logs: {}\n", arguments.out.display()))?)
}

/// Terms of all leaders: times, accuracy, and gap for the vehicles.
fn leaders(outcome: &DemoResult) -> String {
    let line = |term: &JudgedTerm| {
        let since = |time: Timestamp| time.since(outcome.from).as_secs_f64();
        let (leader, from, until) = (&term.epoch.leader, since(term.from), since(term.until));
        let gap = term.gap.map_or_else(String::new, |gap| {
            format!(
                ", first map {} ms after the last one before (for the vehicle that waited longest)",
                gap.as_millis()
            )
        });
        format!(
            "        {leader} led from {from:.1} to {until:.1} s, {:.1} % of the spots right{gap}\n",
            term.score.accuracy_pct()
        )
    };
    outcome.terms.iter().map(line).collect()
}

/// Runs a scene; SIGINT and SIGTERM end it and, with it, its processes.
async fn until_signalled(scene: impl Future<Output = anyhow::Result<DemoResult>>) -> anyhow::Result<DemoResult> {
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    tokio::select! {
        outcome = scene => outcome,
        _ = interrupt.recv() => bail!("interrupted"),
        _ = terminate.recv() => bail!("terminated"),
    }
}

/// A scene's name as the name of a file.
fn file_name(scene: &str) -> String {
    let allowed = |c: char| if c.is_alphanumeric() || c == '-' { c } else { '_' };
    scene.chars().map(allowed).collect()
}

fn vehicles(scenes: &[&Scene]) -> String {
    let most = scenes.iter().map(|scene| scene.cavs.len()).max().unwrap_or(0);
    format!("{most} vehicles that see, report and may lead, {} scenes", scenes.len())
}

/// Where every vehicle placed what it detected.
fn detections(outcome: &DemoResult) -> Vec<(ecod::model::names::NodeName, Point2<f64>)> {
    let placed = |observed: &crate::demo::ObservedReport| {
        let node = observed.report.node.clone();
        observed.report.objects.iter().map(move |o| (node.clone(), Point2::new(o.x_m, o.y_m))).collect::<Vec<_>>()
    };
    outcome.reports.iter().flat_map(placed).collect()
}
