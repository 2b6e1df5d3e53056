//! A cell of real processes, one edge and its vehicles, and the faults that a trial causes.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod_actors::platform::clock;
use tempfile::TempDir;

use crate::failover::analysis::{Accepted, NodeRun};
use crate::failover::doors;
use crate::failover::flood::{Flood, FloodCost};
use crate::failover::logs::{self, LoggedTrouble};
use crate::failover::settings::{Addresses, DETECTIONS, addresses, configuration, frame};
use crate::network::{self, Bridged};
use crate::ports::Ports;
use crate::process::{Process, command};

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_ecod-node");

/// Debian's external broker.
const MOSQUITTO: &str = "/usr/sbin/mosquitto";

/// The edge's place in the cell.
pub(crate) const EDGE: usize = 0;

/// Fewest nodes of a cell in which a vehicle may not lead.
const LEAST_WITH_CAV: usize = 5;

/// Time for all processes to start and agree.
const START_TIMEOUT: Duration = Duration::from_secs(60);

/// Time for which all must have been well before a fault.
const SETTLED: Duration = Duration::from_millis(1500);

/// Parts of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Plan {
    /// One edge and vehicles.
    pub(crate) nodes: usize,
    /// True if the edge is started at all.
    pub(crate) edge: bool,
    /// True if all use mosquitto.
    pub(crate) external_broker: bool,
    /// True if programs use the brokers of the nodes.
    pub(crate) fallback: bool,
    /// True if every node has a network namespace.
    pub(crate) bridged: bool,
    /// True if the vehicles vote on their detections.
    pub(crate) votes: bool,
}

/// Running nodes with their files; all end with it.
#[derive(Debug)]
pub(crate) struct Cell {
    nodes: Vec<Node>,
    busy: Vec<Process>,
    flood: Option<(usize, Timestamp, Flood)>,
    mosquitto: Option<Process>,
    network: Option<Bridged>,
    directory: TempDir,
    apart: Vec<usize>,
    unreached: Option<usize>,
    lossy: bool,
}

#[derive(Debug)]
struct Node {
    name: NodeName,
    address: Addresses,
    directory: PathBuf,
    namespace: Option<String>,
    process: Option<Process>,
    door: Option<Process>,
    paused: bool,
    runs: usize,
}

/// True if this node of so many may not lead: the last one, unless the cell is small.
pub(crate) fn is_cav(nodes: usize, index: usize) -> bool {
    nodes >= LEAST_WITH_CAV && index == nodes - 1
}

/// True if there is a mosquitto here.
pub(crate) fn has_mosquitto() -> bool {
    Path::new(MOSQUITTO).exists()
}

impl Cell {
    /// Writes the configurations and starts all processes.
    pub(crate) fn start(plan: &Plan) -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new().prefix("ecod-trial-").tempdir()?;
        let network = plan.bridged.then(|| Bridged::new(plan.nodes)).transpose()?;
        let mut cell = Self {
            nodes: Vec::new(),
            busy: Vec::new(),
            flood: None,
            mosquitto: None,
            network,
            directory,
            apart: Vec::new(),
            unreached: None,
            lossy: false,
        };
        let mut ports = Ports::new();
        let broker = if plan.external_broker {
            Some(cell.start_mosquitto(&mut ports)?)
        } else {
            None
        };
        let frames = cell.directory.path().join("frames");
        fs::create_dir(&frames)?;
        fs::write(frames.join("0.ppm"), frame())?;
        fs::write(cell.directory.path().join("detections.jsonl"), DETECTIONS)?;
        let all = (0..plan.nodes).map(|node| addresses(&mut ports, node, plan.bridged));
        let all = all.collect::<anyhow::Result<Vec<_>>>()?;
        for (index, address) in all.iter().enumerate() {
            let name = if index == EDGE {
                "edge".to_owned()
            } else {
                format!("v{index:02}")
            };
            let home = cell.directory.path().join(&name);
            fs::create_dir(&home)?;
            let text = configuration(
                plan,
                index,
                &name,
                *address,
                &all,
                broker,
                cell.directory.path(),
            );
            fs::write(home.join("node.toml"), text)?;
            cell.nodes.push(Node {
                name: NodeName::new(name)?,
                address: *address,
                directory: home,
                namespace: plan.bridged.then(|| network::namespace(index)),
                process: None,
                door: None,
                paused: false,
                runs: 0,
            });
        }
        for index in (0..plan.nodes).filter(|index| plan.edge || *index != EDGE) {
            cell.nodes[index].start()?;
        }
        Ok(cell)
    }

    /// Waits until all follow one leader, the edge if it runs, and have done so for a while.
    pub(crate) async fn settle(&mut self) -> anyhow::Result<()> {
        self.settle_within(START_TIMEOUT).await
    }

    /// Waits like [`Self::settle`], for at most this time.
    pub(crate) async fn settle_within(&mut self, limit: Duration) -> anyhow::Result<()> {
        let started = Instant::now();
        let mut well_since: Option<Instant> = None;
        loop {
            match self.disagreement()? {
                None if well_since.is_some_and(|since| since.elapsed() > SETTLED) => return Ok(()),
                None => well_since = well_since.or(Some(Instant::now())),
                Some(why) => {
                    well_since = None;
                    ensure!(started.elapsed() < limit, "the cell does not settle: {why}");
                }
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }

    /// Puts a client at the broker of every node that runs, and waits until each has a map.
    pub(crate) async fn open_doors(&mut self) -> anyhow::Result<()> {
        for node in self.nodes.iter_mut().filter(|node| node.process.is_some()) {
            let log = node.door_log();
            node.door = Some(doors::open(
                (Ipv4Addr::LOCALHOST, node.address.broker.port()).into(),
                node.namespace.as_deref(),
                &log,
            )?);
        }
        let started = Instant::now();
        for node in self.nodes.iter().filter(|node| node.door.is_some()) {
            while logs::at_door(&node.door_log())?.is_empty() {
                ensure!(
                    started.elapsed() < START_TIMEOUT,
                    "the client at {} receives no map",
                    node.name
                );
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        }
        Ok(())
    }

    /// Maps of the client at each door.
    pub(crate) fn doors(&self) -> anyhow::Result<Vec<NodeRun>> {
        let opened = self.nodes.iter().filter(|node| node.door.is_some());
        opened
            .map(|node| {
                Ok(NodeRun {
                    node: node.name.clone(),
                    accepted: logs::at_door(&node.door_log())?,
                })
            })
            .collect()
    }

    /// The reason for which the cell is not well yet.
    fn disagreement(&mut self) -> anyhow::Result<Option<String>> {
        let mut leaders = BTreeSet::new();
        for node in &mut self.nodes {
            let Some(process) = &mut node.process else {
                continue;
            };
            if let Some(status) = process.ended()? {
                bail!("{} ended with {status}: {}", node.name, node.last_words());
            }
            match logs::last_accepted(&node.map_log())? {
                Some(map) if clock::now().since(map.at) < Duration::from_millis(400) => {
                    leaders.insert(map.epoch)
                }
                _ => return Ok(Some(format!("{} gets no maps", node.name))),
            };
        }
        let edge = &self.nodes[EDGE];
        let wanted = edge.process.as_ref().map(|_| &edge.name);
        Ok(match leaders.first() {
            Some(leader)
                if leaders.len() == 1 && wanted.is_none_or(|edge| *edge == leader.leader) =>
            {
                None
            }
            _ => Some(format!("leaders are {leaders:?}")),
        })
    }

    pub(crate) fn kill(&mut self, node: usize) -> anyhow::Result<()> {
        let process = self.nodes[node]
            .process
            .take()
            .context("the process does not run")?;
        process.kill()
    }

    /// Starts a killed node again, with its files.
    pub(crate) fn restart(&mut self, node: usize) -> anyhow::Result<()> {
        self.nodes[node].start()
    }

    pub(crate) fn pause(&mut self, node: usize, paused: bool) -> anyhow::Result<()> {
        let node = &mut self.nodes[node];
        let process = node.process.as_ref().context("the process does not run")?;
        node.paused = paused;
        if paused {
            process.pause()
        } else {
            process.resume()
        }
    }

    pub(crate) fn kill_mosquitto(&mut self) -> anyhow::Result<()> {
        self.mosquitto
            .take()
            .context("there is no external broker")?
            .kill()
    }

    /// Starts or ends so many processes that only compute.
    pub(crate) fn busy(&mut self, loops: usize) -> anyhow::Result<()> {
        self.busy.clear();
        let shell = Path::new("/bin/sh");
        for _ in 0..loops {
            self.busy.push(Process::start(
                command(shell, None).args(["-c", "while :; do :; done"]),
            )?);
        }
        Ok(())
    }

    /// Has programs flood a node's door until the cell ends.
    pub(crate) fn flood(&mut self, index: usize) -> anyhow::Result<()> {
        let other = if index == 1 { 2 } else { 1 };
        let [node, other] = [index, other].map(|index| &self.nodes[index]);
        let process = node
            .process
            .as_ref()
            .context("the process does not run")?
            .id();
        let flood = Flood::start(node.address.broker, &node.name, process, &other.name)?;
        self.flood = Some((index, clock::now(), flood));
        Ok(())
    }

    /// The node whose door is flooded.
    pub(crate) fn flooded(&self) -> Option<&NodeName> {
        self.flood
            .as_ref()
            .map(|(index, ..)| &self.nodes[*index].name)
    }

    /// Cost of the flood so far, if there is one.
    pub(crate) fn flood_cost(&self) -> anyhow::Result<Option<FloodCost>> {
        let (Some((_, since, flood)), Some(flooded)) = (&self.flood, self.flooded()) else {
            return Ok(None);
        };
        let (messages, grown_kib) = flood.cost()?;
        let others = self
            .nodes
            .iter()
            .skip(1)
            .filter(|node| node.name != *flooded);
        let unheard = others
            .map(|node| logs::without(&node.map_log(), flooded, *since))
            .sum::<anyhow::Result<_>>()?;
        Ok(Some(FloodCost {
            messages,
            grown_kib,
            unheard,
        }))
    }

    /// Cuts the network in two, the edge being on the larger side, or heals it.
    pub(crate) fn split(&mut self, split: bool) -> anyhow::Result<()> {
        let half = self.nodes.len() - self.nodes.len() / 2;
        self.apart = if split {
            (half..self.nodes.len()).collect()
        } else {
            Vec::new()
        };
        self.bridged()?.split(&self.apart)
    }

    /// The leader's packets do not reach the last vehicle that may lead, or do again. The standby's broker relays the maps.
    pub(crate) fn cut_one_way(&mut self, cut: bool) -> anyhow::Result<()> {
        let last = self.last_candidate().context("the cell has no nodes")?;
        self.unreached = cut.then_some(last);
        self.bridged()?.cut_one_way(EDGE, last, cut)
    }

    /// The last vehicle that may lead.
    pub(crate) fn last_candidate(&self) -> Option<usize> {
        let nodes = self.nodes.len();
        (0..nodes).rfind(|index| !is_cav(nodes, *index))
    }

    /// Gives a node another address.
    pub(crate) fn readdress(&mut self, node: usize) -> anyhow::Result<()> {
        self.bridged()?.readdress(node)
    }

    /// So many percent of all packets are lost from now on.
    pub(crate) fn lose(&mut self, percent: u8) -> anyhow::Result<()> {
        self.lossy = percent > 0;
        self.bridged()?.lose(percent)
    }

    /// The leader, by the last entry of its own log.
    pub(crate) fn leader(&self) -> anyhow::Result<usize> {
        let newest = self.newest()?.context("there are no maps")?;
        self.index(&newest.epoch.leader)
    }

    pub(crate) fn leader_name(&self) -> anyhow::Result<String> {
        Ok(self.nodes[self.leader()?].name.to_string())
    }

    /// Whom the leader has named to follow it.
    pub(crate) fn standby(&self) -> anyhow::Result<usize> {
        let leader = &self.nodes[self.leader()?];
        let standby = logs::standby(&leader.log())?;
        self.index(&standby.with_context(|| format!("{} has named no standby", leader.name))?)
    }

    /// Waits until the leader has named one.
    pub(crate) async fn until_standby(&self) -> anyhow::Result<()> {
        let started = Instant::now();
        while let Err(error) = self.standby() {
            ensure!(started.elapsed() < START_TIMEOUT, error);
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        Ok(())
    }

    /// Groups of nodes that run and reach each other; empty while packets are lost at random.
    pub(crate) fn components(&self) -> Vec<BTreeSet<NodeName>> {
        let runs = |index: &usize| {
            let node = &self.nodes[*index];
            node.process.is_some() && !node.paused && !self.lossy
        };
        let reached =
            (0..self.nodes.len()).filter(|index| runs(index) && self.unreached != Some(*index));
        let (apart, together): (Vec<_>, Vec<_>) =
            reached.partition(|index| self.apart.contains(index));
        let names = |side: Vec<usize>| {
            side.into_iter()
                .map(|index| self.nodes[index].name.clone())
                .collect()
        };
        [together, apart]
            .into_iter()
            .filter(|side| !side.is_empty())
            .map(names)
            .collect()
    }

    /// The running vehicles, without the edge that serves them.
    pub(crate) fn vehicles(&self) -> BTreeSet<NodeName> {
        let vehicles = self
            .nodes
            .iter()
            .skip(1)
            .filter(|node| node.process.is_some());
        vehicles.map(|node| node.name.clone()).collect()
    }

    /// Where the nodes' brokers listen.
    pub(crate) fn brokers(&self) -> Vec<SocketAddr> {
        self.nodes.iter().map(|node| node.address.broker).collect()
    }

    /// Where the nodes gossip.
    pub(crate) fn gossips(&self) -> Vec<SocketAddr> {
        self.nodes.iter().map(|node| node.address.gossip).collect()
    }

    /// Number of nodes, running or not.
    pub(crate) fn nodes(&self) -> usize {
        self.nodes.len()
    }

    /// The running processes: node and run, and number.
    pub(crate) fn processes(&self) -> Vec<(String, u32)> {
        let process = |node: &Node| {
            Some((
                format!("{}, run {}", node.name, node.runs),
                node.process.as_ref()?.id(),
            ))
        };
        self.nodes.iter().filter_map(process).collect()
    }

    /// Maps that every run of every process accepted.
    pub(crate) fn runs(&self) -> anyhow::Result<Vec<NodeRun>> {
        let runs = self
            .nodes
            .iter()
            .flat_map(|node| (1..=node.runs).map(move |run| (node, run)));
        let read = |(node, run): (&Node, usize)| {
            Ok(NodeRun {
                node: node.name.clone(),
                accepted: logs::accepted(&node.map_log_of(run))?,
            })
        };
        runs.map(read).collect()
    }

    /// The troubles in the logs of all nodes, by node.
    pub(crate) fn troubles(&self) -> anyhow::Result<BTreeMap<NodeName, Vec<LoggedTrouble>>> {
        let read = |node: &Node| Ok((node.name.clone(), logs::troubles(&node.log())?));
        self.nodes.iter().map(read).collect()
    }

    /// Names of nodes.
    pub(crate) fn names(&self, nodes: &[usize]) -> BTreeSet<NodeName> {
        nodes
            .iter()
            .filter_map(|node| Some(self.nodes.get(*node)?.name.clone()))
            .collect()
    }

    /// Keeps configurations and logs, and prints their directory.
    pub(crate) fn keep_files(self) -> PathBuf {
        let Self { directory, .. } = self;
        directory.keep()
    }

    fn newest(&self) -> anyhow::Result<Option<Accepted>> {
        let running = self.nodes.iter().filter(|node| node.process.is_some());
        let maps = running
            .map(|node| logs::last_accepted(&node.map_log()))
            .collect::<anyhow::Result<Vec<_>>>()?;
        Ok(maps.into_iter().flatten().max_by_key(|map| map.at))
    }

    fn index(&self, name: &NodeName) -> anyhow::Result<usize> {
        let index = self.nodes.iter().position(|node| node.name == *name);
        index.with_context(|| format!("{name} is no node of the cell"))
    }

    fn bridged(&self) -> anyhow::Result<&Bridged> {
        self.network.as_ref().context("the cell is on loopback")
    }

    fn start_mosquitto(&mut self, ports: &mut Ports) -> anyhow::Result<SocketAddr> {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, ports.free()?));
        let file = self.directory.path().join("mosquitto.conf");
        let listener = format!("listener {} {}", address.port(), address.ip());
        fs::write(
            &file,
            format!("{listener}\nuser root\nset_tcp_nodelay true\nallow_anonymous true\n"),
        )?;
        self.mosquitto = Some(Process::start(
            command(Path::new(MOSQUITTO), None).arg("-c").arg(file),
        )?);
        Ok(address)
    }
}

impl Node {
    fn start(&mut self) -> anyhow::Result<()> {
        self.runs += 1;
        let log = File::options().create(true).append(true).open(self.log())?;
        let mut command: Command = command(Path::new(PROGRAM), self.namespace.as_deref());
        command.env_clear().envs(
            std::env::vars_os().filter(|(key, _)| !key.to_string_lossy().starts_with("ECOD_")),
        );
        command
            .args(["--log-format", "text", "--config"])
            .arg(self.directory.join("node.toml"))
            .arg("--map-log")
            .arg(self.map_log());
        self.process = Some(Process::start(
            command.stderr(log).current_dir(&self.directory),
        )?);
        Ok(())
    }

    fn log(&self) -> PathBuf {
        self.directory.join("node.log")
    }

    fn door_log(&self) -> PathBuf {
        self.directory.join("door.log")
    }

    fn map_log(&self) -> PathBuf {
        self.map_log_of(self.runs)
    }

    fn map_log_of(&self, run: usize) -> PathBuf {
        self.directory.join(format!("maps.{run}.jsonl"))
    }

    fn last_words(&self) -> String {
        let text = fs::read_to_string(self.log()).unwrap_or_default();
        text.lines().last().unwrap_or("no log").to_owned()
    }
}
