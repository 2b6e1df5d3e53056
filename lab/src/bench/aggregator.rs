//! An aggregator started by the benchmark: a node in its own process, with its broker, on loopback.

use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use ecod::model::names::NodeName;
use ecod::wire::Role;
use ecod_actors::node::config::NodeConfig;
use ecod_actors::observe::recorder::RecordConfig;
use tokio::net::TcpStream;

use super::access::BrokerAccess;
use super::load::landmarks;
use super::target::Target;
use crate::node_process::{NodeProcess, free_address};

/// All vehicles of the largest load vote.
const MAX_VOTERS: usize = 1000;

/// A running aggregator; killed when dropped, though only [`OwnAggregator::stop`] removes its
/// files.
#[derive(Debug)]
pub struct OwnAggregator {
    process: NodeProcess,
    directory: PathBuf,
    target: Target,
    page: SocketAddr,
}

impl OwnAggregator {
    /// Starts `program` as an edge with a dashboard, recording if `records`, and waits until its
    /// broker serves.
    ///
    /// # Errors
    /// Returns an error if it cannot be started or ends.
    pub async fn start(program: &Path, records: bool) -> anyhow::Result<Self> {
        let directory = std::env::temp_dir().join(format!("ecod-bench-{}", std::process::id()));
        fs::create_dir_all(&directory)
            .with_context(|| format!("cannot make {}", directory.display()))?;
        let broker = free_address()?;
        let page = free_address()?;
        let mut config = NodeConfig {
            name: Some(NodeName::from_static("edge")),
            cell: NodeName::from_static("bench"),
            role: Role::Edge,
            listen: Some(broker),
            landmarks: landmarks(),
            record: records.then(|| RecordConfig::new(directory.join("log"))),
            ..NodeConfig::default()
        };
        config.fusion.vote.max_vehicles = MAX_VOTERS;
        config.dashboard.listen = Some(page);
        config.membership.bind = Some(([127, 0, 0, 1], 0).into());
        config.membership.multicast.enabled = false;
        let mut process = NodeProcess::start(program, &config, &directory)?;
        while TcpStream::connect(broker).await.is_err() {
            process.check()?;
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let target = Target {
            access: BrokerAccess::open(broker.into()),
            cell: config.cell,
            landmarks: config.landmarks,
            encoding: config.mqtt.encoding,
            votes: true,
            aggregator: process.pid(),
        };
        Ok(Self {
            process,
            directory,
            target,
            page,
        })
    }

    /// Target of the measurement.
    ///
    /// # Errors
    /// Returns an error if the process has ended.
    pub fn target(&mut self) -> anyhow::Result<&Target> {
        self.process.check()?;
        Ok(&self.target)
    }

    /// Where its page is.
    pub fn page(&self) -> SocketAddr {
        self.page
    }

    /// Stops it and removes its files.
    pub async fn stop(mut self) {
        self.process.stop().await;
        if let Err(error) = fs::remove_dir_all(&self.directory) {
            tracing::warn!(directory = %self.directory.display(), %error, "directory stays");
        }
    }
}
