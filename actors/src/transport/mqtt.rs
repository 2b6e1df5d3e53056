//! MQTT connections of a node: links, incoming messages, protection.

pub(crate) mod config;
pub(crate) mod connection;
mod delivery;
pub(crate) mod inbox;
pub(crate) mod link;
pub(crate) mod packet_counter;
pub(crate) mod packet_sink;
pub(crate) mod probe;
pub(crate) mod region_inbox;
mod round_signature;
pub(crate) mod security;
pub(crate) mod subscription_role;
pub use config::{MqttConfig, MqttVersion};
pub use delivery::{Delivery, Incoming, Subscriber};
pub use ecod::leadership::links::{DataPlane, LinkState};
pub use ecod::leadership::{BrokerAddress, InvalidAddress};
pub use link::LinkEvent;
pub use probe::probe;
pub use region_inbox::FromRegion;
#[cfg(fuzzing)]
pub use round_signature::splits_as_appended;
pub use security::{ENVELOPE_BYTES, Security, SecurityError};
pub use subscription_role::SubscriptionRole;
