//! Where the dashboard learns what it shows; reading never makes another part wait.

use std::sync::Arc;

use tokio::sync::watch;

use super::live_state::LiveState;
use super::snapshot::{LandmarkFacts, NodeFacts};
use crate::observe::readiness::Vitals;
use crate::telemetry::counters::Counters;
use crate::transport::gossip::{FrameCounters, Member};

/// What the node tells its dashboard.
#[derive(Debug, Clone)]
pub struct NodeSources {
    /// The node.
    pub node: NodeFacts,
    /// The cell's known locations.
    pub landmarks: Vec<LandmarkFacts>,
    /// The newest of everything, who leads, and how links and broker are.
    pub vitals: Vitals,
    /// The other nodes.
    pub members: watch::Receiver<Vec<Member>>,
    /// The node's counters.
    pub counters: Arc<Counters>,
    /// The counters of its gossip.
    pub frames: Arc<FrameCounters>,
    /// Reports and statuses.
    pub live_state: Arc<LiveState>,
}
