//! Where the dashboard learns what it shows; reading never makes another part wait.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ecod::epoch::Epoch;
use ecod::time::Timestamp;
use ractor::{Message, RpcReplyPort};
use tokio::sync::watch;

use super::feed::Feed;
use super::picture::{LandmarkFacts, NodeFacts};
use crate::broker::{BrokerHealth, BrokerMessage};
use crate::counters::Counters;
use crate::follower::Newest;
use crate::gateway::{BrokerAddress, GatewayMessage, LinkState};
use crate::leader_election::{DataPlane, Leadership};
use crate::membership::{FrameCounters, Member};
use crate::seat::Seat;

/// What the node tells its dashboard.
#[derive(Debug, Clone)]
pub struct Sources {
    /// The node.
    pub node: NodeFacts,
    /// The cell's known locations.
    pub landmarks: Vec<LandmarkFacts>,
    /// The newest of everything.
    pub newest: Newest,
    /// Who leads.
    pub leadership: watch::Receiver<Leadership>,
    /// The other nodes.
    pub members: watch::Receiver<Vec<Member>>,
    /// Which brokers carry the data.
    pub plane: DataPlane,
    /// The node's counters.
    pub counters: Arc<Counters>,
    /// The counters of its gossip.
    pub frames: Arc<FrameCounters>,
    /// Reports and statuses.
    pub feed: Arc<Feed>,
    /// Tells how links are, and takes reports to be looked at.
    pub gateway: Seat<GatewayMessage>,
    /// Tells whether the node's own broker serves.
    pub broker: Seat<BrokerMessage>,
}

/// What the gateway and the broker answered.
#[derive(Debug, Clone, Default)]
pub struct Probe {
    /// How the links are; none when the gateway did not answer.
    pub links: Option<BTreeMap<BrokerAddress, LinkState>>,
    /// Whether the node's own broker serves.
    pub broker_serves: bool,
}

/// How long a part may take to answer.
const PATIENCE: Duration = Duration::from_millis(500);

impl Sources {
    /// Asks the parts how they are.
    pub async fn probe(&self) -> Probe {
        let (health, links) = tokio::join!(
            ask(&self.broker, |reply| BrokerMessage::Health { reply }),
            ask(&self.gateway, |reply| GatewayMessage::Links { reply }),
        );
        Probe { broker_serves: matches!(health, Some(BrokerHealth::Serving(_))), links }
    }

    /// Whether a broker carries what this node publishes.
    pub fn broker_works(&self, probe: &Probe) -> bool {
        let up = |broker| probe.links.as_ref().and_then(|links| links.get(broker)) == Some(&LinkState::Up);
        self.plane.external.as_ref().is_some_and(up) || (self.plane.embedded && probe.broker_serves)
    }

    /// The newest round accepted, be it a map or verdicts: its epoch and when it came.
    pub fn last_round(&self) -> Option<(Epoch, Timestamp)> {
        let map =
            self.newest.map.borrow().as_ref().map(|received| {
                (Epoch::new(received.map.epoch, received.map.aggregator.clone()), received.received_at)
            });
        let verdicts = self.newest.verdicts.borrow().as_ref().map(|received| {
            let verdicts = &received.message;
            (Epoch::new(verdicts.epoch, verdicts.aggregator.clone()), received.received_at)
        });
        map.into_iter().chain(verdicts).max_by_key(|(_, received_at)| *received_at)
    }
}

async fn ask<M: Message, T: Send + 'static>(seat: &Seat<M>, question: impl FnOnce(RpcReplyPort<T>) -> M) -> Option<T> {
    let answer = seat.holder()?.call(question, Some(PATIENCE)).await;
    answer.ok()?.success_or(()).ok()
}
