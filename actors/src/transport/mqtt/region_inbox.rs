//! Incoming packets of the region: maps of the cells around, statuses of the own cell, and cells'
//! counts about vehicles.

use std::sync::{Arc, Mutex, PoisonError};

use ecod::leadership::round_filter::Origin;
use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::neighbours::MAX_MAP_HZ;
use ecod::wire::{
    CellMap, CellReputation, Limits, NodeState, NodeStatus, RegionTopic, RegionTopicKind,
    RejectReason, ReputationTopic, decode,
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
        /// The map.
        map: Box<CellMap>,
    },
    /// The status of another leader of the own cell, or a last will of this one.
    Status(NodeStatus),
    /// Counts of a cell, perhaps the own one, about a vehicle.
    Reputation(CellReputation),
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
    /// Deliveries of counts about vehicles that the uplink may still hold.
    reputation_capacity: Arc<Semaphore>,
    reputation_throttle: Mutex<KeyedThrottle<NodeName>>,
}

/// Maximum maps that wait for the uplink: some seconds of all cells around.
const CAPACITY: usize = 32;

/// Maximum number of messages about vehicles that wait for the uplink. When a leader connects, all
/// messages about the present vehicles arrive at once.
const REPUTATION_CAPACITY: usize = 1024;

/// Maximum messages about vehicles per second of one cell that are decoded: one about each vehicle
/// of a large cell.
const MAX_REPUTATION_HZ: u32 = 512;

impl RegionInbox {
    /// Creates an inbox for messages of the region to the cell with its origin in the tile, in this
    /// run of the node.
    pub(crate) fn new(
        (cell, tile): (NodeName, Quadkey),
        run: Uuid,
        limits: Limits,
        counters: Arc<Counters>,
        subscriber: RegionSubscriber,
    ) -> Self {
        let capacity = Arc::new(Semaphore::new(CAPACITY));
        let throttle = Mutex::new(KeyedThrottle::per_second(MAX_MAP_HZ));
        let reputation_capacity = Arc::new(Semaphore::new(REPUTATION_CAPACITY));
        let reputation_throttle = Mutex::new(KeyedThrottle::per_second(MAX_REPUTATION_HZ));
        Self {
            cell,
            tile,
            run,
            limits,
            counters,
            subscriber,
            capacity,
            throttle,
            reputation_capacity,
            reputation_throttle,
        }
    }

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
                if self.allows(&self.throttle, &topic.cell, received_at) {
                    let map = Box::new(decode(payload, &self.limits)?);
                    self.deliver(
                        &self.capacity,
                        FromRegion::Map {
                            topic: topic.clone(),
                            map,
                        },
                        received_at,
                    );
                }
            }
            RegionTopicKind::Status if is_own && topic.tile == self.tile && !payload.is_empty() => {
                let status: NodeStatus = decode(payload, &self.limits)?;
                if status.id == self.run && status.state != NodeState::Offline {
                    self.counters.count(Event::Echo);
                    return Ok(PacketOutcome::OwnStatus);
                }
                self.deliver(&self.capacity, FromRegion::Status(status), received_at);
            }
            RegionTopicKind::Status if is_own && topic.tile == self.tile => {}
            RegionTopicKind::Status | RegionTopicKind::Cell => {
                return Err(RejectReason::UnknownTopic);
            }
        }
        Ok(PacketOutcome::Done)
    }

    /// Decodes a cell's counts about a vehicle; a deleted message counts as empty.
    fn read_reputation(
        &self,
        topic: &ReputationTopic,
        payload: &[u8],
        received_at: Timestamp,
    ) -> Result<PacketOutcome, RejectReason> {
        if payload.is_empty() || !self.allows(&self.reputation_throttle, &topic.cell, received_at) {
            return Ok(PacketOutcome::Done);
        }
        let message: CellReputation = decode(payload, &self.limits)?;
        if (&message.cell, &message.vehicle) != (&topic.cell, &topic.vehicle) {
            return Err(RejectReason::NodeMismatch);
        }
        if message.cell == self.cell {
            self.counters.count(Event::Echo);
        }
        self.deliver(
            &self.reputation_capacity,
            FromRegion::Reputation(message),
            received_at,
        );
        Ok(PacketOutcome::Done)
    }

    /// True if one more message of a cell is decoded.
    fn allows(
        &self,
        throttle: &Mutex<KeyedThrottle<NodeName>>,
        cell: &NodeName,
        received_at: Timestamp,
    ) -> bool {
        let is_allowed = throttle
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .allow(cell, received_at);
        if !is_allowed {
            self.counters.shed(ShedReason::CellThrottled, &source(cell));
        }
        is_allowed
    }

    fn deliver(&self, capacity: &Arc<Semaphore>, message: FromRegion, received_at: Timestamp) {
        match Arc::clone(capacity).try_acquire_owned() {
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
        let (of_cell, of_vehicle) = (RegionTopic::parse(path), ReputationTopic::parse(path));
        let outcome = match (&of_cell, &of_vehicle) {
            (Some(topic), _) => self.read(topic, payload, received_at),
            (None, Some(topic)) => self.read_reputation(topic, payload, received_at),
            (None, None) => Err(RejectReason::UnknownTopic),
        };
        outcome.unwrap_or_else(|reason| {
            let cell = of_cell.map(|topic| topic.cell).or(of_vehicle.map(|topic| topic.cell));
            let from = cell.map_or_else(|| via.address.to_string(), |cell| source(&cell));
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
