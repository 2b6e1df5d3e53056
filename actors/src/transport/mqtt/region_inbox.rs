//! Incoming packets of the region: maps of the cells around, and statuses of the own cell.

use std::sync::{Arc, Mutex, PoisonError};

use ecod::leadership::round_filter::Origin;
use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::neighbours::MAX_MAP_HZ;
use ecod::wire::{
    CellMap, Limits, NodeState, NodeStatus, RegionTopic, RegionTopicKind, RejectReason, decode,
};
use tokio::sync::Semaphore;
use uuid::Uuid;

use super::delivery::Delivery;
use super::packet_sink::{PacketOutcome, PacketSink, Via};
use crate::platform::throttle::KeyedThrottle;
use crate::telemetry::counters::{Counters, Event, ShedReason};

/// A checked message of the region.
#[derive(Debug)]
pub enum FromRegion {
    /// The map of another cell.
    Map {
        /// Where it was published.
        topic: RegionTopic,
        /// The map, decoded and within the limits.
        map: Box<CellMap>,
    },
    /// The status of another leader of the own cell, or a last will of this one.
    Status(NodeStatus),
}

/// Callback that takes messages to the uplink. It runs on the link's task and must not block.
pub(crate) type RegionSubscriber = Box<dyn Fn(Delivery<FromRegion>) + Send + Sync>;

/// Decodes, checks and delivers packets of the region.
pub(crate) struct RegionInbox {
    cell: NodeName,
    tile: Quadkey,
    run: Uuid,
    limits: Limits,
    counters: Arc<Counters>,
    subscriber: RegionSubscriber,
    /// Deliveries that the uplink may still hold.
    capacity: Arc<Semaphore>,
    throttle: Mutex<KeyedThrottle<NodeName>>,
}

/// Maximum maps that wait for the uplink: some seconds of all cells around.
const CAPACITY: usize = 32;

impl RegionInbox {
    /// Creates an inbox for messages of the region to the cell with its origin in the tile, in this
    /// run of the node.
    pub(crate) fn new(
        cell: NodeName,
        tile: Quadkey,
        run: Uuid,
        limits: Limits,
        counters: Arc<Counters>,
        subscriber: RegionSubscriber,
    ) -> Self {
        let capacity = Arc::new(Semaphore::new(CAPACITY));
        let throttle = Mutex::new(KeyedThrottle::per_second(MAX_MAP_HZ));
        Self {
            cell,
            tile,
            run,
            limits,
            counters,
            subscriber,
            capacity,
            throttle,
        }
    }

    /// Handles one packet of the region: maps of other cells, and the status of the own cell's
    /// leader. Own messages are counted as echoes.
    ///
    /// # Errors
    /// Returns the reason under which the packet is counted as rejected.
    fn read(
        &self,
        topic: &RegionTopic,
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<PacketOutcome, RejectReason> {
        let is_own = topic.cell == self.cell;
        match topic.kind {
            RegionTopicKind::Map if is_own => self.counters.count(Event::Echo),
            RegionTopicKind::Map => {
                if self.allows(&topic.cell, received_at) {
                    let map = Box::new(decode(payload, &self.limits)?);
                    let topic = topic.clone();
                    self.deliver(FromRegion::Map { topic, map }, received_at);
                }
            }
            RegionTopicKind::Status if is_own && topic.tile == self.tile && !payload.is_empty() => {
                let status: NodeStatus = decode(payload, &self.limits)?;
                if status.id == self.run && status.state != NodeState::Offline {
                    self.counters.count(Event::Echo);
                    return Ok(PacketOutcome::OwnStatus);
                }
                self.deliver(FromRegion::Status(status), received_at);
            }
            RegionTopicKind::Status if is_own && topic.tile == self.tile => {}
            RegionTopicKind::Status | RegionTopicKind::Cell => {
                return Err(RejectReason::UnknownTopic);
            }
        }
        Ok(PacketOutcome::Done)
    }

    /// True if one more message of a cell is decoded.
    fn allows(&self, cell: &NodeName, received_at: Timestamp) -> bool {
        let is_allowed = self
            .throttle
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .allow(cell, received_at);
        if !is_allowed {
            self.counters.shed(ShedReason::CellThrottled, &source(cell));
        }
        is_allowed
    }

    /// Delivers a message, or counts it as dropped if the uplink is too far behind.
    fn deliver(&self, message: FromRegion, received_at: Timestamp) {
        match Arc::clone(&self.capacity).try_acquire_owned() {
            Ok(place) => {
                let origin = Origin::Claimed;
                (self.subscriber)(Delivery {
                    message,
                    received_at,
                    origin,
                    broker: None,
                    _place: Some(place),
                });
            }
            Err(_) => self.counters.count(Event::InboxFull),
        }
    }
}

impl PacketSink for RegionInbox {
    /// Processes one packet of the region's broker. A payload that cannot be used is counted by its
    /// reason and cell.
    fn accept(
        &self,
        via: Via<'_>,
        topic: &[u8],
        payload: &[u8],
        received_at: Timestamp,
    ) -> PacketOutcome {
        self.counters.count(Event::RegionReceived);
        let path = std::str::from_utf8(topic).unwrap_or_default();
        let of_cell = RegionTopic::parse(path);
        let outcome = match &of_cell {
            Some(topic) => self.read(topic, payload, received_at),
            None => Err(RejectReason::UnknownTopic),
        };
        outcome.unwrap_or_else(|reason| {
            let from = of_cell.map_or_else(|| via.address.to_string(), |topic| source(&topic.cell));
            self.counters.reject_message(reason, &from, || {
                format!("message of the region on {} rejected: {}", topic.escape_ascii(), reason.in_words())
            });
            tracing::debug!(topic = %topic.escape_ascii(), bytes = payload.len(), %reason, "payload rejected");
            PacketOutcome::Done
        })
    }
}

/// Name under which messages of a cell are counted, apart from nodes of that name.
pub(crate) fn source(cell: &NodeName) -> String {
    format!("cell {cell}")
}
