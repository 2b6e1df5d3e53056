//! A node that runs on this machine, as its page describes it to commands.

use std::net::SocketAddr;

use ecod::model::names::NodeName;
use ecod::model::time::Timestamp;
use ecod::wire::{Role, Trouble};
use serde::{Deserialize, Serialize};

use crate::node::config::NodeConfig;
use crate::observe::dashboard::DEFAULT_ADDRESS;
use crate::observe::http::{PageError, read_page};

/// The node, its readiness, and its view of the cell: a part of `/api/picture`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningNode {
    /// Time of the answer, in Unix microseconds by the node's clock.
    pub now_us: Timestamp,
    /// Name, cell and role of the node.
    pub node: RunningIdentity,
    /// Whether the node is ready.
    pub readiness: RunningReadiness,
    /// The leader of its cell.
    pub leadership: RunningLeadership,
    /// All nodes of its cell, this one included.
    pub nodes: Vec<RunningMember>,
    /// The current troubles of its cell.
    pub troubles: Vec<RunningTrouble>,
}

/// Name, cell and role of a running node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningIdentity {
    /// Name of the running node.
    pub name: NodeName,
    /// Name of its cell.
    pub cell: NodeName,
    /// Role with which the node was started.
    pub role: Role,
    /// Version of its software.
    pub version: String,
    /// Address at which its broker listens for programs; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub door: Option<SocketAddr>,
    /// End of its certificate's validity, in Unix microseconds; absent without a certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub certificate_ends_us: Option<Timestamp>,
}

/// Readiness of a running node.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningReadiness {
    /// True if the node is ready.
    pub ready: bool,
    /// The reason as text.
    pub reason: String,
}

/// The leadership as a running node sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningLeadership {
    /// The node's position: `seeking`, `following`, `standing_by` or `leading`.
    pub position: String,
    /// Name of the leader; `None` while the node seeks one.
    pub leader: Option<NodeName>,
    /// Highest term that has been seen.
    pub epoch: Option<u64>,
    /// The node that leads next.
    pub standby: Option<NodeName>,
}

/// A node of the cell as a running node sees it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningMember {
    /// Name of the node in its cell.
    pub name: NodeName,
    /// Role with which the node was started.
    pub role: Role,
    /// True if it answers.
    pub alive: bool,
    /// True if it is expected and does not answer.
    pub missing: bool,
    /// Time at which a missing node last answered, in Unix microseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_seen_us: Option<Timestamp>,
}

/// A trouble, and the node that reports it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunningTrouble {
    /// Name of the node that reports the trouble.
    pub told_by: NodeName,
    /// The trouble as that node reports it.
    #[serde(flatten)]
    pub trouble: Trouble,
}

/// Address of the page of a node with this configuration.
pub fn page_address(config: &NodeConfig) -> SocketAddr {
    config.dashboard.listen.unwrap_or(DEFAULT_ADDRESS)
}

impl RunningNode {
    /// Reads the page at an address.
    ///
    /// # Errors
    /// Returns a [`PageError`] if no node answers there, or the node refuses the request.
    pub fn read(page: SocketAddr, config: &NodeConfig) -> Result<Self, PageError> {
        read_page(page, "/api/picture", config.dashboard.token.as_ref())
    }

    /// The node of a configuration, if it answers at its configured page.
    pub async fn find(config: &NodeConfig) -> Option<Self> {
        let asked = config.clone();
        let read = move || Self::read(page_address(&asked), &asked).ok();
        let node = tokio::task::spawn_blocking(read).await.ok()??;
        node.is_of(config).then_some(node)
    }

    /// True if it is the node of this configuration.
    pub fn is_of(&self, config: &NodeConfig) -> bool {
        self.node.cell == config.cell && config.name.as_ref() == Some(&self.node.name)
    }
}
