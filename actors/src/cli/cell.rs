//! `ecod-node cell`: the settings that all nodes of a cell share, and the dismissal of missing
//! nodes, through the local broker of one node.

use std::collections::BTreeMap;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use bytes::Bytes;
use clap::{Args, Subcommand};
use ecod::description::DescriptionHistory;
use ecod::leadership::BrokerAddress;
use ecod::model::names::NodeName;
use ecod::wire::{
    CellDescription, ContentHash, Encoding, NodeState, NodeStatus, SCHEMA_VERSION, Topic, Topics,
};
use ecod::wire::{MAX_DESCRIPTION_BYTES, decode, encode};
use serde_json::{Map, Value, json};
use uuid::Uuid;

use super::{Failure, installation, print};
use crate::node::config::{NodeConfig, SharedConfig};
use crate::node::description::description_file;
use crate::node::running::RunningNode;
use crate::platform::bounded_file;
use crate::transport::mqtt::MqttVersion;
use crate::transport::mqtt::connection::{Client, Connection, MaxQos, Packet, Retention, open};
use crate::transport::pki::{BrokerTrust, OBSERVER_MARK};

/// Commands of `cell`.
#[derive(Debug, Subcommand)]
pub(super) enum CellCommand {
    /// Give a description to a node that may lead; it reaches all nodes
    Set {
        /// The description (TOML)
        file: PathBuf,
        #[command(flatten)]
        door: DoorArguments,
    },
    /// Set the description again that this machine's node had before the current one
    Undo {
        #[command(flatten)]
        door: DoorArguments,
    },
    /// Print the description that the cell has, and which nodes use it
    Show {
        #[command(flatten)]
        door: DoorArguments,
    },
    /// Stop expecting a node that is gone for good, so that no node reports it as missing
    Dismiss {
        /// Name of the missing node
        node: NodeName,
        #[command(flatten)]
        door: DoorArguments,
    },
    /// Compare a file with the description that the cell has; ends with 1 if they differ
    Diff {
        /// The description (TOML)
        file: PathBuf,
        #[command(flatten)]
        door: DoorArguments,
    },
}

/// Flags that name a node of this machine.
#[derive(Debug, Args)]
pub(super) struct DoorArguments {
    /// Configuration of the node (TOML); `ECOD_…` variables apply as they do to the node [default,
    /// without --cell and --door: /etc/ecod/node.toml or ecod/node.toml, if it exists]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of the cell
    #[arg(long)]
    cell: Option<NodeName>,
    /// Address where the node listens, if it is not the configured one; the node's log names it
    #[arg(long, value_name = "IP:PORT")]
    door: Option<SocketAddr>,
}

/// Maximum time for the node's answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// Silence after which the command stops waiting for further statuses of nodes.
const SILENCE: Duration = Duration::from_millis(300);

pub(super) fn run(command: &CellCommand) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .context("cannot start")?;
    runtime.block_on(carry_out(command))
}

async fn carry_out(command: &CellCommand) -> Result<(), Failure> {
    match command {
        CellCommand::Set { file, door } => {
            let text = read(file)?;
            set(DoorClient::open(door).await?, &text).await
        }
        CellCommand::Undo { door } => {
            let client = DoorClient::open(door).await?;
            let text = text_before(&client.config).map_err(Failure::usage)?;
            set(client, &text).await
        }
        CellCommand::Show { door } => Ok(print(&DoorClient::open(door).await?.show().await?)?),
        CellCommand::Dismiss { node, door } => {
            DoorClient::open(door).await?.dismiss(node).await?;
            Ok(print(&format!("{node} is not expected any more\n"))?)
        }
        CellCommand::Diff { file, door } => {
            let text = read(file)?;
            let described = DoorClient::open(door).await?.present().await?;
            if described.version == 0 {
                return Err(anyhow!(
                    "the cell has no description yet; `ecod-node cell set` gives it one"
                )
                .into());
            }
            let lines = differences(&settings(&described.text)?, &settings(&text)?);
            let file = file.display();
            let version = described.version;
            if lines.is_empty() {
                return Ok(print(&format!("no difference to version {version}\n"))?);
            }
            print(&lines)?;
            Err(anyhow!("{file} differs from version {version} of the cell's description").into())
        }
    }
}

/// Sets a description, and prints its cost.
async fn set(mut client: DoorClient, text: &str) -> Result<(), Failure> {
    let shared = SharedConfig::parse(text).map_err(Failure::usage)?;
    let places = shared.landmarks.len();
    let estimate = shared.cost();
    let CellDescription {
        version,
        hash,
        set_by,
        ..
    } = client.set(text).await?;
    let cost = format!(
        "maps of up to {} bytes, {:.0} bytes/s",
        estimate.map_bytes, estimate.bytes_per_s
    );
    Ok(print(&format!(
        "version {version}, hash {hash}, known locations: {places} ({cost}), set by {set_by}\n"
    ))?)
}

/// The text of the description that this machine's node had before the current one.
fn text_before(config: &NodeConfig) -> Result<String, anyhow::Error> {
    let file = description_file(config)
        .context("this node keeps no earlier description: it has no `state_dir`")?;
    let read = file
        .peek()
        .with_context(|| format!("no earlier description in {}", file.path().display()));
    let DescriptionHistory { earlier, .. } = read?;
    let before = earlier
        .last()
        .context("this node has had no other description before")?;
    Ok(before.description.text.clone())
}

/// The text of a description, whose values are checked.
fn read(file: &Path) -> Result<String, Failure> {
    let text = read_bounded(file)
        .with_context(|| format!("cannot read {}", file.display()))
        .map_err(Failure::usage)?;
    SharedConfig::parse(&text)
        .with_context(|| file.display().to_string())
        .map_err(Failure::usage)?;
    Ok(text)
}

/// The text of a file that is small enough for a description; larger files are not read further.
fn read_bounded(file: &Path) -> anyhow::Result<String> {
    let text = bounded_file::read_text(file)?;
    ensure!(
        text.len() <= MAX_DESCRIPTION_BYTES,
        "a description has at most {MAX_DESCRIPTION_BYTES} bytes"
    );
    Ok(text)
}

/// A program's connection to a node.
struct DoorClient {
    client: Client,
    connection: Connection,
    config: NodeConfig,
    topics: Topics,
}

impl DoorClient {
    async fn open(arguments: &DoorArguments) -> Result<Self, Failure> {
        let mut flags = Map::new();
        flags.extend(
            arguments
                .cell
                .as_ref()
                .map(|cell| ("cell".to_owned(), json!(cell))),
        );
        let given = arguments.config.as_deref();
        let file = if arguments.cell.is_none() && arguments.door.is_none() {
            installation::configuration(given)
        } else {
            given.map(Path::to_owned)
        };
        let mut config = NodeConfig::load(file.as_deref(), &flags).map_err(Failure::usage)?;
        // The node may have replaced a busy port.
        let running = if file.is_some() && arguments.door.is_none() {
            RunningNode::find(&config).await
        } else {
            None
        };
        let bound = running.and_then(|node| node.node.door);
        // Version 5 has reasons for refusals; the local broker requires no password.
        config.mqtt.version = MqttVersion::V5;
        config.mqtt.user = None;
        config.mqtt.password = None;
        let address = here(arguments.door.or(bound).unwrap_or(config.broker_listen()));
        let credentials = config.security().map_err(Failure::usage)?.credentials;
        let tls = credentials
            .as_ref()
            .map(|credentials| BrokerTrust::of_door(credentials).client());
        let process = std::process::id();
        let run = Uuid::new_v4().simple();
        let client_id = match config.name.as_ref().filter(|_| tls.is_some()) {
            Some(name) => format!("{name}{OBSERVER_MARK}cell-{process}-{run}"),
            None => format!("ecod-cell-{process}"),
        };
        let (client, connection) = open(
            &BrokerAddress::from(address),
            &client_id,
            None,
            &config.mqtt,
            tls,
        );
        let topics = Topics::new(&config.cell);
        let mut door = Self {
            client,
            connection,
            config,
            topics,
        };
        let accepted = door.connection.next(PATIENCE).await;
        accepted.with_context(|| {
            format!("no node at {address}: it must run on this machine; `--door` names another address of it")
        })?;
        let filters = [
            door.topics.path(&Topic::Cell),
            door.topics.filter("nodes/+"),
        ];
        door.client.subscribe(&filters, MaxQos::AtLeastOnce);
        Ok(door)
    }

    /// The next description or status, if one comes in time.
    async fn next(&mut self, patience: Duration) -> Result<Option<DoorMessage>, anyhow::Error> {
        let limits = self.config.mqtt.limits();
        let next = async {
            loop {
                let (topic, payload) = match self.connection.next(PATIENCE).await? {
                    Packet::Message { topic, payload } => (topic, payload),
                    Packet::PublishRefused(text) => return Err(anyhow!("refused: {text}")),
                    _ => continue,
                };
                let topic = std::str::from_utf8(&topic)
                    .ok()
                    .and_then(|topic| self.topics.parse(topic));
                let message = match topic {
                    Some(Topic::Cell) => {
                        decode(&payload, &limits).ok().map(DoorMessage::Description)
                    }
                    Some(Topic::Nodes(_)) => {
                        decode(&payload, &limits).ok().map(DoorMessage::Status)
                    }
                    _ => None,
                };
                if message.is_some() {
                    return Ok(message);
                }
            }
        };
        tokio::time::timeout(patience, next)
            .await
            .unwrap_or(Ok(None))
    }

    /// The next description or status; fails if the node has no description or status, because it
    /// then belongs to another cell.
    async fn expect(&mut self) -> Result<DoorMessage, anyhow::Error> {
        let cell = self.config.cell.clone();
        let silent = || {
            anyhow!(
                "no answer of a node of cell {cell}: check the cell's name, and the node's version"
            )
        };
        self.next(PATIENCE - SILENCE).await?.ok_or_else(silent)
    }

    /// The description that the node has now; version 0 without one.
    async fn present(&mut self) -> Result<CellDescription, anyhow::Error> {
        loop {
            if let DoorMessage::Description(description) = self.expect().await? {
                return Ok(description);
            }
        }
    }

    /// Sets a description; returns it as the node has numbered it.
    async fn set(&mut self, text: &str) -> Result<CellDescription, anyhow::Error> {
        let node = NodeName::from_static("node");
        let text = text.to_owned();
        let set_by = self.config.name.clone().unwrap_or(node);
        let schema = SCHEMA_VERSION;
        let hash = ContentHash::default();
        let request = CellDescription {
            schema,
            version: 0,
            hash,
            set_by,
            text,
        };
        let payload = encode(&request, Encoding::Json).into();
        self.present().await?;
        self.client.publish(
            &self.topics.path(&Topic::Cell),
            &payload,
            Retention::Acknowledged,
        );
        // A description that is already in use is not published again.
        self.client
            .subscribe(&[self.topics.path(&Topic::Cell)], MaxQos::AtLeastOnce);
        loop {
            let description = self.present().await?;
            if description.version > 0 && description.text == request.text {
                return Ok(description);
            }
        }
    }

    /// Dismisses a missing node; returns when the connected node has confirmed it.
    async fn dismiss(&mut self, node: &NodeName) -> Result<(), anyhow::Error> {
        self.present().await?;
        let topic = self.topics.path(&Topic::Nodes(node.clone()));
        self.client
            .publish(&topic, &Bytes::new(), Retention::Acknowledged);
        loop {
            if let DoorMessage::Status(status) = self.expect().await?
                && status.dismissed.contains(node)
            {
                return Ok(());
            }
        }
    }

    /// The description as a file, with the nodes that have one in comments.
    async fn show(&mut self) -> Result<String, anyhow::Error> {
        let mut description = None;
        let mut nodes = BTreeMap::new();
        loop {
            let next = if description.is_none() {
                Some(self.expect().await?)
            } else {
                self.next(SILENCE).await?
            };
            match next {
                Some(DoorMessage::Description(present)) => description = Some(present),
                Some(DoorMessage::Status(status)) => {
                    nodes.insert(status.node.clone(), status);
                }
                None => break,
            }
        }
        nodes.retain(|node, status| status.state != NodeState::Offline && node.vehicle() == *node);
        let cell = &self.config.cell;
        let mut shown = match &description {
            Some(CellDescription {
                version: version @ 1..,
                hash,
                set_by,
                ..
            }) => {
                format!("# cell {cell}: version {version}, hash {hash}, set by {set_by}\n")
            }
            _ => format!("# cell {cell}: no description\n"),
        };
        for (node, status) in nodes {
            shown += &match status.description {
                Some(held) => {
                    let problem = held
                        .problem
                        .map_or_else(String::new, |problem| format!(", not used: {problem}"));
                    format!(
                        "# {node}: version {}, hash {}{}\n",
                        held.version,
                        held.hash,
                        problem.replace('\n', " ")
                    )
                }
                None => format!("# {node}: none\n"),
            };
        }
        shown += &description.map_or_else(String::new, |description| description.text);
        // Text from other nodes must not control the terminal.
        shown.retain(|character| !character.is_control() || "\n\t".contains(character));
        Ok(shown)
    }
}

/// A message of a node to its local programs.
enum DoorMessage {
    Description(CellDescription),
    Status(NodeStatus),
}

/// The address at which a program of this machine reaches a node that listens there.
fn here(mut listen: SocketAddr) -> SocketAddr {
    match listen {
        SocketAddr::V4(v4) if v4.ip().is_unspecified() => listen.set_ip(Ipv4Addr::LOCALHOST.into()),
        SocketAddr::V6(v6) if v6.ip().is_unspecified() => listen.set_ip(Ipv6Addr::LOCALHOST.into()),
        _ => {}
    }
    listen
}

/// The settings of a description with all defaults; locations by id.
fn settings(text: &str) -> Result<Value, anyhow::Error> {
    let mut settings = serde_json::to_value(SharedConfig::parse(text)?)?;
    if let Some(landmarks) = settings.get_mut("landmarks")
        && let Value::Array(list) = landmarks.take()
    {
        let id = |landmark: &Value| {
            landmark
                .get("id")
                .and_then(Value::as_str)
                .unwrap_or_default()
                .to_owned()
        };
        *landmarks = list
            .into_iter()
            .map(|landmark| (id(&landmark), landmark))
            .collect();
    }
    Ok(settings)
}

/// One line for each value that differs.
fn differences(cell: &Value, file: &Value) -> String {
    let mut lines = String::new();
    compare("", cell, file, &mut lines);
    lines
}

fn compare(key: &str, cell: &Value, file: &Value, lines: &mut String) {
    match (cell, file) {
        (Value::Object(in_cell), Value::Object(in_file)) => {
            let keys: std::collections::BTreeSet<_> =
                in_cell.keys().chain(in_file.keys()).collect();
            for name in keys {
                let below = if key.is_empty() {
                    name.clone()
                } else {
                    format!("{key}.{name}")
                };
                let of = |table: &Map<String, Value>| table.get(name).cloned().unwrap_or_default();
                compare(&below, &of(in_cell), &of(in_file), lines);
            }
        }
        _ if cell == file => {}
        _ => {
            let text = |value: &Value| {
                if value.is_null() {
                    "nothing".to_owned()
                } else {
                    value.to_string()
                }
            };
            *lines += &format!("{key}: cell {}, file {}\n", text(cell), text(file));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_and_spelling_are_ignored() {
        let cell = "[fusion.pace]\ngate_m = 1\n[[landmarks]]\nid = \"a\"\nx_m = 0\ny_m = 0\n[[landmarks]]\nid = \"b\"\nx_m = 1\ny_m = 0";
        let same = "# ours\n[[landmarks]]\nid = \"b\"\nx_m = 1.0\ny_m = 0\n[[landmarks]]\nid = \"a\"\nx_m = 0\ny_m = 0\n[fusion.pace]\ngate_m = 1.0\ngate_sigmas = 4.0";
        let other = "[[landmarks]]\nid = \"a\"\nx_m = 0\ny_m = 2\n[[landmarks]]\nid = \"c\"\nx_m = 0\ny_m = 0";
        let compared = |file| differences(&settings(cell).unwrap(), &settings(file).unwrap());
        assert_eq!(compared(same), "");
        let lines = compared(other);
        for line in [
            "fusion.pace.gate_m: cell 1.0, file 0.5",
            "landmarks.a.y_m: cell 0.0, file 2.0",
            "landmarks.b: cell {",
        ] {
            assert!(lines.contains(line), "{lines}");
        }
        assert!(
            lines.contains("landmarks.c: cell nothing, file {"),
            "{lines}"
        );
    }
}
