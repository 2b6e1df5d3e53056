//! Nodes in this process that can be killed as a process is.

use std::collections::BTreeMap;
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::time::Duration;

use ecod::leadership::Leadership;
use ecod::model::names::NodeName;
use ecod::perception::landmark::LandmarkConfig;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};
use tracing_subscriber::EnvFilter;

use crate::failover::record::Record;

/// Maximum time for anything.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

/// Some nodes of one cell, found by one seed.
pub(crate) struct Cell {
    directory: TempDir,
    seed: SocketAddr,
    nodes: BTreeMap<String, Running>,
}

struct Running {
    node: NodeHandle,
    runtime: Runtime,
}

impl Default for Cell {
    fn default() -> Self {
        // With RUST_LOG=info a failing test tells what the nodes did.
        tracing_subscriber::fmt()
            .with_env_filter(EnvFilter::from_default_env())
            .try_init()
            .ok();
        Self {
            directory: tempfile::tempdir().unwrap(),
            seed: free_address(),
            nodes: BTreeMap::new(),
        }
    }
}

impl Cell {
    /// Starts a node on a runtime of its own; the first is the seed of the others.
    pub(crate) async fn start(&mut self, name: &str, role: Role) {
        self.start_with(name, role, |_| ()).await;
    }

    /// The same with an adjusted configuration.
    pub(crate) async fn start_with(
        &mut self,
        name: &str,
        role: Role,
        adjust: impl FnOnce(&mut NodeConfig),
    ) {
        let is_seed = self.nodes.is_empty();
        let mut config = config(
            name,
            role,
            is_seed.then_some(self.seed),
            self.seed,
            self.directory.path(),
        );
        adjust(&mut config);
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let node = runtime.spawn(node::start(config)).await.unwrap().unwrap();
        self.nodes
            .insert(name.to_owned(), Running { node, runtime });
    }

    /// Ends all tasks of a node where they are; its sockets close.
    pub(crate) fn kill(&mut self, name: &str) {
        let Running { node, runtime } = self.nodes.remove(name).unwrap();
        let other = self.nodes.values().next();
        self.seed = other.map_or_else(free_address, |other| other.node.gossip_address().unwrap());
        runtime.shutdown_background();
        drop(node);
    }

    pub(crate) async fn stop(mut self) {
        while let Some((_, Running { node, runtime })) = self.nodes.pop_first() {
            runtime.spawn(node.stop()).await.unwrap();
            runtime.shutdown_background();
        }
    }

    pub(crate) fn node(&self, name: &str) -> &NodeHandle {
        &self.nodes[name].node
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.nodes.keys().cloned().collect()
    }

    pub(crate) fn leadership(&self, name: &str) -> Leadership {
        self.node(name).leadership().borrow().clone()
    }

    pub(crate) fn record(&self, name: &str) -> Record {
        Record::read(&self.directory.path().join(format!("{name}.maps")))
    }

    /// Waits until every node follows this node, whatever maps it gets.
    pub(crate) async fn led_by(&self, leader: &str) {
        self.until(&format!("all follow {leader}"), |cell| {
            let follows = |name: &String| {
                cell.leadership(name)
                    .leader()
                    .is_some_and(|name| name.as_str() == leader)
            };
            cell.names().iter().all(follows).then_some(())
        })
        .await;
    }

    /// Waits until every node takes maps of this node and follows it.
    pub(crate) async fn served_by(&self, leader: &str) {
        self.until(&format!("{leader} serves all"), |cell| {
            (cell
                .sources()
                .iter()
                .all(|source| source.as_deref() == Some(leader)))
            .then_some(())
        })
        .await;
    }

    /// Waits until every node takes maps of one node that is another than this, and says which.
    pub(crate) async fn served_by_another_than(&self, old: &str) -> String {
        self.until(&format!("another than {old} serves all"), |cell| {
            let sources = cell.sources();
            let first = sources.first()?.clone()?;
            (first != old && sources.iter().all(|source| *source == Some(first.clone())))
                .then_some(first)
        })
        .await
    }

    /// Waits until all agree who leads next, and have a link to it.
    pub(crate) async fn standby_is_named(&self) -> String {
        let standby = self
            .until("all agree on the standby", |cell| {
                let mut named = cell
                    .nodes
                    .values()
                    .map(|running| running.node.leadership().borrow().standby.clone());
                let first = named.next()??;
                named
                    .all(|name| name.as_ref() == Some(&first))
                    .then(|| first.to_string())
            })
            .await;
        tokio::time::sleep(Duration::from_millis(300)).await;
        standby
    }

    /// Whose map each node took last, as far as it also follows it.
    fn sources(&self) -> Vec<Option<String>> {
        let source = |running: &Running| {
            let leader = running.node.leadership().borrow().leader()?.clone();
            let source = running
                .node
                .newest_map()
                .borrow()
                .as_ref()?
                .map
                .aggregator
                .clone();
            (leader == source).then(|| source.to_string())
        };
        self.nodes.values().map(source).collect()
    }

    async fn until<T>(&self, what: &str, mut holds: impl FnMut(&Self) -> Option<T>) -> T {
        let deadline = tokio::time::Instant::now() + PATIENCE;
        loop {
            if let Some(found) = holds(self) {
                return found;
            }
            let leaderships: Vec<_> = self
                .names()
                .iter()
                .map(|name| (name.clone(), self.leadership(name)))
                .collect();
            assert!(
                tokio::time::Instant::now() < deadline,
                "not within {PATIENCE:?}: {what}: {leaderships:?}"
            );
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

/// A node's configuration: loopback only, found by a seed, with its map log and its term in the directory.
pub(crate) fn config(
    name: &str,
    role: Role,
    bind: Option<SocketAddr>,
    seed: SocketAddr,
    directory: &Path,
) -> NodeConfig {
    let landmark = LandmarkConfig {
        id: "slot-0".into(),
        x_m: 0.0,
        y_m: 0.0,
        facing_deg: None,
        vacancy: None,
        synonyms: Default::default(),
    };
    let mut config = NodeConfig {
        name: Some(NodeName::new(name).unwrap()),
        role,
        listen: Some(SocketAddr::from(([127, 0, 0, 1], 0))),
        state_dir: Some(directory.into()),
        map_log: Some(directory.join(format!("{name}.maps"))),
        landmarks: vec![landmark],
        ..NodeConfig::default()
    };
    config.membership.bind = Some(bind.unwrap_or(SocketAddr::from(([127, 0, 0, 1], 0))));
    config.membership.seeds = vec![seed.to_string()];
    config.membership.multicast.enabled = false;
    config.dashboard.enabled = false;
    config.election.stable_ms = 1000;
    config.validate().unwrap();
    config
}

/// An address at which nobody gossips now.
pub(crate) fn free_address() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0")
        .unwrap()
        .local_addr()
        .unwrap()
}
