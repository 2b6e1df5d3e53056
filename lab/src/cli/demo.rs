//! `ecod-lab demo`: a whole cell on this machine, as separate processes.

use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use ecod::model::time::Timestamp;
use ecod_actors::cli::{Failure, print};
use nalgebra::Point2;
use serde::Serialize;
use tokio::signal::unix::{SignalKind, signal};

use super::testbed::{check_writable, read, select};
use super::write_json;
use crate::demo::street_demo::{KnownShare, StreetDemo, StreetResult};
use crate::demo::{Demo, DemoResult, JudgedTerm, News, Progress};
use crate::node_process::{free_address, node_program};
use crate::street::Street;
use crate::testbed::{Scene, Testbed};

use crate::testbed::birdseye::birdseye;
use crate::testbed::score::SceneResult;
use crate::testbed::table::table;

/// The recorded parking lots, of which the first is shown if no scene is named.
const RECORDED: &str = include_str!("../../../examples/testbed/pace_setup1.json");

/// Name of the street among the scenes.
const STREET: &str = "street";

/// Explains the demo's words: node, report, leader, map.
const INTRODUCTION: &str = "\
A cell on this machine, each node a process of its own: an edge, and nodes with a camera. Each node detects
objects and reports them. One node, the leader, fuses all reports into one map and sends it to every node.
The edge leads until it is killed half-way; then one of the nodes with a camera leads.

";

/// Flags of `demo`.
#[derive(Debug, Args)]
pub(super) struct DemoArguments {
    /// Scene file of parking lots, all of which are run [default: the street, and the first lot of
    /// the paper's first setup]
    #[arg(long, value_name = "FILE")]
    scenes: Option<PathBuf>,
    /// Run this scene only; `street` is the street
    #[arg(long, value_name = "NAME")]
    scene: Option<String>,
    /// Time for which each scene is evaluated
    #[arg(long, default_value_t = 15, value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,
    /// Directory for results, pictures, configurations and logs
    #[arg(
        short,
        long = "output",
        alias = "out",
        value_name = "DIR",
        default_value = "demo"
    )]
    out: PathBuf,
}

pub(super) fn run(arguments: &DemoArguments) -> Result<(), Failure> {
    let loaded = match &arguments.scenes {
        Some(file) => read(file),
        None => Testbed::from_json(RECORDED).context("the scenes of this program"),
    };
    let testbed = loaded.map_err(Failure::usage)?;
    let (with_street, lots) = match (&arguments.scenes, arguments.scene.as_deref()) {
        (None, None) => (true, testbed.scenes.iter().take(1).collect()),
        (None, Some(STREET)) => (true, Vec::new()),
        (_, name) => (false, select(&testbed, name).map_err(Failure::usage)?),
    };
    let results_file = arguments.out.join("result.json");
    fs::create_dir_all(&arguments.out)
        .with_context(|| format!("cannot make {}", arguments.out.display()))?;
    check_writable(&results_file)?;
    let show = Show {
        program: node_program()?,
        runtime: tokio::runtime::Runtime::new().context("no threads for the demo")?,
        duration: Duration::from_secs(arguments.seconds),
        out: &arguments.out,
        dashboard: free_address()?,
    };
    print(INTRODUCTION)?;
    print(&format!("watch it at http://{}/\n\n", show.dashboard))?;
    let count = lots.len() + usize::from(with_street);
    let street = if with_street {
        print(&format!("[1/{count}] "))?;
        Some(show.street()?)
    } else {
        None
    };
    let mut results = Vec::with_capacity(lots.len());
    for (index, lot) in (1 + usize::from(with_street)..).zip(lots) {
        print(&format!("[{index}/{count}] "))?;
        results.push(show.lot(&testbed, lot)?);
    }
    if let Some(street) = &street {
        print(&format!("\n{}", street_table(street)))?;
    }
    if !results.is_empty() {
        print(&format!("\n{}", table(&results)))?;
    }
    write_json(
        &results_file,
        &DemoResults {
            scenes: &results,
            street,
        },
    )?;
    Ok(print(&format!(
        "\npictures, results, configurations and logs: {}\nnext: a map of your own video, with {} try FILE\n",
        arguments.out.display(),
        show.program.display()
    ))?)
}

/// How all scenes are run.
struct Show<'a> {
    program: PathBuf,
    runtime: tokio::runtime::Runtime,
    duration: Duration,
    out: &'a Path,
    dashboard: SocketAddr,
}

impl Show<'_> {
    fn street(&self) -> anyhow::Result<StreetResult> {
        let cameras = Street::default().cameras.len();
        let processes = cameras + 1;
        print(&format!(
            "{STREET}: starting {processes} processes and {cameras} network cameras\n"
        ))?;
        let directory = self.out.join(STREET);
        let demo = StreetDemo {
            program: &self.program,
            duration: self.duration,
            directory: &directory,
            dashboard: self.dashboard,
        };
        let outcome = self
            .runtime
            .block_on(until_signalled(demo.run(print_progress)))
            .context("the street")?;
        print(&leaders(&outcome.terms, outcome.from, "objects"))?;
        Ok(outcome.result)
    }

    fn lot(&self, testbed: &Testbed, scene: &Scene) -> anyhow::Result<SceneResult> {
        let name = &scene.name;
        let directory = self.out.join(file_name(name));
        let demo = Demo {
            program: &self.program,
            testbed,
            scene,
            duration: self.duration,
            directory: &directory,
            dashboard: self.dashboard,
        };
        print(&format!(
            "{name}: starting {} processes\n",
            scene.cavs.len() + 1
        ))?;
        let outcome = self
            .runtime
            .block_on(until_signalled(demo.run(print_progress)))
            .with_context(|| format!("scene {name}"))?;
        print(&format!(
            "        {} maps, of which vehicles missed {} in all, {:.1} ms from the cameras to a vehicle's map (median)\n",
            outcome.maps,
            outcome.missed,
            outcome.median_age.as_secs_f64() * 1e3,
        ))?;
        print(&leaders(&outcome.terms, outcome.from, "spots"))?;
        let picture = self.out.join(format!("{}.svg", file_name(name)));
        let svg = birdseye(
            testbed,
            scene,
            &detections(&outcome),
            outcome.last_map.as_ref(),
        )
        .context("picture")?;
        fs::write(&picture, svg).with_context(|| format!("cannot write {}", picture.display()))?;
        Ok(outcome.result)
    }
}

/// The file of results.
#[derive(Serialize)]
struct DemoResults<'a> {
    scenes: &'a [SceneResult],
    #[serde(skip_serializing_if = "Option::is_none")]
    street: Option<StreetResult>,
}

fn print_progress(progress: Progress) -> anyhow::Result<()> {
    let news = match progress.news {
        News::Reports(reports) => format!("{reports} reports"),
        News::EdgeKilled => "the edge is killed".to_owned(),
        News::EdgeStarted => "the edge is started again".to_owned(),
    };
    print(&format!(
        "        {:4.1} s, {news}\n",
        progress.elapsed.as_secs_f64()
    ))
}

/// Terms of all leaders: times, accuracy, and gap for the vehicles.
fn leaders(terms: &[JudgedTerm], start: Timestamp, judged: &str) -> String {
    let line = |term: &JudgedTerm| {
        let since = |time: Timestamp| time.since(start).as_secs_f64();
        let leader = &term.epoch.leader;
        let from = since(term.from);
        let until = since(term.until);
        let gap = term.gap.map_or_else(String::new, |gap| {
            format!(
                ", first map {} ms after the last one before (for the vehicle that waited longest)",
                gap.as_millis()
            )
        });
        format!(
            "        {leader} led from {from:.1} to {until:.1} s, {:.1} % of the {judged} right{gap}\n",
            term.right_pct
        )
    };
    terms.iter().map(line).collect()
}

/// Table of each node's knowledge of the street, alone and with the cell.
fn street_table(street: &StreetResult) -> String {
    let columns = |known: &KnownShare| {
        format!(
            "{:5.1} {:8.1} % {:7.1} %",
            known.known, known.precision_pct, known.recall_pct
        )
    };
    let rows = street
        .alone
        .iter()
        .zip(street.with_cell.values())
        .map(|((node, alone), cell)| format!("{node:<8}{}   {}\n", columns(alone), columns(cell)));
    let hidden = street.seen_only_by.iter().map(|(node, people)| {
        format!("people who were seen only by {node} for a while: {people}\n")
    });
    let failover = match (&street.took_over, street.failover_gap_ms) {
        (Some(leader), Some(gap)) => {
            format!("{leader} led after it, first map {gap} ms after the last one before")
        }
        (Some(leader), None) => format!("{leader} led already"),
        (None, _) => "no node led after it".to_owned(),
    };
    format!(
        "street: {} cars and people; known: found within 2 m, on average; precision: share of a node's objects that are real;\nrecall: share of the real objects that it has\n{:<8}{:^26}   {:^26}\n{:<8}{}   {}\n{}the edge was killed: {failover}\n{}",
        street.objects,
        "",
        "alone",
        "with the cell",
        "",
        "known  precision    recall",
        "known  precision    recall",
        rows.collect::<String>(),
        hidden.collect::<String>(),
    )
}

/// Runs a scene; SIGINT and SIGTERM end it and, with it, its processes.
async fn until_signalled<T>(scene: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        outcome = scene => outcome,
        _ = interrupt.recv() => bail!("interrupted"),
        _ = terminate.recv() => bail!("terminated"),
    }
}

/// A scene's name as the name of a file.
fn file_name(scene: &str) -> String {
    let allowed = |c: char| {
        if c.is_alphanumeric() || c == '-' {
            c
        } else {
            '_'
        }
    };
    scene.chars().map(allowed).collect()
}

/// Places of all vehicles' detections.
fn detections(outcome: &DemoResult) -> Vec<(ecod::model::names::NodeName, Point2<f64>)> {
    let placed = |observed: &crate::demo::ObservedReport| {
        let node = observed.report.node.clone();
        observed
            .report
            .objects
            .iter()
            .map(move |o| (node.clone(), Point2::new(o.x_m, o.y_m)))
            .collect::<Vec<_>>()
    };
    outcome.reports.iter().flat_map(placed).collect()
}
