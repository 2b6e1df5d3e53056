//! A whole cell on this machine: one process for the edge and one for each vehicle, watched from outside.
//!
//! ```text
//! demo ── spawns ──> ecod-node --role edge     (embedded broker on loopback)
//!      ── spawns ──> ecod-node --role cav × n  (each renders, detects, projects, publishes, logs the maps it gets)
//!      ── listens to every report, to tell what each vehicle would have known alone
//! ```

mod observer;
mod process;

use std::collections::BTreeMap;
use std::fs;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use ecod::aggregator::{Aggregator, Fused};
use ecod::names::NodeName;
use ecod::testbed::{Cav, Scene, Testbed};
use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, ReportKind};

pub use self::observer::ObservedReport;
use self::observer::Observer;
use self::process::NodeProcess;
use crate::clock;
use crate::follower::ReceivedMap;
use crate::frame_source::SourceConfig;
use crate::testbed::score::{SceneResult, Score};
use crate::testbed::setup;

/// One scene to be run live.
#[derive(Debug, Clone, Copy)]
pub struct Demo<'a> {
    /// The program that is run as every node.
    pub program: &'a Path,
    /// The scene file, for the vehicles to read.
    pub file: &'a Path,
    /// Camera and placards.
    pub testbed: &'a Testbed,
    /// The scene.
    pub scene: &'a Scene,
    /// How long the maps are judged.
    pub duration: Duration,
    /// Where configurations and logs go.
    pub directory: &'a Path,
}

/// What came of one scene, and what there is to draw.
#[derive(Debug, Clone)]
pub struct DemoResult {
    /// Accuracies.
    pub result: SceneResult,
    /// Maps that at least one vehicle got.
    pub maps: usize,
    /// Maps that a vehicle of the cell did not get.
    pub missed: usize,
    /// Time from the capture of the oldest report in a map to its receipt by a vehicle, median.
    pub median_age: Duration,
    /// The last map.
    pub last_map: Option<GlobalMap>,
    /// The vehicles' reports.
    pub reports: Vec<ObservedReport>,
}

/// How far a running demo is.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Time judged so far.
    pub elapsed: Duration,
    /// Reports seen so far.
    pub reports: usize,
}

/// Time for all nodes to start and see.
const START_TIMEOUT: Duration = Duration::from_secs(20);

/// Time from the first reports of all vehicles to the first map that is judged: the memory of PACE.
const SETTLING: Duration = Duration::from_secs(1);

impl Demo<'_> {
    /// Runs the scene; `progress` is told once a second.
    ///
    /// # Errors
    /// When a node does not start or ends early, `progress` fails, or a file cannot be written; all nodes are stopped in any case.
    pub async fn run(&self, progress: impl Fn(Progress) -> anyhow::Result<()>) -> anyhow::Result<DemoResult> {
        fs::create_dir_all(self.directory).with_context(|| format!("cannot make {}", self.directory.display()))?;
        let broker = free_address()?;
        let mut nodes = vec![self.start_edge(broker)?];
        for cav in &self.scene.cavs {
            nodes.push(self.start_cav(cav, broker)?);
        }
        let observer = Observer::start(broker, setup::unused_name(self.scene, "observer")).await?;
        let outcome = self.watch(&mut nodes, &observer, progress).await;
        for node in nodes.iter_mut().rev() {
            node.stop().await;
        }
        let reports = observer.stop().await;
        let (from, until) = outcome?;
        self.evaluate(reports, from, until)
    }

    /// Waits for reports of all vehicles, then for the time to be judged, and says when that was.
    async fn watch(
        &self,
        nodes: &mut [NodeProcess],
        observer: &Observer,
        progress: impl Fn(Progress) -> anyhow::Result<()>,
    ) -> anyhow::Result<(Timestamp, Timestamp)> {
        let started = clock::now();
        while observer.reporters() < self.scene.cavs.len() {
            if clock::now().since(started) > START_TIMEOUT {
                bail!(
                    "only {} of {} vehicles reported within {START_TIMEOUT:?}",
                    observer.reporters(),
                    self.scene.cavs.len()
                );
            }
            check(nodes)?;
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        tokio::time::sleep(SETTLING).await;
        let from = clock::now();
        while clock::now().since(from) < self.duration {
            tokio::time::sleep(Duration::from_secs(1)).await;
            check(nodes)?;
            progress(Progress { elapsed: clock::now().since(from), reports: observer.reports() })?;
        }
        Ok((from, clock::now()))
    }

    fn evaluate(&self, reports: Vec<ObservedReport>, from: Timestamp, until: Timestamp) -> anyhow::Result<DemoResult> {
        let within = |time: Timestamp| from <= time && time <= until;
        let mut maps: BTreeMap<(u64, u64), GlobalMap> = BTreeMap::new();
        let (mut received, mut ages) = (0, Vec::new());
        for cav in &self.scene.cavs {
            for line in read_map_log(&self.map_log(cav))?.into_iter().filter(|line| within(line.map.fused_at_us)) {
                received += 1;
                ages.extend(line.map.oldest_capture_us.map(|capture| line.received_at.since(capture)));
                maps.insert((line.map.epoch, line.map.round), GlobalMap::clone(&line.map));
            }
        }
        let mut fused = Score::default();
        maps.values().for_each(|map| fused.judge(self.testbed, self.scene, map));
        ages.sort();
        Ok(DemoResult {
            result: SceneResult::new(self.testbed, self.scene, maps.len() as u64, &fused, &self.alone(&reports, from)),
            missed: (maps.len() * self.scene.cavs.len()).saturating_sub(received),
            maps: maps.len(),
            median_age: ages.get(ages.len() / 2).copied().unwrap_or_default(),
            last_map: maps.into_values().next_back(),
            reports,
        })
    }

    /// What every vehicle would have known alone.
    fn alone(&self, reports: &[ObservedReport], from: Timestamp) -> BTreeMap<NodeName, Score> {
        let alone = |cav: &Cav| {
            let landmarks = self.scene.landmarks(&self.testbed.placard);
            let start = reports.first().map_or(from, |observed| observed.received_at);
            let mut aggregator = Aggregator::new(cav.name.clone(), 1, setup::fusion(self.testbed), landmarks, start);
            let mut score = Score::default();
            for observed in reports.iter().filter(|observed| observed.report.node == cav.name) {
                let fused = aggregator.report(ReportKind::Detections, &observed.report, observed.received_at);
                if let Ok(Some(Fused { map: Some(map), .. })) = fused
                    && map.fused_at_us >= from
                {
                    score.judge(self.testbed, self.scene, &map);
                }
            }
            (cav.name.clone(), score)
        };
        self.scene.cavs.iter().map(alone).collect()
    }

    fn start_edge(&self, broker: SocketAddr) -> anyhow::Result<NodeProcess> {
        let mut config = setup::edge(self.testbed, self.scene);
        config.listen = Some(broker);
        NodeProcess::start(self.program, &config, self.directory)
    }

    fn start_cav(&self, cav: &Cav, broker: SocketAddr) -> anyhow::Result<NodeProcess> {
        let source = SourceConfig::Testbed {
            scenes: self.file.into(),
            scene: self.scene.name.clone(),
            cav: cav.name.clone(),
            seed: 1,
        };
        let mut config = setup::cav(self.testbed, self.scene, cav, source);
        config.mqtt.broker = Some(broker.into());
        let log = self.map_log(cav);
        if log.exists() {
            fs::remove_file(&log).with_context(|| format!("cannot remove {}", log.display()))?;
        }
        config.map_log = Some(log);
        NodeProcess::start(self.program, &config, self.directory)
    }

    fn map_log(&self, cav: &Cav) -> PathBuf {
        self.directory.join(format!("{}.maps.jsonl", cav.name))
    }
}

/// A port that nothing listens on now.
fn free_address() -> anyhow::Result<SocketAddr> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).context("no free port on loopback")?;
    listener.local_addr().context("no free port on loopback")
}

fn check(nodes: &mut [NodeProcess]) -> anyhow::Result<()> {
    nodes.iter_mut().try_for_each(NodeProcess::check)
}

fn read_map_log(path: &Path) -> anyhow::Result<Vec<ReceivedMap>> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let lines = text.lines().enumerate();
    lines
        .map(|(n, line)| serde_json::from_str(line).with_context(|| format!("{}, line {}", path.display(), n + 1)))
        .collect()
}
