//! Cells of nodes in this process that can be killed like processes.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use ecod::leadership::Leadership;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::node::{self, NodeHandle};
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};
use tokio::time::{Instant, sleep};
use tracing_subscriber::EnvFilter;

use crate::config::{free_gossip_address, greet};
use crate::wait::PATIENCE;

/// The configuration of a node by its name, its role and the directory of the cell.
type Configure = fn(&str, Role, &Path) -> NodeConfig;

/// Nodes of one cell, each on a separate runtime, and the directory of their files.
pub struct Cell {
    configure: Configure,
    directory: TempDir,
    /// The gossip address of the first node, by which the others find the cell.
    seed: SocketAddr,
    nodes: BTreeMap<String, Running>,
}

struct Running {
    node: NodeHandle,
    runtime: Runtime,
}

impl Cell {
    /// A cell without nodes so far.
    ///
    /// # Panics
    /// Panics if no directory can be made.
    pub fn new(configure: Configure) -> Self {
        // With RUST_LOG=info a failing test prints the logs of the nodes.
        tracing_subscriber::fmt()
            .with_env_filter(EnvFilter::from_default_env())
            .try_init()
            .ok();
        Self {
            configure,
            directory: tempfile::tempdir().unwrap(),
            seed: free_gossip_address(),
            nodes: BTreeMap::new(),
        }
    }

    /// The directory for the files of all nodes.
    pub fn directory(&self) -> &Path {
        self.directory.path()
    }

    /// The configuration of another node, which finds the running nodes.
    pub fn config(&self, name: &str, role: Role) -> NodeConfig {
        let mut config = (self.configure)(name, role, self.directory());
        greet(&mut config, self.seed, self.nodes.is_empty());
        config
    }

    /// Starts a node on a separate runtime; the first node is the seed of the others.
    ///
    /// # Panics
    /// Panics if the node does not start.
    pub async fn start(&mut self, name: &str, role: Role) {
        self.start_with(self.config(name, role)).await;
    }

    /// Starts a node of this configuration on a separate runtime.
    ///
    /// # Panics
    /// Panics if the node does not start.
    pub async fn start_with(&mut self, config: NodeConfig) {
        let name = config.name.as_ref().unwrap().to_string();
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let node = runtime.spawn(node::start(config)).await.unwrap().unwrap();
        self.nodes.insert(name, Running { node, runtime });
    }

    /// Ends all tasks of a node at once; its sockets close.
    ///
    /// # Panics
    /// Panics if no such node runs.
    pub fn kill(&mut self, name: &str) {
        let Running { node, runtime } = self.remove(name);
        runtime.shutdown_background();
        drop(node);
    }

    /// Stops a node in order.
    ///
    /// # Panics
    /// Panics if no such node runs, or it panics.
    pub async fn stop_node(&mut self, name: &str) {
        let Running { node, runtime } = self.remove(name);
        runtime.spawn(node.stop()).await.unwrap();
        runtime.shutdown_background();
    }

    /// Removes a node from the cell; another node becomes the seed.
    fn remove(&mut self, name: &str) -> Running {
        let running = self.nodes.remove(name).unwrap();
        let other = self.nodes().next();
        self.seed = other.map_or_else(free_gossip_address, |(_, other)| {
            other.gossip_address().unwrap()
        });
        running
    }

    /// Stops all nodes. Their files are in the directory.
    ///
    /// # Panics
    /// Panics if a node panics.
    pub async fn stop(mut self) -> TempDir {
        while let Some((_, Running { node, runtime })) = self.nodes.pop_first() {
            runtime.spawn(node.stop()).await.unwrap();
            runtime.shutdown_background();
        }
        self.directory
    }

    /// A running node.
    ///
    /// # Panics
    /// Panics if no such node runs.
    pub fn node(&self, name: &str) -> &NodeHandle {
        &self.nodes[name].node
    }

    /// The running nodes, by name.
    pub fn nodes(&self) -> impl Iterator<Item = (&str, &NodeHandle)> {
        self.nodes
            .iter()
            .map(|(name, running)| (name.as_str(), &running.node))
    }

    /// The names of the running nodes.
    pub fn names(&self) -> Vec<String> {
        self.nodes.keys().cloned().collect()
    }

    /// The election as reported by a node.
    pub fn leadership(&self, name: &str) -> Leadership {
        self.node(name).leadership().borrow().clone()
    }

    /// Waits until every node follows this node, independently of the maps that they receive.
    pub async fn led_by(&self, leader: &str) {
        self.until(&format!("all follow {leader}"), |cell| {
            let follows = |(_, node): (&str, &NodeHandle)| {
                let leadership = node.leadership();
                let leadership = leadership.borrow();
                leadership
                    .leader()
                    .is_some_and(|name| name.as_str() == leader)
            };
            cell.nodes().all(follows).then_some(())
        })
        .await;
    }

    /// Waits until every node accepts maps of this node and follows it.
    pub async fn served_by(&self, leader: &str) {
        self.until(&format!("{leader} serves all"), |cell| {
            cell.sources()
                .iter()
                .all(|source| source.as_deref() == Some(leader))
                .then_some(())
        })
        .await;
    }

    /// Waits until every node accepts maps of one node other than this node, and returns its name.
    pub async fn served_by_another_than(&self, old: &str) -> String {
        self.until(&format!("another than {old} serves all"), |cell| {
            let sources = cell.sources();
            let first = sources.first()?.clone()?;
            (first != old && sources.iter().all(|source| *source == Some(first.clone())))
                .then_some(first)
        })
        .await
    }

    /// Waits until all nodes agree on the standby and have a link to it, and returns its name.
    pub async fn standby_is_named(&self) -> String {
        let standby = self
            .until("all agree on the standby", |cell| {
                let mut named = cell
                    .nodes()
                    .map(|(_, node)| node.leadership().borrow().standby.clone());
                let first = named.next()??;
                named
                    .all(|name| name.as_ref() == Some(&first))
                    .then(|| first.to_string())
            })
            .await;
        sleep(Duration::from_millis(300)).await;
        standby
    }

    /// The aggregator of each node's newest map, if the node also follows it.
    fn sources(&self) -> Vec<Option<String>> {
        let source = |(_, node): (&str, &NodeHandle)| {
            let leader = node.leadership().borrow().leader()?.clone();
            let source = node.newest_map().borrow().as_ref()?.map.aggregator.clone();
            (leader == source).then(|| source.to_string())
        };
        self.nodes().map(source).collect()
    }

    /// Waits until the condition has a result.
    ///
    /// # Panics
    /// Panics without a result within [`PATIENCE`].
    pub async fn until<T>(&self, what: &str, mut holds: impl FnMut(&Self) -> Option<T>) -> T {
        let deadline = Instant::now() + PATIENCE;
        loop {
            if let Some(found) = holds(self) {
                return found;
            }
            let leaderships: Vec<_> = self
                .nodes()
                .map(|(name, _)| (name, self.leadership(name)))
                .collect();
            assert!(
                Instant::now() < deadline,
                "not within {PATIENCE:?}: {what}: {leaderships:?}"
            );
            sleep(Duration::from_millis(20)).await;
        }
    }
}
