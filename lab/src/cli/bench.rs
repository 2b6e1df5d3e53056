//! `ecod-lab bench`: latency, capacity and costs of a live cell.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use clap::Args;
use ecod::model::names::NodeName;
use ecod::vote::VoteMode;
use ecod_actors::cli::{Failure, print};
use ecod_actors::node::config::NodeConfig;
use ecod_actors::transport::mqtt::BrokerAddress;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use serde::Serialize;
use serde_json::{Map, Value, json};
use tokio::signal::unix::{SignalKind, signal};

use super::columns::columns;
use crate::bench::access::BrokerAccess;
use crate::bench::aggregator::OwnAggregator;
use crate::bench::doors::DoorFigures;
use crate::bench::latency::{Answers, Latencies, Quantiles};
use crate::bench::load::Load;
use crate::bench::measurement::{BenchFigure, measure};
use crate::bench::page;
use crate::bench::saturation::{self, AggregatorShares, Saturation, Step};
use crate::bench::target::Target;
use crate::node_process::node_program;

/// Flags of `bench`.
#[derive(Debug, Args)]
pub(super) struct BenchArguments {
    /// Numbers of simulated vehicles, each with ten reports a second
    #[arg(long, value_delimiter = ',', default_value = "4,32", value_parser = clap::value_parser!(u16).range(1..=1000))]
    cavs: Vec<u16>,
    /// Seconds for which each number of vehicles is measured
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=3600))]
    seconds: u64,
    /// Milliseconds over which the vehicles of a round spread their reports; with 0 they report at
    /// once
    #[arg(long, value_name = "MS", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..50))]
    spread_ms: u64,
    /// Broker of a running cell to be measured; without it the program starts its own aggregator on
    /// loopback
    #[arg(long, value_name = "HOST:PORT")]
    connect: Option<BrokerAddress>,
    /// Configuration of a node of the running cell: its broker, its name, its locations
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of the running cell
    #[arg(long)]
    cell: Option<NodeName>,
    /// Skip the search for the highest load at which 99 of 100 reports are answered within 100 ms
    #[arg(long)]
    no_saturate: bool,
    /// Most vehicles of that search
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u16).range(4..=1000))]
    up_to: u16,
    /// Measure instead the costs of an own aggregator with 32 vehicles: memory, processor time,
    /// recording
    #[arg(long, conflicts_with_all = ["cavs", "spread_ms", "connect", "config", "cell", "no_saturate", "up_to"])]
    costs: bool,
    /// Measure instead the local broker of a vehicle, compared to the vehicle itself and the
    /// leader's broker; fails if a goal is missed
    #[arg(long, conflicts_with_all = ["cavs", "spread_ms", "connect", "config", "cell", "no_saturate", "up_to", "costs"])]
    doors: bool,
    /// Write the figures to this file as JSON, in the section `cell`, `costs` or `doors`; other
    /// sections stay
    #[arg(short, long = "output", alias = "out", value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Everything that was measured.
#[derive(Debug, Default, Serialize)]
struct Figures {
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    vehicles: BTreeMap<usize, Comparison>,
    goals: BTreeMap<String, Goal>,
    #[serde(skip_serializing_if = "Option::is_none")]
    costs: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    doors: Option<DoorFigures>,
    #[serde(skip_serializing_if = "Option::is_none")]
    saturation: Option<Saturation>,
}

/// Figures of a cell and of the bare path.
#[derive(Debug, Serialize)]
struct Comparison {
    map: Ways,
    #[serde(skip_serializing_if = "Option::is_none")]
    verdict: Option<Ways>,
    report_bytes: usize,
    map_bytes: usize,
    verdict_bytes: usize,
    refused: u64,
    sent_late_us: u128,
}

/// One kind of answer on both paths.
#[derive(Debug, Serialize)]
struct Ways {
    cell: Quantiles,
    bare: Quantiles,
    p50_ratio: f64,
    p99_ratio: f64,
}

/// A figure that must not be exceeded.
#[derive(Debug, Serialize)]
struct Goal {
    figure: f64,
    goal: f64,
    met: bool,
}

/// Maximum ratio of the cell's latency to the latency of the bare path.
const MAX_RATIO: f64 = 1.5;

/// Rounds of a measurement, between which vehicles reconnect.
const PASSES: u64 = 4;

/// Number of vehicles for which the costs are reported.
const COST_VEHICLES: usize = 32;

/// Time for which the vehicles report while a browser shows the page.
const PAGE_TIME: Duration = Duration::from_secs(4);

/// The load at which the search begins.
const SEARCH_FROM: usize = 4;

/// Seconds of one load of the search.
const SEARCH_SPAN: Duration = Duration::from_secs(4);

pub(super) fn run(arguments: &BenchArguments) -> Result<(), Failure> {
    let runtime = tokio::runtime::Runtime::new().context("no threads for the vehicles")?;
    Ok(runtime.block_on(async {
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut terminate = signal(SignalKind::terminate())?;
        tokio::select! {
            outcome = bench(arguments) => outcome,
            _ = interrupt.recv() => bail!("interrupted"),
            _ = terminate.recv() => bail!("terminated"),
        }
    })?)
}

async fn bench(arguments: &BenchArguments) -> anyhow::Result<()> {
    allow_many_connections();
    let mut figures = Figures::default();
    if let Some(target) = arguments.running_cell()? {
        print(&format!(
            "cell {} through the broker at {}\n",
            target.cell, target.access.broker
        ))?;
        compare(&target, arguments, &mut figures).await?;
        saturate(&target, arguments, &mut figures).await?;
    } else if arguments.doors {
        doors(&node_program()?, arguments, &mut figures).await?;
    } else {
        let program = node_program()?;
        print(
            "an aggregator of this program's own with its embedded broker, in a process of its own, on loopback\n",
        )?;
        if arguments.costs {
            costs(&program, arguments, &mut figures).await?;
        } else {
            let mut aggregator = OwnAggregator::start(&program, false).await?;
            compare(aggregator.target()?, arguments, &mut figures).await?;
            saturate(aggregator.target()?, arguments, &mut figures).await?;
            aggregator.stop().await;
        }
    }
    print("\n")?;
    for (name, Goal { figure, goal, met }) in &figures.goals {
        print(&format!(
            "{name}: {figure:.2}, goal {goal}: {}\n",
            if *met { "met" } else { "MISSED" }
        ))?;
    }
    if let Some(path) = &arguments.out {
        save(path, arguments.section(), &figures)?;
    }
    if arguments.doors && figures.goals.values().any(|goal| !goal.met) {
        bail!("a goal of doors is missed");
    }
    Ok(())
}

impl BenchArguments {
    /// Section of the figures.
    fn section(&self) -> &'static str {
        if self.costs {
            "costs"
        } else if self.doors {
            "doors"
        } else {
            "cell"
        }
    }

    /// The running cell to be measured, if one is given.
    fn running_cell(&self) -> anyhow::Result<Option<Target>> {
        let loaded = self
            .config
            .as_deref()
            .map(NodeConfig::load_cell)
            .transpose()?;
        let named = self
            .connect
            .clone()
            .or_else(|| loaded.as_ref()?.mqtt.broker.clone());
        let Some(broker) = named else {
            if loaded.is_some() {
                bail!(
                    "the configuration names no `mqtt.broker`: give --connect HOST:PORT, the aggregator's"
                );
            }
            return Ok(None);
        };
        let config = loaded.unwrap_or_default();
        if !config.fusion.algorithms.pace() {
            bail!("the benchmark needs maps: set `fusion.algorithms` to `pace` or `both`");
        }
        let access = BrokerAccess::of(broker, &config)?;
        // By packets, not every round has verdicts.
        let votes =
            config.fusion.algorithms.vote() && config.fusion.vote.mode == VoteMode::Weighted;
        let cell = self.cell.clone().unwrap_or(config.cell);
        let landmarks = config.landmarks;
        let encoding = config.mqtt.encoding;
        Ok(Some(Target {
            access,
            cell,
            landmarks,
            encoding,
            votes,
            aggregator: None,
        }))
    }
}

/// The cell compared to the bare path, for each number of vehicles.
async fn compare(
    target: &Target,
    arguments: &BenchArguments,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    let spread = Duration::from_millis(arguments.spread_ms);
    let mut rows = vec![row([
        "vehicles",
        "answer",
        "way",
        "p50 µs",
        "p99 µs",
        "p99.9 µs",
        "n",
        "missing",
    ])];
    for vehicles in arguments.cavs.iter().map(|vehicles| usize::from(*vehicles)) {
        let load = Load {
            spread,
            ..Load::new(
                vehicles,
                Duration::from_secs(arguments.seconds) / PASSES as u32,
            )
        };
        let mut cell = Answers::default();
        let mut bare = Answers::default();
        let mut last = None;
        for _ in 0..PASSES {
            let measured = measure(target, load).await?;
            cell.add(&measured.cell);
            bare.add(&measured.bare);
            last = Some(measured);
        }
        let Some(last) = last else { continue };
        let map = Ways::of(&cell.map, &bare.map);
        let verdict = target.votes.then(|| Ways::of(&cell.verdict, &bare.verdict));
        for (answer, ways) in [("map", Some(&map)), ("verdict", verdict.as_ref())] {
            let Some(ways) = ways else { continue };
            ways.add_rows(vehicles, answer, &mut rows);
            figures.goal(
                format!("vehicles_{vehicles}_{answer}_p50_ratio"),
                ways.p50_ratio,
                MAX_RATIO,
            );
            figures.goal(
                format!("vehicles_{vehicles}_{answer}_p99_ratio"),
                ways.p99_ratio,
                MAX_RATIO,
            );
        }
        let BenchFigure {
            report_bytes,
            map_bytes,
            verdict_bytes,
            refused,
            latest,
            ..
        } = last;
        let sent_late_us = latest.as_micros();
        let comparison = Comparison {
            map,
            verdict,
            report_bytes,
            map_bytes,
            verdict_bytes,
            refused,
            sent_late_us,
        };
        figures.vehicles.insert(vehicles, comparison);
    }
    print(&format!("\n{}", columns(&rows)))
}

impl Ways {
    fn of(cell: &Latencies, bare: &Latencies) -> Self {
        let cell = cell.quantiles();
        let bare = bare.quantiles();
        Self {
            cell,
            bare,
            p50_ratio: cell.p50_us / bare.p50_us,
            p99_ratio: cell.p99_us / bare.p99_us,
        }
    }

    fn add_rows(&self, vehicles: usize, answer: &str, rows: &mut Vec<Vec<String>>) {
        for (way, quantiles) in [("cell", self.cell), ("bare", self.bare)] {
            let Quantiles {
                p50_us,
                p99_us,
                p999_us,
                n,
                missing,
            } = quantiles;
            let numbers = [p50_us, p99_us, p999_us].map(|us| format!("{us:.0}"));
            let counts = [n.to_string(), missing.to_string()];
            rows.push(
                [
                    row([&vehicles.to_string(), answer, way]),
                    numbers.to_vec(),
                    counts.to_vec(),
                ]
                .concat(),
            );
        }
        let ratios = [self.p50_ratio, self.p99_ratio].map(|ratio| format!("{ratio:.2}"));
        rows.push(row(["", "", "ratio", &ratios[0], &ratios[1]]));
    }
}

fn row<const N: usize>(cells: [&str; N]) -> Vec<String> {
    cells.map(str::to_owned).to_vec()
}

async fn saturate(
    target: &Target,
    arguments: &BenchArguments,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    if arguments.no_saturate {
        return Ok(());
    }
    print(
        "\nvehicles    map ms p50, p99   verdict ms p50, p99   missing  refused  late ms   map kB  verdict kB  ",
    )?;
    print("broker %  aggregator %  vehicles %\n")?;
    let print_step = |step: &Step| {
        let times = |latency: Option<Quantiles>| {
            let [p50, p99] = [
                latency.map(|latency| latency.p50_us),
                latency.map(|latency| latency.p99_us),
            ]
            .map(in_ms);
            format!("{p50:>9} {p99:>8}")
        };
        let missing = step.map.missing + step.verdict.map_or(0, |verdict| verdict.missing);
        let [map_kb, verdict_kb] =
            [step.map_bytes, step.verdict_bytes].map(|bytes| bytes as f64 / 1000.0);
        let watched = step.shares.aggregator;
        let percent = |part: fn(AggregatorShares) -> f64| {
            watched.map_or("-".into(), |parts| format!("{:.0}", part(parts)))
        };
        let broker = percent(|parts| parts.broker);
        let fusion = percent(|parts| parts.fusion);
        print(&format!(
            "{:>8} {}    {} {missing:>9} {:>8} {:>8.1} {map_kb:>8.1} {verdict_kb:>11.1} {broker:>9} {fusion:>13} {:>11.0}\n",
            step.vehicles,
            times(Some(step.map)),
            times(step.verdict),
            step.refused,
            step.sent_late_ms,
            step.shares.vehicles,
        ))
    };
    let most = usize::from(arguments.up_to);
    let found = saturation::search(target, [SEARCH_FROM, most], SEARCH_SPAN, print_step).await?;
    let carried = found
        .most_vehicles
        .map_or_else(|| "none".to_owned(), |vehicles| vehicles.to_string());
    print(&format!(
        "most vehicles with p99 below {:?}: {carried}\n",
        saturation::LIMIT
    ))?;
    match &found.first_saturated {
        Some(first) => print(&format!("saturated first: {first}\n"))?,
        None => print(&format!("nothing saturated up to {most} vehicles\n"))?,
    }
    figures.saturation = Some(found);
    Ok(())
}

fn in_ms(us: Option<f64>) -> String {
    us.map_or_else(|| "-".to_owned(), |us| format!("{:.2}", us / 1000.0))
}

/// Costs of a node without camera, with the dashboard enabled and unused, and of recording; then
/// the time until a browser shows the first picture.
async fn costs(
    program: &Path,
    arguments: &BenchArguments,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    let load = Load {
        bare: false,
        votes: false,
        ..Load::new(COST_VEHICLES, Duration::from_secs(arguments.seconds))
    };
    let mut usages = Vec::new();
    let mut viewed = None;
    for records in [false, true] {
        let mut aggregator = OwnAggregator::start(program, records).await?;
        let measured = measure(aggregator.target()?, load).await?;
        if !records {
            viewed = Some(page_figures(&mut aggregator).await?);
        }
        aggregator.stop().await;
        usages.push(measured.aggregator.context("the aggregator ended")?);
    }
    let [plain, recording] = &usages[..] else {
        bail!("two nodes were measured")
    };
    let resident_mb = plain.resident_bytes as f64 / 1e6;
    let added = recording.percent() - plain.percent();
    print(&format!(
        "\nan aggregator with {COST_VEHICLES} vehicles: {resident_mb:.1} MB, "
    ))?;
    print(&format!(
        "{:.1} % of a core, recording {added:.1} % more\n",
        plain.percent()
    ))?;
    figures.goal(
        format!("vehicles_{COST_VEHICLES}_resident_mb"),
        resident_mb,
        25.0,
    );
    figures.goal(
        format!("vehicles_{COST_VEHICLES}_cpu_percent"),
        plain.percent(),
        5.0,
    );
    figures.goal(
        format!("vehicles_{COST_VEHICLES}_recording_cpu_percent"),
        added,
        5.0,
    );
    let viewed = viewed.context("the page was not measured")?;
    let page_kb = viewed.bytes as f64 / 1e3;
    let first_picture_ms = viewed.first_picture.as_secs_f64() * 1e3;
    print(&format!(
        "its page: {page_kb:.1} kB uncompressed, first picture after {first_picture_ms:.1} ms\n"
    ))?;
    figures.goal("page_kb".into(), page_kb, 150.0);
    figures.goal("page_first_picture_ms".into(), first_picture_ms, 1000.0);
    figures.costs = Some(json!({
        "vehicles": COST_VEHICLES,
        "page_kb": page_kb,
        "page_first_picture_ms": first_picture_ms,
        "resident_mb": resident_mb,
        "resident_mb_without_files": plain.anonymous_bytes as f64 / 1e6,
        "cpu_percent": plain.percent(),
        "cpu_percent_by_thread": plain.threads,
        "recording_resident_mb": recording.resident_bytes as f64 / 1e6,
        "recording_cpu_percent": recording.percent(),
        "recording_cpu_percent_by_thread": recording.threads,
    }));
    Ok(())
}

/// The local broker of a vehicle: the additional delay for programs, and its cost.
async fn doors(
    program: &Path,
    arguments: &BenchArguments,
    figures: &mut Figures,
) -> anyhow::Result<()> {
    print("an edge and a vehicle with a door, each in a process of its own, on loopback\n\n")?;
    let measured =
        crate::bench::doors::measure(program, Duration::from_secs(arguments.seconds)).await?;
    let mut rows = vec![row(["way", "p50 µs", "p99 µs", "p99.9 µs", "n", "missing"])];
    let ways = [
        ("map at the node -> at its door", measured.behind_node),
        ("report at a door -> map", measured.report_at_door),
        (
            "report at the leader's broker -> map",
            measured.report_at_leader,
        ),
    ];
    for (
        way,
        Quantiles {
            p50_us,
            p99_us,
            p999_us,
            n,
            missing,
        },
    ) in ways
    {
        let numbers = [p50_us, p99_us, p999_us].map(|us| format!("{us:.0}"));
        rows.push(
            [
                row([way]),
                numbers.to_vec(),
                row([&n.to_string(), &missing.to_string()]),
            ]
            .concat(),
        );
    }
    print(&columns(&rows))?;
    let DoorFigures {
        hop_us,
        resident_mb,
        door_mb,
        ..
    } = measured;
    print(&format!(
        "one hop {hop_us:.0} µs; an idle vehicle {resident_mb:.1} MB, of which the door {door_mb:.1} MB\n"
    ))?;
    for (name, figure, goal) in measured.goals() {
        figures.goal(name.into(), figure, goal);
    }
    figures.doors = Some(measured);
    Ok(())
}

/// Figures of the page as a browser gets it while the vehicles report.
async fn page_figures(aggregator: &mut OwnAggregator) -> anyhow::Result<page::PageFigures> {
    let address = aggregator.page();
    let load = Load {
        bare: false,
        ..Load::new(COST_VEHICLES, PAGE_TIME)
    };
    let viewed = async {
        tokio::time::sleep(PAGE_TIME / 2).await;
        page::fetch(address).await
    };
    let (measured, viewed) = tokio::join!(measure(aggregator.target()?, load), viewed);
    measured?;
    viewed
}

impl Figures {
    fn goal(&mut self, name: String, figure: f64, goal: f64) {
        self.goals.insert(
            name,
            Goal {
                figure,
                goal,
                met: figure <= goal,
            },
        );
    }
}

/// Replaces the section and keeps the others. A file that is not understood is kept as it is.
fn save(path: &Path, section: &str, figures: &Figures) -> anyhow::Result<()> {
    let mut sections: Map<String, Value> = match std::fs::read(path) {
        Ok(bytes) => serde_json::from_slice(&bytes)
            .with_context(|| format!("{} has no sections of figures", path.display()))?,
        Err(error) if error.kind() == ErrorKind::NotFound => Map::new(),
        Err(error) => {
            return Err(error).with_context(|| format!("cannot read {}", path.display()));
        }
    };
    sections.insert(section.into(), serde_json::to_value(figures)?);
    super::write_json(path, &sections)
}

/// Every vehicle is a descriptor here and another at the broker, which inherits the limit.
fn allow_many_connections() {
    let raised = getrlimit(Resource::RLIMIT_NOFILE)
        .and_then(|(_, most)| setrlimit(Resource::RLIMIT_NOFILE, most, most));
    if let Err(error) = raised {
        tracing::warn!(%error, "the limit of open files stays");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_sections_and_files_are_kept() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("bench.json");
        save(&path, "cell", &Figures::default()).unwrap();
        save(&path, "costs", &Figures::default()).unwrap();
        let sections: Map<String, Value> =
            serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        assert!(sections.keys().eq(["cell", "costs"]), "{sections:?}");
        std::fs::write(&path, "no figures").unwrap();
        assert!(save(&path, "cell", &Figures::default()).is_err());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "no figures");
    }
}
