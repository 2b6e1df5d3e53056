//! The actor that takes the cell's maps: it drops what was superseded and hands on the rest.
//!
//! ```text
//! Gateway ── TakeMap ──> Follower ──> watch of the newest map, optional log file
//! ```

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use ecod::names::NodeName;
use ecod::time::Timestamp;
use ecod::wire::{GlobalMap, NodeStatus, RejectReason};
use ractor::{Actor, ActorProcessingErr, ActorRef};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use crate::counters::{Counters, Event};
use crate::gateway::{Delivery, GatewayMessage, Incoming};
use crate::seat::Seat;

/// What the follower is asked to do.
#[derive(Debug)]
pub enum FollowerMessage {
    /// Take a map.
    TakeMap {
        /// The map and when it came.
        delivery: Delivery,
    },
}

/// A map and when it came; one line of a map log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReceivedMap {
    /// When it came, by this node's clock.
    #[serde(rename = "received_at_us")]
    pub received_at: Timestamp,
    /// The map.
    pub map: Arc<GlobalMap>,
}

/// What a follower needs at its start.
pub struct FollowerArguments {
    /// Gets the newest map.
    pub newest: watch::Sender<Option<ReceivedMap>>,
    /// A file to which every accepted map is appended with its time of receipt, one JSON
    /// object a line.
    pub log: Option<PathBuf>,
    /// What the node says about itself; epoch and aggregator follow the maps.
    pub status: NodeStatus,
    /// Where the status is published.
    pub gateway: Seat<GatewayMessage>,
    /// The node's counters.
    pub counters: Arc<Counters>,
}

/// Keeps the newest map.
#[derive(Debug, Default)]
pub struct Follower;

/// The newest map and where it goes.
pub struct FollowerState {
    newest: watch::Sender<Option<ReceivedMap>>,
    log: Option<BufWriter<File>>,
    status: NodeStatus,
    gateway: Seat<GatewayMessage>,
    counters: Arc<Counters>,
}

impl Actor for Follower {
    type Msg = FollowerMessage;
    type State = FollowerState;
    type Arguments = FollowerArguments;

    async fn pre_start(
        &self,
        _myself: ActorRef<Self::Msg>,
        arguments: Self::Arguments,
    ) -> Result<Self::State, ActorProcessingErr> {
        let FollowerArguments { newest, log, status, gateway, counters } = arguments;
        let log = log.as_deref().map(open).transpose()?;
        Ok(FollowerState { newest, log, status, gateway, counters })
    }

    async fn handle(
        &self,
        _myself: ActorRef<Self::Msg>,
        message: Self::Msg,
        state: &mut Self::State,
    ) -> Result<(), ActorProcessingErr> {
        let FollowerMessage::TakeMap { delivery } = message;
        if let Incoming::Map(map) = &delivery.message {
            state.take(map, delivery.received_at);
        }
        Ok(())
    }
}

impl FollowerState {
    fn take(&mut self, map: &Arc<GlobalMap>, received_at: Timestamp) {
        let superseded =
            self.newest.borrow().as_ref().is_some_and(|newest| {
                order(map) <= order(&newest.map) && received_at.since(newest.received_at) < MEMORY
            });
        if superseded {
            self.counters.reject(RejectReason::Superseded);
            return;
        }
        self.counters.count(Event::MapAccepted);
        self.follow(map);
        let received = ReceivedMap { received_at, map: Arc::clone(map) };
        self.write(&received);
        self.newest.send_replace(Some(received));
    }

    /// Says so when the aggregator or its epoch has changed.
    fn follow(&mut self, map: &GlobalMap) {
        if (self.status.epoch, &self.status.aggregator) != (map.epoch, &Some(map.aggregator.clone())) {
            tracing::info!(aggregator = %map.aggregator, epoch = map.epoch, "following");
            self.status.epoch = map.epoch;
            self.status.aggregator = Some(map.aggregator.clone());
            self.gateway.send(GatewayMessage::PublishStatus { status: self.status.clone() });
        }
    }

    fn write(&mut self, received: &ReceivedMap) {
        let Some(log) = &mut self.log else { return };
        let written = serde_json::to_writer(&mut *log, received).map_err(std::io::Error::from);
        if let Err(error) = written.and_then(|()| log.write_all(b"\n")).and_then(|()| log.flush()) {
            tracing::warn!(%error, "map log abandoned");
            self.log = None;
        }
    }
}

/// How long a newest map outranks others after it came: an aggregator that starts anew with a clock set back, or a map
/// from a stranger with a huge epoch, silences the rest for no longer than this.
const MEMORY: Duration = Duration::from_secs(3);

/// Maps are ordered by epoch, then aggregator, then round.
fn order(map: &GlobalMap) -> (u64, &NodeName, u64) {
    (map.epoch, &map.aggregator, map.round)
}

fn open(path: &Path) -> Result<BufWriter<File>, ActorProcessingErr> {
    let file = File::options().create(true).append(true).open(path);
    file.map(BufWriter::new).map_err(|error| format!("cannot open map log {}: {error}", path.display()).into())
}

#[cfg(test)]
mod tests {
    use ecod::wire::{NodeState, Role, SCHEMA_VERSION};
    use uuid::Uuid;

    use super::*;

    fn follower() -> FollowerState {
        let status = NodeStatus {
            schema: SCHEMA_VERSION,
            node: NodeName::from_static("euclid"),
            id: Uuid::nil(),
            role: Role::Cav,
            state: NodeState::Following,
            epoch: 0,
            aggregator: None,
            version: String::new(),
        };
        let newest = watch::Sender::new(None);
        FollowerState { newest, log: None, status, gateway: Seat::default(), counters: Arc::default() }
    }

    fn map(epoch: u64, round: u64) -> Arc<GlobalMap> {
        Arc::new(GlobalMap {
            schema: SCHEMA_VERSION,
            aggregator: NodeName::from_static("edge"),
            epoch,
            round,
            fused_at_us: Timestamp(0),
            oldest_capture_us: None,
            landmarks: Vec::new(),
            objects: Vec::new(),
        })
    }

    #[test]
    fn a_huge_epoch_silences_the_others_for_a_moment_only() {
        let mut follower = follower();
        let second = |n: u64| Timestamp(n * 1_000_000);
        let accepted = |follower: &FollowerState| follower.newest.borrow().as_ref().map(|newest| newest.map.epoch);
        follower.take(&map(u64::MAX, 1), second(0));
        follower.take(&map(7, 1), second(1));
        assert_eq!(accepted(&follower), Some(u64::MAX));
        assert_eq!(follower.counters.rejects(RejectReason::Superseded), 1);
        follower.take(&map(7, 2), second(4));
        assert_eq!(accepted(&follower), Some(7));
        follower.take(&map(7, 2), second(5));
        assert_eq!(follower.counters.rejects(RejectReason::Superseded), 2, "the same map is not taken twice");
    }
}
