//! `ecod-node --role …`: one node of a cell.

use std::net::SocketAddr;
#[cfg(feature = "camera")]
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
#[cfg(feature = "camera")]
use std::process::Command;
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use ecod::model::names::NodeName;
#[cfg(feature = "camera")]
use ecod::wire::Role;
use serde_json::{Value, json};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{oneshot, watch};
use tokio::time::timeout;

use super::{Failure, installation, print};
#[cfg(feature = "camera")]
use crate::camera::frame_source::capture::Readers;
use crate::node::NodeError;
use crate::node::config::{NodeConfig, variables_without_key};
use crate::node::roaming::Roamer;
use crate::node::service::ServiceManager;
#[cfg(feature = "camera")]
use crate::platform::installed;
use crate::transport::mqtt::BrokerAddress;

/// Flags of a node; each overrides the key of its name in the configuration file.
#[derive(Debug, Default, Args)]
pub(super) struct RunArguments {
    /// When to lead: `edge` whenever possible, `auto` without a better candidate, `cav` not at all
    #[arg(long, value_parser = ["auto", "cav", "edge"])]
    role: Option<String>,
    #[command(flatten)]
    join: SeedArguments,
    /// Address where this node's own MQTT broker listens
    #[arg(long, value_name = "IP:PORT", value_parser = ip_and_port)]
    listen: Option<SocketAddr>,
    /// Directory for state that survives a restart
    #[arg(long, value_name = "DIR")]
    state_dir: Option<String>,
    /// Description of the cell (TOML) with which this node starts a new cell
    #[arg(long, value_name = "FILE")]
    description: Option<String>,
    /// Append every accepted map with its time of receipt to this file, one JSON object per line
    #[arg(long, value_name = "FILE")]
    map_log: Option<String>,
    /// Address of the web page, metrics and health. Default 127.0.0.1:8080, or a free port if that
    /// is in use. Addresses other than loopback need `dashboard.token`
    #[arg(long, value_name = "IP:PORT", value_parser = ip_and_port, num_args = 0..=1)]
    dashboard: Option<Option<SocketAddr>>,
    /// Disable page, metrics and health
    #[arg(long, conflicts_with = "dashboard")]
    no_dashboard: bool,
    /// Record to this directory (MCAP); the configuration table `record` has more options
    #[arg(long, value_name = "DIR")]
    record: Option<String>,
    /// Print the configuration that results from file, environment and flags, and exit
    #[arg(long)]
    print_config: bool,
    /// With --print-config: print only what differs from the defaults
    #[arg(long, requires = "print_config")]
    changed: bool,
    /// Stop when standard input ends, for example when the parent process ends
    #[arg(long, hide = true)]
    stop_at_eof: bool,
}

/// Flags by which a program finds and joins a cell.
#[derive(Debug, Clone, Default, Args)]
struct SeedArguments {
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of this node, unique in its cell
    #[arg(long)]
    name: Option<NodeName>,
    /// Name of the cell
    #[arg(long)]
    cell: Option<NodeName>,
    /// MQTT broker for all data; without one, nodes use their own
    #[arg(long, value_name = "HOST:PORT")]
    broker: Option<BrokerAddress>,
    /// Address of a node of the cell; may be given several times
    #[arg(long = "seed", value_name = "HOST:PORT")]
    seeds: Vec<String>,
}

pub(super) fn ip_and_port(text: &str) -> Result<SocketAddr, &'static str> {
    text.parse()
        .map_err(|_| "must be an IP address and a port, such as 0.0.0.0:1883")
}

pub(super) fn run(arguments: &RunArguments) -> Result<(), Failure> {
    let config = arguments.load()?;
    if arguments.print_config {
        let text = if arguments.changed {
            config.to_toml_changed()
        } else {
            config.to_toml()
        };
        return Ok(print(
            &text.context("the configuration cannot be written as TOML")?,
        )?);
    }
    #[cfg(feature = "camera")]
    if !config.has_camera() {
        continue_without_opencv();
    }
    run_node(config, arguments.stop_at_eof)
}

/// Replaces this process by the program without camera support that a package has installed next to
/// this one, with the same process id and arguments, so that the libraries of OpenCV are not
/// loaded. Returns if there is no such program.
#[cfg(feature = "camera")]
fn continue_without_opencv() {
    if let Some(program) = installed::path("lib/ecod-node/ecod-node") {
        let error = Command::new(&program)
            .args(std::env::args_os().skip(1))
            .exec();
        tracing::warn!(program = %program.display(), %error, "cannot start the smaller program without OpenCV; continuing with this one, which uses more memory");
    }
}

/// Runs a node until it is stopped or gives up.
pub(super) fn run_node(config: NodeConfig, stop_at_eof: bool) -> Result<(), Failure> {
    run_to_end(serve(config, stop_at_eof))
}

/// Runs `serve`, which runs one or several nodes, on its own threads.
pub(super) fn run_to_end(serve: impl Future<Output = anyhow::Result<()>>) -> Result<(), Failure> {
    let runtime = tokio::runtime::Runtime::new().context("cannot start threads for the node")?;
    let served = runtime.block_on(serve);
    // A detector may block forever; a restart of the node must not wait for it.
    runtime.shutdown_timeout(SHUTDOWN_TIMEOUT);
    #[cfg(feature = "camera")]
    Readers::of_process().wait_for_end(SHUTDOWN_TIMEOUT);
    served.map_err(|error| match error.downcast_ref() {
        Some(NodeError::NameTaken { .. }) => Failure::name_taken(error),
        _ => error.into(),
    })
}

impl RunArguments {
    /// The configuration that results from file, environment and flags.
    fn load(&self) -> Result<NodeConfig, Failure> {
        NodeConfig::load(self.join.config.as_deref(), &self.overrides()).map_err(Failure::usage)
    }

    /// The flags that were given, as keys of the configuration.
    fn overrides(&self) -> Value {
        let Self {
            role,
            join,
            listen,
            state_dir,
            description,
            map_log,
            dashboard,
            no_dashboard,
            record,
            ..
        } = self;
        let seeds = Some(&join.seeds).filter(|seeds| !seeds.is_empty());
        let enabled = if *no_dashboard {
            Some(false)
        } else {
            dashboard.map(|_| true)
        };
        let mut keys = json!({
            "role": role,
            "name": join.name,
            "cell": join.cell,
            "listen": listen,
            "state_dir": state_dir,
            "description": description,
            "map_log": map_log,
            "record": record,
            "mqtt": { "broker": join.broker },
            "membership": { "seeds": seeds },
            "dashboard": { "enabled": enabled, "listen": dashboard.flatten() },
        });
        remove_nulls(&mut keys);
        keys
    }
}

/// Removes null values, so that only stated keys remain. A table without keys would hide that a
/// file has another value in its place.
fn remove_nulls(value: &mut Value) {
    if let Value::Object(keys) = value {
        keys.values_mut().for_each(remove_nulls);
        keys.retain(|_, value| {
            !value.is_null() && value.as_object().is_none_or(|table| !table.is_empty())
        });
    }
}

/// Maximum time for the page to be served before the node names its address.
const PAGE_TIMEOUT: Duration = Duration::from_secs(2);

/// Maximum time for the threads of a stopped node to end.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// Runs the node until SIGINT or SIGTERM.
async fn serve(config: NodeConfig, stop_at_eof: bool) -> anyhow::Result<()> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    #[cfg(feature = "camera")]
    if config.role == Role::Cav && !config.has_camera() && config.record.is_none() {
        tracing::warn!("no [camera] is configured: only other programs of this vehicle can report");
    }
    let variables = variables_without_key();
    if !variables.is_empty() {
        tracing::warn!(
            variables = variables.join(", "),
            "environment variables that begin with ECOD_ but name no key are left out"
        );
    }
    let announced = (!config.only_observes()).then(|| config.clone());
    let mut vehicle = Roamer::start(config).await?;
    if let Some(config) = announced {
        let page = vehicle.present().dashboard_address();
        tokio::spawn(async move { announce(&config, page).await });
    }
    if let Some(manager) = ServiceManager::from_environment() {
        vehicle.present().report_to(manager);
    }
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
        () = input_ended(), if stop_at_eof => {}
        Err(failed) = vehicle.drive() => return Err(failed.into()),
    }
    tracing::info!("stopping");
    vehicle.stop().await;
    Ok(())
}

/// Logs what runs, where its page is, and what a user can do next, once the page is served.
async fn announce(config: &NodeConfig, mut page: watch::Receiver<Option<SocketAddr>>) {
    let bound = async {
        let bound = timeout(PAGE_TIMEOUT, page.wait_for(Option::is_some)).await;
        *bound.ok()?.ok()?
    };
    let is_enabled = config.dashboard.enabled;
    let page = if is_enabled { bound.await } else { None };
    let name = config.name.as_ref().map_or("node", NodeName::as_str);
    let role = config.role;
    let cell = &config.cell;
    let version = env!("CARGO_PKG_VERSION");
    tracing::info!("{name} ({role}) of cell {cell} runs, version {version}");
    match page {
        Some(page) if config.dashboard.token.is_some() => {
            tracing::info!("page: http://{page}/?token= and the token");
        }
        Some(page) => tracing::info!("page: http://{page}/"),
        None if is_enabled => tracing::info!("no page yet: its address is in use"),
        None => tracing::info!("no page: `dashboard.enabled` is false"),
    }
    let joining = config.joining();
    tracing::info!("next: `ecod-node status` shows the cell; {joining}");
}

/// Flags of a program that joins a cell as an observer. The configuration may belong to any node of
/// the cell.
#[derive(Debug, Args)]
pub(super) struct ObserverArguments {
    #[command(flatten)]
    join: SeedArguments,
}

impl ObserverArguments {
    /// Name given to the observer.
    pub(super) fn name(&self) -> Option<&NodeName> {
        self.join.name.as_ref()
    }

    /// Configuration of a node that only observes, by default of the installed node: it cannot lead,
    /// has no camera, keeps no state,
    /// and does not use the addresses in the file. Its name is made of the node's name, `purpose`
    /// and the process id.
    pub(super) fn load(&self, purpose: &str) -> Result<NodeConfig, Failure> {
        let mut join = self.join.clone();
        // Flags that name another cell leave out the installed node, with its key and certificate.
        if join.cell.is_none() && join.broker.is_none() && join.seeds.is_empty() {
            join.config = installation::configuration(join.config.as_deref());
        }
        let arguments = RunArguments {
            join,
            ..RunArguments::default()
        };
        arguments.load()?.observing(purpose).map_err(Failure::usage)
    }
}

/// Waits for the end of standard input. Its reading thread is abandoned, since it cannot be woken.
pub(super) async fn input_ended() {
    let (ended, end) = oneshot::channel();
    std::thread::spawn(move || {
        let copied = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        tracing::debug!(?copied, "standard input ended");
        // The receiver is gone when the node stops for another reason.
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
    fn unset_flags_keep_file_values() {
        let mut keys = json!({ "name": null, "mqtt": { "broker": "edge:1883" }, "dashboard": { "listen": null } });
        remove_nulls(&mut keys);
        assert_eq!(keys, json!({ "mqtt": { "broker": "edge:1883" } }));
    }

    #[test]
    fn observer_ignores_node_addresses() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("node.toml");
        let text = "name = \"euclid\"\n[dashboard]\nlisten = \"127.0.0.1:8080\"\n[membership]\nbind = \"127.0.0.1:17884\"\n";
        std::fs::write(&path, text).unwrap();
        let join = SeedArguments {
            config: Some(path),
            ..SeedArguments::default()
        };
        let arguments = ObserverArguments { join };
        let Ok(config) = arguments.load("recorder") else {
            panic!("the configuration is valid")
        };
        assert!(!config.dashboard.enabled && !config.has_broker());
        assert_eq!(config.membership.bind.map(|bind| bind.port()), Some(0));
        assert!(
            config
                .name
                .unwrap()
                .as_str()
                .starts_with("euclid--recorder-")
        );
    }
}
