//! The embedded MQTT broker behind a front end that authenticates, limits and authorises its
//! clients.

#![deny(clippy::indexing_slicing)]

mod backlog;
mod byte_throttle;
mod client_rejection;
mod connect_packet;
mod connection_throttle;
mod departures;
mod door;
mod embedded;
mod frontend;
mod heartbeat;
mod in_flight;
mod outbound_queue;
mod packet_scanner;
mod permissions;
mod principal;
mod publish_throttle;
mod relay;
mod retained;
mod subscriptions;
mod websocket;
use std::net::SocketAddr;

#[cfg(fuzzing)]
pub use connect_packet::read_connect_packet;
pub use departures::ExpulsionSink;
pub use door::{Door, DoorSetup};
pub use embedded::{BrokerConfig, BrokerError, EmbeddedBroker, MqttBroker};
pub use permissions::AccessPolicy;
pub use principal::LeaderCheck;
#[cfg(fuzzing)]
pub use websocket::read_websocket;

/// State of an embedded broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrokerHealth {
    /// Not started, or stopped.
    Stopped,
    /// Serves clients at this address.
    Serving(SocketAddr),
    /// The broker has ended by itself or hangs. The actor ends with this answer, and the node must
    /// not lead in the meantime.
    Dead,
}
