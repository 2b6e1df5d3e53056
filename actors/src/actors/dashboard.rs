//! The actor that serves the node's page, API, metrics and health over HTTP.
//!
//! ```text
//! Follower ──────── watch of maps, verdicts, reputations ──┐
//! LeaderElection ── watch of the leadership ───────────────┼─> NodeMonitor ── latest snapshot ──> browsers
//! Gateway ───────── LiveState: latest reports, statuses ───┘        │ thread of its own
//! Gateway, Broker <── probe, every half second ─────────────────────┘
//! ```
//!
//! The page shows the messages that its node accepted, so it follows the same aggregator. The
//! dashboard does not hold up other actors: it reads watches and counters, takes snapshots only
//! while there are viewers, and skips snapshots that a browser misses.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::dashboard::DashboardMessage;
use crate::observe::dashboard::node_monitor::NodeMonitor;
use crate::observe::dashboard::server::Server;
use crate::observe::dashboard::{DashboardConfig, NodeSources};

/// Arguments of a dashboard's start.
#[derive(Debug)]
pub struct DashboardArguments {
    /// Address, limits and token.
    pub config: DashboardConfig,
    /// Inputs from the node.
    pub sources: NodeSources,
    /// Receives the bound address. A restarted dashboard binds the address that this watch already
    /// contains.
    pub bound: watch::Sender<Option<SocketAddr>>,
}

/// Owner of the server, which stops when the actor ends.
#[derive(Debug, Default)]
pub struct Dashboard;

/// Time between two checks of the server.
const CHECK_PERIOD: Duration = Duration::from_secs(1);

impl Actor for Dashboard {
    type Msg = DashboardMessage;
    type State = Server;
    type Arguments = DashboardArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        DashboardArguments {
            config,
            sources,
            bound,
        }: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        config.validate()?;
        let monitor = Arc::new(NodeMonitor::new(sources, config.max_rate_hz));
        let server = Server::start(config, monitor, bound)?;
        myself.send_interval(CHECK_PERIOD, || DashboardMessage::CheckServer);
        Ok(server)
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        DashboardMessage::CheckServer: Self::Msg,
        server: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        if server.has_ended() {
            Err("the dashboard's thread ended".into())
        } else {
            Ok(())
        }
    }
}
