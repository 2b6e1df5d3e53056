//! The link to the region's broker, and the messages published on it.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use ecod::diagnostics::TroubleKind;
use ecod::leadership::BrokerAddress;
use ecod::leadership::links::LinkState;
use ecod::model::names::NodeName;
use ecod::model::quadkey::Quadkey;
use ecod::model::time::Timestamp;
use ecod::wire::{CellDescription, CellMap, NodeStatus, RegionTopic, RegionTopicKind, encode};
use uuid::Uuid;

use crate::telemetry::counters::{Counters, Event};
use crate::transport::mqtt::connection::{LastWill, MaxQos, Retention, offline_payload};
use crate::transport::mqtt::link::{Link, LinkChange, LinkId, LinkSetup, LinkSink};
use crate::transport::mqtt::packet_sink::PacketSink;
use crate::transport::mqtt::{MqttConfig, Security};

/// Maximum time for sending DISCONNECT; if exceeded, the broker publishes the last will. A stopping
/// node waits for it.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(1);

/// Materials of a link to the region's broker.
pub(super) struct RegionLinkSetup {
    pub(super) cell: NodeName,
    pub(super) tile: Quadkey,
    pub(super) config: MqttConfig,
    pub(super) security: Security,
    pub(super) sink: Arc<dyn PacketSink>,
    pub(super) counters: Arc<Counters>,
    pub(super) seed: u64,
}

/// A running link. Dropping it cuts the connection, and the broker publishes the last will.
pub(super) struct RegionLink {
    id: LinkId,
    cell: NodeName,
    tile: Quadkey,
    link: Link,
    setup: Arc<LinkSetup>,
    /// Retained messages that a full queue has refused.
    unsent: Vec<(String, Bytes)>,
}

impl RegionLink {
    /// Begins to connect to a broker for a node with this status.
    pub(super) fn open(
        id: LinkId,
        broker: BrokerAddress,
        setup: RegionLinkSetup,
        status: &NodeStatus,
        report: LinkSink,
    ) -> Self {
        let RegionLinkSetup {
            cell,
            tile,
            config,
            security,
            sink,
            counters,
            seed,
        } = setup;
        let path = |kind| {
            RegionTopic {
                tile,
                cell: cell.clone(),
                kind,
            }
            .path()
        };
        let status_topic = path(RegionTopicKind::Status);
        let tiles = tile.with_neighbours();
        let around = tiles
            .iter()
            .map(|tile| RegionTopic::filter(*tile, RegionTopicKind::Map));
        let filters = around.chain([status_topic.clone()]).collect();
        let will = LastWill {
            topic: status_topic,
            payload: offline_payload(status, config.encoding).into(),
        };
        let setup = Arc::new(LinkSetup {
            // Kept secret, because a client that uses the same client id ends this connection. The
            // id of this run is in the status.
            client_id: format!("{cell}-{}-{}", status.node, Uuid::new_v4().simple()),
            filters,
            will: Mutex::new(will),
            config,
            security,
            sink,
            unreachable: TroubleKind::UplinkUnreachable,
            counters,
            seed,
        });
        let link = Link::spawn(id, broker, Arc::clone(&setup), report);
        Self {
            id,
            cell,
            tile,
            link,
            setup,
            unsent: Vec::new(),
        }
    }

    pub(super) fn id(&self) -> LinkId {
        self.id
    }

    pub(super) fn tile(&self) -> Quadkey {
        self.tile
    }

    /// Replaces the connection. The last will of the earlier one comes before the new status.
    pub(super) fn reconnect(&mut self, report: LinkSink) {
        let broker = self.link.broker.clone();
        self.link = Link::spawn(self.id, broker, Arc::clone(&self.setup), report);
    }

    /// Processes an event of the link; returns true if the connection has just been established and
    /// has no published messages yet.
    pub(super) fn change(&mut self, change: LinkChange) -> bool {
        let state = match change {
            LinkChange::Accepted { client, .. } => {
                client.subscribe(&self.setup.filters, MaxQos::AtMostOnce);
                self.link.client = Some(client);
                self.unsent.clear();
                LinkState::Up
            }
            LinkChange::Lost(state) => {
                self.link.client = None;
                state
            }
            LinkChange::Answered if self.link.state == LinkState::Stalled => LinkState::Up,
            // Name conflicts and last wills are handled as status messages.
            LinkChange::Answered | LinkChange::DeclaredOffline | LinkChange::Namesake(_) => {
                return false;
            }
        };
        let before = std::mem::replace(&mut self.link.state, state);
        if before != state {
            tracing::info!(broker = %self.link.broker, %state, "uplink changed");
        }
        state == LinkState::Up && before != LinkState::Stalled
    }

    /// Publishes a map, unless the broker is unreachable or does not forward messages: maps are not
    /// queued. Returns true if it was sent.
    pub(super) fn publish_map(&mut self, map: &CellMap, now: Timestamp) -> bool {
        let payload = Bytes::from(encode(map, self.setup.config.encoding));
        if payload.len() > self.setup.config.max_map_bytes {
            self.setup.counters.count(Event::PublishTooLarge);
            return false;
        }
        self.send_unsent();
        let is_sent = self.link.state == LinkState::Up
            && self.link.publish(
                &self.topic(RegionTopicKind::Map),
                &payload,
                Retention::Transient,
            );
        self.setup.counters.count(if is_sent {
            Event::RegionPublished
        } else {
            Event::RegionWithheld
        });
        // The broker also returns this cell's own map.
        if self.link.state == LinkState::Up && self.link.misses_echo(now) {
            self.link.state = LinkState::Stalled;
            tracing::info!(broker = %self.link.broker, state = %LinkState::Stalled, "uplink changed");
        }
        is_sent
    }

    /// Publishes the node's status, now if there is a connection, and as the last will of later
    /// ones.
    pub(super) fn publish_status(&mut self, status: &NodeStatus) {
        let encoding = self.setup.config.encoding;
        self.setup
            .will
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .payload = offline_payload(status, encoding).into();
        self.retain(RegionTopicKind::Status, encode(status, encoding).into());
    }

    /// Publishes the description of the cell, if there is a connection.
    pub(super) fn publish_description(&mut self, description: &CellDescription) {
        self.retain(
            RegionTopicKind::Cell,
            encode(description, self.setup.config.encoding).into(),
        );
    }

    /// Ends the connection without the last will, after `last`, if given, as the retained status.
    pub(super) async fn close(mut self, last: Option<&NodeStatus>) {
        if let Some(status) = last {
            self.publish_status(status);
        }
        self.link.leave(LEAVE_TIMEOUT).await;
    }

    /// Ends the connection of a cell that has left its tile. If connected, first removes the cell's
    /// messages from the tile.
    pub(super) async fn withdraw(mut self) {
        self.retain(RegionTopicKind::Status, Bytes::new());
        self.retain(RegionTopicKind::Cell, Bytes::new());
        self.link.leave(LEAVE_TIMEOUT).await;
    }

    fn topic(&self, kind: RegionTopicKind) -> String {
        RegionTopic {
            tile: self.tile,
            cell: self.cell.clone(),
            kind,
        }
        .path()
    }

    fn retain(&mut self, kind: RegionTopicKind, payload: Bytes) {
        let topic = self.topic(kind);
        self.unsent.retain(|(unsent, _)| *unsent != topic);
        if self.link.client.is_some() && !self.link.publish(&topic, &payload, Retention::Repeated) {
            self.unsent.push((topic, payload));
        }
    }

    fn send_unsent(&mut self) {
        let link = &self.link;
        self.unsent
            .retain(|(topic, payload)| !link.publish(topic, payload, Retention::Repeated));
    }
}
