//! The embedded MQTT broker behind a front end that authenticates, limits and authorises its clients.

#![deny(clippy::indexing_slicing)]

mod connect_packet;
mod connection_throttle;
mod embedded;
mod frontend;
mod heartbeat;
mod permissions;
mod principal;
mod publish_throttle;
mod retained;
use std::net::SocketAddr;

#[cfg(fuzzing)]
pub use connect_packet::read_connect_packet;
pub use embedded::{BrokerConfig, BrokerError, EmbeddedBroker, MqttBroker};
pub use frontend::AccessPolicy;
pub use permissions::LeaderCheck;

/// Whether the broker serves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrokerHealth {
    /// Not started, or stopped.
    Stopped,
    /// Accepts clients at this address.
    Serving(SocketAddr),
    /// Was started, but has ended by itself or hangs; a node without its broker must not lead. The actor ends with this
    /// answer.
    Dead,
}
