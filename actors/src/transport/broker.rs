//! The embedded MQTT broker behind a front end that authenticates, limits and authorises its clients.

#![deny(clippy::indexing_slicing)]

mod admission;
mod embedded;
mod gate;
mod holder;
mod login;
mod permissions;
mod pulse;
mod retained;
mod throttle;
use std::net::SocketAddr;

pub use embedded::{BrokerConfig, BrokerError, EmbeddedBroker, Mqtt};
pub use gate::Guard;
#[cfg(fuzzing)]
pub use login::read_login;
pub use permissions::Elected;

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
