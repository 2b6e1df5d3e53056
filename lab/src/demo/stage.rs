//! The processes of a demo: started, watched, the edge killed half-way and started again, and
//! stopped.

use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::Role;
use ecod_actors::messages::newest::ReceivedMap;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::dashboard::DashboardConfig;
use ecod_actors::platform::clock;
use ecod_actors::transport::gossip::MembershipConfig;

use super::report_collector::{ObservedReport, ReportCollector};
use crate::node_process::{NodeProcess, free_address};

/// Progress of a running demo.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Time evaluated so far.
    pub elapsed: Duration,
    /// Event since the last call.
    pub news: News,
}

/// Event of a running demo.
#[derive(Debug, Clone, Copy)]
pub enum News {
    /// Number of reports received so far.
    Reports(usize),
    /// The edge's process was killed.
    EdgeKilled,
    /// The edge's process was started again.
    EdgeStarted,
}

/// Reports and times of a cell that ran.
#[derive(Debug)]
pub(super) struct Played {
    pub(super) reports: Vec<ObservedReport>,
    /// The time to be evaluated.
    pub(super) from: Timestamp,
    pub(super) until: Timestamp,
    pub(super) killed_at: Option<Timestamp>,
}

/// Time for all nodes to start and detect objects.
const START_TIMEOUT: Duration = Duration::from_secs(20);

/// Time for which the edge is gone.
const EDGE_GONE: Duration = Duration::from_secs(1);

/// Time from the first reports of all vehicles to the first map that is evaluated: the memory of
/// PACE.
const SETTLING: Duration = Duration::from_secs(1);

/// Addresses of a node: of its broker, for other nodes, and for poses.
#[derive(Debug, Clone, Copy)]
struct NodeAddresses {
    broker: SocketAddr,
    gossip: SocketAddr,
    poses: SocketAddr,
}

/// Program, directory and addresses of a cell on this machine.
pub(super) struct Stage<'a> {
    program: &'a Path,
    directory: &'a Path,
    addresses: Vec<NodeAddresses>,
}

impl<'a> Stage<'a> {
    /// A stage for a number of nodes; files of an earlier cell are removed from the directory.
    pub(super) fn new(
        program: &'a Path,
        directory: &'a Path,
        nodes: usize,
    ) -> anyhow::Result<Self> {
        fs::create_dir_all(directory)
            .with_context(|| format!("cannot make {}", directory.display()))?;
        let state = directory.join("state");
        if state.exists() {
            fs::remove_dir_all(&state)
                .with_context(|| format!("cannot remove {}", state.display()))?;
        }
        let free = |_| {
            Ok(NodeAddresses {
                broker: free_address()?,
                gossip: free_address()?,
                poses: free_address()?,
            })
        };
        let addresses = (0..nodes).map(free).collect::<anyhow::Result<_>>()?;
        Ok(Self {
            program,
            directory,
            addresses,
        })
    }

    /// Where a node may receive its poses; the edge is number 0.
    pub(super) fn pose_address(&self, node: usize) -> SocketAddr {
        self.addresses[node].poses
    }

    /// Runs the nodes, of which the first is the edge; the others may lead, and the first of them
    /// serves its page at `dashboard`. All are stopped in any case.
    pub(super) async fn play(
        &self,
        configs: Vec<NodeConfig>,
        dashboard: SocketAddr,
        observer: NodeName,
        duration: Duration,
        progress: impl Fn(Progress) -> anyhow::Result<()>,
    ) -> anyhow::Result<Played> {
        let edge = configs
            .first()
            .and_then(|edge| edge.name.clone())
            .context("no edge")?;
        let cell = configs
            .first()
            .map(|edge| edge.cell.clone())
            .context("no cell")?;
        let mut nodes = Vec::with_capacity(configs.len());
        for (index, mut config) in configs.into_iter().enumerate() {
            // The first vehicle's page: the edge is killed half-way.
            config.dashboard = DashboardConfig {
                enabled: index == 1,
                listen: Some(dashboard),
                ..DashboardConfig::default()
            };
            if index > 0 {
                config.role = Role::Auto;
                config.map_log = config.name.as_ref().map(|name| self.map_log_file(name));
            }
            nodes.push(self.start_node(config, index)?);
        }
        let brokers = self
            .addresses
            .iter()
            .map(|node| node.broker.into())
            .collect();
        let collector = ReportCollector::start(cell, brokers, observer).await?;
        let watched = watch(&mut nodes, &collector, &edge, duration, progress).await;
        for node in nodes.iter_mut().rev() {
            node.stop().await;
        }
        let reports = collector.stop().await;
        Ok(Played {
            reports,
            ..watched?
        })
    }

    /// The maps that a vehicle received, in order.
    pub(super) fn map_log(&self, vehicle: &NodeName) -> anyhow::Result<Vec<ReceivedMap>> {
        let path = self.map_log_file(vehicle);
        let text =
            fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let lines = text.lines().enumerate();
        lines
            .map(|(n, line)| {
                serde_json::from_str(line)
                    .with_context(|| format!("{}, line {}", path.display(), n + 1))
            })
            .collect()
    }

    fn map_log_file(&self, vehicle: &NodeName) -> PathBuf {
        self.directory.join(format!("{vehicle}.maps.jsonl"))
    }

    /// Starts a node that finds the others by seeds.
    fn start_node(&self, config: NodeConfig, index: usize) -> anyhow::Result<NodeProcess> {
        if let Some(log) = config.map_log.as_ref().filter(|log| log.exists()) {
            fs::remove_file(log).with_context(|| format!("cannot remove {}", log.display()))?;
        }
        let membership = MembershipConfig {
            bind: Some(self.addresses[index].gossip),
            seeds: self
                .addresses
                .iter()
                .map(|node| node.gossip.to_string())
                .collect(),
            ..config.membership
        };
        let listen = Some(self.addresses[index].broker);
        let state_dir = Some(self.directory.join("state"));
        NodeProcess::start(
            self.program,
            &NodeConfig {
                listen,
                state_dir,
                membership,
                ..config
            },
            self.directory,
        )
    }
}

/// Waits for reports of all vehicles and maps of the edge, then for the evaluated time, during
/// which the edge is killed and restarted. Returns the times of these events.
async fn watch(
    nodes: &mut [NodeProcess],
    collector: &ReportCollector,
    edge: &NodeName,
    duration: Duration,
    progress: impl Fn(Progress) -> anyhow::Result<()>,
) -> anyhow::Result<Played> {
    let started = clock::now();
    let vehicles = nodes.len() - 1;
    while collector.reporters() < vehicles || collector.leader().as_ref() != Some(edge) {
        if clock::now().since(started) > START_TIMEOUT {
            let reporters = collector.reporters();
            let leader = collector
                .leader()
                .map_or_else(|| "no node".to_owned(), |leader| leader.to_string());
            bail!(
                "after {START_TIMEOUT:?} {reporters} of {vehicles} vehicles report and {leader} leads"
            );
        }
        check(nodes)?;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    tokio::time::sleep(SETTLING).await;
    let from = clock::now();
    let mut played = Played {
        reports: Vec::new(),
        from,
        until: from,
        killed_at: None,
    };
    let kill_at = from + duration / 2;
    let restart_at = from + duration / 2 + EDGE_GONE;
    let mut next_progress = from;
    while clock::now().since(from) < duration {
        tokio::time::sleep(Duration::from_millis(50)).await;
        check(nodes)?;
        let now = clock::now();
        let edge = &mut nodes[0];
        let report = |news| {
            progress(Progress {
                elapsed: now.since(from),
                news,
            })
        };
        if played.killed_at.is_none() && now >= kill_at {
            edge.kill().await?;
            played.killed_at = Some(now);
            report(News::EdgeKilled)?;
        } else if edge.is_killed() && now >= restart_at {
            edge.restart()?;
            report(News::EdgeStarted)?;
        } else if now >= next_progress {
            next_progress = now + Duration::from_secs(1);
            report(News::Reports(collector.reports()))?;
        }
    }
    played.until = clock::now();
    Ok(played)
}

fn check(nodes: &mut [NodeProcess]) -> anyhow::Result<()> {
    nodes.iter_mut().try_for_each(NodeProcess::check)
}
