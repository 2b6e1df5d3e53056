//! A whole cell on this machine: one process for the edge and one for each vehicle, watched from outside.
//!
//! ```text
//! demo ── spawns ──> ecod-node --role edge
//!      ── spawns ──> ecod-node --role auto × n  (each plays rendered frames, detects, projects, publishes, logs the maps it gets)
//!      ── listens to every report on all brokers, to tell what each vehicle would have known alone
//!      ── kills the edge half-way and starts it again a second later
//! ```

mod judged_term;
mod report_collector;

use std::collections::BTreeMap;
use std::fs;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use ecod::aggregator::{Aggregator, Fused};
use ecod::model::epoch::Epoch;
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{GlobalMap, ReportKind, Role};
use ecod_actors::camera::frame_source::SourceConfig;
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::platform::clock;
use ecod_actors::transport::gossip::MembershipConfig;

pub use self::judged_term::JudgedTerm;
pub use self::report_collector::ObservedReport;

use self::judged_term::judged_terms;
use self::report_collector::ReportCollector;
use crate::node_process::NodeProcess;
use crate::testbed::score::{SceneResult, SpotScore};
use crate::testbed::{Cav, Scene, Testbed, frames, setup};

/// One scene to be run live.
#[derive(Debug, Clone, Copy)]
pub struct Demo<'a> {
    /// The program that is run as every node.
    pub program: &'a Path,
    /// Camera and placards.
    pub testbed: &'a Testbed,
    /// The scene.
    pub scene: &'a Scene,
    /// Time for which the maps are judged.
    pub duration: Duration,
    /// Where configurations and logs go.
    pub directory: &'a Path,
    /// Where the first vehicle serves its page.
    pub dashboard: SocketAddr,
}

/// Result of one scene, with the data for its drawing.
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
    /// From when on the maps are judged.
    pub from: Timestamp,
    /// Terms of all leaders, in order.
    pub terms: Vec<JudgedTerm>,
}

/// Progress of a running demo.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Time judged so far.
    pub elapsed: Duration,
    /// Event since the last call.
    pub news: News,
}

/// Event of a running demo.
#[derive(Debug, Clone, Copy)]
pub enum News {
    /// So many reports were seen so far.
    Reports(usize),
    /// The edge's process was killed.
    EdgeKilled,
    /// The edge's process was started again.
    EdgeStarted,
}

/// Time for all nodes to start and see.
const START_TIMEOUT: Duration = Duration::from_secs(20);

/// Time for which the edge is gone.
const EDGE_GONE: Duration = Duration::from_secs(1);

/// Where a node listens: its broker, and for other nodes.
#[derive(Debug, Clone, Copy)]
struct NodeAddresses {
    broker: SocketAddr,
    gossip: SocketAddr,
}

/// Time from the first reports of all vehicles to the first map that is judged: the memory of PACE.
const SETTLING: Duration = Duration::from_secs(1);

impl Demo<'_> {
    /// Runs the scene; `progress` is told once a second.
    ///
    /// # Errors
    /// When a node does not start or ends early, `progress` fails, or a file cannot be written; all nodes are stopped in any case.
    pub async fn run(&self, progress: impl Fn(Progress) -> anyhow::Result<()>) -> anyhow::Result<DemoResult> {
        fs::create_dir_all(self.directory).with_context(|| format!("cannot make {}", self.directory.display()))?;
        let state = self.directory.join("state");
        if state.exists() {
            fs::remove_dir_all(&state).with_context(|| format!("cannot remove {}", state.display()))?;
        }
        // Before any node runs: the renderer needs the processor.
        let frames = self.directory.join("frames");
        let render = |cav: &Cav| frames::render(self.testbed, self.scene, cav, 1, &frames.join(cav.name.as_str()));
        let sources = self.scene.cavs.iter().map(render).collect::<anyhow::Result<Vec<_>>>()?;
        let addresses = free_addresses(self.scene.cavs.len() + 1)?;
        let mut nodes = vec![self.start_node(setup::edge(self.testbed, self.scene), &addresses, 0)?];
        for (index, (cav, source)) in self.scene.cavs.iter().zip(sources).enumerate() {
            nodes.push(self.start_cav(cav, source, &addresses, index + 1)?);
        }
        let brokers = addresses.iter().map(|node| node.broker.into()).collect();
        let collector = ReportCollector::start(brokers, setup::unused_name(self.scene, "observer")).await?;
        let outcome = self.watch(&mut nodes, &collector, progress).await;
        for node in nodes.iter_mut().rev() {
            node.stop().await;
        }
        fs::remove_dir_all(&frames).with_context(|| format!("cannot remove {}", frames.display()))?;
        let reports = collector.stop().await;
        let (from, until) = outcome?;
        self.evaluate(reports, from, until)
    }

    /// Waits for reports of all vehicles and maps of the edge, then for the time to be judged, in which the edge is
    /// killed and started again, and says when that was.
    async fn watch(
        &self,
        nodes: &mut [NodeProcess],
        collector: &ReportCollector,
        progress: impl Fn(Progress) -> anyhow::Result<()>,
    ) -> anyhow::Result<(Timestamp, Timestamp)> {
        let started = clock::now();
        let edge = setup::edge(self.testbed, self.scene).name;
        while collector.reporters() < self.scene.cavs.len() || collector.leader() != edge {
            if clock::now().since(started) > START_TIMEOUT {
                let (reporters, leader) = (collector.reporters(), collector.leader());
                let leader = leader.map_or_else(|| "nobody".to_owned(), |leader| leader.to_string());
                let vehicles = self.scene.cavs.len();
                bail!("after {START_TIMEOUT:?} {reporters} of {vehicles} vehicles report and {leader} leads");
            }
            check(nodes)?;
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        tokio::time::sleep(SETTLING).await;
        let from = clock::now();
        let (killed_at, started_at) = (from + self.duration / 2, from + self.duration / 2 + EDGE_GONE);
        let mut next_progress = from;
        while clock::now().since(from) < self.duration {
            tokio::time::sleep(Duration::from_millis(50)).await;
            check(nodes)?;
            let (now, edge) = (clock::now(), &mut nodes[0]);
            let tell = |news| progress(Progress { elapsed: now.since(from), news });
            if edge.starts() == 1 && !edge.is_killed() && now >= killed_at {
                edge.kill().await?;
                tell(News::EdgeKilled)?;
            } else if edge.is_killed() && now >= started_at {
                edge.restart()?;
                tell(News::EdgeStarted)?;
            } else if now >= next_progress {
                next_progress = now + Duration::from_secs(1);
                tell(News::Reports(collector.reports()))?;
            }
        }
        Ok((from, clock::now()))
    }

    fn evaluate(&self, reports: Vec<ObservedReport>, from: Timestamp, until: Timestamp) -> anyhow::Result<DemoResult> {
        let within = |time: Timestamp| from <= time && time <= until;
        let mut maps: BTreeMap<(Epoch, u64), GlobalMap> = BTreeMap::new();
        let (mut ages, mut logs) = (Vec::new(), Vec::new());
        for cav in &self.scene.cavs {
            let mut log = read_map_log(&self.map_log(cav))?;
            log.retain(|line| within(line.map.fused_at_us));
            for line in &log {
                ages.extend(line.map.oldest_capture_us.map(|capture| line.received_at.since(capture)));
                let epoch = Epoch::new(line.map.epoch, line.map.aggregator.clone());
                maps.insert((epoch, line.map.round), GlobalMap::clone(&line.map));
            }
            logs.push(log);
        }
        let received: usize = logs.iter().map(Vec::len).sum();
        let mut fused = SpotScore::default();
        maps.values().for_each(|map| fused.judge(self.testbed, self.scene, map));
        ages.sort();
        Ok(DemoResult {
            result: SceneResult::new(self.testbed, self.scene, maps.len() as u64, &fused, &self.alone(&reports, from)),
            missed: (maps.len() * self.scene.cavs.len()).saturating_sub(received),
            maps: maps.len(),
            median_age: ages.get(ages.len() / 2).copied().unwrap_or_default(),
            last_map: maps.into_values().next_back(),
            reports,
            from,
            terms: judged_terms(self.testbed, self.scene, logs.iter().map(Vec::as_slice)),
        })
    }

    /// Accuracy of every vehicle alone.
    fn alone(&self, reports: &[ObservedReport], from: Timestamp) -> BTreeMap<NodeName, SpotScore> {
        let alone = |cav: &Cav| {
            let landmarks = self.scene.landmarks(&self.testbed.placard);
            let start = reports.first().map_or(from, |observed| observed.received_at);
            let mut aggregator = Aggregator::new(cav.name.clone(), 1, setup::fusion(self.testbed), landmarks, start);
            let mut score = SpotScore::default();
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

    /// Starts a node that finds the others by seeds.
    fn start_node(&self, config: NodeConfig, addresses: &[NodeAddresses], index: usize) -> anyhow::Result<NodeProcess> {
        let membership = MembershipConfig {
            bind: Some(addresses[index].gossip),
            seeds: addresses.iter().map(|node| node.gossip.to_string()).collect(),
            ..config.membership
        };
        let listen = Some(addresses[index].broker);
        let state_dir = Some(self.directory.join("state"));
        NodeProcess::start(self.program, &NodeConfig { listen, state_dir, membership, ..config }, self.directory)
    }

    fn start_cav(
        &self,
        cav: &Cav,
        source: SourceConfig,
        addresses: &[NodeAddresses],
        index: usize,
    ) -> anyhow::Result<NodeProcess> {
        let mut config = setup::cav(self.testbed, self.scene, cav, source);
        config.role = Role::Auto;
        // The first vehicle's: the edge is killed half-way.
        config.dashboard.enabled = index == 1;
        config.dashboard.listen = Some(self.dashboard);
        let log = self.map_log(cav);
        if log.exists() {
            fs::remove_file(&log).with_context(|| format!("cannot remove {}", log.display()))?;
        }
        config.map_log = Some(log);
        self.start_node(config, addresses, index)
    }

    fn map_log(&self, cav: &Cav) -> PathBuf {
        self.directory.join(format!("{}.maps.jsonl", cav.name))
    }
}

/// Addresses on which nothing listens now, no two the same.
fn free_addresses(count: usize) -> anyhow::Result<Vec<NodeAddresses>> {
    let sockets: std::io::Result<Vec<_>> = (0..count)
        .map(|_| Ok((TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?, UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?)))
        .collect();
    let node = |(broker, gossip): &(TcpListener, UdpSocket)| {
        Ok(NodeAddresses { broker: broker.local_addr()?, gossip: gossip.local_addr()? })
    };
    sockets.and_then(|sockets| sockets.iter().map(node).collect()).context("no free port on loopback")
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
