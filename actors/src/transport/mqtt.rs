//! MQTT connections of a node: links, incoming messages, protection.

pub(crate) mod address;
pub(crate) mod config;
pub(crate) mod connection;
pub(crate) mod data_plane;
pub(crate) mod inbox;
pub(crate) mod link;
pub(crate) mod probe;
pub(crate) mod security;
pub(crate) mod silence;
pub(crate) mod subscription_role;
pub use address::{BrokerAddress, InvalidAddress};
pub use config::{MqttConfig, MqttVersion};
pub use data_plane::DataPlane;
pub use inbox::{Delivery, Incoming, LinkState, Subscriber};
pub use link::LinkEvent;
pub use probe::probe;
pub use security::{ENVELOPE_BYTES, Security, SecurityError};
pub use subscription_role::SubscriptionRole;
