//! The actor that shows the node to people and machines: a page, an API, metrics and health, by HTTP.
//!
//! ```text
//! Follower ──────── watch of maps, verdicts, reputations ──┐
//! LeaderElection ── watch of the leadership ───────────────┼─> NodeMonitor ── pictures, latest only ──> browsers
//! Gateway ───────── LiveState: latest reports, statuses ────────┘      │ a thread of its own
//! Gateway, Broker <── how are you, every half second ─────────────┘
//! ```
//!
//! What a node accepts is what its page shows, so that the page follows the aggregator as the node does. Nothing waits
//! for the dashboard: it reads watches and counters, makes pictures only while someone looks, and drops what a browser
//! is too slow for.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use ractor::{Actor, ActorProcessingErr, ActorRef};
use tokio::sync::watch;

use crate::messages::dashboard::DashboardMessage;
use crate::observe::dashboard::node_monitor::NodeMonitor;
use crate::observe::dashboard::server::Server;
use crate::observe::dashboard::{DashboardConfig, NodeSources};

/// What a dashboard needs at its start.
#[derive(Debug)]
pub struct DashboardArguments {
    /// Address, limits and token.
    pub config: DashboardConfig,
    /// What it shows.
    pub sources: NodeSources,
    /// Gets the address that is listened on. A run before this one may have bound it; it is then taken again.
    pub bound: watch::Sender<Option<SocketAddr>>,
}

/// Owns the server; stops it when the actor ends, however it ends.
#[derive(Debug, Default)]
pub struct Dashboard;

/// The running server.
#[derive(Debug)]
pub struct DashboardState {
    server: Server,
}

/// How often the server is looked at.
const CHECK_PERIOD: Duration = Duration::from_secs(1);

impl Actor for Dashboard {
    type Msg = DashboardMessage;
    type State = DashboardState;
    type Arguments = DashboardArguments;

    async fn pre_start(
        &self,
        myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let DashboardArguments { config, sources, bound } = arguments;
        config.validate()?;
        let monitor = Arc::new(NodeMonitor::new(sources, config.max_rate_hz));
        let server = Server::start(config, monitor, bound)?;
        myself.send_interval(CHECK_PERIOD, || DashboardMessage::CheckServer);
        Ok(DashboardState { server })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let DashboardMessage::CheckServer = message;
        if state.server.has_ended() { Err("the dashboard's thread ended".into()) } else { Ok(()) }
    }
}
