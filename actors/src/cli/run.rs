//! `ecod-node --role …`: one node of a cell.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use ecod::model::names::NodeName;
#[cfg(feature = "camera")]
use ecod::wire::Role;
use serde::Serialize;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::oneshot;

use super::{Failure, print};
use crate::node;
use crate::node::config::NodeConfig;
use crate::node::service::ServiceManager;
use crate::transport::mqtt::BrokerAddress;
use crate::transport::pki::OBSERVER_MARK;

/// Flags of a node; each overrides the key of its name in the configuration file.
#[derive(Debug, Default, Args, Serialize)]
pub struct RunArguments {
    /// Who leads: `edge` whenever it is there, `auto` if no better candidate is, `cav` never
    #[arg(long, value_parser = ["auto", "cav", "edge"])]
    #[serde(skip_serializing_if = "Option::is_none")]
    role: Option<String>,
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    config: Option<PathBuf>,
    /// Name of the node, unique in its cell
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<NodeName>,
    /// Name of the cell
    #[arg(long)]
    #[serde(skip_serializing_if = "Option::is_none")]
    cell: Option<NodeName>,
    /// Where the embedded broker of a node that may lead listens
    #[arg(long, value_name = "IP:PORT", value_parser = ip_and_port)]
    #[serde(skip_serializing_if = "Option::is_none")]
    listen: Option<SocketAddr>,
    /// An external broker for all data; without one the nodes' own are used
    #[arg(long, value_name = "HOST:PORT")]
    #[serde(skip)]
    broker: Option<BrokerAddress>,
    /// A node to ask for the cell; may be given several times
    #[arg(long = "seed", value_name = "HOST:PORT")]
    #[serde(skip)]
    seeds: Vec<String>,
    /// Directory for what survives a restart
    #[arg(long, value_name = "DIR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    state_dir: Option<PathBuf>,
    /// Append every accepted map and its time of receipt to this file, one JSON object a line
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    map_log: Option<PathBuf>,
    /// Where the web page with the cell, metrics and health is served: 127.0.0.1:8080 if nothing is said, or a free
    /// port if that is taken; other addresses than loopback need `dashboard.token`
    #[arg(long, value_name = "IP:PORT", value_parser = ip_and_port, num_args = 0..=1)]
    #[serde(skip)]
    dashboard: Option<Option<SocketAddr>>,
    /// Serve neither page nor metrics nor health
    #[arg(long, conflicts_with = "dashboard")]
    #[serde(skip)]
    no_dashboard: bool,
    /// Record in this directory (MCAP); the table `record` of the configuration file has more
    #[arg(long, value_name = "DIR")]
    #[serde(skip_serializing_if = "Option::is_none")]
    record: Option<PathBuf>,
    /// Print the configuration that results from file, environment and flags, and exit
    #[arg(long)]
    #[serde(skip)]
    print_config: bool,
    /// Stop when standard input ends, as it does when the process that started the node is gone
    #[arg(long, hide = true)]
    #[serde(skip)]
    stop_at_eof: bool,
}

fn ip_and_port(text: &str) -> Result<SocketAddr, &'static str> {
    text.parse().map_err(|_| "must be an IP address and a port, such as 0.0.0.0:1883")
}

/// Flags as they are laid over the configuration.
#[derive(Serialize)]
struct Overrides<'a> {
    #[serde(flatten)]
    top: &'a RunArguments,
    #[serde(skip_serializing_if = "Option::is_none")]
    mqtt: Option<MqttOverrides<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    membership: Option<MembershipOverrides<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    dashboard: Option<DashboardOverrides>,
}

#[derive(Serialize)]
struct MqttOverrides<'a> {
    broker: &'a BrokerAddress,
}

#[derive(Serialize)]
struct MembershipOverrides<'a> {
    seeds: &'a [String],
}

#[derive(Serialize)]
struct DashboardOverrides {
    enabled: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    listen: Option<SocketAddr>,
}

pub(super) fn run(arguments: &RunArguments) -> Result<(), Failure> {
    let config = arguments.load()?;
    if arguments.print_config {
        return Ok(print(&config.to_toml().context("the configuration cannot be written as TOML")?)?);
    }
    run_node(config, arguments.stop_at_eof)
}

/// Runs a node until it is told to stop or gives up.
pub(super) fn run_node(config: NodeConfig, stop_at_eof: bool) -> Result<(), Failure> {
    let runtime = tokio::runtime::Runtime::new().context("no threads for the node")?;
    let served = runtime.block_on(serve(config, stop_at_eof));
    // A detector may be busy for good; whoever restarts the node must not wait for it.
    runtime.shutdown_timeout(SHUTDOWN_TIMEOUT);
    #[cfg(feature = "camera")]
    crate::camera::frame_source::capture::wait_for_readers(SHUTDOWN_TIMEOUT);
    Ok(served?)
}

impl RunArguments {
    /// The configuration that results from file, environment and flags.
    fn load(&self) -> Result<NodeConfig, Failure> {
        let mqtt = self.broker.as_ref().map(|broker| MqttOverrides { broker });
        let seeds = (!self.seeds.is_empty()).then_some(&*self.seeds);
        let membership = seeds.map(|seeds| MembershipOverrides { seeds });
        let wanted = self.dashboard.map(|listen| DashboardOverrides { enabled: true, listen });
        let dashboard =
            if self.no_dashboard { Some(DashboardOverrides { enabled: false, listen: None }) } else { wanted };
        let overrides = Overrides { top: self, mqtt, membership, dashboard };
        NodeConfig::load(self.config.as_deref(), &overrides).map_err(Failure::usage)
    }
}

/// How long the threads of a stopped node may take to end.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// Runs the node until SIGINT or SIGTERM.
async fn serve(config: NodeConfig, stop_at_eof: bool) -> anyhow::Result<()> {
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    #[cfg(feature = "camera")]
    if config.role == Role::Cav && config.camera.is_none() && config.record.is_none() {
        tracing::warn!("no [camera] is configured: this vehicle reports nothing, it only follows");
    }
    let mut node = node::start(config).await?;
    if let Some(manager) = ServiceManager::from_environment() {
        node.report_to(manager);
    }
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
        () = input_ended(), if stop_at_eof => {}
        failed = node.failed() => failed?,
    }
    tracing::info!("stopping");
    node.stop().await;
    Ok(())
}

/// How somebody joins a cell to watch it.
#[derive(Debug, Args)]
pub(super) struct ObserverArguments {
    /// Configuration of a node of the cell (TOML): how the cell is found, its key, its locations
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of this observer, unique in the cell
    #[arg(long)]
    name: Option<NodeName>,
    /// Name of the cell
    #[arg(long)]
    cell: Option<NodeName>,
    /// An external broker for all data; without one the nodes' own are used
    #[arg(long, value_name = "HOST:PORT")]
    broker: Option<BrokerAddress>,
    /// A node to ask for the cell; may be given several times
    #[arg(long = "seed", value_name = "HOST:PORT")]
    seeds: Vec<String>,
}

impl ObserverArguments {
    /// The name that the observer was given.
    pub(super) fn name(&self) -> Option<&NodeName> {
        self.name.as_ref()
    }

    /// Whose configuration this is.
    fn holder(&self) -> Result<Option<NodeName>, Failure> {
        let run = RunArguments { config: self.config.clone(), cell: self.cell.clone(), ..RunArguments::default() };
        Ok(run.load()?.name)
    }

    /// The configuration of a node that only listens: it leads nothing, has no camera, keeps nothing, and leaves the
    /// addresses in the file to the node that they are for. Without a name it has that of the process.
    pub(super) fn load(&self, purpose: &str) -> Result<NodeConfig, Failure> {
        let name = format!("{purpose}-{}", std::process::id());
        let name = self.name.clone().or_else(|| NodeName::new(&name).ok());
        let run = RunArguments {
            role: Some("cav".into()),
            config: self.config.clone(),
            name,
            cell: self.cell.clone(),
            broker: self.broker.clone(),
            seeds: self.seeds.clone(),
            ..RunArguments::default()
        };
        let mut config = run.load()?;
        // With the certificate of a node, the observer takes a name below that node's.
        if config.tls.is_some()
            && self.name.is_none()
            && let Some(holder) = self.holder()?
        {
            let name = format!("{holder}{OBSERVER_MARK}{purpose}-{}", std::process::id());
            config.name = Some(NodeName::new(&name).map_err(|error| Failure::usage(anyhow::anyhow!(error)))?);
        }
        if let Some(bind) = &mut config.membership.bind {
            bind.set_port(0);
        }
        #[cfg(feature = "camera")]
        {
            config.camera = None;
        }
        (config.membership.advertise, config.state_dir, config.map_log) = (None, None, None);
        config.dashboard.enabled = false;
        Ok(config)
    }
}

/// Waits for the end of standard input. The thread that reads it is left behind: it cannot be woken.
async fn input_ended() {
    let (ended, end) = oneshot::channel();
    std::thread::spawn(move || {
        let copied = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        tracing::debug!(?copied, "standard input ended");
        // Nobody waits any more when the node stops for another reason.
        let _ = ended.send(());
    });
    if end.await.is_err() {
        std::future::pending::<()>().await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_observer_leaves_the_addresses_in_the_file_to_the_node_they_are_for() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("node.toml");
        let text =
            "name = \"euclid\"\n[dashboard]\nlisten = \"127.0.0.1:8080\"\n[membership]\nbind = \"127.0.0.1:17884\"\n";
        std::fs::write(&path, text).unwrap();
        let arguments =
            ObserverArguments { config: Some(path), name: None, cell: None, broker: None, seeds: Vec::new() };
        let Ok(config) = arguments.load("recorder") else { panic!("the configuration is valid") };
        assert!(!config.dashboard.enabled);
        assert_eq!(config.membership.bind.map(|bind| bind.port()), Some(0));
        assert!(config.name.unwrap().as_str().starts_with("recorder-"));
    }
}
